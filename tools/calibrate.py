"""Measure a camera and write the results to its calibration file."""
from __future__ import annotations

import argparse
import math
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from pdavis_cv import Calibration, Recording, fuse
from pdavis_cv._beside import all_or_none
from pdavis_cv.analysis import found_zero
from pdavis_cv.aps import clip_level
from pdavis_cv.calibration.check import check_recording
from pdavis_cv.calibration.frames import dark_frame, flat_frame, frames_of
from pdavis_cv.calibration.layout import detect_layout
from pdavis_cv.calibration.sweep import fit_sweep, read_sweep, steps_in_time
from pdavis_cv.fusion.learning import learned_camera
from pdavis_cv.recording.base import start_of
from pdavis_cv.sensor import CHANNELS, NOMINAL_THRESHOLDS, resolve_layout

from ._calibration_report import Page, write_report
from ._camera import of_all_pixels
from ._common import (
    Parser,
    UsageError,
    add_json_option,
    checked_out,
    command,
    for_people,
    tell,
)
from ._options import (
    add_fuse_options,
    add_source_options,
    analyser_given,
    fuse_options,
    opened,
    together,
)
from ._progress import stage
from ._values import layout_option, number, numbers, positive, roi_option, within

Found = tuple[dict[str, Any], Page]


@command
def main(argv: Sequence[str] | None = None) -> int:
    """Run ``pdavis calibrate``."""
    args = _parser().parse_args(argv)
    if args.part == "check":
        return _check(args)
    if args.part == "zero":
        return _zero(args)
    parts = _ALL if args.part == "all" else (args.part,)
    path = Path(args.out)
    checked_out(path)
    known = Calibration.load(path) if path.exists() else None
    done = []
    for part in parts:
        files = getattr(args, f"{part}_files" if args.part == "all" else "files")
        if not files:
            continue
        stage(f"measuring {part}")
        with for_people(args):
            with all_or_none():
                known = _measure(part, files, args, known)
                known.save(path)
            print(f"wrote {path}: {', '.join(known.parts)}")
        done.append(part)
    if known is None or not done:
        raise UsageError("all needs a recording for at least one part (see --help)")
    tell(args, (), wrote=[path], holds=known.parts,
         measured={part: known.notes[part] for part in done})
    return 0


def _measure(
    part: str, files: list[str], args: argparse.Namespace, known: Calibration | None
) -> Calibration:
    # A sweep may be one file for each angle; otherwise several are images of one.
    recordings = [opened(args, one) for one in (
        files if part == "sweep" and len(files) > 1 else [together(files)])]
    try:
        info = recordings[0].info
        if known is None:
            known = Calibration(sensor_size=info.sensor_size, serial=info.serial)
        for recording in recordings:
            known.check_fits(recording.info.sensor_size, recording.info.serial)
        values, page = _PARTS[part](recordings, args, known)
        if known.usable is not None and "usable" in values:
            values["usable"] = values["usable"] & known.usable
    finally:
        for recording in recordings:
            recording.close()
    note = {"files": [Path(file).name for file in files],
            **{line.split(":")[0]: line.split(":", 1)[1].strip()
               for line in page.lines}}
    for line in page.lines:
        print(" ", line)
    merged = known.merge(Calibration(
        sensor_size=known.sensor_size, serial=info.serial,
        notes={part: note, **{name: stated for name in (
            "wavelength_nm", "f_number", "temperature_c")
            if (stated := getattr(args, name, None)) is not None}}))
    values = {name: value for name, value in values.items() if value is not None}
    if "layout" in values and args.force:
        merged = merged.replace(layout=None)
    merged = merged.merge(Calibration(sensor_size=known.sensor_size, **values))
    report = Path(args.out).with_suffix(f".{part}.png")
    if write_report(report, page):
        print(f"wrote {report}")
    return merged


def _dark(
    recordings: list[Recording], args: argparse.Namespace, known: Calibration
) -> Found:
    found = dark_frame(recordings[0])
    page = Page("Dark frame")
    page.say("frames", found.frames)
    page.say("median dark", f"{np.median(found.dark):.2f} DN")
    if found.clamped:
        page.say("note", f"the file holds no negative samples, {found.clamped:.0%} are "
                 "0: dark is inferred from those above")
    page.say("spread of dark", f"{np.std(found.dark[found.usable]):.2f} DN")
    page.say("noise of one frame", f"{np.median(found.noise):.2f} DN (median)")
    page.say("hot or noisy pixels", f"{np.count_nonzero(~found.usable)} "
             "(6 robust standard deviations)")
    page.image("dark offset (DN)", found.dark)
    page.image("noise (DN)", found.noise)
    page.histogram("dark offset (DN)", found.dark)
    return {"dark": found.dark, "dark_noise": found.noise, "usable": found.usable}, page


