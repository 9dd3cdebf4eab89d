"""Measure a loaded sample: traces of regions, the load's frequency, maps, a report.

Amplitude and phase of a periodic load are measured with the frames, traces also with
the fused images.  The folder OUT receives results.csv (one row per region) and
results.json, maps.ome.tif, traces.csv and frames.csv (one row per region and time; also
in jAER's dialect), cycle.csv, loop.csv if the load's lag is known, tendon.webm, and
report.html, which contains all figures and needs no other files.
"""
from __future__ import annotations

import argparse
import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pdavis_cv import (
    AnalysisWarning,
    Layout,
    PolarFrame,
    Recording,
    analysis,
    export,
    fuse,
)
from pdavis_cv._beside import all_or_none
from pdavis_cv._opencv import opencv
from pdavis_cv.export.ometiff import tifffile
from pdavis_cv.recording.base import start_of

from .._common import Parser, UsageError, add_json_option, command, tell
from .._images import facts_of, grid_times, held_at, of_frames, told_if_nothing
from .._options import add_file, add_fuse_options, fuse_options, opened
from .._progress import progress, stage
from .._values import number, positive, seconds, within
from . import force, periodic, report, results
from .findings import Findings
from .video import TendonSheet

_SAME = 0.1     # relative difference of frequencies that mean the same
_STATED = 0.02  # to which a stated one is taken to be right
_EXACT = 0.25   # cycles over the record that events do not tell apart


@command
def main(argv: Sequence[str] | None = None) -> int:
    """Run ``pdavis tendon``."""
    args = parser().parse_args(argv)
    if (args.thickness_um is None) != (args.wavelength_nm is None):
        raise UsageError("--thickness-um and --wavelength-nm belong together")
    report.matplotlib()  # report a missing package before the work
    opencv()
    tifffile()
    load = None if args.load is None else analysis.read_load(args.load)
    args.out.mkdir(parents=True, exist_ok=True)
    with all_or_none():
        with opened(args) as recording:
            findings = measure(args, recording, load)
        written = results.write(args, findings)
        if not args.no_video:
            written.append(args.out / "tendon.webm")
        stage("report")
        written.append(args.out / "report.html")
        report.write_report(written[-1], findings)
    lines, facts = report.summary(findings)
    tell(args, [*(f"wrote {path}" for path in written), *lines], wrote=written, **facts)
    return 0


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    parser = Parser(
        "tendon", __doc__ or "",
        "pdavis tendon tendon.aedat4 -o tendon --region fibre=120,80,40,24 "
        "--fps 100")
    add = parser.add_argument
    add_file(parser, "a recording with frames and events")
    add("-o", "--out", type=Path, required=True, metavar="OUT",
        help="folder to write to")
    add("--region", action="append", default=[], type=_regions, metavar="ROI",
        help="[name=]x,y,w,h or [name=]x1,y1;x2,y2;... or a Fiji .roi or .zip or a "
             ".geojson; repeatable; default the whole image")
    add("--estimate", choices=("stokes", "pixels"), default="stokes",
        help="DoLP and AoP of the mean Stokes vector, or their mean over pixels")
    add("--load-hz", type=positive, metavar="HZ",
        help="frequency of the load, to 2 %%; default: the strongest in DoLP")
    add("--smooth", type=int, choices=(1, 3, 5, 7), default=7, metavar="N",
        help="average the maps over N x N pixels: 1, 3, 5 or 7; default 7")
    add("--background", metavar="FILE", help="a recording of the light without the "
        "sample: its S1/S0 and S2/S0 are subtracted")
    add("--thickness-um", type=number, metavar="UM",
        help="thickness of the sample, for the birefringence")
    add("--wavelength-nm", type=number, metavar="NM",
        help="wavelength of the light, for the birefringence")
    load = parser.add_argument_group("load file").add_argument
    load("--load", metavar="CSV", help="force or displacement over time")
    load("--align", choices=("trigger", "offset", "correlation"),
         help="how to align its clock; default: by triggers if both have them, by "
              "--offset if it is given, else by correlation with DoLP")
    load("--offset", type=seconds, metavar="S", help="time of the recording at the "
         "file's zero, or that of an event in the recording less that in the file")
    load("--within", type=seconds, metavar="S", help="search by correlation within "
         "this of --offset; .5 with --align correlation")
    load("--load-sign", type=int, choices=(1, -1), default=1,
         help="1 if DoLP rises with the file's numbers (tension positive; default), -1 "
              "if it falls; for correlation")
    load("--skew-ppm", type=number, default=0.0, metavar="PPM",
         help="with --align offset: by how much its clock is slower")
    add("--decimal", choices=(".", ","), default=".",
        help="decimal sign of the tables; with a comma, columns are separated by ;")
    look = parser.add_argument_group("video").add_argument
    look("--no-video", action="store_true", help="write no video")
    look("--slow", type=number, default=4.0, metavar="FACTOR",
         help="factor of slow motion; default 4")
    look("--scale", type=within(1, 64), metavar="N",
         help="enlarge each pixel; default: panels fill a screen")
    look("--pixel-um", type=number, metavar="UM",
         help="size of a pixel in the object, for a scale bar")
    add_json_option(parser)
    add_fuse_options(parser)
    return parser


