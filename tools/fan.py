"""Make a video of a rotating wheel of polarizers: frames above, fused below.

Each row shows I0, AoP and DoLP; a second recording (of another camera) adds a row.
With --centre and --radius the angle of each sector is measured, and written to OUT.csv
(one row per image and sector) and to the terminal (one line per sector).
"""
from __future__ import annotations

import argparse
import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pdavis_cv import Recording, export, fuse, open_recording, render
from pdavis_cv._beside import all_or_none
from pdavis_cv._opencv import opencv
from pdavis_cv.analysis import SectorSummary, Wheel, summarise_sectors
from pdavis_cv.recording.base import start_of

from ._common import Parser, UsageError, add_json_option, checked_out, command, tell
from ._images import (
    facts_of,
    full_scale,
    grid_times,
    held_at,
    of_frames,
    screen_scale,
    told_if_nothing,
    tone_of,
)
from ._options import add_file, add_fuse_options, fuse_options, opened
from ._progress import progress, stage
from ._values import layout_option, number, numbers, seconds, within


@command
def main(argv: Sequence[str] | None = None) -> int:
    """Run ``pdavis fan``."""
    args = _parser().parse_args(argv)
    suffixes = (".webm", ".mp4", ".mkv", ".avi", *export.ANIMATIONS)
    if args.out.suffix.lower() not in suffixes:
        raise UsageError(f"-o must end in {', '.join(suffixes)}, got {args.out}")
    checked_out(args.out, args.file)
    if (args.centre is None) != (args.radius is None):
        raise UsageError("--centre and --radius belong together")
    if not args.slow > 0:
        raise UsageError(f"--slow must be positive, got {args.slow:g}")
    opencv()
    with all_or_none(), opened(args) as recording:
        if args.beside is None:
            lines, facts = make_fan(args, recording, None)
        else:
            with open_recording(args.beside, layout=args.beside_layout,
                                source_fps=args.beside_fps) as second:
                lines, facts = make_fan(args, recording, second)
    tell(args, lines, **facts)
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = Parser(
        "fan", __doc__ or "",
        "pdavis fan wheel.aedat4 -o fan.webm --fps 1000 --slow 40 "
        "--centre 172,129 --radius 120 --hub 25 --rpm 200")
    add = parser.add_argument
    add_file(parser, "a recording with frames and events")
    add("-o", "--out", type=Path, required=True, metavar="OUT",
        help="video to write: .webm, .mp4, .mkv or .avi; .gif or .webp for slides")
    add("--beside", metavar="FILE", help="a second recording, shown in a row below")
    add("--beside-layout", type=layout_option, metavar="LAYOUT", help="its polarizers")
    add("--beside-fps", type=number, metavar="RATE",
        help="its images per second, if the file has no times")
    add("--beside-offset", type=seconds, default=0.0, metavar="S",
        help="its time at the first image shown, seconds after its own first image")
    look = parser.add_argument_group("pictures").add_argument
    look("--slow", type=number, default=20.0, metavar="FACTOR",
         help="factor of slow motion; default 20")
    look("--scale", type=within(1, 64), metavar="N",
         help="enlarge each pixel; default: panels fill a screen")
    look("--mask-dolp", type=number, default=0.3, metavar="DOLP",
         help="grey out AoP of weaker polarization; default 0.3")
    look("--still", type=Path, metavar="PNG",
         help="also write the middle picture of the video")
    wheel = parser.add_argument_group("sectors").add_argument
    wheel("--centre", type=lambda text: numbers(text, 2), metavar="X,Y",
          help="axis, in sensor pixels")
    wheel("--radius", type=number, metavar="PX", help="outer radius")
    wheel("--hub", type=number, default=0.0, metavar="PX",
          help="inner radius; default 0")
    wheel("--sectors", type=within(1, 360), default=6, metavar="N",
          help="number of sectors; default 6")
    wheel("--rpm", type=number, default=0.0, metavar="RPM",
          help="turns per minute, positive counter-clockwise; default 0")
    wheel("--sector0", type=number, default=0.0, metavar="DEG",
          help="angle of the middle of sector 0 at the recording's start")
    wheel("--spacing", type=number, metavar="DEG",
          help="angle between adjacent polarizers; default 180/N")
    add_json_option(parser)
    add_fuse_options(parser)
    parser.set_defaults(fps=1000.0)
    return parser


