"""Simulate a polarization event camera before a scene with known ground truth.

FILE is AEDAT-4 (.aedat4) or AEDAT-2.0 (.aedat).  FILE.truth.npz, next to it, holds the
values of a perfect instrument (t_us, aop, dolp, s0 at one position; roi; lit; load and
losses of the read-out bus).
"""
from __future__ import annotations

import argparse
import math
import os
from collections.abc import Sequence
from pathlib import Path

from pdavis_cv._beside import all_or_none
from pdavis_cv.recording.registry import writer_for
from pdavis_cv.recording.stream import source_from_packets
from pdavis_cv.sensor import Sensor
from pdavis_cv.simulation import DEFAULT_CAMERA, PRESETS, SCENES, Camera, named_scene

from ._common import Parser, UsageError, add_json_option, checked_out, command, tell
from ._progress import progress_in_time
from ._values import LAST_SEED, number, numbers, positive, within

_WHOLE = ("fan", "tendon", "texture")
LONGEST_S = 1e6
"""Longest simulation, s; a choice."""
_REGION = (12, 12)  # that of the paper's figures, pixels


@command
def main(argv: Sequence[str] | None = None) -> int:
    """Run ``pdavis simulate``."""
    parser = _parser()
    args = parser.parse_args(argv)
    try:
        scene = named_scene(
            args.scene, seconds=args.seconds, rpm=args.rpm, hz=args.hz, seed=args.seed,
            start_angle=math.radians(args.start_deg), light=args.light,
            background=args.background, flicker_hz=args.flicker, camera=args.camera)
    except ValueError as error:
        raise UsageError(str(error)) from None
    _, write = writer_for(args.out)
    sensor = Sensor.SONY if args.camera == "sony" else Sensor.PDAVIS
    size = args.size or (Sensor.PDAVIS.size if args.scene in _WHOLE else _REGION)
    if size[0] > sensor.size[0] or size[1] > sensor.size[1]:
        raise UsageError(f"--size must lie within the {sensor.name}'s "
                         f"{sensor.size[1]}x{sensor.size[0]}, got {size[1]}x{size[0]}")
    if args.seconds > LONGEST_S:
        raise UsageError(
            f"--seconds must be at most {LONGEST_S:g}, got {args.seconds:g}")
    camera = Camera.preset(args.camera, seed=args.seed, size=size)
    if camera.dvs is None and args.out.suffix == ".aedat":
        raise UsageError("AEDAT-2.0 is for event cameras; use a .aedat4 file")
    checked_out(args.out, recording=True, force=args.force)
    stream = camera.stream(scene, args.seconds, run=args.run, threads=args.threads)
    truth = Path(f"{os.fspath(args.out)}.truth.npz")
    with all_or_none():
        missing = write(args.out, source_from_packets(stream.info, progress_in_time(
            stream.packets(), 0, round(args.seconds * 1e6))))
        stream.truth().save(truth)
    lost = int(stream.truth().bus_lost.sum())
    lines = [f"wrote {args.out} and {truth}",
             *(f"not kept: {count:,} {what}" for what, count in missing.items())]
    if lost:
        lines.append(f"the read-out bus lost {lost} events")
    tell(args, lines, wrote=[args.out, truth], not_kept=missing, bus_lost=lost)
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = Parser(
        "simulate", __doc__ or "",
        "pdavis simulate polarizer --camera nominal --rpm 1000 -o polarizer.aedat4")
    add = parser.add_argument
    add("scene", choices=list(SCENES), metavar="SCENE",
        help="; ".join(f"{name}: {what}" for name, what in SCENES.items()))
    add("-o", "--out", type=Path, required=True, metavar="FILE",
        help="recording to write")
    add("--camera", choices=list(PRESETS), default=DEFAULT_CAMERA,
        help=f"default {DEFAULT_CAMERA}")
    add("--seconds", type=positive, default=3.0, help="duration, default 3")
    add("--seed", type=within(0, LAST_SEED), default=0,
        help="number of the specimen, default 0")
    add("--run", type=within(0, LAST_SEED), default=0,
        help="number of the noise of this specimen; default 0")
    add("--size", type=_size, metavar="WxH", help="pixels around the middle of the "
        "sensor; default 346x260 for structured scenes, 12x12 for uniform ones")
    add("--threads", type=within(1, 256), default=1,
        help="number of threads, default 1; it does not change the result")
    add("--force", action="store_true", help="replace an existing recording")
    add_json_option(parser)
    group = parser.add_argument_group("scene").add_argument
    group("--rpm", type=number, default=200.0,
          help="turns per minute, default 200; negative is clockwise")
    group("--hz", type=positive, default=1.0, help="cycles of the tendon, default 1")
    group("--start-deg", type=number, default=0.0, help="angle at time 0, default 0")
    group("--light", type=positive, metavar="DN/MS",
          help="S0 in DN per ms; default 30.75, which gives 600 DN in 20 ms at most")
    group("--background", type=number, default=0.0, metavar="DN/MS",
          help="S0 of a constant background, 30%% polarized at 30 degrees")
    group("--flicker", type=positive, metavar="HZ",
          help="mains frequency of the lamp, 50 or 60: it flickers at twice that")
    return parser


def _size(text: str) -> tuple[int, int]:
    width, height = numbers(text.lower().replace("x", ","), 2, int)
    return height, width
