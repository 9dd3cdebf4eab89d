"""Pixels that frames measure badly get their offset from the channels' redundancy."""
from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pdavis_cv import _kernels
from pdavis_cv._types import Events, State
from pdavis_cv._workers import Workers
from pdavis_cv.events import EVENT_DTYPE
from pdavis_cv.pixel.model import PixelModel
from pdavis_cv.reconstruct.frames import log_exposure
from pdavis_cv.reconstruct.redundancy import RATIO_SIGMA, EventRedundancy, null_of
from pdavis_cv.recording.base import ApsFrame

VALID_VARIANCE = 0.25
"""An estimate is valid up to this variance of log intensity (ln^2), without the part
that the uncertain lag adds: a sigma of 0.5 ln (lab.studies.constants)."""

EXCESS = 1.2
"""Inflation of the variance from `EventRedundancy`, which counts its comparisons only.
Engineering choice: the coverage (44 to 57 % within one sigma on `nominal` cameras) asks
for up to 2.5, but in dim light the filter's own variance is too small as well."""

DIM_VARIANCE = 0.04
"""Variance (ln^2) of read and shot noise above which a sample counts as dim: a relative
error of 20 %, reached at 11 DN (lab.studies.constants)."""

EARLY_US = 500_000
"""How much of the events before the first frame is kept, us, as a frame may arrive this
long after its mid-exposure.  Longer than any exposure and readout of these cameras."""

PRIOR_SIGMA = 0.3
"""Prior sigma (ln) if a macropixel's four channels are assumed to have equal mean
squares (lab.studies.constants)."""

COLUMNS = 128
"""Macropixels in a row of the virtual sensor, which threads share by rows: near the
number in a row of the cameras' sensors."""


