"""Records of the increments' filter, and a frame that waits in it."""
from __future__ import annotations

import copy

import numpy as np
from numpy.typing import NDArray

from pdavis_cv._types import Records
from pdavis_cv.pixel.model import SAMPLES, SHORT_US, PixelModel
from pdavis_cv.reconstruct.frames import log_exposure, usable_samples
from pdavis_cv.recording.base import ApsFrame

_COVARIANCES = 6    # of level and both gains: a triangle of 3 x 3

NODE_DTYPE = np.dtype([
    ("mean", "<f8"), ("light", "<f8", 2), ("open_t", "<i8"),
    ("around_t", "<i8"), ("open_variance", "<f4"), ("middle", "<f4")],
    align=True)
ANCHOR_DTYPE = np.dtype([
    ("log", "<f4"), ("gain", "<f4", 2), ("p", "<f4", _COVARIANCES), ("hot", "<f4"),
    ("motion", "<f4"), ("sampled", "<f4")])
SHOWN_DTYPE = np.dtype([
    ("last", "<i8"), ("next", "<i8"), ("ahead", "<f4"), ("behind", "<f4"),
    ("p_behind", "<f4"), ("p", "<f4", 3), ("gains", "<f4", 3), ("since", "<f4", 2),
    ("until", "<f4", 2), ("theta", "<f4", 2), ("corner", "<f4"), ("before", "<f4"),
    ("next_weight", "<f4"), ("drift", "<f4"), ("opened", "<f4"), ("sign", "i1"),
    ("next_sign", "i1"), ("context", "i1"), ("state", "i1")], align=True)
COURSE_DTYPE = np.dtype([
    ("until", "<i8"), ("origin", "<i8"), ("last", "<i8"), ("level", "<f8", 3),
    ("rise", "<f4", 3), ("bend", "<f4", 3), ("open", "<f4", (3, 3)), ("before", "<f4"),
    ("sign", "i1"), ("context", "i1")], align=True)
"""Records of _kernels/_increments.pxd, which says what their fields are."""


Hole = tuple[float, float, float]   # see Waiting
NO_HOLE = 0.0, 0.0, 0.0


class Waiting:
    """A frame, and what the events say in its exposure.

    Parameters
    ----------
    frame : ApsFrame
        As read out.
    model : PixelModel
        Gives its noise, and the light that it lacks.
    gains : ndarray of float32, shape (H, W, 2)
        Of the pixels' thresholds, about which the mean over the exposure is linear.
    """

    def __init__(
        self, frame: ApsFrame, model: PixelModel, gains: NDArray[np.float32],
    ) -> None:
        self.frame, self.gains = frame, gains
        # Of the columns: begin and end of the exposure, and its middle.
        self.times = np.stack([
            np.broadcast_to(time, frame.shape[1:]) for time in (
                frame.exposure_start_us, frame.exposure_end_us, frame.column_mid_us)
        ]).astype(np.int64)
        self.begin_us, self.mid_us = int(self.times[0].min()), int(self.times[2].max())
        self.end_us = int(self.times[1].max())
        longest = int((self.times[1] - self.times[0]).max())
        # Number of times in the exposure at which light is evaluated.
        self.samples = 1 if longest <= SHORT_US else SAMPLES
        self.arrived_us = frame.available_us
        self.nodes = np.zeros(frame.shape, NODE_DTYPE)
        # ln DN/ms, its variance, and what other times and pixels say since `after_us`.
        self.sample = np.zeros((3, *frame.shape), np.float32)
        self.around: NDArray[np.float64] | None = None  # see `increments_node`
        self.after_us: int | None = None    # the frame before
        self.known_us: int | None = None    # up to which events have been looked at
        self.lit = False        # whether the lamp's ripple is in the nodes
        # Since the frame before: begin and end (us) of where events are missing, and by
        # how much more noise (8) grows there.
        self.hole: Hole = NO_HOLE
        self.set_model(model)

    def set_model(self, model: PixelModel) -> None:
        """Compute log light and its noise."""
        frame, dn = self.frame, self.frame.dn
        ms = np.exp(log_exposure(frame))
        full = np.maximum(dn + np.float32(model.black) * ms, 1)
        usable = (usable_samples(frame) > 0) & (dn >= 1)
        self.sample[0] = np.log(full) - np.log(ms)
        self.sample[1] = np.where(usable, model.frame_variance(dn, ms), 0)

    @property
    def arrays(self) -> tuple[object, ...]:
        """As kernels take them."""
        return (self.nodes, self.sample, self.gains, self.times, self.samples,
                self.around, 1e-6 * self.hole[2] * (self.hole[1] - self.hole[0]))

    def copy(self) -> Waiting:
        """Return an independent copy."""
        other = copy.copy(self)
        other.nodes, other.sample = self.nodes.copy(), self.sample.copy()
        other.around = None if self.around is None else self.around.copy()
        return other


def between(
    before: Waiting | None, later: list[Waiting], ended: Records,
    shape: tuple[int, int], t_us: int, hole: Hole,
) -> tuple[object, object, Records, NDArray[np.float64], bool]:
    """Return frames before and after a time, as kernels take them, and their middles.

    A frame before that is not there has no sample.  Middles are (2, W), and where they
    would be if noise grew all along as at t_us.  Last is whether only one is after.
    """
    here = np.full(shape[1], t_us)
    middles = np.stack([here if before is None else before.times[2],
                        later[0].times[2] if later else here]).astype(np.float64)
    begin, end, more = hole
    grown = more * (np.clip(middles, begin, end) - min(max(t_us, begin), end))
    here = (middles - t_us + grown) / (1 + more * (begin <= t_us < end))
    middles = np.concatenate([middles, t_us + here])
    arrays = (
        np.zeros(shape, NODE_DTYPE), np.zeros((3, *shape), np.float32),
        np.zeros((*shape, 2), np.float32), np.zeros((3, shape[1]), np.int64), 1,
        later[0].around if later else np.zeros((3, *shape)), 0.0
    ) if before is None else before.arrays
    return arrays, later[0].arrays if later else None, ended, middles, len(later) < 2


def thresholds_of(
    anchors: Records, model: PixelModel
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return `KalmanFilter.thresholds`."""
    thetas = model.thresholds[::-1, None, None] * (1 + np.moveaxis(
        anchors["gain"][..., ::-1].astype(np.float64), -1, 0))
    own = np.where(anchors["sampled"][..., None] > 0, anchors["p"][..., 3:],
                   model.spread**2 * np.array([1.0, 0.0, 1.0]))
    relative = own[..., [[2, 1], [1, 0]]] + (model.theta_cov / np.outer(
        model.theta, model.theta))[::-1, ::-1]
    return thetas, relative * np.einsum("iyx,jyx->yxij", thetas, thetas)
