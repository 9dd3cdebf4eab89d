"""From an estimate of log intensity to an image of polarization."""
from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pdavis_cv import _kernels
from pdavis_cv._types import Facts
from pdavis_cv._workers import Workers
from pdavis_cv.analyser import Analyser, stokes_gain
from pdavis_cv.calibration.model import Calibration
from pdavis_cv.fusion.camera import analyser_of, gain_of, mismatch_of
from pdavis_cv.fusion.window import Roi, Window
from pdavis_cv.mosaic import (
    HALF_SIZE,
    demosaic as demosaic_mosaic,
    demosaic_valid,
    demosaic_variance,
    places_of,
    scratch_rows,
)
from pdavis_cv.polarimetry import PolarFrame
from pdavis_cv.reconstruct.base import Estimate, Reconstructor
from pdavis_cv.sensor import Layout, Sensor

__all__ = ["ImageMaker", "Samples", "samples_of"]

_BILINEAR_NS = 1.4
"""Time that weighted bilinear demosaicing of a pixel takes, ns (measured)."""


class Samples(NamedTuple):
    """Estimate of a method for the pixels of a window, or of a part of it.

    Parameters
    ----------
    intensity : ndarray of float32, shape (H, W)
        Linear.
    variance : ndarray of float32, shape (H, W), or None
        Variance of its natural log.
    valid : ndarray of bool, shape (H, W)
    quality : ndarray of float32, shape (H, W), or None
    """

    intensity: NDArray[np.float32]
    variance: NDArray[np.float32] | None
    valid: NDArray[np.bool_]
    quality: NDArray[np.float32] | None

    def part(self, rows: slice, columns: slice) -> Samples:
        """Return views of a part."""
        return Samples._make(
            None if plane is None else plane[rows, columns] for plane in self)


def samples_of(method: Reconstructor, t_us: int) -> Samples:
    """Return the estimate of a method that has been fed as far as t_us needs."""
    return _samples(method, method.read(t_us))


def _samples(method: Reconstructor, estimate: Estimate) -> Samples:
    return Samples(method.intensity(estimate.log_intensity), estimate.variance,
                   estimate.valid, method.quality)


