"""The built-in works: export images, score, measure traces, calibrate."""
from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

import pdavis_cv
from pdavis_cv import export
from pdavis_cv.batch.jobs import Work
from pdavis_cv.calibration.model import Calibration
from pdavis_cv.export.stacks import StackFile
from pdavis_cv.fusion.options import FusionOptions
from pdavis_cv.pixel.model import PixelModel
from pdavis_cv.quantities import chosen
from pdavis_cv.reconstruct.methods import default_method
from pdavis_cv.recording.base import Recording, start_of

if TYPE_CHECKING:   # imported by the workers only
    from pdavis_cv.analysis import LeftOutFrames, Traces
    from pdavis_cv.polarimetry import PolarFrame
    from pdavis_cv.reconstruct.base import Estimate

_STACKS: dict[str, type[StackFile]] = {
    ".npz": export.NpzFile, ".h5": export.Hdf5File, ".ome.tif": export.OmeTiffFile}
_PICTURE = "preview.png"


@dataclass(frozen=True, kw_only=True)
class _Part:
    """The interval of a recording that a work uses: seconds after its first sample."""

    start_s: float | None = None
    stop_s: float | None = None

    def _of(self, recording: Recording, options: FusionOptions) -> FusionOptions:
        changes = {}
        for name, value in (("start_us", self.start_s), ("stop_us", self.stop_s)):
            if value is not None:
                changes[name] = start_of(recording) + round(value * 1e6)
        return options.replace(**changes)


@dataclass(frozen=True, kw_only=True)
class Export(_Part):
    """Export images as a stack of float arrays, with a small picture.

    Parameters
    ----------
    suffix : {".npz", ".h5", ".ome.tif"}
        Format of the stack.
    quantities : tuple of str
        Names from `pdavis_cv.QUANTITIES`.
    start_s, stop_s : float, optional
        Seconds after the recording's first sample, half-open; default all.

    Raises
    ------
    ValueError
        If the suffix or a quantity is unknown.
    """

    suffix: str = ".npz"
    quantities: tuple[str, ...] = ("s0", "aop", "dolp")

    def __post_init__(self) -> None:
        if self.suffix not in _STACKS:
            raise ValueError(
                f"suffix must be one of {', '.join(_STACKS)}, got {self.suffix!r}")
        chosen(self.quantities)

    def __call__(
        self, recording: Recording, options: FusionOptions, folder: Path
    ) -> Mapping[str, Any]:
        """Write ``images`` with the suffix, and with OpenCV ``preview.png``."""
        images = pdavis_cv.fuse(recording, self._of(recording, options))
        first = _first(images)
        facts = export.provenance(
            first.provenance, recording, units=export.units(self.quantities, recording))
        path = folder / f"images{self.suffix}"
        with _STACKS[self.suffix](path, self.quantities, facts) as file:
            file.add(first)
            for image in images:
                file.add(image)
        _draw(first, folder)
        return {"method": first.provenance["method"], "images": file.count,
                "height": first.shape[0], "width": first.shape[1],
                "valid": float(first.valid.mean())}


@dataclass(frozen=True, kw_only=True)
class Trace(_Part):
    """Measure intensity, DoLP and AoP of regions over time.

    Parameters
    ----------
    regions : tuple of str
        Regions in the notation of `analysis.parse_roi`; default: the whole image.
    start_s, stop_s : float, optional
        Seconds after the recording's first sample, half-open; default all.
    """

    regions: tuple[str, ...] = ()

    def __call__(
        self, recording: Recording, options: FusionOptions, folder: Path
    ) -> Mapping[str, Any]:
        """Write ``traces.csv``; figures are means over time."""
        images = pdavis_cv.fuse(recording, self._of(recording, options))
        first = _first(images)
        analysis = pdavis_cv.analysis
        rois = [roi for text in self.regions for roi in analysis.parse_roi(text)]
        height, width = recording.info.sensor_size
        recorder = analysis.TraceRecorder(rois or [analysis.Roi.from_rectangle(
            *(options.roi or (0, 0, width, height)), name="all")])
        recorder.add(first)
        for image in images:
            recorder.add(image)
        traces = recorder.traces(recording)
        export.write_traces(folder / "traces.csv", traces,
                            origin_us=start_of(recording))
        _draw(first, folder)
        return {"method": first.provenance["method"], "images": recorder.count,
                **_means(traces)}


def _means(traces: Traces) -> dict[str, float]:
    """Return means over time: AoP and DoLP of the mean Stokes vector."""
    found: dict[str, float] = {}
    for roi, table in zip(traces.rois, traces.table, strict=True):
        known = table[np.isfinite(table["s0"])]
        s0, s1, s2 = (float(known[name].mean()) if len(known) else np.nan
                      for name in ("s0", "s1", "s2"))
        found |= {f"{roi.name} s0_dn_per_ms": s0,
                  f"{roi.name} dolp": float(np.hypot(s1, s2) / s0),
                  f"{roi.name} aop_deg": float(np.rad2deg(
                      np.mod(np.arctan2(s2, s1) / 2, np.pi))),
                  f"{roi.name} event_rate_hz": float(np.nanmean(table["event_rate"]))
                  if np.isfinite(table["event_rate"]).any() else np.nan}
    return found


