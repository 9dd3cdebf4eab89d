"""Amplitude and phase of a load, from the frames alone."""
from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdavis_cv import PolarFrame, Recording, analysis, fuse
from pdavis_cv.fusion.camera import chosen_layout, chosen_sensor
from pdavis_cv.fusion.images import mismatch_of
from pdavis_cv.mosaic import HALF_SIZE
from pdavis_cv.sensor import Sensor

from .._options import calibration_of

FloatArray = NDArray[np.float64]

_RATIO, _CONTRAST_SIGMA = 34.5, 0.010
"""Where no extinction ratio is stated, the middle of the published ones of the PDAVIS,
25 to 44: the sensor's holds at the best wavelength.  And the rms error of the contrast
if they are uniform in their logarithm."""
_COMMON_OFFSET = 1 / 2
"""Offset that all pixels share, relative to its spread: without dark frames."""


def assume_ratio(recording: Recording, options: dict[str, Any]) -> list[str]:
    """Set the extinction ratio in arguments of fuse() if none is known, and say so."""
    calibration = options["calibration"]
    if options["extinction_ratio"] != "nominal" or (
            calibration is not None and calibration.analyser is not None) or (
            chosen_sensor(options["layout"], recording) != Sensor.PDAVIS):
        return []
    options["extinction_ratio"] = _RATIO
    return [f"extinction ratio assumed ({_RATIO:g}, the middle of 25 to 44)"]


class Frames:
    """Frames of a recording as images at the middles of their exposures.

    Without frames the options are those of fused images, which count as frames of no
    exposure.  `background` are S0, S1, S2 without the sample.
    """

    def __init__(
        self, recording: Recording, options: dict[str, Any], background: Any
    ) -> None:
        self._recording, self.options = recording, options
        self._background = background
        frames = [] if options["method"] != "frames" else [
            frame for packet in recording.packets() for frame in packet.frames]
        self._mid = np.array([frame.mid_us for frame in frames], np.int64)
        self._exposure = np.array([
            np.mean(np.subtract(frame.exposure_end_us, frame.exposure_start_us))
            for frame in frames])
        self.column_s = (frames[0].column_mid_us - frames[0].mid_us) / 1e6 if (
            frames) else np.zeros(recording.info.sensor_size[1])

    def exposure_us(self, t_us: NDArray[np.int64]) -> FloatArray:
        """Return the exposures at times."""
        if not self._mid.size:
            return np.zeros(len(t_us))
        return np.asarray(np.interp(t_us, self._mid, self._exposure), np.float64)

    def images(
        self, demosaic: str | None = None
    ) -> Iterator[tuple[PolarFrame, FloatArray]]:
        """Yield images with a valid pixel, and their S0, S1, S2."""
        options = {**self.options, "demosaic": demosaic or self.options["demosaic"]}
        for image in fuse(self._recording, **options):
            if image.valid.any():
                stokes = np.stack((image.s0, image.s1, image.s2)).astype(np.float64)
                if self._background is not None:
                    stokes = analysis.subtract_background(stokes, self._background)
                yield image, stokes


@dataclass(frozen=True, eq=False)
class PeriodicLight:
    """What frames say of the regions, and of each pixel.

    `fit` is that of the R regions, `t_us` the times of the T frames, `stokes` the mean
    S0, S1, S2 of the regions, float64 (R, T, 3), `pixels` the number that is valid in
    all frames, int64 (R,).  `errors` are those of camera, polarizers and demosaicing,
    of each region in `fit`.  `maps` are of each pixel, smoothed; None if no harmonic is
    resolved; `raw_mean` is the mean S0, S1, S2, not smoothed, float64 (3, H, W).
    """

    fit: analysis.Periodic
    t_us: NDArray[np.int64]
    stokes: FloatArray
    pixels: NDArray[np.int64]
    errors: list[FloatArray]
    maps: analysis.Harmonics | None
    raw_mean: FloatArray