def make_fan(
    args: argparse.Namespace, recording: Recording, second: Recording | None
) -> tuple[list[str], dict[str, Any]]:
    """Write the video and the measurements, beside those of a second camera if any.

    Returns text for the user, and facts for --json.
    """
    options = fuse_options(args, recording)
    origin = start_of(recording)
    times = grid_times(recording, args.fps, options["start_us"], options["stop_us"])
    options |= {"fps": None, "start_us": None, "stop_us": None, "times_us": times}
    held_options = of_frames(options, args.settings)
    stage("measuring brightness; estimating parameters of the camera")
    tones = [tone_of(recording, each, "I0") for each in (held_options, options)]
    facts = facts_of(recording, options, slow=args.slow, images_per_second=args.fps)
    wheel = None if args.centre is None else Wheel(
        centre=tuple(args.centre), radius=args.radius, hub=args.hub,
        sectors=args.sectors, rpm=args.rpm, start_angle=math.radians(args.sector0),
        origin_us=origin)
    beside = _beside(args, second, times)
    measured: dict[str, list[Any]] = {"frames": [], "fused": []}
    still = None
    images = told_if_nothing(
        fuse(recording, **options), recording, options["calibration"])
    pairs = zip(fuse(recording, **held_options), images, times.tolist(), strict=True)
    with export.moving_file(args.out, args.fps / args.slow, facts) as video:
        for held, fused, t in progress(pairs, len(times), "images"):
            rows = [("frames", held, tones[0].seen),
                    (str(fused.provenance["method"]), fused, tones[1].seen),
                    *(next(beside) if beside is not None else ())]
            picture = render.fan_sheet(
                rows, scale=args.scale or screen_scale(rows[0][1].shape),
                least_dolp=args.mask_dolp,
                title=f"{recording.name}   t = {(t - origin) / 1e6:.4f} s   "
                      f"{args.slow:g} x slower   {args.fps:g} images/s")
            if video.count == len(times) // 2:
                still = picture
            video.add(picture)
            if wheel is not None:
                measured["frames"].append(wheel.measure(held))
                measured["fused"].append(wheel.measure(fused))
    height, width = picture.shape[:2]
    lines = [f"wrote {args.out}: {video.count} pictures of {width}x{height}, "
             f"{video.fps:g} per second, {args.slow:g} times slower"]
    lines += facts["assumed"]
    told: dict[str, Any] = {"wrote": [args.out], "images": video.count,
                            "assumed": facts["assumed"]}
    if args.still is not None and still is not None:
        export.write_png(args.still, still, facts)
        lines.append(f"wrote {args.still}")
        told["wrote"].append(args.still)
    if wheel is not None:
        path = args.out.with_suffix(".csv")
        lines += _write_sectors(args, wheel, measured, facts, origin)
        told["wrote"].append(path)
    return lines, told


def _beside(
    args: argparse.Namespace, second: Recording | None, times: Any
) -> Iterator[list[Any]] | None:
    """Yield the row of the second camera at each time: its last frame."""
    if second is None:
        return None
    first = next(fuse(second, method="frames", hold="mid"), None)
    if first is None or first.t_us is None:
        raise UsageError(f"{args.beside}: no image with a time")
    top = full_scale(second)
    tone = render.ToneCurve.of(
        [first.quad[0]], [first.valid], saturated=top and top / 2)
    shifted = times - times[0] + first.t_us + round(args.beside_offset * 1e6)
    frames = fuse(second, method="frames", hold="mid")
    return ([("second camera", frame, tone.seen)]
            for frame in held_at(frames, iter(shifted.tolist())))


_SECTOR_COLUMNS = ("source", "t_s", "sector", "pixels", "aop_deg", "aop_se_deg",
                   "aop_sd_deg", "aop_on_wheel_deg", "dolp", "dolp_se")


def _write_sectors(
    args: argparse.Namespace, wheel: Wheel, measured: dict[str, list[Any]],
    facts: dict[str, Any], origin: int,
) -> list[str]:
    """Write the table of sectors, and return a line per sector."""
    def rows() -> Iterator[Sequence[Any]]:
        for source, images in measured.items():
            for image in images:
                for k, row in enumerate(image):
                    t = int(row["t_us"])
                    on_wheel = np.mod(row["aop"] - wheel.turned(t), np.pi)
                    yield (source, (t - origin) / 1e6, k, int(row["pixels"]),
                           *np.rad2deg([row["aop"], row["aop_se"], row["aop_sd"],
                                        on_wheel]), row["dolp"], row["dolp_se"])

    path = args.out.with_suffix(".csv")
    export.write_csv(path, _SECTOR_COLUMNS, rows(), facts)
    spacing = None if args.spacing is None else math.radians(args.spacing)
    lines = [f"wrote {path}: {len(measured['fused'])} images x {wheel.sectors} sectors",
             "source  sector   AoP on wheel   spread   error from spacing   DoLP"]
    for source, images in measured.items():
        lines += [_line(source, s) for s in summarise_sectors(
            wheel, images, spacing=spacing)]
    return lines


def _line(source: str, summary: SectorSummary) -> str:
    aop, se, sd, error = (math.degrees(value) for value in (
        summary.aop, summary.aop_se, summary.aop_sd, summary.error))
    return (f"{source:<7} {summary.sector:>4}   {aop:8.2f} +- {se:.2f}   {sd:6.2f}   "
            f"{error:+18.2f}   {summary.dolp:.3f}")