@dataclass(frozen=True, kw_only=True)
class Score:
    """Score how well left-out frames are predicted, which needs no ground truth.

    Parameters
    ----------
    seconds : float
        Length of the beginning of the recording that is scored.
    """

    seconds: float = 10.0

    def __call__(
        self, recording: Recording, options: FusionOptions, folder: Path
    ) -> Mapping[str, Any]:
        """Return the scores that ``pdavis score`` prints; write no file."""
        stop_us = start_of(recording) + round(self.seconds * 1e6)
        halves = both_halves(recording, stop_us)
        asked = {one.name: getattr(options, one.name)
                 for one in dataclasses.fields(options)
                 if one.name not in ("fps", "times_us", "start_us", "stop_us",
                                     "parameters", "demosaic")}
        asked |= dict(options.parameters)
        if options.method is None:
            asked["method"] = default_method(halves[0].kept.info)
        scores = pdavis_cv.analysis.pooled(
            one.score(predicted(one, **asked)) for one in halves)
        return {"frames": sum(len(one.times_us) for one in halves), **{
            f"{score.kind} {name}": getattr(score, name) for score in scores
            for name in ("rmse", "bias", "coverage", "pixels")}}


def both_halves(recording: Recording, stop_us: int) -> list[LeftOutFrames]:
    """Return the odd frames before a time left out, and the even ones."""
    return [pdavis_cv.analysis.LeftOutFrames(recording, stop_us=stop_us, half=half)
            for half in pdavis_cv.analysis.HALVES]


def predicted(left_out: LeftOutFrames, **options: Any) -> Iterator[Estimate]:
    """Yield a method's prediction of each left-out frame: the mean of its exposure.

    Predictions are on the clock of the events.  If an offset of the frames' clock is
    found, the times of left-out frames are moved by it like those of the others; for a
    causal method too, which may not have found it yet at that time.

    Parameters
    ----------
    left_out : LeftOutFrames
    **options
        Those of `fuse`.

    Yields
    ------
    Estimate
        In the order of ``left_out.times_us``.
    """
    return left_out.averaged(
        estimate for _, estimate in predicted_images(left_out, **options))


def predicted_images(
    left_out: LeftOutFrames, **options: Any,
) -> Iterator[tuple[PolarFrame, Estimate]]:
    """Yield the super-pixel image and the estimate of each time in an exposure."""
    estimates: list[Estimate] = []
    from pdavis_cv.fusion import Fusion

    options = {**options, "demosaic": "superpixel",
               "method": pdavis_cv.analysis.observed(options["method"], estimates)}
    recording: Recording = left_out.kept
    clock_us = Fusion(recording, **{**options, "causal": False}).clock_offset_us
    times_us = left_out.sample_times_us.ravel() + clock_us
    for image in pdavis_cv.fuse(recording, times_us=times_us, **options):
        model, estimate = image.provenance["parameters"].get("model"), estimates[0]
        if isinstance(model, PixelModel) and estimate.variance is not None:
            log, variance = model.in_frames(estimate.log_intensity, estimate.variance)
            estimate = estimate._replace(log_intensity=log, variance=variance)
        yield image, estimate


@dataclass(frozen=True, kw_only=True)
class Calibrate:
    """Estimate parameters of the camera and write them as a calibration file.

    Parameters
    ----------
    nominal : (float, float)
        Contrast thresholds ON and OFF to start from, natural-log units.
    """

    nominal: tuple[float, float] = (0.2, 0.2)

    def __call__(
        self, recording: Recording, options: FusionOptions, folder: Path
    ) -> Mapping[str, Any]:
        """Write ``camera.npz``, starting from the ``calibration`` of the options."""
        info, known = recording.info, options.calibration
        from pdavis_cv.fusion.learning import learned_camera

        parts, _ = learned_camera(recording, nominal=self.nominal, calibration=known)
        base = known or Calibration(sensor_size=info.sensor_size, serial=info.serial)
        base.merge(Calibration(sensor_size=info.sensor_size, **parts)).save(
            folder / "camera.npz")
        told = {**parts, **parts.get("learned", {})}
        return {name: float(np.median(value)) for name, value in told.items()
                if name not in ("learned", "model")}


def _first(images: Iterable[PolarFrame]) -> PolarFrame:
    image = next(iter(images), None)
    if image is None:
        raise ValueError("the recording holds no image in the interval asked for")
    return image


def _draw(image: PolarFrame, folder: Path) -> None:
    """Write a small picture, if OpenCV is installed."""
    with contextlib.suppress(ImportError):
        export.write_png(folder / _PICTURE, pdavis_cv.render.summary(image))


WORKS: dict[str, Work] = {"export": Export(), "traces": Trace(), "score": Score(),
                          "calibrate": Calibrate()}
"""The built-in works by name, with default parameters."""


def work_of(work: str | Work) -> Work:
    """Return the work of that name; a work is returned as it is."""
    if callable(work):
        return work
    if work not in WORKS:
        raise ValueError(
            f"work must be one of {', '.join(WORKS)} or a function, got {work!r}")
    return WORKS[work]
