"""What `python -m lab.bench` times of reading and writing recordings.

The peers are other people's packages: a case whose peer is not installed is skipped.
"""
from __future__ import annotations

import importlib
import inspect
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from time import perf_counter, process_time
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdavis_cv.events import EVENT_DTYPE
from pdavis_cv.recording.aedat2.writer import write_aedat2
from pdavis_cv.recording.aedat4.writer import Aedat4Writer, write_aedat4
from pdavis_cv.recording.base import ApsFrame, Packet
from pdavis_cv.recording.memory import recording_from_arrays
from pdavis_cv.recording.open import open_recording

from .cases import EVENTS, PACKET, SHAPE, Comparison, case, event_input
from .event_files import write_evt3

KINDS = ("uniform", "clustered")
SMALL, FRAMES = 80_000, 60
"""A second as a DAVIS346 in a calm scene gives it: small packets, many frames."""


def _seconds(work: Callable[..., object], *arguments: Any) -> float:
    start = perf_counter()
    work(*arguments)
    return perf_counter() - start


def _rate(count: int, seconds: float) -> float:
    return count / seconds / 1e6


def _peer(name: str) -> Any:
    try:
        return importlib.import_module(name)
    except ImportError:
        raise ImportError(f"{name} is not installed") from None


def _all_events(path: Path) -> NDArray[Any]:
    with open_recording(path) as recording:
        return recording.events()


def _numpy_aedat2(path: Path, start: int) -> NDArray[Any]:
    """Return the events of AEDAT-2.0 words as NumPy alone decodes them."""
    words = np.frombuffer(path.read_bytes(), ">u4", offset=start).reshape(-1, 2)
    height, width = SHAPE
    address = words[:, 0].astype(np.uint32)
    x, y = address >> 12 & 0x3FF, address >> 22 & 0x1FF
    keep = (address & 0x80000400 == 0) & (x < width) & (y < height)
    address, x, y = address[keep], x[keep], y[keep]
    events = np.empty(len(address), EVENT_DTYPE)
    events["t"] = words[:, 1].astype(np.int32)[keep]
    events["x"], events["y"] = width - 1 - x, height - 1 - y
    events["p"] = address >> 11 & 1
    return events


@case("aedat2", "AEDAT-2.0 to one array, against NumPy", 3)
def _aedat2() -> Iterator[Comparison]:
    for kind in KINDS:
        events = event_input(kind)
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "events.aedat2"
            write_aedat2(path, recording_from_arrays(events, sensor_size=SHAPE))
            start = path.stat().st_size - 8 * EVENTS
            origin = events["t"][0] - _numpy_aedat2(path, start)["t"][0]

            def check(events: NDArray[Any] = events, path: Path = path,
                      start: int = start, origin: int = origin) -> None:
                np.testing.assert_array_equal(_all_events(path), events)
                again = _numpy_aedat2(path, start)
                again["t"] += origin
                np.testing.assert_array_equal(again, events)

            yield Comparison(
                kind, check,
                partial(_seconds, _all_events, path),
                partial(_seconds, _numpy_aedat2, path, start),
                partial(_rate, EVENTS), "Mev/s")


