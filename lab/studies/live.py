"""What `lab/docs/live.md` says of speed: latency, a browser, bursts, the bridge.

python lab/studies/live.py image FOLDER   event to image, 1 Mev/s, 60 images/s
python lab/studies/live.py page FOLDER    event to drawn, and images drawn, in Chromium
python lab/studies/live.py burst FOLDER   10 Mev/s for a minute: memory and losses
python lab/studies/live.py bridge FOLDER  images of the MJPEG bridge that cv2 gets

FOLDER keeps the simulated recordings: the fan before 346x260 pixels, at the speed that
gives the rate.  An event arrives when its packet of 2 ms is complete.
"""
from __future__ import annotations

import argparse
import contextlib
import itertools
import multiprocessing
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np

from lab.bench.images import endless
from pdavis_cv import Layout, open_recording, recording_from_arrays, serve, write_aedat4
from pdavis_cv.live import Session
from pdavis_cv.live.clock import moved
from pdavis_cv.live.replay import ReplaySource
from pdavis_cv.recording.base import Packet, Recording
from pdavis_cv.simulation import Camera, named_scene
from pdavis_cv.viewer import handler
from pdavis_cv.viewer.show import LiveShow

SIZE = (260, 346)
FAN_RPM = {1: 12.4, 10: 124.0}      # by Mev/s
AFTER_S = 10.0      # of a burst
LEARN_S = 10.0      # until then the camera is learned: shown apart


def fan(folder: Path, mev_s: int) -> Recording:
    """Open a turn of the fan, simulated once, of which each second has a rate."""
    path = folder / f"fan-{mev_s}.aedat4"
    if not path.exists():
        seconds = 60 / FAN_RPM[mev_s]
        scene = named_scene("fan", seconds=seconds, rpm=FAN_RPM[mev_s], hz=1.0, seed=0,
                            camera="nominal")
        made, _ = Camera.preset("nominal", seed=0, size=SIZE).record(scene, seconds)
        write_aedat4(path, made)
    recording = open_recording(path, layout=Layout.PDAVIS)
    parts = list(recording.packets())
    events = np.concatenate([part.events for part in parts])
    frames = [frame for part in parts for frame in part.frames]
    recording.close()
    return recording_from_arrays(events, frames, sensor_size=SIZE,
                                 layout=Layout.PDAVIS)


def noise(folder: Path, mev_s: int) -> Recording:
    """Return 4 s of events all over the sensor, as `python -m lab.bench` makes them."""
    packets = itertools.takewhile(
        lambda packet: packet.stop_us < 4_000_000, endless(1e6 * mev_s).packets())
    parts = list(packets)
    return recording_from_arrays(
        np.concatenate([part.events for part in parts]),
        [frame for part in parts for frame in part.frames],
        sensor_size=SIZE, layout=Layout.PDAVIS)


SCENES = {"fan": fan, "noise": noise}


def told(name: str, values: Sequence[float]) -> None:
    """Print the quantiles of latencies in ms."""
    if not len(values):
        print(f"{name}: none")
        return
    p50, p95, p99 = np.quantile(values, (0.5, 0.95, 0.99))
    print(f"{name}: {len(values)}, median {p50:.1f}, 95 % {p95:.1f}, 99 % {p99:.1f}, "
          f"most {max(values):.1f} ms", flush=True)


def image(folder: Path, args: argparse.Namespace) -> None:
    """Print the latency from an event's time to the image that shows it."""
    source = ReplaySource(SCENES[args.scene](folder, args.rate), "fan", loop=True)
    late: list[tuple[float, float]] = []
    with Session(source, method=args.method, fps=args.fps,
                 threads=args.threads) as session:
        begun, cpu = time.monotonic(), time.process_time()
        while time.monotonic() - begun < args.seconds:
            shown = session.read(60)
            assert shown is not None
            now = time.monotonic()
            late.append((now - begun, 1e3 * (now - session.clock.host_s(shown.t_us))))
        stats = session.stats
        used = (time.process_time() - cpu) / (time.monotonic() - begun)
    told(f"first {LEARN_S:g} s", [value for t, value in late if t < LEARN_S])
    told("after", [value for t, value in late if t >= LEARN_S])
    # An image whose successor is due is skipped, so that ages alone do not show for how
    # long none has come.
    told("between two images", [1e3 * (now - before) for (before, _), (now, _)
                                in itertools.pairwise(late) if now >= LEARN_S])
    print(f"{used:.2f} CPU-s per s, skipped {stats.skipped_images}, dropped "
          f"{stats.dropped_events}, {stats.events_per_s / 1e6:.2f} Mev/s, load "
          f"{os.getloadavg()[0]:.1f}")


def cpu_of_children() -> float:
    """Return the processor time of this process's descendants, s; Linux only."""
    parents: dict[int, int] = {}
    used: dict[int, float] = {}
    for entry in Path("/proc").iterdir():
        if not entry.name.isdigit():
            continue
        try:
            parts = (entry / "stat").read_text().rpartition(")")[2].split()
        except OSError:
            continue
        parents[int(entry.name)] = int(parts[1])
        used[int(entry.name)] = (int(parts[11]) + int(parts[12])) / os.sysconf(
            "SC_CLK_TCK")
    total = 0.0
    for process, seconds in used.items():
        above = parents.get(process, 0)
        while above and above != os.getpid():
            above = parents.get(above, 0)
        total += seconds if above else 0.0
    return total


