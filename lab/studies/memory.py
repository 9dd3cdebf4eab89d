"""Memory of long runs at 346x260 pixels: a stream of an hour, and kept snapshots.

python -m lab.studies.memory stream [--minutes 60]      one pass, kalman, causal
python -m lab.studies.memory snapshots [--seconds 60]   a VideoCapture read to the end

Uniform events, 33 thousand per second, and 25 frames per second.  The stream's bound
is 300 MB resident.  A `Cursor` keeps snapshots of at most 256 MiB: that, and a tenth,
is the bound on the growth of resident memory from the first image on.  Reads /proc:
Linux only.
"""
from __future__ import annotations

import argparse
import multiprocessing
import os
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

from lab.bench.images import SHAPE, endless
from pdavis_cv import Aedat4Writer, Layout, VideoCapture, fuse

EVENTS_PER_S = 33_000.0
FPS = 10
STREAM_MB = 300e6 / 2**20
SNAPSHOTS_MB = 1.1 * 256
WAYS: dict[str, dict[str, Any]] = {
    "default": {}, "offline": {"mode": "offline"}, "causal": {"causal": True},
    "denoise": {"denoise": True}}


def rss_mb() -> float:
    """Return the resident memory of this process, MiB."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20


def stream(minutes: float) -> float:
    """Fuse a stream that is read once; return the largest resident memory, MiB."""
    begun, most, told = time.perf_counter(), 0.0, 0.0
    images = fuse(endless(EVENTS_PER_S), method="kalman", causal=True, fps=FPS)
    for number, _ in enumerate(images):
        passed = number / FPS / 60
        most = max(most, rss_mb())
        if passed >= told:
            print(f"{passed:5.1f} min of stream, {time.perf_counter() - begun:6.0f} s: "
                  f"{rss_mb():.1f} MiB, most {most:.1f} of {STREAM_MB:.0f}", flush=True)
            told += 1 if passed < 5 else 5
        if passed >= minutes:
            break
    return most


def write(path: Path, seconds: float) -> None:
    """Write so much of the stream."""
    with Aedat4Writer(path, sensor_size=SHAPE, layout=Layout.PDAVIS) as file:
        for packet in endless(EVENTS_PER_S).packets():
            file.add(packet)
            if len(packet.events) and packet.events["t"][-1] >= 1e6 * seconds:
                break


def grown_mb(path: Path, options: dict[str, Any]) -> tuple[float, float]:
    """Return resident memory after the first image, and its growth to the end, MiB."""
    capture = VideoCapture(path, method="kalman", fps=FPS, **options)
    if not capture.read()[0]:
        raise RuntimeError(capture.last_error)
    first = most = rss_mb()
    while capture.read()[0]:
        most = max(most, rss_mb())
    return first, most - first


def apart(function: Callable[..., Any], *given: Any) -> Any:
    """Call a function in a process of its own, with memory of its own."""
    spawn = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(1, mp_context=spawn) as pool:
        return pool.submit(function, *given).result()


def snapshots(seconds: float) -> bool:
    """Read a recording to its end in each way; return whether the bound holds."""
    holds = True
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "x.aedat4"
        write(path, seconds)
        for name, options in WAYS.items():
            first, grown = apart(grown_mb, path, options)
            print(f"{name:8} {first:6.0f} MiB after the first image, +{grown:.0f} of "
                  f"{SNAPSHOTS_MB:.0f}", flush=True)
            holds &= grown <= SNAPSHOTS_MB
    return holds


def main(argv: Sequence[str] | None = None) -> int:
    """Run one of the two, or both; return 1 if a bound does not hold."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", nargs="?", choices=("stream", "snapshots"),
                        help="default both")
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--quick", action="store_true", help="1.2 s of each")
    args = parser.parse_args(argv)
    if args.quick:
        args.minutes, args.seconds = 0.02, 1.2
    holds = True
    if args.what != "snapshots":
        holds = apart(stream, args.minutes) <= STREAM_MB
    if args.what != "stream":
        holds &= snapshots(args.seconds)
    return int(not holds)


if __name__ == "__main__":
    sys.exit(main())