class Saturated:
    """Estimates log intensity from events where frames measure it badly or not at all.

    The macropixels that have a saturated or dim pixel in the first frame are put side
    by side, as the cells of a virtual sensor, which `EventRedundancy` processes.  If
    there are none, it costs nothing.

    Parameters
    ----------
    shape : (int, int)
        (height, width).
    theta_on, theta_off : float or ndarray of float64, shape (H, W)
        Contrast thresholds, natural-log units.
    response : array_like of shape (2, 2, 3) or (H, W, 3), or None
        As for `EventRedundancy`.
    lookahead_us : int
        How far beyond the time of `fill` the stream will have been fed, us.
    model : PixelModel
        Of the camera.
    ratio_sigma : float
        As for `EventRedundancy`; pixels in dim light have at least its default.
    """

    def __init__(
        self, shape: tuple[int, int], theta_on: ArrayLike, theta_off: ArrayLike,
        response: ArrayLike | None, lookahead_us: int,
        model: PixelModel, ratio_sigma: float,
    ) -> None:
        self.response = None if response is None else np.array(response, np.float64)
        self._shape, self._model = shape, model
        self._thresholds, self._lookahead_us = (theta_on, theta_off), lookahead_us
        self._ratio_sigma = ratio_sigma
        # By pixel of the virtual sensor: its flat sensor index.
        self._grid = np.empty((0, 0), np.intp)
        # [place, i]: flat sensor index of the pixel at that place of macropixel i.
        self._pixels = np.empty((4, 0), np.intp)
        # By macropixel of the sensor: its number i, -1: none.
        self._cell_of = np.empty((0, 0), np.int32)
        self._bound = np.zeros(shape, np.float32)
        self._half = math.inf   # log of half of full scale
        self._level: float | None = None    # log intensity that `_law` is evaluated at
        self._dim = False       # whether most of these pixels are dim, not saturated
        self._early: tuple[NDArray[Any], ...] = ()  # events before the first frame
        self._method: EventRedundancy | None = None
        # Cache of `_missing_of`: its last argument and its result.
        self._filled: tuple[NDArray[np.intp], tuple[
            NDArray[np.uint8], NDArray[np.intp]]] | None = None
        null_of(self.response, shape)  # refuses an impossible response

    def _make(self, pixels: NDArray[np.intp], level: float, dim: bool) -> None:
        """Set up the virtual sensor of n macropixels, flat sensor indices (4, n).

        level is the log intensity that sets the speed of their photoreceptors; dim,
        whether most of their bad samples are dim, not saturated.
        """
        self._pixels, self._level, self._dim = pixels, level, dim
        self._filled = None
        count = pixels.shape[1]
        columns = min(count, COLUMNS)
        rows = -(-count // columns)
        self._cell_of = np.full([side // 2 for side in self._shape], -1, np.int32)
        y, x = np.unravel_index(pixels[0], self._shape)
        self._cell_of[y // 2, x // 2] = np.arange(count)
        # The last row is filled up with the last macropixel, without its events.
        cells = np.minimum(np.arange(rows * columns), count - 1)
        # (place, cell) to (row, column) of all pixels.
        places = pixels[:, cells].reshape(2, 2, rows, columns)
        self._grid = places.transpose(2, 0, 3, 1).reshape(2 * rows, 2 * columns)
        response = self.response
        if response is not None and response.shape != (2, 2, 3):
            response = self._gathered(response)
        on, off = (self._gathered(theta) for theta in self._thresholds)
        self._method = EventRedundancy(
            self._grid.shape, theta_on=on, theta_off=off, response=response,
            lookahead_us=self._lookahead_us, bandwidth=self._law(level),
            ratio_sigma=self._spread(), model=self._model)
        self._method.reads_valid = True

    def _gathered(self, values: ArrayLike) -> NDArray[np.float64]:
        """Return values of the sensor's pixels for those of the virtual sensor."""
        by_pixel = np.broadcast_to(values, self._shape + np.shape(values)[2:])
        return by_pixel.reshape(-1, *by_pixel.shape[2:])[self._grid].astype(np.float64)

    def _law(self, level: float) -> tuple[float, float]:
        # The bandwidth is that at one level of light, as no frame measures the light.
        hz, slope = self._model.bandwidth
        return hz + slope * math.exp(level), 0.0

    def _spread(self) -> float:
        # In dim light leak and noise events, which are not the same in all pixels, are
        # a large part of the events.  The learned spread is that of brighter pixels.
        return max(self._ratio_sigma, RATIO_SIGMA) if self._dim else self._ratio_sigma

    def retune(
        self, model: PixelModel, ratio_sigma: float,
        thresholds: tuple[ArrayLike, ArrayLike],
    ) -> None:
        """Continue with others."""
        self._model, self._ratio_sigma = model, ratio_sigma
        self._thresholds = thresholds
        if self._method is not None and self._level is not None:
            on, off = (self._gathered(theta) for theta in thresholds)
            self._method.retune(
                theta_on=on, theta_off=off, bandwidth=self._law(self._level),
                ratio_sigma=self._spread(), model=model)

    def add_frame(
        self, frame: ApsFrame, sample: NDArray[np.float32], noise: NDArray[np.float32],
        workers: Workers,
    ) -> None:
        """Take a frame: its log samples and their variance, 0 where not usable."""
        # The sample of a saturated pixel is full scale, a lower bound of its light.
        self._bound = np.ascontiguousarray(sample)
        level = math.log(frame.full_scale_dn) - float(log_exposure(frame)[0])
        self._half = level - math.log(2)
        if self._level is None:
            poor = (noise <= 0) | (noise > DIM_VARIANCE)
            pixels = _cells_with(poor)
            if pixels.size:
                # Photoreceptors are the faster, the brighter these pixels are.
                light = min(level, float(np.median(sample[poor])))
                # A saturated pixel's sample is full scale.
                self._make(pixels, light, dim=light < self._half)
            else:
                self._level = level
            # Feed the kept events since the frame's mid-exposure: it may be late.
            early, self._early = self._early, ()
            if early:
                since = max(frame.mid_us, int(early[-1]["t"][-1]) - EARLY_US)
                for events in early:
                    self.add_events(events[events["t"] > since], workers)

    def add_events(self, events: Events, workers: Workers) -> None:
        """Take events that follow everything fed before; threads share the work."""
        if self._level is None and len(events):
            since = int(events["t"][-1]) - EARLY_US
            kept = [each for each in self._early if each["t"][-1] >= since]
            self._early = (*kept, events.copy())
        if self._method is None:
            return
        mine = np.empty(len(events), EVENT_DTYPE)
        n = _kernels.saturated_events(
            events, self._cell_of, self._method.shape[1] // 2, mine)
        if n:
            self._method.workers = workers
            self._method.add_events(mine[:n])

    def settle(self, t_us: int, workers: Workers) -> None:
        """Do pending work (see `Reconstructor.settle`); threads share it."""
        if self._method is not None:
            self._method.workers = workers
            self._method.settle(t_us)

    def fill(
        self, t_us: int, unknown: NDArray[np.intp], log: NDArray[np.float32],
        variance: NDArray[np.float32], valid: NDArray[np.bool_], workers: Workers,
    ) -> None:
        """Combine the filter's estimate and that from events, weighted by variance.

        A pixel that the filter does not know gets the estimate from events if that is
        good enough, and else the last frame's sample, which is a bound (a lower one
        where the pixel saturates).

        Parameters
        ----------
        t_us : int
            Time of the estimate.
        unknown : ndarray of intp, shape (N,)
            Flat indices of the pixels that the filter does not know.  The same array
            object must be passed while they are the same pixels.
        log, variance : ndarray of float32, shape (H, W)
            Log intensity and its variance.
        valid : ndarray of bool, shape (H, W)
            Set where the resulting variance is at most `VALID_VARIANCE`.
        workers : Workers
            Threads that share the work.
        """
        if self._method is None:
            log.ravel()[unknown] = self._bound.ravel()[unknown]
            return
        missing, others = self._missing_of(unknown)
        log.ravel()[others] = self._bound.ravel()[others]
        self._method.workers = workers
        estimate = self._method.read(t_us)
        assert estimate.variance is not None
        _kernels.saturated_fill(
            (self._pixels, missing),
            (estimate.log_intensity, estimate.variance, estimate.valid.view(np.uint8),
             self._method.quality), self._bound, PRIOR_SIGMA**2, EXCESS,
            self._half, VALID_VARIANCE, (log, variance, valid.view(np.uint8)))

    def _missing_of(
        self, unknown: NDArray[np.intp]
    ) -> tuple[NDArray[np.uint8], NDArray[np.intp]]:
        """Return whether each pixel of the macropixels is unknown, and all others."""
        if self._filled is None or self._filled[0] is not unknown:
            missing = np.zeros(self._shape, np.uint8)
            missing.ravel()[unknown] = 1
            cells = missing.ravel()[self._pixels]
            missing.ravel()[self._pixels] = 0
            self._filled = unknown, (cells, np.flatnonzero(missing))
        return self._filled[1]

    def state(self) -> State:
        """Return copies of everything."""
        return {"bound": self._bound, "half": self._half, "pixels": self._pixels,
                "level": self._level, "dim": self._dim, "early": self._early,
                "method": None if self._method is None else self._method.snapshot()}

    def restore(self, state: State) -> None:
        """Return to what `state` returned, which is copied."""
        self._bound, self._level = state["bound"], state["level"]
        self._half = state["half"]
        self._early, self._method = state["early"], None
        if state["method"] is not None:
            self._make(state["pixels"], state["level"], state["dim"])
            assert self._method is not None
            self._method.restore(state["method"])


def _cells_with(marked: NDArray[np.bool_]) -> NDArray[np.intp]:
    """Return the flat indices (4, n) of the pixels of macropixels with a marked one."""
    rows, columns = (side // 2 for side in marked.shape)
    pairs = marked[:2 * rows:2, :2 * columns] | marked[1:2 * rows:2, :2 * columns]
    row, column = np.nonzero(pairs[:, ::2] | pairs[:, 1::2])
    return np.stack([np.ravel_multi_index((2 * row + i, 2 * column + j), marked.shape)
                     for i in (0, 1) for j in (0, 1)])