# ---- in a browser ------------------------------------------------------------------

WATCH = b"""
{   const before = take, channel = new MessageChannel();
    let painted = [], seen = [];
    channel.port1.onmessage = () => {
        const at = Date.now() + 0.5;
        seen.push(...painted.map(t => [t, at]));
        painted = [];
    };
    take = buffer => {
        const told = before(buffer);
        if (told.planes.length)
            requestAnimationFrame(() => {
                painted.push(told.t_us);
                channel.port2.postMessage(0);
            });
        return told;
    };
    setInterval(() => fetch(address("command", {}), {
        method: "POST", headers: {"Content-Type": "application/json"},
        body: JSON.stringify({do: "seen", value: seen.splice(0)})}), 500);
}
"""
"""Ends the page's program: a drawing is seen when the frame that holds it has been
painted.  The page says so itself, every half second, because a browser that is watched
through DevTools sends each message of its WebSocket there too, .3 CPU-s per s.  Times
are the system's, in whole ms: `performance.timeOrigin` was up to 25 ms off."""

CHROMIUM = ("--headless", "--no-sandbox", "--disable-gpu", "--disable-quic",
            "--no-first-run", "--disable-background-networking",
            "--disable-component-update", "--disable-sync", "--window-size=1280,900",
            "--remote-debugging-port=0")


@contextlib.contextmanager
def watched(report: Callable[[list[tuple[int, float]]], None]) -> Iterator[None]:
    """Have pages report what they have painted, each t_us and ms since 1970."""
    page_of, commands_of = handler.page, LiveShow.commands
    with mock.patch.object(handler, "page", lambda name: page_of(name) + (
            WATCH if name == "page.js" else b"")), mock.patch.object(
            LiveShow, "commands",
            lambda show: {**commands_of(show), "seen": report}):
        yield