def _flat(
    recordings: list[Recording], args: argparse.Namespace, known: Calibration
) -> Found:
    found = flat_frame(recordings[0], known.dark)
    page = Page("Flat frame")
    page.say("frames", found.frames)
    page.say("gain spread", f"{100 * np.std(found.gain[found.usable]):.2f} % rms")
    page.say("dead or deviating pixels", np.count_nonzero(~found.usable))
    if known.dark is None:
        page.say("note", "no dark frame was subtracted: measure dark first")
    page.image("gain", found.gain)
    page.histogram("gain", found.gain)
    return {"gain": found.gain, "usable": found.usable}, page


def _clip(
    recordings: list[Recording], args: argparse.Namespace, known: Calibration
) -> Found:
    frames = [frame for _, frame in zip(range(20), frames_of(recordings[0]),
                                        strict=False)]
    if not frames:
        raise ValueError(f"{recordings[0].path}: a clip level needs frames")
    stack = np.stack([frame.dn for frame in frames])
    level = clip_level(stack, frames[0].full_scale_dn)
    page = Page("Clip level")
    page.say("frames", len(frames))
    page.say("clip level", "no pile-up at the top of the histogram: overexpose a part "
             "of the scene" if level is None else f"{level:.0f} DN")
    page.histogram("DN", stack, logarithmic=True)
    return {"clip_dn": level}, page


