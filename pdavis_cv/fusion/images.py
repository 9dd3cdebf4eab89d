"""From an estimate of log intensity to an image of polarization."""
from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdavis_cv import _kernels
from pdavis_cv._types import Facts
from pdavis_cv._workers import Workers
from pdavis_cv.analyser import Analyser, stokes_gain
from pdavis_cv.calibration.model import Calibration
from pdavis_cv.fusion.camera import analyser_of, gain_of
from pdavis_cv.fusion.window import Roi, Window
from pdavis_cv.mosaic import (
    HALF_SIZE,
    demosaic as demosaic_mosaic,
    demosaic_valid,
    demosaic_variance,
    places_of,
    scratch_rows,
)
from pdavis_cv.polarimetry import PolarFrame, adopted, adopted_colours, retimed
from pdavis_cv.reconstruct.base import Reconstructor, Shown
from pdavis_cv.sensor import Layout, Sensor

_BILINEAR_NS = 1.4
"""Time that weighted bilinear demosaicing of a pixel takes, ns (measured)."""


class ImageMaker:
    """Demosaic the estimate for a window and make a PolarFrame of it.

    The image is the region `roi` (x, y, width, height) on the sensor, whose layout is
    given.  S1 and S2 are corrected for the extinction ratio, where the calibration has
    no analyser matrix.  The sensor, by default `Sensor.PDAVIS`, gives the spread of the
    pixels.
    """

    def __init__(
        self, window: Window, roi: Roi, layout: Layout, demosaic: str,
        extinction_ratio: float | None, calibration: Calibration | None,
        sensor: Sensor | None, workers: Workers,
    ) -> None:
        self._workers = workers
        self._layout, self._demosaic = window.layout(layout), demosaic
        self._crop = window.crop_of(roi, demosaic)
        self._analyser = analyser_of(
            calibration, (window.rows, window.columns), self._layout, demosaic,
            self._crop)
        self._ratio = extinction_ratio if self._analyser is None else None
        self._spread = np.array(mismatch_of(sensor, calibration), np.float32)
        self._gain = gain_of(calibration, (window.rows, window.columns), demosaic)
        null = (self._analyser or Analyser.ideal()).null()
        self._null = np.ascontiguousarray(null.reshape(4, *null.shape[1:] or (1, 1)))
        # Rows of the window are rows of the image, each interpolated from neighbours.
        self._whole = demosaic == "bilinear" and self._crop is None
        self._usable: tuple[bytes, NDArray[np.bool_]] | None = None
        self._last: tuple[object, PolarFrame] | None = None
        width, height = roi[2:]
        self.shape = ((height // 2, width // 2) if demosaic in HALF_SIZE
                      else (height, width))

    def begin(
        self, method: Reconstructor, t_us: int, frame: tuple[int, int, float] | None,
        provenance: Facts,
    ) -> PolarFrame | Callable[[], PolarFrame]:
        """Return the image that a method's state, fed for t_us, gives, or its maker.

        `frame` is mid-exposure, arrival and exposure (ms) of the last frame used, which
        turns the spread of offsets into that of intensities.  The result is an image
        that is held, or a function that makes one: it may be called in another thread
        while the state goes on, and more than once.
        """
        frame_us, spread = None if frame is None else frame[0], self._spread.copy()
        spread[3] *= 0 if frame is None or not method.needs.frames else 1 / frame[2]
        shown = method.shows(t_us)
        if shown is not None and self._last is not None and self._last[0] is shown:
            return retimed(self._last[1], t_us, frame_us, provenance)
        read, quality = method.begin_read(t_us), method.quality

        def made() -> PolarFrame:
            return self._made(read(), quality, spread, t_us=t_us,
                              frame_us=frame_us, provenance=provenance)

        if shown is None:
            return made
        self._last = shown, made()
        return self._last[1]

    def _made(
        self, shown: Shown, quality: NDArray[np.float32] | None,
        spread: NDArray[np.float32], **about: Any,
    ) -> PolarFrame:
        intensity, samples, usable = shown
        if self._gain is not None:
            intensity /= self._gain
        # The arrays are new and nobody else's: the image takes them over.
        about |= {"valid": self._valid(usable),
                  "extinction_ratio": self._ratio, "quality": self._quality(quality)}
        if self._layout.colours:
            return adopted_colours(self._cropped(demosaic_mosaic(
                intensity, self._layout, self._demosaic, valid=usable)),
                **about)
        if samples is not None and self._whole:
            return self._in_one_pass(intensity, samples, spread, about)
        quad, variance = self._channels(intensity, samples, usable, spread)
        return adopted(
            quad, analyser=self._analyser, variance=variance, places_differ=True,
            reconciled=variance is not None, **about)

    def _in_one_pass(
        self, intensity: NDArray[np.float32], samples: NDArray[np.float32],
        spread: NDArray[np.float32], about: dict[str, Any],
    ) -> PolarFrame:
        """Return the image of uncertain samples; of several threads, with its angle."""
        quad, variance = np.empty((2, 4, *intensity.shape), np.float32)
        polarizes = self._analyser is None and self._workers.threads > 1
        aop, dolp = np.empty((2, *(intensity.shape if polarizes else (0, 0))),
                             np.float32)

        def work(first: int, last: int) -> None:
            _kernels.bilinear_weighted(
                intensity, samples, places_of(self._layout), spread, self._null,
                (first, last), scratch_rows(2, intensity.shape[1]), quad, variance,
                stokes_gain(self._ratio), aop, dolp)

        self._workers.rows(len(intensity), work,
                           row_ns=_BILINEAR_NS * intensity.shape[1])
        return adopted(
            quad, analyser=self._analyser, variance=variance, reconciled=True,
            places_differ=True, aop_dolp=(aop, dolp) if polarizes else None, **about)

    def _quality(
        self, samples: NDArray[np.float32] | None
    ) -> NDArray[np.float32] | None:
        if samples is not None and self._demosaic in HALF_SIZE:
            samples = samples[::2, ::2].copy()
        return None if samples is None else self._cropped(samples)

    def _valid(self, samples: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Return where the image is made of usable samples; cached, as rarely new."""
        same = samples.tobytes()    # compared in half of the time that arrays take
        known = self._usable    # another thread may replace it
        if known is None or known[0] != same:
            self._usable = known = same, self._cropped(
                demosaic_valid(samples, self._layout, self._demosaic))
        return known[1]

    def _channels(
        self, intensity: NDArray[np.float32], samples: NDArray[np.float32] | None,
        usable: NDArray[np.bool_], spread: NDArray[np.float32],
    ) -> tuple[NDArray[np.float32], NDArray[np.float32] | None]:
        """Return the four intensities of each pixel and, if known, their variances."""
        quad = self._cropped(demosaic_mosaic(
            intensity, self._layout, self._demosaic, valid=usable, variance=samples))
        if samples is None:
            return quad, None
        variance = self._cropped(demosaic_variance(
            samples, self._layout, self._demosaic, valid=usable))
        gain, angle, contrast, offset = spread.tolist()
        _kernels.mismatch(quad, gain, angle, contrast, offset, variance)
        # The four channels measure three numbers: weighted least squares.
        _kernels.reconcile(quad, variance, self._null)
        return quad, variance

    def _cropped(self, array: NDArray[Any]) -> NDArray[Any]:
        if self._crop is None:
            return array
        rows, columns = self._crop
        return np.ascontiguousarray(array[..., rows, columns])


def mismatch_of(
    sensor: Sensor | None, calibration: Calibration | None,
) -> tuple[float, float, float, float]:
    """Return the spread of gain, angle (radians), contrast and offset (DN) of pixels.

    What was calibrated has none.
    """
    if sensor is None or sensor.extinction_ratio is None:
        sensor = Sensor.PDAVIS
    gain, angle_deg, ratio = sensor.mismatch
    contrast = 2 * ratio / ((sensor.extinction_ratio or math.inf) + 1) ** 2
    if calibration is not None and calibration.analyser is not None:
        gain = angle_deg = contrast = 0.0
    known = calibration is not None and calibration.dark is not None
    return gain, math.radians(angle_deg), contrast, 0.0 if known else sensor.offset_dn