@contextlib.contextmanager
def chromium(url: str) -> Iterator[None]:
    """Show a page in headless Chromium."""
    program = shutil.which("chromium")
    if program is None:
        raise SystemExit("page: needs Chromium, got no program chromium")
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        browser = subprocess.Popen(
            [program, *CHROMIUM, f"--user-data-dir={profile}", url],
            stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        try:
            yield
        finally:
            browser.terminate()
            browser.wait()


def page(folder: Path, args: argparse.Namespace) -> None:
    """Print the latency from an event's time to its drawing, and images per second."""
    source = ReplaySource(SCENES[args.scene](folder, args.rate), "fan", loop=True)
    epoch = time.time() - time.monotonic()
    seen: list[tuple[int, float, float]] = []   # t_us, time drawn in s, latency in ms
    with Session(source, method=args.method, fps=args.fps,
                 threads=args.threads) as session:

        def report(painted: list[tuple[int, float]]) -> None:
            for t_us, at_ms in painted:
                at = 1e-3 * at_ms - epoch
                seen.append((t_us, at, 1e3 * (at - session.clock.host_s(t_us))))

        with watched(report), serve(session, port=0) as server, chromium(server.url):
            time.sleep(LEARN_S)
            cpu, begun = time.process_time(), time.monotonic()
            children = cpu_of_children()
            time.sleep(args.seconds)
            passed = time.monotonic() - begun
            used = (time.process_time() - cpu) / passed
            drawing = (cpu_of_children() - children) / passed
            stats = session.stats
            time.sleep(1)       # the last report
    within = [one for one in seen if begun <= one[1] < begun + passed]
    late = [latency for _, _, latency in within]
    drawn = len({t_us for t_us, _, _ in within}) / passed
    told("event to drawn", late)
    print(f"drawn {drawn:.1f} of {args.fps:g} images/s; event to image "
          f"{stats.latency_ms:.1f}, 95 % {stats.latency_p95_ms:.1f} ms, "
          f"{stats.images_per_s:.1f} images/s; CPU-s per s: "
          f"session and server {used:.2f}, browser {drawing:.2f}; load "
          f"{os.getloadavg()[0]:.1f}")


# ---- a burst -----------------------------------------------------------------------

def rss_mib() -> float:
    """Return the memory of this process."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20


class Burst(ReplaySource):
    """Sends a recording for some seconds, then another; counts what it sends."""

    def __init__(self, first: Recording, then: Recording, burst_s: float) -> None:
        super().__init__(first, "burst", loop=True, seconds=burst_s + AFTER_S)
        self._then = ReplaySource(then, "then", loop=True)
        self._burst_us = round(1e6 * burst_s)
        self.sent = 0

    def _stream(self) -> Iterator[Packet]:
        start = offset = 0
        for packet in super()._stream():
            start = start or packet.start_us
            offset = packet.stop_us
            if offset - start > self._burst_us:
                break
            yield packet
        for packet in self._then._stream():
            yield moved(packet, offset)

    def _arrivals(self) -> Iterator[Packet]:
        for packet in super()._arrivals():
            self.sent += len(packet.events)
            yield packet


def burst(folder: Path, args: argparse.Namespace) -> None:
    """Print what a minute of 10 Mev/s does, and whether the recording is complete."""
    scene = SCENES[args.scene]
    source = Burst(scene(folder, 10), scene(folder, 1), args.seconds)
    with tempfile.TemporaryDirectory(dir=folder) as place:
        path = Path(place) / "burst.aedat4"
        begun, cpu = time.monotonic(), time.process_time()
        memory: list[float] = []
        after: list[float] = []
        with Session(source, method=args.method, fps=args.fps, threads=args.threads,
                     record=path) as session:
            while True:
                try:
                    shown = session.read(0.5)
                except TimeoutError:
                    continue
                if shown is None:
                    break
                if time.monotonic() - begun > args.seconds + 1:
                    after.append(
                        1e3 * (time.monotonic() - session.clock.host_s(shown.t_us)))
                if time.monotonic() - begun > len(memory):
                    memory.append(rss_mib())
            wall = time.monotonic() - begun
            stats = session.stats
        stats_after = session.stats
        used = time.process_time() - cpu
        with open_recording(path, layout=Layout.PDAVIS) as made:
            recorded = sum(len(packet.events) for packet in made.packets())
        size = path.stat().st_size
    tenth = len(memory) // 6
    print(f"sent {source.sent}, recorded {recorded}, missing "
          f"{source.sent - recorded} (counted "
          f"{stats_after.unrecorded_events}), {size / 2**20:.0f} MiB")
    print(f"memory MiB: {', '.join(f'{m:.0f}' for m in memory[::max(tenth, 1)])}; most "
          f"{max(memory):.0f}")
    told("from 1 s after the burst on", after)
    print(f"fusing: {stats.method}, dropped {stats.dropped_events} in {stats.jumps} "
          f"jumps; {wall:.1f} s, "
          f"{used / wall:.2f} CPU-s per s, load {os.getloadavg()[0]:.1f}", flush=True)


# ---- the bridge --------------------------------------------------------------------

def bridge(folder: Path, args: argparse.Namespace) -> None:
    """Print how many images cv2 gets from the bridge, and how late."""
    source = ReplaySource(SCENES[args.scene](folder, args.rate), "fan", loop=True)
    sent: dict[int, float] = {}
    with Session(source, method=args.method, fps=args.fps,
                 threads=args.threads) as session, serve(
            session, port=0) as server:
        original = server.picture

        def noted(output: str, number: int, image: Any) -> bytes:
            sent.setdefault(number, time.time())
            return original(output, number, image)

        server.picture = noted  # type: ignore[method-assign]
        time.sleep(LEARN_S)
        sent.clear()
        context = multiprocessing.get_context("spawn")
        mine, theirs = context.Pipe()
        reader = context.Process(target=_read, args=(
            f"{server.url}stream.mjpg?output=aop_bgr", args.seconds, theirs))
        reader.start()
        version, times = mine.recv()
        reader.join()
    starts = np.array(sorted(sent.values()))
    at = np.searchsorted(starts, times) - 1
    told(f"cv2 {version}, sent to read", 1e3 * (np.array(times) - starts[at]))
    print(f"{len(times) / (times[-1] - times[0]):.1f} images/s of {args.fps:g}, load "
          f"{os.getloadavg()[0]:.1f}")


def _read(url: str, seconds: float, pipe: Any) -> None:
    import cv2
    capture = cv2.VideoCapture(url)
    times: list[float] = []
    begun = time.time()
    while time.time() - begun < seconds and capture.read()[0]:
        times.append(time.time())
    pipe.send((cv2.__version__, times))


def main(argv: Sequence[str] | None = None) -> int:
    """Run one of them."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    studies: dict[str, Callable[[Path, argparse.Namespace], None]] = {
        "image": image, "page": page, "burst": burst, "bridge": bridge}
    parser.add_argument("what", choices=studies, nargs="?", default="image")
    parser.add_argument("folder", type=Path, nargs="?", default=Path(
        tempfile.gettempdir()))
    parser.add_argument("--quick", action="store_true",
                        help="a second of random events, cf, which shows that it runs")
    parser.add_argument("--scene", choices=SCENES, default="fan")
    parser.add_argument("--method", default="kalman", type=lambda name: (
        None if name == "best" else name), help="best: none stated")
    parser.add_argument("--fps", type=float)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--seconds", type=float)
    parser.add_argument("--rate", type=int, default=1, choices=FAN_RPM, help="Mev/s")
    args = parser.parse_args(argv)
    if args.quick:
        args.scene, args.method, args.seconds = "noise", "cf", 1.0
    args.fps = args.fps or (30 if args.what == "page" else 60)
    args.seconds = args.seconds or {"image": 40, "burst": 60}.get(args.what, 20)
    studies[args.what](args.folder, args)
    return 0


if __name__ == "__main__":
    sys.exit(main())
