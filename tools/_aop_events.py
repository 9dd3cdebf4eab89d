"""``pdavis export --what aop-events``: write an angle after each event, or a video."""
from __future__ import annotations

import argparse
import io
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdavis_cv import AOP_EVENT_DTYPE, AopEvents, Recording, export, render
from pdavis_cv._beside import all_or_none, write_beside
from pdavis_cv._types import Events
from pdavis_cv.calibration.thresholds import resolve_thresholds
from pdavis_cv.render.colours import Picture
from pdavis_cv.sensor import resolve_layout

from ._common import UsageError, covered
from ._progress import progress

COLUMNS = ("t_us", "x", "y", "aop_deg")
MOVING = (".webm", ".mp4", ".m4v", ".mkv", ".avi", *export.ANIMATIONS)
SUFFIXES = (".csv", ".npy", *MOVING)
_FPS = 100.0
_LEAST_WIDTH = 240


def export_aop_events(
    args: argparse.Namespace, recording: Recording, options: dict[str, Any]
) -> tuple[list[str], dict[str, Any]]:
    """Write the AoP events of a recording to ``args.out``.

    The options are those of `fuse`: interval, layout, thresholds, calibration, fps; and
    ``parameters`` of `AopEvents`.  Returns lines for the terminal, and the same for
    ``--json``.
    """
    stream, facts = _stream(args, recording, options)
    pieces = (stream.add(packet.events) for packet in progress(
        recording.packets(options["start_us"], options["stop_us"]), None, "packets")
        if len(packet.events))
    suffix = args.out.suffix.lower()
    if suffix in MOVING:
        count, pictures = _video(args, recording, options, pieces, facts)
        what = f"{count} AoP events in {pictures} pictures"
    else:
        count = (_csv if suffix == ".csv" else _npy)(args.out, pieces, facts)
        what = f"{count} AoP events ({', '.join(COLUMNS)})" if suffix == ".csv" else (
            f"{count} AoP events (t us, x, y, aop rad)")
    return [f"wrote {args.out}: {what}"], {
        "wrote": [args.out], "aop_events": count, **facts}


def _stream(
    args: argparse.Namespace, recording: Recording, options: dict[str, Any]
) -> tuple[AopEvents, dict[str, Any]]:
    calibration = options["calibration"]
    layout = resolve_layout(
        options["layout"], None if calibration is None else calibration.layout,
        recording.info.layout)
    on, off = resolve_thresholds(
        recording, options["thresholds"], options["nominal_thresholds"], calibration)
    parameters = dict(args.settings)
    try:
        stream = AopEvents(recording.info.sensor_size, theta_on=on, theta_off=off,
                           layout=layout, **parameters)
    except TypeError as error:
        raise UsageError(
            "--set of AoP events takes cutoff_hz, radius and correct_phase, got "
            f"{', '.join(parameters)}") from error
    return stream, {"layout": str(layout), "theta_on": float(np.mean(on)),
                    "theta_off": float(np.mean(off)), **parameters}


def _csv(path: Path, pieces: Iterator[Events], facts: dict[str, Any]) -> int:
    count = 0

    def rows() -> Iterator[tuple[Any, ...]]:
        nonlocal count
        for piece in pieces:
            count += len(piece)
            degrees = np.rad2deg(piece["aop"]).round(3)
            yield from zip(*(column.tolist() for column in (
                piece["t"], piece["x"], piece["y"], degrees)), strict=True)

    export.write_csv(path, COLUMNS, rows(), facts)
    return count


def _npy(path: Path, pieces: Iterator[Events], facts: dict[str, Any]) -> int:
    found = [np.empty(0, AOP_EVENT_DTYPE), *pieces]
    together = np.concatenate(found)
    array = io.BytesIO()    # numpy.save does not notice that a disk is full
    np.save(array, together)
    with all_or_none(), write_beside(path) as part:
        part.write_bytes(array.getvalue())
        export.write_json(path.with_suffix(".npy.json"), {
            **facts, "units": {"t": "us", "x": "pixel", "y": "pixel", "aop": "rad"}})
    return len(together)


def _video(
    args: argparse.Namespace, recording: Recording, options: dict[str, Any],
    pieces: Iterator[Events], facts: dict[str, Any],
) -> tuple[int, int]:
    """Write a picture per interval: each pixel has the hue of its last angle in it."""
    fps, count = options["fps"] or _FPS, 0
    with export.moving_file(args.out, fps / args.slow, facts) as video:
        for events in _intervals(pieces, options["start_us"], round(1e6 / fps)):
            video.add(_picture(events, recording.info.sensor_size))
            count += len(events)
        if not video.count:
            raise UsageError(
                f"{recording.name}: no event in the interval asked for: "
                f"{covered(recording)}")
    return count, video.count


def _intervals(
    pieces: Iterator[Events], start_us: int | None, interval_us: int
) -> Iterator[NDArray[Any]]:
    """Divide a stream into intervals, including empty ones."""
    waiting: list[NDArray[Any]] = []
    end: int | None = None if start_us is None else start_us + interval_us
    for piece in pieces:
        if end is None:
            end = int(piece["t"][0]) + interval_us
        while len(piece) and piece["t"][-1] >= end:
            cut = int(np.searchsorted(piece["t"], end))
            yield np.concatenate([*waiting, piece[:cut]])
            waiting, piece, end = [], piece[cut:], end + interval_us
        waiting.append(piece)
    if waiting:
        yield np.concatenate(waiting)


def _picture(events: Events, shape: tuple[int, int]) -> Picture:
    last = np.full(shape, np.nan, np.float32)
    last[events["y"], events["x"]] = events["aop"]
    seen = np.isfinite(last)
    picture = render.aop_bgr(last, seen)
    picture[~seen] = 0
    scale = math.ceil(_LEAST_WIDTH / shape[1])
    return picture.repeat(scale, axis=0).repeat(scale, axis=1)
