"""Show what a recording contains: its header, and with --scan all its data."""
from __future__ import annotations

import argparse
import contextlib
import datetime
import json
import sys
from collections.abc import Iterator, Sequence
from typing import Any

from pdavis_cv import Layout, Sensor
from pdavis_cv._text import MOST_TEXT, shown
from pdavis_cv.calibration.thresholds import thresholds_from_biases
from pdavis_cv.export.files import plain
from pdavis_cv.fusion.learning import learned_parts, learned_pixels
from pdavis_cv.fusion.turning_speed import found_hz
from pdavis_cv.recording.advice import Advice, advise
from pdavis_cv.recording.base import Recording, RecordingInfo, Report
from pdavis_cv.recording.facts import ASSUMED, FILE, Fact, assumptions

from ._camera import of_all_pixels
from ._common import Parser, command, in_flags
from ._options import add_file, add_source_options, opened

_LEAST_OFFSET_US = 1000
"""Least offset of the clocks that is told, us: the pixels' lag looks like a smaller
one."""


@command
def main(argv: Sequence[str] | None = None) -> int:
    """Run ``pdavis info``."""
    args = _parser().parse_args(argv)
    with opened(args) as recording:
        report = recording.scan() if args.scan else None
        camera = learned_parts(learned_pixels(recording)) if (
            args.scan and recording.info.frame_count != 0) else {}
        turning = _modulation(recording) if args.scan else []
        advice = [  # a modulation has lines at 100 and 120 Hz, too
            *(one for one in advise(recording)
              if one.topic != "flicker" or not turning),
            *_clock(camera.get("clock_offset_us", 0), camera.get("learned", {}).get(
                "clock_offset_sigma_us", 0)), *turning] if args.scan else []
        problems = recording.problems
        name = args.file if isinstance(args.file, str) else recording.name
        if args.json:
            facts = {"file": name, "info": recording.info,
                     "facts": _known(recording.info),
                     "assumed": assumptions(recording.info.facts),
                     "problems": list(problems)}
            if report is not None:
                facts["scan"] = report
                facts["advice"] = advice
                facts["camera"] = {
                    name: value for name, value in {
                        **camera, **camera.get("learned", {})}.items()
                    if isinstance(value, float)}
            json.dump(facts, sys.stdout, indent=2, default=_plain)
            print()
            return 0
        print(name)
        for name, text in [*_rows(recording.info, report), *of_all_pixels(camera)]:
            print(f"  {name:<11} {shown(' '.join(text.splitlines()), MOST_TEXT)}")
        for problem in problems:
            print(f"  problem     {in_flags(problem.message)[:MOST_TEXT]}")
        for one in advice:
            print(f"  {one.topic}: {one.finding}; {one.action}")
    return 0


def _clock(us: float, sigma_us: float) -> list[Advice]:
    """Return advice if the clocks of frames and events differ."""
    if abs(us) < _LEAST_OFFSET_US:
        return []
    return [Advice(
        "clocks", f"frames' stamps are {abs(us) / 1000:.1f} +- {sigma_us / 1000:.1f} "
        f"ms {'early' if us > 0 else 'late'} by the clock of the events",
        f"method kalman corrects them; for other methods use --clock-offset {us:.0f}")]


def _modulation(recording: Recording) -> list[Advice]:
    """Return advice if all the light of an ordinary event camera is modulated."""
    info = recording.info
    hz = None if info.layout is not None or info.event_count == 0 else (
        found_hz(recording))
    return [] if hz is None else [Advice(
        "analyser", f"modulated at {hz:.2f} Hz: a turning analyser?",
        f"--analyser-found, or --analyser-rpm {30 * hz:.4g}, makes images of it")]


def _parser() -> argparse.ArgumentParser:
    parser = Parser("info", __doc__ or "", "pdavis info recording.aedat4 --scan")
    add_file(parser, "a recording")
    add_source_options(parser)
    parser.add_argument("--json", action="store_true", help="for programs")
    parser.add_argument("--scan", action="store_true", help="read and count all data")
    return parser