def _sweep(
    recordings: list[Recording], args: argparse.Namespace, known: Calibration
) -> Found:
    layout = resolve_layout(args.layout, known.layout, recordings[0].info.layout)
    count = 1 if args.angles is None else len(args.angles)
    if count != len(recordings):
        raise UsageError(f"--angles names {len(args.angles or ())} angles for "
                         f"{len(recordings)} files")
    # The file has no number of frames for the dark values: use that of the paper.
    error = 0.0 if known.dark_noise is None else known.dark_noise / np.sqrt(100)
    fit = fit_sweep(read_sweep(
        _steps(recordings[0], args) if args.angles is None else
        zip(np.deg2rad(args.angles), recordings, strict=True),
        dark=known.dark, gain=known.gain, dark_sigma=error))
    page = Page("Analyser matrix from a polarizer sweep")
    of = "" if args.wavelength_nm is None else f" at {args.wavelength_nm:g} nm"
    for angle, place in zip(CHANNELS, layout.places, strict=True):
        part = np.s_[place // 2::2, place % 2::2]
        off = np.rad2deg((fit.angle[part] - np.deg2rad(angle) + np.pi / 2) % np.pi
                         - np.pi / 2)
        page.say(f"{angle} deg{of}",
                 f"extinction ratio {np.median(fit.extinction_ratio[part]):.2f} "
                 f"(error of one {np.median(fit.extinction_ratio_sigma[part]):.2f}), "
                 f"angle {angle + np.median(off):.2f} +- {np.std(off):.2f} deg "
                 f"(error of one {np.rad2deg(np.median(fit.angle_sigma)):.3f})")
    page.say(f"lamp polarization{of}", f"{100 * np.hypot(*fit.source):.2f} %, "
             f"beam wander {100 * np.hypot(*fit.wander):.2f} %")
    cells = [np.median(fit.analyser[place // 2::2, place % 2::2], axis=(0, 1))
             for place in layout.places]
    page.say("response of the cell",
             f"condition number {np.linalg.cond(np.stack(cells)):.2f} (ideal 1.41)")
    page.say("residual", f"{np.median(fit.residual):.2f} of the expected noise; "
             f"{np.count_nonzero(~fit.usable)} pixels left out")
    page.image("extinction ratio", fit.extinction_ratio)
    page.image("response to S0", fit.analyser[..., 0])
    page.histogram("extinction ratio", fit.extinction_ratio)
    return {"analyser": fit.analyser, "usable": fit.usable, "layout": layout}, page


def _steps(recording: Recording, args: argparse.Namespace) -> Any:
    start = start_of(recording) + round(args.first_s * 1e6)
    stop = recording.info.stop_us
    if stop is None:
        stop = recording.scan().stop_us or start
    hold, settle = round(args.hold_s * 1e6), round(args.settle_s * 1e6)
    count = args.steps or max(int((stop - start) // hold), 0)
    angles = np.deg2rad(args.start_deg + args.step_deg * np.arange(count))
    return steps_in_time(
        recording, angles, [start + settle + k * hold for k in range(count)],
        hold - settle)


def _layout(
    recordings: list[Recording], args: argparse.Namespace, known: Calibration
) -> Found:
    origin = start_of(recordings[0])
    known_angle = None if args.known is None else (
        origin + round(args.known[0] * 1e6), float(np.deg2rad(args.known[1])))
    found = detect_layout(
        recordings[0], direction={"ccw": 1, "cw": -1, None: 0}[args.direction],
        known_angle=known_angle, family=args.family, roi=args.roi)
    page = Page("Polarizer layout")
    page.say("from", f"{found.source}, {found.cycles:.1f} periods of the light")
    page.say("orthogonal places", f"{found.pairs}, correlation "
             f"{found.pair_correlation:.2f} (next best {found.rival_correlation:.2f})")
    sense = {1: "counter-clockwise", -1: "clockwise", 0: "unknown"}[found.direction]
    page.say("sense of rotation", sense)
    if len(found.layouts) == 1:
        page.say("layout", found.layouts[0])
        return {"layout": found.layouts[0]}, page
    page.say("candidates", "; ".join(map(str, found.layouts)))
    page.say("note", "give --direction (as displayed) and --known SECONDS,DEGREES to "
             "tell them apart; no layout was written")
    return {}, page


def _thresholds(
    recordings: list[Recording], args: argparse.Namespace, known: Calibration
) -> Found:
    parts, error = learned_camera(
        recordings[0], nominal=args.nominal, calibration=known)
    page = Page("Contrast thresholds")
    for name in ("on", "off"):
        plane, sigma = parts[f"theta_{name}"], parts[f"theta_{name}_sigma"]
        page.say(f"{name.upper()} threshold", f"median {np.median(plane):.4f}, spread "
                 f"{np.std(plane):.4f}, error of one {np.median(sigma):.4f} ln units")
        page.image(f"{name.upper()} threshold", plane)
    page.say("ON/OFF ratio", f"error of one {100 * np.median(error):.2f} %")
    page.histogram("ON/OFF ratio", parts["theta_on"] / parts["theta_off"])
    if "learned" not in parts:
        page.say("note", "too little is told: these are the expected values")
        return parts, page
    for what, text in of_all_pixels(parts):
        page.say(what, text)
    dead_s = parts["learned"]["model"].dead_s
    page.say("refractory period", f"{1e6 * dead_s:.0f} us" if dead_s
             else "none that matters")
    return parts, page


_PARTS: dict[str, Callable[
    [list[Recording], argparse.Namespace, Calibration], Found]] = {
        "dark": _dark, "flat": _flat, "clip": _clip, "layout": _layout,
        "sweep": _sweep, "thresholds": _thresholds}
_ALL = tuple(_PARTS)


def _check(args: argparse.Namespace) -> int:
    with opened(args, together(args.files)) as recording:
        findings = check_recording(recording)
    words = {True: "ok", False: "WRONG", None: "unknown"}
    tell(args, [f"  {finding.what:<12} {words[finding.ok]:<8} {finding.message}"
                for finding in findings], findings=[asdict(one) for one in findings])
    return 0 if all(finding.ok is not False for finding in findings) else 1


def _zero(args: argparse.Namespace) -> int:
    with opened(args, together(args.files)) as recording:
        zero, sigma = found_zero(
            fuse(recording, **fuse_options(args, recording)), math.radians(args.known))
    degrees, error = math.degrees(zero), math.degrees(sigma)
    lines = [f"zero: add {degrees:.3f} +- {error:.3f} degrees to the angle"]
    phase = None
    if analyser_given(args) is not None:
        phase = (args.analyser_phase + degrees) % 180
        lines.append(f"--analyser-phase {phase:.3f}")
    tell(args, lines, zero_deg=degrees, sigma_deg=error, analyser_phase_deg=phase)
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = Parser(
        "calibrate", __doc__ or "",
        "pdavis calibrate dark covered.aedat4 -o camera.npz\n"
        "  pdavis calibrate sweep turned.aedat4 -o camera.npz --step-deg 5 --hold-s 2")
    parts = parser.add_subparsers(
        dest="part", metavar="PART", required=True, parser_class=_PartParser)
    texts = {
        "dark": "offset, noise and hot pixels, from covered frames (100 in the paper)",
        "flat": "gain and dead pixels, from uniform unpolarized light",
        "clip": "DN at which pixels saturate, from an overexposed scene",
        "layout": "polarizer layout, from a rotating polarizer",
        "sweep": "extinction ratio, angle and gain of each pixel, from a polarizer "
                 "turned in steps",
        "thresholds": "contrast thresholds and bandwidth, from a slowly turning "
                      "polarizer",
        "zero": "zero of the angle, from a polarizer of known direction that fills the "
                "image or --roi; printed, for --analyser-phase",
        "all": "every part that a set of recordings allows",
        "check": "whether layout and orientation are plausible (exit code 1: no)"}
    for part, text in texts.items():
        one = parts.add_parser(
            part, help=text, description=text[0].upper() + text[1:] + ".",
            epilog=_EXAMPLES[part])
        _add_options(one, part)
    return parser


class _PartParser(Parser):
    def __init__(self, *, prog: str, description: str, epilog: str) -> None:
        super().__init__(prog.removeprefix("pdavis "), description, epilog)


_EXAMPLES = {
    "dark": "pdavis calibrate dark covered.aedat4 -o camera.npz",
    "flat": "pdavis calibrate flat sphere.aedat4 -o camera.npz",
    "clip": "pdavis calibrate clip overexposed.aedat4 -o camera.npz",
    "layout": "pdavis calibrate layout turning.aedat4 -o camera.npz --direction ccw "
              "--known 0.5,30",
    "sweep": "pdavis calibrate sweep steps.aedat4 -o camera.npz --step-deg 5 "
             "--hold-s 2",
    "thresholds": "pdavis calibrate thresholds slow.aedat4 -o camera.npz",
    "zero": "pdavis calibrate zero film.aedat4 --trigger 0 --known-deg 90",
    "all": "pdavis calibrate all --dark covered.aedat4 --sweep steps.aedat4 "
           "-o camera.npz",
    "check": "pdavis calibrate check recording.aedat4",
}


def _add_options(parser: argparse.ArgumentParser, part: str) -> None:
    add = parser.add_argument
    if part == "all":
        for name in _ALL:
            option = "rotating" if name == "layout" else name
            add(f"--{option}", nargs="+", metavar="FILE", default=[],
                dest=f"{name}_files", help=f"recordings for {name}")
    else:
        add("files", nargs="+", metavar="FILE", help="a recording")
    add_json_option(parser)
    if part == "zero":
        add("--known-deg", type=number, required=True, dest="known", metavar="DEG",
            help="direction of its light, as AoP")
        add_fuse_options(parser)
        return
    add_source_options(parser)
    add("--roi", type=roi_option, metavar="X,Y,W,H",
        help="lit part of the sensor, in pixels")
    if part == "check":
        return
    add("-o", "--out", required=True, metavar="NPZ",
        help="the camera's calibration file; its other parts are kept")
    add("--force", action="store_true",
        help="replace a layout that contradicts the new one")
    for name, text in (("wavelength-nm", "wavelength, noted"),
                       ("f-number", "f-number, noted"),
                       ("temperature-c", "temperature, noted")):
        add(f"--{name}", type=positive, help=text)
    if part in ("layout", "all"):
        add("--direction", choices=("ccw", "cw"),
            help="direction of rotation as displayed")
        add("--known", type=lambda text: numbers(text, 2), metavar="S,DEG",
            help="angle at one time")
        add("--family", type=layout_option, metavar="LAYOUT",
            help="layout up to a constant angle")
    if part in ("thresholds", "all"):
        add("--nominal", type=lambda text: tuple(numbers(text, 2)), metavar="ON,OFF",
            default=NOMINAL_THRESHOLDS,
            help="expected thresholds, ln units; default 0.2,0.2")
    if part in ("sweep", "all"):
        add("--angles", metavar="DEG,DEG,...",
            type=lambda text: numbers(text, text.count(",") + 1),
            help="one angle per file; otherwise one file has all steps")
        for name, default, text in (
                ("start-deg", 0.0, "angle of the first step"),
                ("step-deg", 5.0, "angle of a step, counter-clockwise as displayed"),
                ("hold-s", 1.0, "seconds between steps"),
                ("settle-s", 0.1, "seconds after a step that are left out"),
                ("first-s", 0.0, "time at which the first step begins")):
            add(f"--{name}", type=number, default=default,
                help=f"{text}; default {default:g}")
        add("--steps", type=within(1, 10**9), help="number of steps; default: all")