def measure(
    args: argparse.Namespace, recording: Recording, frames: Frames, demosaic: str,
    regions: list[analysis.Roi], hz: float, reference_us: int,
) -> PeriodicLight:
    """Fit the regions, demosaiced as stated, then each pixel of ``frames``.

    `hz` is the load's frequency, `reference_us` the time of phase 0.
    """
    always: NDArray[np.bool_] | None = None
    for image, _ in frames.images(demosaic):
        always = image.valid.copy() if always is None else always & image.valid
        last = image
    assert always is not None
    x0, scale = _place(last)
    origin = x0, int(last.provenance.get("roi", (0, 0))[1])
    masks = [roi.mask((last.shape[0], last.shape[1]), origin=origin, scale=scale)
             for roi in regions]
    inside = [mask & always if (mask & always).any() else mask for mask in masks]
    made = [(int(image.t_us or 0), [stokes[:, mask].mean(1) for mask in inside])
            for image, stokes in frames.images(demosaic)]
    t = np.array([when for when, _ in made], np.int64)
    stokes = np.array([values for _, values in made]).transpose(1, 0, 2)
    exposure = frames.exposure_us(t)
    fit = analysis.fit_periodic(t, stokes, exposure, hz, reference_us)
    running = analysis.HarmonicFit(
        always.shape, fit.law, harmonics=fit.harmonics, degree=fit.degree,
        span_us=(int(t[0]), int(t[-1])))
    for (image, planes), open_us in zip(frames.images(), exposure, strict=True):
        running.add(int(image.t_us or 0), planes, float(open_us), image.valid)
    whole = running.result()
    delay = frames.column_s[x0:x0 + always.shape[1] * scale:scale]
    if np.any(delay):
        whole = whole.delayed(delay)
    pixels = np.array([int(mask.sum()) for mask in inside])
    fit = replace(fit, regions=tuple(      # with the mean delay of their columns
        one.delayed(np.average(delay, weights=mask.sum(0)))
        for one, mask in zip(fit.regions, inside, strict=False)))
    return PeriodicLight(
        fit, t, stokes, pixels,
        _errors(args, recording, fit, whole, inside, last, exposure),
        whole.smoothed(args.smooth) if fit.harmonics else None,
        whole.coefficients[:, 0])


def _place(image: PolarFrame) -> tuple[int, int]:
    """Return the sensor's column at which an image begins, and pixels per pixel."""
    scale = 2 if image.provenance.get("demosaic") in HALF_SIZE else 1
    return int(image.provenance.get("roi", (0, 0))[0]), scale


def _errors(
    args: argparse.Namespace, recording: Recording, fit: analysis.Periodic,
    maps: analysis.Harmonics, masks: list[NDArray[np.bool_]], image: PolarFrame,
    exposure_us: FloatArray,
) -> list[FloatArray]:
    """Return the errors of camera, polarizers and demosaicing in each region."""
    calibration = calibration_of(args.calibration) if args.calibration else None
    sensor = recording.info.sensor or Sensor.PDAVIS
    gain, angle, contrast, dark = mismatch_of(sensor, calibration)
    dark /= max(float(exposure_us.mean()) / 1e3, 1e-3)
    common = _CONTRAST_SIGMA if args.extinction_ratio is None and (
        image.provenance["extinction_ratio"] == _RATIO) else 0.0
    if calibration is not None and calibration.analyser is not None:
        common = 0.0
    scale, found = _place(image)[1], []
    sampled: list[FloatArray] = []
    if scale == 1 and fit.regions:
        layout = chosen_layout(args.layout, calibration, recording)
        sampled = analysis.mosaic_errors(
            maps, masks, layout.crop(*image.provenance["roi"][:2]),
            str(image.provenance["demosaic"]))
    for i, (one, mask) in enumerate(zip(fit.regions, masks, strict=False)):
        offset = dark / max(float(one.coefficients[0, 0]), 1e-9)
        found.append(np.concatenate((*sampled[i:i + 1], analysis.specimen_errors(
            one, gain, angle, contrast, offset,
            samples=max(mask.sum() * scale ** 2 / 4, 1), common_contrast=common,
            common_offset=offset * _COMMON_OFFSET))))
    return found