class ImageMaker:
    """Demosaic the estimate for a window and make a PolarFrame of it.

    Parameters
    ----------
    window : Window
    roi : (int, int, int, int)
        The region that is the image, (x, y, width, height) on the sensor.
    layout : Layout
        Layout of the whole sensor.
    demosaic : str
        One of ``DEMOSAIC_METHODS``.
    extinction_ratio : float or None
        Contrast that S1 and S2 are corrected for, where there is no analyser matrix.
    calibration : Calibration or None
    sensor : Sensor or None
        Gives the spread of the polarizers; default `Sensor.PDAVIS`.
    workers : Workers
        Threads that share the rows.
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
        # An analyser matrix already includes the mismatch of the pixels.
        spread = mismatch_of(sensor) if self._analyser is None else ()
        self._spread = np.array(spread, np.float32)
        self._gain = gain_of(
            calibration, (window.rows, window.columns), demosaic)
        null = (self._analyser or Analyser.ideal()).null()
        self._null = np.ascontiguousarray(null.reshape(4, *null.shape[1:] or (1, 1)))
        # Rows of the window are rows of the image, each interpolated from neighbours.
        self._whole = demosaic == "bilinear" and self._crop is None
        self._usable: tuple[bytes, NDArray[np.bool_]] | None = None
        self._last: tuple[object, PolarFrame] | None = None
        width, height = roi[2:]
        self.shape = ((height // 2, width // 2) if demosaic in HALF_SIZE
                      else (height, width))

    def _here(
        self, method: Reconstructor, t_us: int, frame_us: int | None,
        provenance: Facts,
    ) -> PolarFrame:
        """Return the image of `begin`, made in this thread."""
        shown = method.shows(t_us)
        if shown is not None and self._last is not None and self._last[0] is shown:
            return self._last[1].retimed(t_us, frame_us, provenance)
        image = self.made(samples_of(method, t_us), t_us, frame_us, provenance)
        self._last = None if shown is None else (shown, image)
        return image

    def begin(
        self, method: Reconstructor, t_us: int, frame_us: int | None,
        provenance: Facts,
    ) -> Callable[[], PolarFrame]:
        """Return a function that returns the image that a method's state gives at t_us.

        Of two threads, the second one may finish it, if that takes long.

        Parameters
        ----------
        method : Reconstructor
            Fed as far as it needs for t_us.
        t_us : int
        frame_us : int or None
            Mid-exposure of the last frame used.
        provenance : mapping of str to object
        """
        queue = self._workers.queue
        if (queue is None or queue.late or not self._whole or self._analyser is not None
                or method.shows(t_us) is not None):
            image = self._here(method, t_us, frame_us, provenance)
            return lambda: image
        estimate = method.read(t_us)
        if estimate.variance is None:
            made = self.made(_samples(method, estimate), t_us, frame_us, provenance)
            return lambda: made
        log: NDArray[np.float32] | None = estimate.log_intensity
        if type(method).intensity is Reconstructor.intensity and self._gain is None:
            intensity = np.empty_like(estimate.log_intensity)
        else:
            log, intensity = None, self._intensity(_samples(method, estimate))
        quad, variance = np.empty((2, 4, *intensity.shape), np.float32)
        aop, dolp = np.empty((2, *intensity.shape), np.float32)
        number = queue.post(
            log, intensity, estimate.variance, places_of(self._layout), self._spread,
            self._null, scratch_rows(6, intensity.shape[1]), quad, variance,
            stokes_gain(self._ratio), aop, dolp)
        about = self._about(
            estimate.valid, method.quality, t_us, frame_us, provenance)

        def finished() -> PolarFrame:
            self._workers.wait(queue, number)
            return PolarFrame.adopt(
                quad, variance=variance, reconciled=True, aop_dolp=(aop, dolp), **about)

        return finished

    def made(
        self, samples: Samples, t_us: int, frame_us: int | None,
        provenance: Facts,
    ) -> PolarFrame:
        """Return the image of samples of the window.

        Parameters
        ----------
        samples : Samples
            Taken over: their arrays belong to the image from here on.
        t_us, frame_us, provenance
            As for `begin`.
        """
        intensity = self._intensity(samples)
        _, variance, usable, quality = samples
        # The arrays are new and nobody else's: the image takes them over.
        about = self._about(usable, quality, t_us, frame_us, provenance)
        if variance is None and self._whole and self._analyser is None:
            return PolarFrame.adopt_mosaic(intensity, self._layout, **about)
        quad, variance = self._channels(intensity, variance, usable)
        return PolarFrame.adopt(
            quad, analyser=self._analyser, variance=variance,
            reconciled=variance is not None, **about)

    def _intensity(self, samples: Samples) -> NDArray[np.float32]:
        """Return the intensity of samples, corrected by the pixels' gains in place."""
        intensity = samples.intensity
        if self._gain is not None:
            intensity /= self._gain
        return intensity

    def _about(
        self, usable: NDArray[np.bool_], quality: NDArray[np.float32] | None,
        t_us: int, frame_us: int | None, provenance: Facts,
    ) -> dict[str, Any]:
        """Return what an image is made with besides its channels."""
        if quality is not None:
            if self._demosaic in HALF_SIZE:
                quality = quality[::2, ::2].copy()
            quality = self._cropped(quality)
        return {"valid": self._valid(usable), "t_us": t_us, "frame_us": frame_us,
                "extinction_ratio": self._ratio, "provenance": provenance,
                "quality": quality}

    def _valid(self, samples: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Return where the image is made of usable samples; cached, as rarely new."""
        same = samples.tobytes()    # compared in half of the time that arrays take
        if self._usable is None or self._usable[0] != same:
            self._usable = same, self._cropped(
                demosaic_valid(samples, self._layout, self._demosaic))
        return self._usable[1]

    def _channels(
        self, intensity: NDArray[np.float32], samples: NDArray[np.float32] | None,
        usable: NDArray[np.bool_],
    ) -> tuple[NDArray[np.float32], NDArray[np.float32] | None]:
        """Return the four intensities of each pixel and, if known, their variances."""
        if samples is None:
            return self._cropped(demosaic_mosaic(
                intensity, self._layout, self._demosaic, valid=usable)), None
        if self._whole:
            quad, variance = np.empty((2, 4, *intensity.shape), np.float32)

            def work(first: int, last: int) -> None:
                _kernels.bilinear_weighted(
                    intensity, samples, places_of(self._layout), self._spread,
                    self._null, (first, last), scratch_rows(2, intensity.shape[1]),
                    quad, variance)

            self._workers.rows(len(intensity), work,
                               row_ns=_BILINEAR_NS * intensity.shape[1])
            return quad, variance
        quad = self._cropped(demosaic_mosaic(
            intensity, self._layout, self._demosaic, valid=usable,
            variance=samples))
        variance = self._cropped(demosaic_variance(
            samples, self._layout, self._demosaic, valid=usable))
        if self._spread.size:
            gain, angle, contrast = self._spread.tolist()
            _kernels.mismatch(quad, gain, angle, contrast, variance)
        # The four channels measure three numbers: weighted least squares.
        _kernels.reconcile(quad, variance, self._null)
        return quad, variance

    def _cropped(self, array: NDArray[Any]) -> NDArray[Any]:
        if self._crop is None:
            return array
        rows, columns = self._crop
        return np.ascontiguousarray(array[..., rows, columns])