def _regions(text: str) -> list[analysis.Roi]:
    try:
        return analysis.parse_roi(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from None


def measure(
    args: argparse.Namespace, recording: Recording, load: analysis.LoadTrace | None
) -> Findings:
    """Measure a recording and write the video."""
    options = fuse_options(args, recording)
    # Guided demosaicing has the smaller stripes, bilinear no error of a region's mean.
    options["demosaic"], of_regions = (args.demosaic or name for name in (
        "guided", "bilinear"))
    assumed = periodic.assume_ratio(recording, options)
    fps = float(args.fps or 100.0)
    times = grid_times(recording, fps, options["start_us"], options["stop_us"])
    options |= {"fps": None, "start_us": None, "stop_us": None, "times_us": times}
    held = {**of_frames(options, args.settings), "hold": "mid", "times_us": None,
            "start_us": int(times[0]), "stop_us": int(times[-1]) + 1}
    background = _background(args, options)
    regions = [roi for group in args.region for roi in group]
    if not regions:
        height, width = recording.info.sensor_size
        x, y, w, h = args.roi or (0, 0, width // 2 * 2, height // 2 * 2)
        regions = [analysis.Roi.from_rectangle(x, y, w, h, "all")]
    names = [roi.name for roi in regions]
    if len(set(names)) < len(names):
        raise UsageError(f"regions must have different names, got {', '.join(names)}")
    stage("traces of the fused images; estimating parameters of the camera")
    fused = _traces(args, recording, options | {"demosaic": of_regions}, regions,
                    background)
    assert fused is not None  # there is a time on the grid
    frames = None
    if recording.info.frame_count != 0:
        frames = _traces(args, recording, held | {"demosaic": of_regions}, regions,
                         background)
    facts = facts_of(recording, options, estimate=args.estimate, images_per_second=fps)
    facts["assumed"] = [*facts["assumed"], *assumed]
    stage("amplitude and phase")
    start = start_of(recording)
    light = periodic.measure(
        args, recording,
        periodic.Frames(recording, options if frames is None else held, background),
        of_regions, regions, _found_hz(args, recording, fused), start)
    found = Findings(start, facts, fused, frames, light)
    found.waves = results.waves_of(args, found)
    _optics(args, found)
    found.messages += [f"{roi.name}: no amplitude: {reason}" for roi, reason in zip(
        regions, light.fit.reasons, strict=True) if reason]
    if light.fit.doubt:
        found.messages.append(light.fit.doubt)
    if frames is None:
        found.messages.append(
            "no frames: amplitude and phase are those of the fused images, which "
            "follow fast light incompletely")
    if load is not None:
        force.align(args, recording, found, load)
    for message in found.messages:
        warnings.warn(message, AnalysisWarning, stacklevel=2)
    if not args.no_video:
        _video(args, recording, options, held, found)
    return found


def _traces(
    args: argparse.Namespace, recording: Recording, options: dict[str, Any],
    regions: Sequence[analysis.Roi], background: Any,
) -> analysis.Traces | None:
    """Record traces of the regions."""
    recorder = analysis.TraceRecorder(
        regions, estimate=args.estimate, background=background)
    times = options["times_us"]
    images = told_if_nothing(
        fuse(recording, **options), recording, options["calibration"])
    for image in progress(images, None if times is None else len(times), "images"):
        recorder.add(image)
    return recorder.traces(recording) if recorder.count else None


def _found_hz(
    args: argparse.Namespace, recording: Recording, fused: analysis.Traces
) -> float:
    """Return the load's frequency: as stated, or the strongest in a region's DoLP.

    Of fused images, frames may pull it to where it aliases; events say where it is, and
    whether a stated one that frames see always at the same phases is exact.
    """
    for roi, row in zip(fused.rois, fused.table, strict=True):
        known = np.count_nonzero(np.isfinite(row["dolp"]))
        if known < 8:
            raise UsageError(
                f"region {roi.name}: its DoLP is known in {known} images, and 8 are "
                "needed; pdavis view shows which pixels are valid")
    by_events = analysis.event_hz(
        recording, fused.rois,
        Layout.of(args.layout or recording.info.layout or Layout.PDAVIS),
        int(fused.t_us[0]), int(fused.t_us[-1]))
    if args.load_hz is not None:
        stated = float(args.load_hz)
        seconds = (fused.t_us[-1] - fused.t_us[0]) / 1e6
        if by_events is None or abs(by_events / stated - 1) > _STATED or (
                abs(by_events - stated) * seconds < _EXACT):
            return stated
        return by_events
    hz, _ = max((analysis.trace_hz(fused.t_us, row["dolp"]) for row in fused.table),
                key=lambda found: found[1])
    return hz if by_events is None or abs(hz / by_events - 1) < _SAME else by_events


def _background(args: argparse.Namespace, options: dict[str, Any]) -> Any:
    """Return the mean Stokes planes of the recording without the sample."""
    if args.background is None:
        return None
    kept = {name: options[name] for name in (
        "roi", "layout", "demosaic", "calibration", "extinction_ratio")}
    with opened(args, args.background) as empty:
        planes: Any = 0.0
        n = 0
        for image in fuse(empty, method="frames", hold="mid", **kept):
            planes = planes + np.stack((image.s0, image.s1, image.s2)).astype(float)
            n += 1
    if not n:
        raise UsageError(f"{args.background}: no frame to use as background")
    return planes / n


def _optics(args: argparse.Namespace, found: Findings) -> None:
    """Add retardance and birefringence of the traces."""
    if args.thickness_um is None:
        return
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", AnalysisWarning)
        delta, se = analysis.retardance(
            found.fused.table["dolp"], found.fused.table["dolp_se"])
    found.extra["retardance_deg"] = np.rad2deg(delta)
    found.extra["retardance_se_deg"] = np.rad2deg(se if se is not None else 0)
    found.extra["birefringence"] = analysis.birefringence(
        delta, thickness_um=args.thickness_um, wavelength_nm=args.wavelength_nm)
    found.messages += [str(warning.message) for warning in caught]


def _video(
    args: argparse.Namespace, recording: Recording, options: dict[str, Any],
    held: dict[str, Any], found: Findings,
) -> None:
    """Make the images a second time, and the video of them."""
    stage("video")
    times = options["times_us"]
    sheet = TendonSheet(args, recording, found, {**options, "times_us": times})
    step = float(np.median(np.diff(times))) if len(times) > 1 else 1e4
    # Without frames, the fused images are used instead.
    frames: Iterator[PolarFrame] = held_at(
        fuse(recording, **(held if found.frames is not None else options)),
        iter(times.tolist()))
    with export.VideoFile(
            args.out / "tendon.webm", 1e6 / step / args.slow, found.facts) as video:
        for image, frame in progress(
                zip(fuse(recording, **options), frames, strict=True), len(times),
                "pictures"):
            picture = sheet.picture(frame, image)
            if video.count == len(times) // 2:
                found.still = picture
            video.add(picture)
