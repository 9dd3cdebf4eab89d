"""The degree of polarization that lasts from frame to frame."""
from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdavis_cv import _kernels
from pdavis_cv._types import State
from pdavis_cv._workers import Workers
from pdavis_cv.analyser import Analyser

FRAMES = 10
"""Memory of the mean and of its variance, frames: half a second of the paper's cameras
(lab.studies.constants)."""

LATE_FRAMES = 2
"""Memory, frames, of the variance that shows at once that the degree has changed.
A mean over the last frame would be of 9 numbers (lab.studies.constants)."""

FIRST_ERROR = 0.1
"""Error of the one comparison that is assumed before the first: the degree has to last
for a frame or two in all neighbours before it counts (lab.studies.constants)."""

SURE = 10.0
"""The degree is used where it is more than this many times its sigma: unpolarized light
with structure has an apparent degree.  Chosen on the real DAVIS346, which has no
polarizers: 5 raises the error of its moving pixels by 0.1 %, 10 by less than 0.03 %
(lab.studies.constants: other cameras)."""

_CELL_NS = 9
"""Time that a macropixel takes in an image, ns."""


class LastingDegree:
    """Degree of polarization of each macropixel as frames tell it, and its variance.

    The angle turns, while the degree is mostly a property of what is seen, and lasts.
    Frames measure it well: the four pixels are exposed at the same time, so that an
    error of time is the same in all of them, while events err in each pixel apart.  How
    well the mean of the last frames predicts the next one is measured in the 3 x 3
    macropixels around each.  Its variance is what this error has in excess of the noise
    of the frame.  Where the degree does not last, that is large, and images stay as
    they are.

    Parameters
    ----------
    shape : (int, int)
        (height, width) of the sensor.
    response : ndarray of float64, shape (2, 2, 3) or (H, W, 3), or None
        Response of each pixel (of the cell) to S0, S1, S2; None: ideal polarizers,
        orthogonal ones on the diagonals.
    """

    def __init__(
        self, shape: tuple[int, int], response: NDArray[np.float64] | None,
    ) -> None:
        size = tuple(side // 2 for side in shape)
        # Mean, frames in it, error of its last prediction; over neighbours, products of
        # errors that follow each other, squared errors and their number, and these two
        # with the short memory.
        self._planes = np.zeros((3 + 3 + 2, *size), np.float32)
        # Degree, variance and share, as `_kernels.lasting_degree` takes them.
        self._lasting = np.zeros((3, *size), np.float32)
        if response is None:
            by_place = Analyser.ideal().response[[0, 1, 3, 2]]  # 0, 90 on a diagonal
        elif response.shape == (2, 2, 3):
            by_place = response.reshape(4, 3)
        else:
            by_place = np.stack([
                np.moveaxis(response[place], -1, 0) for place in _places(shape)])
        analyser = Analyser(by_place)
        one = by_place.shape[2:] or (1, 1)
        # Numbers of each place, as `_kernels.lasting_degree` takes them.
        self._analyser = np.concatenate([
            np.moveaxis(analyser.solution, 0, 1).reshape(-1, *one),
            analyser.response[:, 1:].astype(np.float32).reshape(-1, *one),
            analyser.null().reshape(-1, *one)])

    def add_frame(self, log: NDArray[np.float32]) -> None:
        """Take log intensities at the middle of a frame's exposure, after its update.

        Parameters
        ----------
        log : ndarray of float32, shape (H, W)
            NaN where a pixel has no usable sample.
        """
        if not self._lasting.size:
            return
        light = np.exp([log[place] for place in _places(log.shape)])
        solution = self._analyser[:12].reshape(4, 3, *self._analyser.shape[1:])
        s0, s1, s2 = (solution * light[:, np.newaxis]).sum(0)
        usable = s0 > 0     # NaN is not
        degree = np.hypot(s1, s2) / np.where(usable, s0, 1)
        mean, seen, last, *sums = self._planes
        compared = usable & (seen > 0)
        error = np.where(compared, degree - mean, 0)
        seen = np.minimum(seen + usable, FRAMES)
        mean = mean + np.where(usable, degree - mean, 0) / np.maximum(seen, 1)
        products, squares, number = (
            _sum_around(one) for one in (error * last, error * error, compared))
        product, total, count, late, late_count = sums = [
            (1 - 1 / memory) * one + more for memory, one, more in zip(
                (FRAMES,) * 3 + (LATE_FRAMES,) * 2, sums,
                (products, squares, number, squares, number), strict=True)]
        variance = (total + FIRST_ERROR**2) / (count + 1)
        latest = late / np.maximum(late_count, 1)
        # What errors of consecutive frames share is not noise of a frame.
        own = np.minimum(variance / np.maximum(seen, 1)
                         + np.maximum(product / (count + 1), 0), variance)
        more = mean * mean - SURE**2 * np.maximum(variance, latest)
        share = np.where(more > 0, more / np.where(more > 0, mean * mean, 1), 0)
        # Others may hold the arrays: they are replaced, never changed.
        self._planes = np.stack([mean, seen, error, *sums])
        self._lasting = np.stack([
            mean, np.maximum(own, latest - (variance - own)), share])

    def weigh(
        self, light: NDArray[np.float32], variance: NDArray[np.float32],
        valid: NDArray[np.uint8], workers: Workers,
    ) -> None:
        """Weigh the degree of an image against the one that lasts.

        Intensities of macropixels change in proportion to S1 and S2: S0 and the angle
        remain.

        Parameters
        ----------
        light, variance : ndarray of float32, shape (H, W)
            Intensity, which changes, and the variance of its logarithm.
        valid : ndarray of uint8, shape (H, W)
            1: usable.
        workers : Workers
            Threads that share the work.
        """
        if not self._lasting.size:      # a single row or column
            return
        workers.rows(
            self._lasting.shape[1], lambda first, last: _kernels.lasting_degree(
                self._lasting, self._analyser, (light, variance, valid), (first, last)),
            row_ns=_CELL_NS * self._lasting.shape[2])

    def state(self) -> State:
        """Return the state, which nothing changes later."""
        return {"planes": self._planes, "lasting": self._lasting}

    def restore(self, state: State) -> None:
        """Return to what `state` returned."""
        self._planes, self._lasting = state["planes"], state["lasting"]


def _sum_around(values: NDArray[Any]) -> NDArray[np.float32]:
    """Return the sums of 3 x 3 values, 0 beyond the edge."""
    wide = np.pad(values, 1).astype(np.float32)
    wide = wide[:-2] + wide[1:-1] + wide[2:]
    return np.asarray(wide[:, :-2] + wide[:, 1:-1] + wide[:, 2:])


def _places(shape: tuple[int, int]) -> list[tuple[slice, slice]]:
    """Return the slices of the four places in the macropixels, row by row."""
    rows, columns = (side // 2 * 2 for side in shape)
    return [(slice(i, rows, 2), slice(j, columns, 2)) for i in (0, 1) for j in (0, 1)]