def _rows(info: RecordingInfo, report: Report | None) -> list[tuple[str, str]]:
    writer = f", written by {info.writer}" if info.writer else ""
    rows = [("format", info.format + writer)]
    if info.camera:
        rows.append(("camera", info.camera))
    rows += _facts(info)
    known = info if report is None else report
    seconds = None
    if known.start_us is not None and known.stop_us is not None:
        seconds = (known.stop_us - known.start_us) / 1e6
        rows.append(("time", f"{known.start_us} .. {known.stop_us} us "
                     f"({seconds:.6g} s)"))
    for name in ("event", "frame", "imu", "trigger"):
        count = getattr(known, f"{name}_count")
        label = "imu" if name == "imu" else f"{name}s"
        if name == "frame" and isinstance(info.frame_times, float):
            rate: float | None = info.frame_times
        else:   # frames alone begin and end the time
            gaps = (count or 0) - (name == "frame" and info.event_count == 0)
            rate = gaps / seconds if gaps and seconds else None
        rows.append((label, _count(count, rate)))
    if report is not None and report.event_count:
        share = report.on_count / report.event_count
        rows.append(("ON events", f"{report.on_count:,} ({share:.1%})"))
    if info.wall_clock_us is not None and known.start_us is not None:
        seconds = (info.wall_clock_us + known.start_us) / 1e6
        try:
            moment = datetime.datetime.fromtimestamp(seconds, datetime.UTC)
            rows.append(("recorded", f"{moment:%Y-%m-%d %H:%M:%S} UTC"))
        except (OverflowError, OSError, ValueError):
            rows.append(("recorded", f"{seconds:g} s after 1970, no date"))
    for name, ampere in info.biases.items():
        rows.append(("bias", f"{name} {ampere:.3g} A"))
    return rows


def _known(info: RecordingInfo) -> dict[str, Fact]:
    """Return the facts of a recording, with the thresholds that its biases give."""
    facts = dict(info.facts)
    with contextlib.suppress(ValueError):
        facts["thresholds"] = Fact(thresholds_from_biases(info.biases), FILE)
    return facts


def _facts(info: RecordingInfo) -> Iterator[tuple[str, str]]:
    """Yield what is known of the camera, with the origin of each fact."""
    facts, nobody = _known(info), Fact(None, "unknown")
    size, sensor, layout, ratio, times, exposure, scale, thresholds = (
        facts.get(name, nobody) for name in (
            "sensor_size", "sensor", "layout", "extinction_ratio", "frame_times",
            "exposure_us", "full_scale_dn", "thresholds"))

    def said(text: str, fact: Fact) -> str:
        return "unknown" if fact is nobody else f"{text} ({fact.origin})"

    height, width = size.value
    yield "size", said(f"{width}x{height}", size)
    yield "sensor", said(sensor.value and sensor.value.name, sensor)
    yield "polarizers", said(str(layout.value), layout) + (
        "" if ratio is nobody else
        f", extinction ratio {said(f'{ratio.value:g}', ratio)}")
    if info.event_count != 0:
        yield "thresholds", said("ON {:.3g}, OFF {:.3g}, from its biases".format(
            *thresholds.value or (0, 0)), thresholds)
    if info.frame_count == 0:
        return
    if times.origin == ASSUMED:
        yield "frame times", f"rate assumed ({times.value:g} per second)"
    else:
        yield "frame times", said(
            times.value if isinstance(times.value, str) else
            f"{times.value or 0:g} per second", times)
    if exposure is not nobody or not isinstance(times.value, str):
        yield "exposure", said(f"{(exposure.value or 0) / 1000:g} ms", exposure)
    yield "full scale", said(f"{scale.value} DN", scale)


def _count(count: int | None, rate: float | None) -> str:
    if count is None:
        return "not known without --scan"
    return f"{count:,}" + (
        "" if rate is None or count == 1 else f" ({rate:,.5g} per second)")


def _plain(value: Any) -> Any:
    """Return a value that JSON can represent, for `json.dump`."""
    if isinstance(value, Layout):
        return value.stored_angles if value.colours else value.angles_deg
    return value.name if isinstance(value, Sensor) else plain(value)
