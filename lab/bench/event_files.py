"""Formats of events alone: how fast they are read, the case `event-files`.

Each is read into one array; the floor is not a program but the rate that is promised.
"""
from __future__ import annotations

import contextlib
import struct
import tempfile
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from time import process_time
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdavis_cv.recording.open import open_recording

from .cases import EVENTS, SHAPE, Comparison, case, event_input

PROMISED = 20e6
"""Events per CPU second."""
MESSAGE = 20_000
"""Events of a ROS message."""
_LISTS: dict[str, Any] = {"sensor_size": SHAPE}
"""What formats are told that do not hold it."""


def _evt2(path: Path, events: NDArray[Any]) -> None:
    t, high = events["t"], events["t"] >> 6
    words = (events["p"].astype("<u4") << 28 | (t & 63).astype("<u4") << 22
             | events["x"].astype("<u4") << 11 | events["y"])
    new = np.flatnonzero(np.diff(high, prepend=-1))
    words = np.insert(words, new, (8 << 28 | high[new]).astype("<u4"))
    path.write_bytes(b"%% evt 2.0\n%% geometry %dx%d\n%% end\n" % SHAPE[::-1]
                     + words.astype("<u4").tobytes())


def write_evt3(
    path: Path, events: NDArray[Any], size: tuple[int, int] = SHAPE
) -> None:
    """Write what changes from event to event; none of these has a neighbour."""
    t, x, y, p = (events[name].astype(np.int64) for name in "txyp")
    rows = np.stack([8 << 12 | t >> 12 & 0xFFF, 6 << 12 | t & 0xFFF, y,
                     2 << 12 | p << 11 | x], 1).astype("<u2")
    said = np.ones(rows.shape, bool)
    said[1:, :3] = rows[1:, :3] != rows[:-1, :3]
    path.write_bytes(b"%% format EVT3;height=%d;width=%d\n%% end\n" % size
                     + rows[said].tobytes())


def _dat(path: Path, events: NDArray[Any]) -> None:
    words = np.stack([events["t"].astype("<u4"),
                      events["x"].astype("<u4") | events["y"].astype("<u4") << 14
                      | events["p"].astype("<u4") << 28], 1)
    path.write_bytes(b"%% Data file containing CD events.\n%% Version 2\n%% Height %d\n"
                     b"%% Width %d\n\x0c\x08" % SHAPE + words.tobytes())


def _text(path: Path, events: NDArray[Any], line: str) -> None:
    path.write_text("".join(
        line.format(t=t, s=t // 10**6, us=t % 10**6, x=x, y=y, p=p)
        for t, x, y, p in events[["t", "x", "y", "p"]].tolist()))


def _npy(path: Path, events: NDArray[Any]) -> None:
    with path.open("wb") as file:
        np.save(file, events)


def _npz(path: Path, events: NDArray[Any]) -> None:
    with path.open("wb") as file:
        np.savez(file, t=events["t"], x=events["x"], y=events["y"], p=events["p"])


def _rpg(path: Path, events: NDArray[Any]) -> None:
    import h5py
    with h5py.File(path, "w") as file:
        group = file.create_group("events")
        group["ts"] = events["t"] / 1e6
        group["xs"], group["ys"] = (events[k].astype(np.int16) for k in "xy")
        group["ps"] = events["p"].astype(bool)
        file.attrs["sensor_resolution"] = SHAPE


def _messages(events: NDArray[Any], dtype: Any) -> Iterator[tuple[int, bytes]]:
    """Yield time in ns, and shape and events of a dvs_msgs/EventArray."""
    for begin in range(0, len(events), MESSAGE):
        part = events[begin:begin + MESSAGE]
        rows = np.zeros(len(part), dtype)
        rows["x"], rows["y"], rows["p"] = part["x"], part["y"], part["p"]
        rows["s"], rows["ns"] = part["t"] // 10**6, part["t"] % 10**6 * 1000
        yield (int(part["t"][-1]) * 1000,
               struct.pack("<III", *SHAPE, len(part)) + rows.tobytes())


def _ros1(path: Path, events: NDArray[Any]) -> None:
    from rosbags import rosbag1
    packed = [("x", "<u2"), ("y", "<u2"), ("s", "<u4"), ("ns", "<u4"), ("p", "u1")]
    with rosbag1.Writer(path) as bag:
        topic = bag.add_connection(
            "/dvs/events", "dvs_msgs/msg/EventArray", md5sum="0" * 32,
            msgdef="std_msgs/Header header\nuint32 height\nuint32 width\n"
                   "dvs_msgs/Event[] events\n")
        for t, data in _messages(events, packed):
            bag.write(topic, t, bytes(16) + data)     # an empty header


def _ros2(path: Path, events: NDArray[Any]) -> None:
    from rosbags import rosbag2
    # CDR aligns numbers to their sizes: an event takes 16 bytes, but the first begins
    # where a time may follow its place at once.
    aligned = [("x", "<u2"), ("y", "<u2"), ("gap", "V2"), ("s", "<u4"), ("ns", "<u4"),
               ("p", "u1"), ("end", "V1")]
    first_gap, end = 12 + 4, -1
    with rosbag2.Writer(path, version=8) as bag:
        topic = bag.add_connection(
            "/dvs/events", "dvs_msgs/msg/EventArray", rihs01="RIHS01_" + "0" * 64,
            msgdef="std_msgs/Header header\nuint32 height\nuint32 width\n"
                   "dvs_msgs/Event[] events\n")
        for t, data in _messages(events, aligned):
            # stamp, and a frame name of one byte, its end
            header = struct.pack("<iII4x", 0, 0, 1)
            bag.write(topic, t, b"\0\1\0\0" + header + data[:first_gap]
                      + data[first_gap + 2:end])


FORMATS: dict[str, tuple[Callable[[Path, NDArray[Any]], None], dict[str, Any]]] = {
    "EVT2": (_evt2, {}), "EVT3": (write_evt3, {}), "DAT": (_dat, {}),
    "text, us": (partial(_text, line="{t} {x} {y} {p}\n"), _LISTS),
    "text, s": (partial(_text, line="{s}.{us:06d} {x} {y} {p}\n"), _LISTS),
    "npy": (_npy, _LISTS), "npz": (_npz, _LISTS), "rpg HDF5": (_rpg, {}),
    "ROS 1": (_ros1, {}), "ROS 2": (_ros2, {}),
}
"""Name -> (what writes events, what opening needs); those without a package are left
out."""


def _read(path: Path, options: dict[str, Any]) -> NDArray[Any]:
    with open_recording(path, **options) as recording:
        return recording.events()


@case("event-files", "lists, RAW, bags, HDF5 to one array, against 20 Mev per CPU s", 1)
def _event_files() -> Iterator[Comparison]:
    events = event_input("uniform")
    for name, (write, options) in FORMATS.items():
        with tempfile.TemporaryDirectory() as folder, \
                contextlib.suppress(ModuleNotFoundError):
            path = Path(folder) / "events"
            write(path, events)

            def check(path: Path = path, options: dict[str, Any] = options) -> None:
                np.testing.assert_array_equal(_read(path, options), events)

            def candidate(
                path: Path = path, options: dict[str, Any] = options
            ) -> float:
                start = process_time()
                _read(path, options)
                return process_time() - start

            yield Comparison(name, check, candidate, lambda: EVENTS / PROMISED,
                             lambda s: EVENTS / s / 1e6, "Mev/s")
