"""What is fuzzed: an entry per parser, and what each promises of any bytes."""
import contextlib
import functools
import logging
import os
import socket
import tempfile
import warnings
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace

import corpus
import mutators
import numpy as np
import records

import pdavis_cv
from pdavis_cv import open_recording

MOST_SAMPLES = 5_000_000
_DATABASE = b"SQLite format 3"


def read_recording(data, folder):
    """Read what may be a recording from end to end; return the places of its events.

    Bytes with a database in them are a folder: metadata.yaml, then the database.

    Raises
    ------
    RecordingError
        If it is none.
    """
    metadata, found, database = data.partition(_DATABASE)
    path = folder
    if found:
        (folder / "metadata.yaml").write_bytes(metadata)
        (folder / "bag.db3").write_bytes(found + database)
    else:
        path = folder / "file.bin"
        path.write_bytes(data)
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        try:
            with open_recording(path) as recording:
                return _read(recording)
        finally:
            of_damage = [one for one in told
                         if issubclass(one.category, pdavis_cv.DamagedFileWarning)]
            assert len(of_damage) <= 1, of_damage
            foreign = [one for one in told
                       if not issubclass(one.category, pdavis_cv.PdavisWarning)]
            assert not foreign, foreign[0]


def _read(recording):
    """Return places of all events, after checks of what every packet promises."""
    height, width = recording.info.sensor_size
    places, count, before = [], 0, None
    for packet in recording.packets():
        events = packet.events
        assert len(events) <= 65_536
        assert len(packet.frames) <= 1
        assert packet.stop_us - packet.start_us <= 10_000
        assert before is None or packet.start_us >= before
        before = packet.stop_us - 1
        if len(events):
            assert events["x"].max() < width
            assert events["y"].max() < height
            assert events["p"].max() <= 1
            assert np.all(events["t"][1:] >= events["t"][:-1])
            places.append(events["y"].astype(np.int64) << 16 | events["x"])
        for frame in packet.frames:
            assert frame.shape == (height, width)
        count += len(events)
        assert count < MOST_SAMPLES
    assert len(recording.problems) < 100
    middle = None if before is None else before // 2
    for _ in recording.packets(middle, before):
        break
    recording.events(middle, before)
    return np.concatenate(places) if places else np.zeros(0, np.int64)


def read_weights(data, folder):
    """Read an archive as weights, or as a checkpoint where it looks like one."""
    from pdavis_cv.reconstruct.checkpoint import firenet_weights, read_state_dict
    from pdavis_cv.reconstruct.weights import Weights
    path = folder / "file.bin"
    path.write_bytes(data)
    with contextlib.suppress(pdavis_cv.errors.WeightsError):
        Weights.load(path)
    read_state_dict(path)
    firenet_weights(path)


def read_calibration(data, folder):
    """Read a camera's file, and use what it says as `fuse` would."""
    path = folder / "file.bin"
    path.write_bytes(data)
    known = pdavis_cv.Calibration.load(path)
    assert known.replace(notes={}).sensor_size == known.sensor_size


def read_load(data, folder):
    """Read the table of a test frame."""
    from pdavis_cv.analysis.load import read_load as read
    path = folder / "file.csv"
    path.write_bytes(data)
    trace = read(path)
    assert np.isfinite(trace.t_s).all()
    assert np.isfinite(trace.primary).all()
    assert (np.diff(trace.t_s) > 0).all()
    if trace.trigger is not None:
        trace.trigger_times()
    trace.inside_gap(trace.t_s)


def read_roi(data, folder):
    """Read Fiji's regions, and draw them."""
    from pdavis_cv.analysis.roi import read_rois
    logging.getLogger("roifile").setLevel(logging.ERROR)
    path = folder / "file.roi"
    path.write_bytes(data)
    for region in read_rois(path):
        region.mask((12, 16))


def read_dv(data, folder):
    """Receive a stream of DV's protocol."""
    from pdavis_cv.live import dv
    dv.MARGIN_US = 1 << 60      # how busy this machine is decides nothing
    ours, theirs = socket.socketpair()
    with theirs:
        theirs.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 1 << 22)
        theirs.setblocking(False)
        with contextlib.suppress(BlockingIOError):
            theirs.send(data)
    times, before = [], None
    try:
        with dv.DvSource("dv", [ours]) as source:
            height, width = source.info.sensor_size
            for packet in source.packets():
                assert packet.start_us is None or before is None or (
                    packet.start_us >= before)
                if packet.stop_us is not None:
                    before = packet.stop_us - 1
                assert not len(packet.events) or (
                    packet.events["x"].max() < width
                    and packet.events["y"].max() < height)
                times.append(packet.events["t"].copy())
                assert all(f.shape == (height, width) for f in packet.frames)
    finally:
        ours.close()
    return np.concatenate(times) if times else np.zeros(0, np.int64)


@functools.cache
def _viewer(pid):
    """Return what a handler needs, and a door: threads belong to one process."""
    from pdavis_cv.viewer import serve
    server = serve(corpus.small((12, 16), 1), port=0, layout=pdavis_cv.Layout.PDAVIS,
                   method="frames")
    door = socket.create_server(("127.0.0.1", 0))
    return SimpleNamespace(site=server.site, owner=server,
                           note=lambda *_: None), door


