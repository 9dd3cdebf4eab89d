"""Stream simulated data for hours through fuse, export, a live session and the viewer.

One period of a rotating polarizer on a small sensor is repeated with continuing times,
faster than real time unless --paced is given.  Memory, handles and threads of this
process are sampled, and the difference of each image from the one a period earlier.
"""
from __future__ import annotations

import argparse
import csv
import gc
import math
import os
import tempfile
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, astuple, dataclass, fields
from http import HTTPStatus
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pdavis_cv.tools._common import (
    Parser,
    UsageError,
    add_json_option,
    checked_out,
    command,
    tell_now,
)
from pdavis_cv.tools._values import positive

if TYPE_CHECKING:
    from pdavis_cv import PolarFrame


RPM = 6.0
PERIOD_US = round(60e6 / RPM)
FPS = 10
"""Images per second of stream time."""
PART_S = 60.0
"""Stream time of each part, s."""
WARM_S = 600.0
"""Stream time, s, after which growth is measured, when code is loaded and caches are
filled; if the first round of all parts takes longer, that is used."""
PARTS = ("fuse", "export", "live", "viewer")


@dataclass
class Sample:
    """Measurements at the end of one part of the stream."""

    stream_s: float
    wall_s: float
    way: str
    method: str
    images: int
    rss_mb: float
    handles: int
    threads: int
    drift: float


@command
def main(argv: Sequence[str] | None = None) -> int:
    """Run ``python -m lab.soak``."""
    args = _parser().parse_args(argv)
    if args.out is not None:
        checked_out(args.out)
    if not Path("/proc/self/statm").exists():
        raise UsageError("memory is read from /proc, which only Linux has")
    from pdavis_cv import METHODS
    methods = args.methods.split(",") if args.methods else list(METHODS)
    unknown = set(methods) - set(METHODS)
    if unknown:
        raise UsageError(f"--methods must be of {', '.join(METHODS)}, got "
                         f"{', '.join(sorted(unknown))}")
    wanted_s = 3600 * args.hours if args.minutes is None else 60 * args.minutes
    samples = []
    for sample in _stream(args.parts or list(PARTS), methods, wanted_s, args.size,
                          args.paced):
        samples.append(sample)
        tell_now(args, [
            f"{sample.stream_s / 3600:7.3f} h  {sample.way:6} {sample.method:7} "
            f"{sample.rss_mb:7.1f} MB  {sample.handles} handles  "
            f"{sample.threads} threads  drift {sample.drift:.1e}"], **asdict(sample))
    if args.out is not None:
        _write(args.out, samples)
    turn = len(methods) * len(args.parts or PARTS)
    lines, facts = _grown(samples, turn)
    tell_now(args, lines, **facts)
    return int(_too_much(facts, args.most_mb))


def _grown(samples: list[Sample], turn: int) -> tuple[list[str], dict[str, Any]]:
    """Return the growth after the warm-up, as text and by name."""
    after = [s for i, s in enumerate(samples) if s.stream_s >= WARM_S and i >= turn - 1]
    stream, wall = samples[-1].stream_s, samples[-1].wall_s
    images = sum(s.images for s in samples)
    lines = [f"{stream / 3600:.2f} h of stream in {wall / 3600:.2f} h: {images} images"]
    facts = {"stream_s": stream, "wall_s": wall, "images": images, "since_s": math.nan,
             "memory_mb": math.nan, "handles": 0, "threads": 0, "drift": math.nan}
    if len(after) < 2:
        return [*lines, "too short to tell growth"], facts
    first = after[0]
    grown = max(s.rss_mb for s in after) - first.rss_mb
    handles = max(s.handles for s in after) - first.handles
    threads = max(s.threads for s in after) - first.threads
    drift = max((s.drift for s in after if math.isfinite(s.drift)), default=math.nan)
    lines.append(
        f"from {first.stream_s / 60:.0f} min on: memory +{grown:.1f} MB, handles "
        f"+{handles}, threads +{threads}, drift at most {drift:.1e} of S0")
    return lines, facts | {"since_s": first.stream_s, "memory_mb": grown,
                           "handles": handles, "threads": threads, "drift": drift}


def _too_much(grown: dict[str, Any], most_mb: float) -> bool:
    return bool(grown["memory_mb"] > most_mb or grown["handles"] > 0
                or grown["threads"] > 0)


