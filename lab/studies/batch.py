"""What `docs/batch.md` says of speed: workers, done jobs, memory, recordings per hour.

python lab/studies/batch.py workers    two workers against one, 16 recordings, kalman
python lab/studies/batch.py done       a second run of 200 done jobs
python lab/studies/batch.py memory     the parent's memory with 10,000 jobs
python lab/studies/batch.py warmup     what cf still knows of seconds ago
"""
from __future__ import annotations

import argparse
import os
import resource
import tempfile
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Executor, Future
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdavis_cv import (
    FusionOptions,
    Layout,
    batch,
    fuse,
    recording_from_arrays,
    write_aedat4,
)
from pdavis_cv.simulation import Camera, named_scene

SIZE, SECONDS, RPM = (32, 32), 1.0, 300.0   # of each simulated recording
KALMAN = FusionOptions(method="kalman", fps=100, layout="pdavis")


def recordings(folder: Path, count: int) -> list[Path]:
    """Simulate a turning polarizer by so many specimens of a camera."""
    paths = []
    for seed in range(count):
        camera = Camera.preset("nominal", seed=seed, size=SIZE)
        scene = named_scene("polarizer", seconds=SECONDS, rpm=RPM, hz=1.0, seed=seed,
                            camera="nominal")
        recording, _ = camera.record(scene, SECONDS)
        paths.append(folder / f"run{seed:03}.aedat4")
        write_aedat4(paths[-1], recording)
    return paths


def workers(folder: Path) -> None:
    """Print wall and CPU time of one worker and of two, interleaved."""
    paths = recordings(folder, 16)
    for turn in range(2):
        for count in (1, 2):
            start = time.perf_counter()
            table = batch.run(paths, KALMAN, folder / f"{turn}-{count}", workers=count,
                              work="traces", progress=False)
            wall = time.perf_counter() - start
            cpu = sum(row["cpu_s"] for row in table)
            peak = max(row["peak_mib"] for row in table)
            busy = sum(row["wall_s"] for row in table)
            print(f"{count} workers: {wall:.1f} s, {cpu:.1f} s of CPU in jobs, workers "
                  f"busy {busy / wall / count:.0%}, peak {peak:.0f} MiB, "
                  f"load {os.getloadavg()[0]:.1f}")


def done(folder: Path) -> None:
    """Print the time of a second run of 200 jobs."""
    paths = recordings(folder, 2)
    options = [KALMAN.replace(method="cf", cutoff_hz=1 + k / 100) for k in range(100)]
    for _ in range(2):
        start, cpu = time.perf_counter(), time.process_time()
        table = batch.run(paths, options, folder / "out", progress=False,
                          work=batch.Trace(stop_s=0.1))
        print(f"{len(table)} jobs: {time.perf_counter() - start:.2f} s, "
              f"{time.process_time() - cpu:.2f} s of CPU in the parent")


class Nothing:
    """A work that opens nothing and does nothing."""

    opens = False

    def __call__(self, source: Any, options: FusionOptions, folder: Path) -> None:
        """Do nothing."""


class Inline(Executor):
    """Does everything at once, so that all memory is the parent's."""

    def submit(  # type: ignore[override]
        self, function: Callable[..., Any], /, *args: Any, **kwargs: Any
    ) -> Future[Any]:
        """Do it."""
        future: Future[Any] = Future()
        future.set_result(function(*args, **kwargs))
        return future


def memory(folder: Path) -> None:
    """Print the peak of the parent's memory after 200 and after 10,000 jobs."""
    for count in (200, 10_000):
        batch.run((f"part{i}" for i in range(count)), FusionOptions(), folder / "out",
                  work=Nothing(), executor=Inline(), progress=False)
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
        print(f"{count} jobs: peak {peak:.0f} MiB")


def warmup(folder: Path) -> None:
    """Print how many numbers of cf differ if the recording begins so late."""
    seconds, start_us = 21.0, 20_000_000
    camera = Camera.preset("nominal", seed=1, size=(24, 24))
    scene = named_scene("polarizer", seconds=seconds, rpm=60.0, hz=1.0, seed=1,
                        camera="nominal")
    recording, _ = camera.record(scene, seconds)
    packets = list(recording.packets())
    events = np.concatenate([packet.events for packet in packets])
    frames = [frame for packet in packets for frame in packet.frames]
    options = FusionOptions(method="cf", layout="pdavis", fps=50, start_us=start_us)

    def numbers(begin_us: int) -> NDArray[np.float32]:
        part = recording_from_arrays(
            events[events["t"] >= begin_us],
            [frame for frame in frames if frame.mid_us >= begin_us],
            sensor_size=(24, 24), layout=Layout.PDAVIS)
        return np.stack([image.quad for image in fuse(part, options)])

    whole = numbers(0)
    for before_s in (1, 2, 3, 5, 8, 12, 16):
        late = numbers(start_us - round(before_s * 1e6))
        print(f"{before_s} s before: {np.mean(late != whole):.2%} of {whole.size} "
              f"numbers differ, by {np.max(np.abs(late / whole - 1)):.1g} at most")


def main(argv: Sequence[str] | None = None) -> int:
    """Run what is asked for; return 0."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("what", choices=tuple(_STUDIES), nargs="?", default="memory")
    parser.add_argument("--quick", action="store_true", help="a first look: done")
    args = parser.parse_args(argv)
    with tempfile.TemporaryDirectory() as folder:
        _STUDIES["done" if args.quick else args.what](Path(folder))
    return 0


_STUDIES = {"workers": workers, "done": done, "memory": memory, "warmup": warmup}

if __name__ == "__main__":
    raise SystemExit(main())