def read_http(data, folder):
    """Answer a request."""
    from pdavis_cv.viewer.handler import Handler
    server, door = _viewer(os.getpid())
    theirs = socket.create_connection(door.getsockname())
    ours, _ = door.accept()
    with ours, theirs:
        theirs.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 1 << 22)
        ours.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 1 << 22)
        theirs.sendall(data)
        theirs.shutdown(socket.SHUT_WR)
        if b"stream" in data:   # which ends only where nobody takes it
            theirs.close()
        with contextlib.suppress(ConnectionError, TimeoutError):
            Handler(ours, ("fuzz", 0), server)
        ours.close()
        if b"stream" not in data:
            answer = theirs.recv(1 << 20)
            assert b" 500 " not in answer.partition(b"\r\n")[0], answer


@dataclass(frozen=True)
class Target:
    """One parser.

    Parameters
    ----------
    whole : callable
        From what makes recordings to the bytes of whole files.
    read : callable
        Given bytes and a folder; may raise `allowed` and nothing else.
    grammar : tuple of callable
        Mutators that know the format, each (bytes, rng) -> bytes.
    allowed : tuple of type
    parts : callable, optional
        From a whole file to the (first byte, byte after the last) of its packets: an
        event of a packet that is not touched must be delivered.
    records : callable, optional
        The same of records, whose bytes may be overwritten, but not moved (`records`);
        with the places of their events where leaving a record out breaks the file.
    spread : int
        So many records after a damaged one may suffer with it.
    """

    whole: Callable
    read: Callable = read_recording
    grammar: tuple = ()
    allowed: tuple = field(default=(pdavis_cv.RecordingError,))
    parts: Callable | None = None
    records: Callable | None = None
    spread: int = 0

    @property
    def divided(self):
        """Whether a file has parts that others do not depend on."""
        return bool(self.parts or self.records)


RECORDINGS = {
    "aedat4": Target(corpus.aedat4, grammar=mutators.AEDAT4,
                     parts=corpus.aedat4_packets),
    "aedat2": Target(corpus.aedat2, records=records.aedat2),
    "aedat31": Target(corpus.aedat31, parts=corpus.aedat31_packets),
    "hdf5": Target(corpus.hdf5, grammar=mutators.HDF5),
    "prophesee": Target(corpus.prophesee, records=records.prophesee, spread=2),
    "lists": Target(corpus.lists, grammar=mutators.ARRAYS + mutators.TABLES,
                    records=records.lists),
    "rpg": Target(corpus.rpg, grammar=mutators.HDF5),
    "ros1": Target(corpus.ros1, records=records.bags),
    "ros2": Target(corpus.ros2, records=records.bags),
    "usb": Target(corpus.usb),
}
"""Formats of recordings, by name."""
_DV = (pdavis_cv.DeviceError,)
_WEIGHTS = (pdavis_cv.errors.WeightsError,)
_CALIBRATION = (pdavis_cv.errors.CalibrationError,)
OTHERS = {
    "weights": Target(corpus.weights, read_weights, mutators.ARRAYS + mutators.PICKLES,
                      _WEIGHTS),
    "calibration": Target(corpus.calibration, read_calibration, mutators.ARRAYS,
                          _CALIBRATION),
    "load": Target(corpus.load, read_load, mutators.TABLES, (ValueError,)),
    "roi": Target(corpus.roi, read_roi, mutators.ARCHIVES, (ValueError,)),
    "dv": Target(corpus.dv, read_dv, mutators.AEDAT4_STREAM, _DV),
    "http": Target(corpus.http, read_http, mutators.REQUESTS, ()),
}
TARGETS = RECORDINGS | OTHERS
"""Everything that is fuzzed, by name."""


def fuzz_one(name, data, folder):
    """Read bytes; return what came of it, None where they were refused as they may be.

    Parameters
    ----------
    name : str
        Of `TARGETS`.
    data : bytes
    folder : Path
        Files are written here, over those of the call before.
    """
    target = TARGETS[name]
    try:
        return target.read(data, folder)
    except target.allowed:
        return None


@functools.cache
def whole_parts(name):
    """Return for each file of a corpus its bytes, and its parts with their events.

    Parts are (first byte, byte after the last, places of their events, which tell
    each).  Which events a packet holds is found by leaving it out.
    """
    target, found = TARGETS[name], []
    with tempfile.TemporaryDirectory() as folder:
        for data in target.whole(corpus.small):
            every = target.read(data, Path(folder))
            parts = []
            for start, stop, *places in (target.parts or target.records)(data):
                if not places:
                    rest = fuzz_one(name, data[:start] + data[stop:], Path(folder))
                    places = [np.setdiff1d(every, rest)]
                parts.append((start, stop, places[0]))
            held = sum(len(places) for *_, places in parts)
            assert target.records or held == len(every), (name, held, len(every))
            if parts:
                found.append((data, parts))
    return found


def part_mutant(name, number, rng):
    """Return a file with parts damaged, the events of the others, and a number.

    So many of those may be missing: a time that could be right makes a later one late.
    """
    files, records_ = whole_parts(name), TARGETS[name].records is not None
    data, parts = files[number % len(files)]
    hit = {int(i) for i in rng.integers(len(parts), size=rng.integers(1, 3))}
    if records_ and max(hit) - min(hit) < 2:    # two beside each other are like one
        hit = {min(hit)}
    for i in sorted(hit, reverse=True):
        start, stop, _ = parts[i]
        change = mutators.overwritten if records_ else mutators.damaged
        data = data[:start] + change(data[start:stop], rng) + data[stop:]
    spoilt = {i + k for i in hit for k in range(1 + TARGETS[name].spread)}
    return data, np.concatenate([np.zeros(0, np.int64), *(
        places for i, (*_, places) in enumerate(parts) if i not in spoilt)]), (
            len(hit) * (8 if TARGETS[name].spread else 1))