@case("aedat4", "AEDAT-4 (LZ4) to one array, against aedat and concatenate", 1.2)
def _aedat4() -> Iterator[Comparison]:
    aedat = _peer("aedat")

    def theirs(path: Path) -> NDArray[Any]:
        return np.concatenate([
            packet["events"] for packet in aedat.Decoder(path) if "events" in packet])

    rng = np.random.default_rng(4)
    frames = [ApsFrame(rng.integers(100, 900, SHAPE), t, t + 8_000)
              for t in range(2_000, 1_000_000, 1_000_000 // FRAMES)]
    inputs: dict[str, tuple[NDArray[Any], list[ApsFrame]]] = {
        kind: (event_input(kind), []) for kind in KINDS}
    inputs["calm, with frames"] = (
        np.ascontiguousarray(event_input("uniform")[::EVENTS // SMALL]), frames)
    for name, (events, images) in inputs.items():
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "events.aedat4"
            write_aedat4(path, recording_from_arrays(
                events, images, sensor_size=SHAPE))

            def check(events: NDArray[Any] = events, path: Path = path) -> None:
                np.testing.assert_array_equal(_all_events(path), events)
                got = theirs(path)
                for ours, other in zip("txyp", ("t", "x", "y", "on"), strict=True):
                    np.testing.assert_array_equal(got[other], events[ours])

            yield Comparison(
                name, check,
                partial(_seconds, _all_events, path),
                partial(_seconds, theirs, path),
                partial(_rate, len(events)), "Mev/s")


def _by_this(pdavis_cv: Any, path: Path) -> Iterator[NDArray[Any]]:
    with pdavis_cv.open_recording(path) as recording:
        for packet in recording.packets():
            yield packet.events


def _by_aedat(aedat: Any, path: Path) -> Iterator[NDArray[Any]]:
    return (packet["events"] for packet in aedat.Decoder(path) if "events" in packet)


def _by_faery(faery: Any, path: Path) -> Iterator[NDArray[Any]]:
    if path.suffix == ".raw":
        yield from faery.events_stream_from_file(path)
        return
    with faery.aedat.Decoder(path) as decoder:
        for _, events in decoder:
            yield events


def _by_dv(dv: Any, path: Path) -> Iterator[NDArray[Any]]:
    recording = dv.io.MonoCameraRecording(str(path))
    while recording.isRunning():
        if (batch := recording.getNextEventBatch()) is not None:
            yield batch.numpy()


_READERS: dict[str, Callable[[Any, Path], Iterator[NDArray[Any]]]] = {
    "pdavis_cv": _by_this, "aedat": _by_aedat, "faery": _by_faery,
    "dv_processing": _by_dv}
"""Functions that pass over the packets of a file as arrays, by the package they use."""


def _pass_seconds(name: str, path: Path) -> float:
    """Return the CPU time of a pass in this process."""
    reader, start = _peer(name), process_time()
    sum(map(len, _READERS[name](reader, path)))
    return process_time() - start


def _process_seconds(name: str, path: Path) -> float:
    """Return the CPU time of a process that passes over a file once."""
    from resource import RUSAGE_CHILDREN, getrusage  # which Windows lacks
    read = _READERS[name]
    program = "\n".join((
        "from __future__ import annotations", "import sys", "from pathlib import Path",
        f"import {name} as reader", inspect.getsource(read),
        f"sum(map(len, {read.__name__}(reader, Path(sys.argv[1]))))"))
    before = getrusage(RUSAGE_CHILDREN)
    subprocess.run([sys.executable, "-c", program, path], check=True)
    after = getrusage(RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def _packets(seconds: Callable[[str, Path], float]) -> Iterator[Comparison]:
    """Yield comparisons of what it takes to pass over files."""
    second = event_input("uniform")
    longer = np.tile(second, 4)
    longer["t"] += np.repeat(np.arange(4) * 1_000_000, EVENTS)
    calm = second.copy()
    calm["t"] *= 30     # packets of 330 events
    with tempfile.TemporaryDirectory() as folder:
        for name, events in (("1 s", second), ("4 s", longer), ("30 s", calm)):
            path = Path(folder) / f"{name}.aedat4"
            write_aedat4(path, recording_from_arrays(events, sensor_size=SHAPE))
            for peer in ("aedat", "faery", "dv_processing"):
                yield _by_packets(path, peer, len(events), seconds)
        for name, events in (("1 s", second), ("30 s", calm)):
            path = Path(folder) / f"{name}.raw"
            write_evt3(path, events)
            yield _by_packets(path, "faery", EVENTS, seconds)


def _by_packets(path: Path, peer: str, count: int,
                seconds: Callable[[str, Path], float]) -> Comparison:
    def check() -> None:
        one, two = (np.concatenate(list(_READERS[name](_peer(name), path)))
                    for name in ("pdavis_cv", peer))
        for a, b in zip(one.dtype.names or (), two.dtype.names or (), strict=True):
            np.testing.assert_array_equal(one[a], two[b])

    return Comparison(
        f"{path.name} by {peer}", check, partial(seconds, "pdavis_cv", path),
        partial(seconds, peer, path), partial(_rate, count), "Mev/s")


@case("packets", "AEDAT-4 (LZ4) and EVT3 in packets, CPU time, against readers", 0.9)
def _packets_again() -> Iterator[Comparison]:
    return _packets(_pass_seconds)


@case("packets-once", "a process that reads AEDAT-4 (LZ4) or EVT3 once, CPU time", 0.9)
def _packets_once() -> Iterator[Comparison]:
    return _packets(_process_seconds)


@case("aedat4_write", "AEDAT-4 (LZ4) from packets of 10,000, against faery", 1.0)
def _aedat4_write() -> Iterator[Comparison]:
    faery = _peer("faery")

    def theirs(packets: list[NDArray[Any]], path: Path) -> Callable[[], None]:
        foreign = [_for_faery(packet, faery.EVENTS_DTYPE) for packet in packets]
        description = _description(faery.aedat)

        def write() -> None:
            with faery.aedat.Encoder(
                    path, description, faery.aedat.LZ4_DEFAULT) as writer:
                for packet in foreign:
                    writer.write(0, packet)
        return write

    return _writing(theirs)


@case("aedat4_write_dv",
      "AEDAT-4 (LZ4) from packets of 10,000, against dv_processing", 1.0)
def _aedat4_write_dv() -> Iterator[Comparison]:
    dv = _peer("dv_processing")

    def theirs(packets: list[NDArray[Any]], path: Path) -> Callable[[], None]:
        stores = []
        for packet in packets:
            stores.append(dv.EventStore())
            for t, x, y, p in packet.tolist():
                stores[-1].push_back(t, x, y, p == 1)
        options = dv.io.MonoCameraWriter.EventOnlyConfig(
            "DAVIS346_00000000", SHAPE[::-1], dv.CompressionType.LZ4)

        def write() -> None:
            writer = dv.io.MonoCameraWriter(str(path), options)
            for store in stores:
                writer.writeEvents(store)
            del writer      # ends the file
        return write

    return _writing(theirs)


def _writing(
    peer: Callable[[list[NDArray[Any]], Path], Callable[[], None]]
) -> Iterator[Comparison]:
    """Yield comparisons with what `peer` returns: what writes packets to a path."""
    for kind in KINDS:
        events = event_input(kind)
        packets = [events[i:i + PACKET] for i in range(0, EVENTS, PACKET)]
        with tempfile.TemporaryDirectory() as folder:
            path, other = Path(folder) / "ours.aedat4", Path(folder) / "other.aedat4"

            def ours(packets: list[NDArray[Any]] = packets, path: Path = path) -> None:
                with Aedat4Writer(path, sensor_size=SHAPE) as writer:
                    for packet in packets:
                        writer.add(Packet(packet))

            theirs = peer(packets, other)

            def check(events: NDArray[Any] = events, path: Path = path,
                      other: Path = other,
                      work: tuple[Callable[[], None], ...] = (ours, theirs)) -> None:
                for one, written in zip(work, (path, other), strict=True):
                    one()
                    np.testing.assert_array_equal(_all_events(written), events)

            yield Comparison(kind, check, partial(_seconds, ours),
                             partial(_seconds, theirs), partial(_rate, EVENTS), "Mev/s")


def _for_faery(events: NDArray[Any], dtype: Any) -> NDArray[Any]:
    out = np.empty(len(events), dtype)
    for ours, other in zip("txyp", ("t", "x", "y", "on"), strict=True):
        out[other] = events[ours]
    return out


def _description(aedat: Any) -> list[Any]:
    """Return the header that faery's own file writer gives to its encoder."""
    node, attribute = aedat.DescriptionNode, aedat.DescriptionAttribute
    path = "/mainloop/Recorder/outInfo/"
    info = node("info", f"{path}0/info/", {
        "sizeX": attribute("int", SHAPE[1]), "sizeY": attribute("int", SHAPE[0]),
        "source": attribute("string", "faery")}, [])
    stream = node("0", f"{path}0/", {
        "compression": attribute("string", "LZ4"),
        "originalOutputName": attribute("string", "events"),
        "typeIdentifier": attribute("string", "EVTS")}, [info])
    return [node("outInfo", path, {}, [stream])]
