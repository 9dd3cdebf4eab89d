"""Simulate a polarization event camera before a scene whose truth is known.

FILE is AEDAT-4 (.aedat4) or AEDAT-2.0 (.aedat); FILE.truth.npz beside it holds what
a perfect instrument would have measured (t_us, aop, dolp, s0 at one place; roi; lit;
load and losses of the read-out bus).
"""
from __future__ import annotations

import argparse
import dataclasses
import math
import os
from collections.abc import Sequence
from pathlib import Path

import pdavis_cv
from pdavis_cv.recording.base import Recording
from pdavis_cv.sensor import Sensor
from pdavis_cv.simulation import (
    PRESETS,
    Camera,
    Fan,
    FlatLight,
    IrradianceSweep,
    MalusSweep,
    PolarizerBeforePlate,
    RotatingPlate,
    RotatingPolarizer,
    Scene,
    Tendon,
    Texture,
)

from ._common import Parser, UsageError, command, numbers, positive

__all__ = ["SCENES", "main", "make_scene"]

SCENES = {
    "polarizer": "a turning polarizer",
    "qwp": "a turning quarter-wave plate behind a fixed polarizer",
    "plate": "a turning polarizer before a fixed quarter-wave plate",
    "fan": "six polarizers in a wheel, one half lit far brighter",
    "tendon": "a birefringent fibre sheet that is pulled in cycles",
    "malus": "a polarizer turned in steps of 5 degrees and held",
    "dr": "a turning polarizer under 40 nW/cm2 to 42 mW/cm2",
    "texture": "a moving texture with fields of AoP and DoLP",
    "flat": "constant unpolarized light",
    "dark": "no light",
}
_WHOLE = ("fan", "tendon", "texture")
_REGION = (12, 12)  # of the paper's figures


@command
def main(argv: Sequence[str] | None = None) -> int:
    """Run ``pdavis simulate``."""
    parser = _parser()
    args = parser.parse_args(argv)
    scene = make_scene(args)
    sensor = Sensor.SONY if args.camera == "sony" else Sensor.PDAVIS
    size = args.size or (Sensor.PDAVIS.size if args.scene in _WHOLE else _REGION)
    if size[0] > sensor.size[0] or size[1] > sensor.size[1]:
        raise UsageError(f"--size must lie within the {sensor.name}'s "
                         f"{sensor.size[1]}x{sensor.size[0]}, got {size[1]}x{size[0]}")
    camera = Camera.preset(args.camera, seed=args.seed, size=size)
    if camera.dvs is None and args.out.suffix == ".aedat":
        raise UsageError("AEDAT-2.0 is for event cameras; use a .aedat4 file")
    stream = camera.stream(scene, args.seconds, run=args.run, threads=args.threads)
    _write(args.out, stream)
    truth = Path(f"{os.fspath(args.out)}.truth.npz")
    stream.truth().save(truth)
    print(f"wrote {args.out} and {truth}")
    lost = int(stream.truth().bus_lost.sum())
    if lost:
        print(f"the read-out bus lost {lost} events")
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = Parser(
        "simulate", __doc__ or "",
        "pdavis simulate polarizer --camera nominal --rpm 1000 -o polarizer.aedat4")
    parser.add_argument(
        "scene", choices=list(SCENES), metavar="SCENE",
        help="; ".join(f"{name}: {what}" for name, what in SCENES.items()))
    parser.add_argument(
        "-o", "--out", type=Path, required=True, metavar="FILE",
        help="recording to write")
    parser.add_argument(
        "--camera", choices=list(PRESETS), default="nominal", help="default nominal")
    parser.add_argument(
        "--seconds", type=positive, default=3.0, help="duration, default 3")
    parser.add_argument(
        "--seed", type=int, default=0, help="names the specimen, default 0")
    parser.add_argument(
        "--run", type=int, default=0,
        help="same specimen, other noise; default 0")
    parser.add_argument(
        "--size", type=_size, metavar="WxH",
        help="pixels in the middle of the sensor; default 346x260 for scenes with "
             "structure, 12x12 for uniform ones")
    parser.add_argument(
        "--threads", type=int, default=1, help="default 1; the result is the same")
    group = parser.add_argument_group("scene")
    group.add_argument(
        "--rpm", type=float, default=200.0,
        help="turns per minute, default 200; negative is clockwise")
    group.add_argument(
        "--hz", type=positive, default=1.0, help="cycles of the tendon, default 1")
    group.add_argument(
        "--start-deg", type=float, default=0.0, help="angle at time 0, default 0")
    group.add_argument(
        "--light", type=positive, metavar="DN/MS",
        help="S0 in DN per ms; default 30.75, which gives 600 DN in 20 ms at most")
    group.add_argument(
        "--background", type=float, default=0.0, metavar="DN/MS",
        help="S0 of a constant background, 30%% polarized at 30 degrees")
    group.add_argument(
        "--flicker", type=positive, metavar="HZ",
        help="mains frequency of the lamp, 50 or 60: it flickers at twice that")
    return parser


def make_scene(args: argparse.Namespace) -> Scene:
    """Return the scene that the options stand for."""
    angle, rpm = math.radians(args.start_deg), args.rpm
    hold = args.seconds * 1e6 / 37  # 0..180 degrees
    scenes: dict[str, Scene] = {
        "polarizer": RotatingPolarizer(rpm=rpm, start_angle=angle),
        "qwp": RotatingPlate(rpm=rpm, start_angle=angle),
        "plate": PolarizerBeforePlate(rpm=rpm, start_angle=angle),
        "fan": Fan(rpm=rpm, start_angle=angle),
        "tendon": Tendon(hz=args.hz),
        "malus": MalusSweep(hold_us=hold, move_us=hold / 10, start_angle=angle),
        "dr": IrradianceSweep(
            rpm=rpm, hold_us=args.seconds * 1e6 / 13, start_angle=angle,
            dn_per_ms=0.68 if args.camera == "sony" else 27.0),
        "texture": Texture(seed=args.seed),
        "flat": FlatLight(),
        "dark": FlatLight(s0=0.0),
    }
    scene = scenes[args.scene]
    if args.light is not None:
        if args.scene in ("dr", "dark"):
            raise UsageError(f"{args.scene} sets its own light: leave --light out")
        scene = dataclasses.replace(scene, s0=args.light)  # type: ignore[type-var]
    if args.background < 0:
        raise UsageError(f"--background must not be negative, got {args.background:g}")
    if args.background:
        scene = scene + FlatLight(
            s0=args.background, dolp=0.3, aop=math.radians(30))
    return scene if args.flicker is None else scene.flicker(args.flicker)


def _write(path: Path, recording: Recording) -> None:
    if path.suffix == ".aedat4":
        pdavis_cv.write_aedat4(path, recording)
    elif path.suffix == ".aedat":
        pdavis_cv.write_aedat2(path, recording)
    else:
        raise UsageError(f"{path}: the name must end in .aedat4 or .aedat")


def _size(text: str) -> tuple[int, int]:
    width, height = numbers(text.lower().replace("x", ","), 2, int)
    return height, width


if __name__ == "__main__":
    raise SystemExit(main())
