"""Pixels that no frame has measured: offsets from the channels' redundancy."""
from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pdavis_cv.reconstruct.frames import log_exposure
from pdavis_cv.reconstruct.redundancy import EventRedundancy, null_of
from pdavis_cv.recording.base import ApsFrame

__all__ = ["VALID_VARIANCE", "Saturated"]

VALID_VARIANCE = 0.25
"""An estimate is valid up to this variance of log intensity, lag apart."""

PRIOR_SIGMA = 0.3
"""Of a log intensity, where the mean squares of a macropixel's four are taken equal."""


class Saturated:
    """What is known of pixels that have never had a usable sample.

    Only the events of macropixels with such a pixel are looked at, from the first
    frame on; where every pixel has had a sample this costs next to nothing.

    Parameters
    ----------
    shape : (int, int)
        (height, width).
    theta_on, theta_off : float or ndarray of float64, shape (H, W)
        Contrast thresholds, natural-log units.
    response : array_like of shape (2, 2, 3) or (H, W, 3), or None
        As for `EventRedundancy`.
    lookahead_us : int
        What will have been fed after the time of `fill`.
    bandwidth : (float, float, float)
        As for `KalmanFilter`.
    """

    def __init__(
        self, shape: tuple[int, int], theta_on: ArrayLike, theta_off: ArrayLike,
        response: ArrayLike | None, lookahead_us: int,
        bandwidth: tuple[float, float, float],
    ) -> None:
        self.response = None if response is None else np.array(response, np.float64)
        self._shape, self._bandwidth = shape, bandwidth
        self._options: dict[str, Any] = {"theta_on": theta_on, "theta_off": theta_off,
                         "lookahead_us": lookahead_us, "response": self.response}
        self._never = np.ones(shape, np.bool_)
        self._watched = np.zeros(shape, np.bool_)
        self._bound = np.zeros(shape, np.float32)
        self._method: EventRedundancy | None = None
        null_of(self.response, shape)  # refuses an impossible response

    def _make(self, level: float) -> EventRedundancy:
        # The photoreceptors are as fast as the least light that saturates makes them.
        hz, slope, sigma = self._bandwidth
        return EventRedundancy(
            self._shape, bandwidth=(hz + slope * math.exp(level), 0.0, sigma),
            **self._options)

    def add_frame(
        self, frame: ApsFrame, sample: NDArray[np.float32], usable: NDArray[np.bool_]
    ) -> None:
        """Note which pixels this frame measures; sample is what `log_samples` gives."""
        self._never &= ~usable
        self._watched = _cells_with(self._never)
        # Of pixels that are not usable the converter's end: a bound is all there is.
        self._bound = sample
        if self._method is None and self._watched.any():
            self._method = self._make(
                math.log(frame.full_scale_dn) - float(log_exposure(frame)[0]))

    def add_events(self, events: NDArray[Any]) -> None:
        """Take events, after those and the frames before."""
        if self._method is None or not self._watched.any():
            return
        mine = events[self._watched[events["y"], events["x"]]]
        if len(mine):
            self._method.add_events(mine)

    def fill(
        self, t_us: int, log: NDArray[np.float32], variance: NDArray[np.float32],
        valid: NDArray[np.bool_],
    ) -> None:
        """Complete an estimate where its variance is negative: nothing is known.

        There it becomes the last frame's sample, which is a bound (a lower one where
        the pixel saturates), and where the events tell enough, what they tell.

        Parameters
        ----------
        t_us : int
            Time of the estimate.
        log, variance : ndarray of float32, shape (H, W)
            Log intensity and its variance.
        valid : ndarray of bool, shape (H, W)
            Set where the variance is then at most `VALID_VARIANCE`.
        """
        unknown = variance < 0
        if not unknown.any():
            return
        log[unknown] = self._bound[unknown]
        if self._method is None:
            return
        shown, rest, enough = self._method.read(t_us)
        assert rest is not None
        rows, columns = (side // 2 for side in self._shape)
        whole = np.zeros(self._shape, np.bool_)
        whole[:2 * rows, :2 * columns] = True
        unknown &= whole
        # The offset of a macropixel: from the pixels that are known, else the bound.
        known = (whole & ~unknown)[:2 * rows, :2 * columns]
        apart = np.where(known, (log - shown)[:2 * rows, :2 * columns], 0)
        count = _summed(known.astype(np.float32))
        bound = _summed(self._bound[:2 * rows, :2 * columns]) / 4
        offset = np.where(count > 0, _summed(apart) / np.maximum(count, 1), bound)
        at = np.nonzero(unknown & enough)
        log[at] = shown[at] + offset[at[0] // 2, at[1] // 2]
        # Where the gains are less certain, the prior of equal mean squares has a say.
        variance[at] = rest[at] + PRIOR_SIGMA**2 * self._method.quality[at]
        valid[at] = variance[at] <= VALID_VARIANCE

    def state(self) -> Mapping[str, Any]:
        """Return copies of everything."""
        return {"never": self._never.copy(), "bound": self._bound,
                "method": None if self._method is None else self._method.snapshot()}

    def restore(self, state: Mapping[str, Any]) -> None:
        """Take over copies of what `state` returned."""
        self._never[:] = state["never"]
        self._bound, snapshot = state["bound"], state["method"]
        self._watched = np.zeros(self._shape, np.bool_)
        self._method = None
        if snapshot is not None:
            self._watched = _cells_with(self._never)
            self._method = EventRedundancy(
                self._shape, bandwidth=snapshot.parameters["bandwidth"],
                **self._options)
            self._method.restore(snapshot)


def _summed(plane: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the sums over macropixels of a plane of even size."""
    rows, columns = plane.shape
    total: NDArray[np.float32] = plane.reshape(
        rows // 2, 2, columns // 2, 2).sum((1, 3))
    return total


def _cells_with(marked: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return the pixels of whole macropixels with a marked one."""
    rows, columns = (side // 2 for side in marked.shape)
    out = np.zeros(marked.shape, np.bool_)
    even = marked[:2 * rows, :2 * columns]
    if even.any():
        pairs = even[::2] | even[1::2]
        cells = pairs[:, ::2] | pairs[:, 1::2]
        out[:2 * rows, :2 * columns] = cells.repeat(2, 0).repeat(2, 1)
    return out