def _stream(
    parts: Sequence[str], methods: Sequence[str], wanted_s: float, side: int,
    paced: bool,
) -> Iterator[Sample]:
    """Cycle through all ways of using the stream and all methods until the end."""
    begun, stream_s = time.monotonic(), 0.0
    with tempfile.TemporaryDirectory() as folder:
        ways: dict[str, Callable[..., Iterator[PolarFrame]]] = {
            "fuse": _fused, "export": _exported, "live": _live, "viewer": _viewed}
        while True:
            for method in methods:
                for way in parts:
                    seconds = min(PART_S, wanted_s - stream_s)
                    where = (f"simulate:polarizer?size={side}x{side}&rpm={RPM:g}"
                             f"&speed={int(paced)}&seconds={seconds:g}")
                    images, drift = _followed(
                        ways[way](where, method, Path(folder)))
                    stream_s += seconds
                    gc.collect()
                    yield Sample(round(stream_s, 3), time.monotonic() - begun, way,
                                 method, images, _rss_mb(),
                                 len(os.listdir("/proc/self/fd")),
                                 threading.active_count(), drift)
                    if stream_s >= wanted_s - 1e-6:
                        return


def _followed(images: Iterator[PolarFrame]) -> tuple[int, float]:
    """Return the number of images, and the distance of the last from an earlier one.

    The distance is the root mean square of I0 .. I135 relative to S0, of the last
    image and the one at the same phase of the second period.
    """
    period = round(PERIOD_US * FPS / 1e6)
    early: dict[int, Any] = {}
    count, last = 0, None
    for image in images:
        if period <= count < 2 * period:
            early[count % period] = image.quad.copy()
        last = (count, image)
        count += 1
    if last is None or (last[0] % period) not in early or last[0] < 2 * period:
        return count, math.nan
    number, image = last
    valid = image.valid
    if not valid.any():
        return count, math.nan
    change = (image.quad - early[number % period])[:, valid]
    level = float(np.mean(image.s0[valid]))
    return count, float(np.sqrt(np.mean(change ** 2))) / level


def _options(method: str) -> dict[str, Any]:
    return {"method": method, "fps": FPS}


def _fused(where: str, method: str, folder: Path) -> Iterator[PolarFrame]:
    from pdavis_cv import fuse, open_source
    with open_source(where) as source:
        yield from fuse(source, causal=True, **_options(method))


def _exported(where: str, method: str, folder: Path) -> Iterator[PolarFrame]:
    from pdavis_cv.export import NpyFile
    path = folder / "x.npy"
    with NpyFile(path, ["quad"]) as file:
        for image in _fused(where, method, folder):
            file.add(image)
            yield image
    path.unlink()


def _live(where: str, method: str, folder: Path) -> Iterator[PolarFrame]:
    from pdavis_cv.live import Session
    path = folder / "x.aedat4"
    with Session(where, record=path, **_options(method)) as session:
        yield from session
    path.unlink()


def _viewed(where: str, method: str, folder: Path) -> Iterator[PolarFrame]:
    """Yield images while a client requests them."""
    from pdavis_cv import serve
    from pdavis_cv.live import Session
    with Session(where, **_options(method)) as session, serve(
            session, port=0) as server:
        ended = threading.Event()
        page = threading.Thread(target=_look, args=(server.url, ended))
        page.start()
        try:
            yield from session
        finally:
            ended.set()
            page.join()


def _look(url: str, ended: threading.Event) -> None:
    """Request the last image again and again."""
    while not ended.is_set():
        try:
            with urllib.request.urlopen(url + "snapshot.npz", timeout=60) as answer:
                answer.read()
        except urllib.error.HTTPError as error:
            if error.code != HTTPStatus.SERVICE_UNAVAILABLE:    # no image yet
                raise
        ended.wait(0.02)


def _rss_mb() -> float:
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20


def _write(path: Path, samples: list[Sample]) -> None:
    from pdavis_cv._beside import write_beside
    with write_beside(path) as part, open(part, "w", newline="") as file:
        table = csv.writer(file)
        table.writerow(field.name for field in fields(Sample))
        table.writerows(astuple(sample) for sample in samples)


def _parser() -> argparse.ArgumentParser:
    parser = Parser("soak", __doc__ or "", "python -m lab.soak --hours 24 -o soak.csv")
    parser.prog = "python -m lab.soak"
    parser.add_argument("--hours", type=positive, default=24.0,
                        help="hours of stream time, default 24")
    parser.add_argument("--minutes", type=positive,
                        help="minutes of stream time, instead of --hours")
    parser.add_argument("--paced", action="store_true",
                        help="in real time instead of as fast as possible")
    parser.add_argument("--methods", metavar="M,M", help="default all")
    parser.add_argument("--parts", nargs="+", choices=PARTS, help="default all")
    parser.add_argument("--size", type=int, default=8, choices=(8, 16, 32, 64),
                        help="height and width in pixels, default 8")
    parser.add_argument("--most-mb", type=positive, default=10.0,
                        help="largest growth of memory that passes, default 10")
    parser.add_argument("-o", "--out", type=Path, metavar="CSV",
                        help="table of samples")
    add_json_option(parser)
    return parser


if __name__ == "__main__":
    raise SystemExit(main())
