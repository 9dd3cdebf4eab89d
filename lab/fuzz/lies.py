"""Valid files with one lie: a length, count, offset or time that is not so.

A lie says what it may cost.  A damaged time costs its own sample, a lie in what nothing
depends on costs nothing, and whatever else is missing must be reported.
"""
import contextlib
import re
import struct
import tempfile
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import corpus
import numpy as np
from event_bytes import npy_file, ros1_message, ros2_message, ros_parts, text_file
from mutators import INTEGERS, some

import pdavis_cv
from pdavis_cv import open_recording
from pdavis_cv.recording.file_reader import FileReader

SIZE = (12, 16)
WORK, LEAST = 4, 2 << 20
"""Bytes read per byte of a file, in one reading, and what any file may cost."""
JUMPS_US = (1, 999, 10**6, -10**6, 3600 * 10**6, -3600 * 10**6, 2**20, 2**31, -2**31,
            2**32, 2**40, -2**40, 2**55, 2**61, -2**61, 2**62)


@dataclass
class Lie:
    """Where a lie can be told.

    Parameters
    ----------
    at : int
        Byte.
    code : str
        Of `struct`.
    kind : {"time", "number", "unused"}
    costs : sequence of int, optional
        Times of the events that may be missing; default: any, if that is reported.
    said : bool
        Whether what else is missing must be reported: fewer of what is counted are not.
    """

    at: int
    code: str
    kind: str = "number"
    costs: tuple = None
    said: bool = True


def told(data, lie, rng):
    """Return the file with a lie in it."""
    size = struct.calcsize(lie.code)
    value, = struct.unpack_from(lie.code, data, lie.at)
    if lie.kind == "time" and lie.code == "<d":     # seconds
        value += some(JUMPS_US, rng) / 1e6
        value, = struct.unpack("<q", struct.pack("<d", value))
    elif lie.kind == "time":
        value += some(JUMPS_US, rng)
    elif lie.kind == "unused" or rng.integers(8) == 0:
        value = int.from_bytes(rng.bytes(size), "little")
    elif rng.integers(2):
        value = some((*INTEGERS, len(data), len(data) - lie.at), rng)
    else:
        value = some((0, -value, value * 2, value // 2, value + 1, value - 1,
                      value + 8, value - 8, value * 1000), rng)
    order = "big" if lie.code[0] == ">" else "little"
    return (data[:lie.at] + (value & (1 << 8 * size) - 1).to_bytes(size, order)
            + data[lie.at + size:])


# Formats: from the bytes of a whole file to where one may lie -----------------------


def aedat2(data):
    begin = data.rindex(b"#End Of ASCII Header\r\n") + 22
    for at in range(begin, len(data) - 7, 8):
        address, t = struct.unpack_from(">Ii", data, at)
        event = not address >> 31 and not address & 0x400
        yield Lie(at + 4, ">i", "time", (t,) if event else ())


def aedat31(data):
    for at, stop in corpus.aedat31_packets(data):
        kind, _, size = struct.unpack_from("<hhi", data, at)
        yield Lie(at, "<h", said=False)     # of other samples
        yield from (Lie(at + place, "<i") for place in (4, 8, 16, 20, 24))
        if kind == 1:
            for place in range(at + 28, stop, size):
                t, = struct.unpack_from("<i", data, place + 4)
                yield Lie(place + 4, "<i", "time", (t,))


def aedat4(data):
    position = struct.pack("<q", data.rindex(b"FTAB") - 8)
    if position in data[:200]:
        yield Lie(data.index(position), "<q", costs=())
    for at, _ in corpus.aedat4_packets(data):
        yield Lie(at, "<i")
        yield Lie(at + 4, "<i")
        body = at + 8
        root = body + 4 + struct.unpack_from("<I", data, body + 4)[0]
        vtable = root - struct.unpack_from("<i", data, root)[0]
        yield from (Lie(place, "<I") for place in (body, body + 4, root))
        yield from (Lie(place, "<H") for place in (vtable, vtable + 4))
        yield Lie(vtable + 2, "<H", "unused", ())
        if data[body + 8:body + 12] != b"EVTS":
            continue
        field = root + struct.unpack_from("<H", data, vtable + 4)[0]
        vector = field + struct.unpack_from("<I", data, field)[0]
        count, = struct.unpack_from("<I", data, vector)
        yield from (Lie(place, "<I") for place in (field, vector))
        for place in range(vector + 4, vector + 4 + 16 * count, 16):
            t, = struct.unpack_from("<q", data, place)
            yield Lie(place, "<q", "time", (t,))
            yield Lie(place + 13, "<H", "unused", ())
    # The index only repeats what packets say: place, stream and size, count, times.
    begin = data.rindex(b"FTAB") + 16
    for place in range(begin, len(data) - 7, 8):
        value, = struct.unpack_from("<q", data, place)
        costs = None if 0 < value >> 32 < len(data) else ()
        yield Lie(place, "<q", costs=costs)
        yield Lie(place, "<q", "time", costs)


def prophesee(data):
    if data.startswith(b"% Data"):
        for at in range(data.index(b"\n", data.index(b"% Width")) + 3, len(data), 8):
            yield Lie(at, "<I", "time", struct.unpack_from("<I", data, at))
        return
    begin, code = data.index(b"% end\n") + 6, "<I" if b"evt 2.0" in data else "<H"
    for at in range(begin, len(data), struct.calcsize(code)):
        yield Lie(at, code, said=False)


def npy(data):
    begin = 10 + struct.unpack_from("<H", data, 8)[0]
    yield Lie(8, "<H")
    for digits in re.finditer(rb"\d", data[:begin]):
        yield Lie(digits.start(), "B", said=False)
    for at in range(begin, len(data), 13):
        yield Lie(at, "<q", "time", struct.unpack_from("<q", data, at))


def text(data):
    for found in re.finditer(rb"(?<=\n)\d+", data):     # its first digit
        yield Lie(found.start(), "B", "time", (int(found[0]),))


def rpg(data):
    t = base().events()["t"] / 1e6 + 1_500_000_000
    begin = data.index(t.tobytes())
    for k, us in enumerate(np.rint(t * 1e6).astype(int).tolist()):
        yield Lie(begin + 8 * k, "<d", "time", (us,))
    for at in range(0, min(begin, 4096), 8):
        yield Lie(at, "<q", said=False)


def bags(data):
    make = ros1_message if data.startswith(b"#ROSBAG") else ros2_message
    for events in ros_parts(base().events()):
        message = make(events, SIZE)
        at = data.index(message)
        if make is ros1_message:
            yield Lie(at, "<I", "unused", ())       # seq
            yield Lie(at + 12, "<I", costs=tuple(events["t"].tolist()))
            yield from (Lie(at + k, "<I", said=False) for k in (16, 20, 24))
            for k, t in enumerate(events["t"].tolist()):
                yield Lie(at + 28 + 13 * k + 4, "<I", costs=(t,))
                yield Lie(at + 28 + 13 * k + 8, "<I", costs=(t,))
        else:
            yield from (Lie(at + k, "<I", said=False) for k in (12, 20, 24, 28))
    if make is ros1_message:
        for found in re.finditer(rb"op=|size=|count=|conn=|time=|ver=", data):
            yield Lie(found.start() - 4, "<I")
            yield Lie(found.end(), "<I")


def png(data):
    at = 8
    while at < len(data):
        yield Lie(at, ">I")
        if data[at + 4:at + 8] == b"IHDR":
            yield from (Lie(at + k, code) for k, code in (
                (8, ">I"), (12, ">I"), (16, "B"), (17, "B"), (20, "B")))
        at += 12 + int.from_bytes(data[at:at + 4], "big")


def checked_png(data):
    """Return a PNG of which only the lie is wrong: sums are made again."""
    out, at = data[:8], 8
    while at < len(data):
        size = int.from_bytes(data[at:at + 4], "big")
        body = data[at + 4:at + 8 + size]
        out += data[at:at + 4] + body + struct.pack(">I", zlib.crc32(body))
        at += 12 + size
    return out


def pictures(data):
    for at in range(min(len(data) - 4, 256)):
        yield from (Lie(at, code) for code in ("B", "<I", ">I", "<H", ">H"))


# ----------------------------------------------------------------------------------


def base():
    """Return 180 events in 100 ms, no two of one time or place."""
    return corpus._recording(SIZE, 2, 180, 100_000)


def image(suffix):
    import cv2
    pixels = np.random.default_rng(0).integers(0, 256, (8, 8), np.uint8)
    with tempfile.TemporaryDirectory() as folder:
        assert cv2.imwrite(f"{folder}/x{suffix}", pixels)
        return Path(folder, f"x{suffix}").read_bytes()


FORMATS: dict[str, tuple[Callable, Callable]] = {
    "aedat2": (lambda: corpus.aedat2(lambda *_: corpus._recording(
        (128, 128), 1, 180, 100_000)), aedat2),
    "aedat31": (lambda: corpus.aedat31(lambda *_: base()), aedat31),
    "aedat4": (lambda: corpus.aedat4(lambda *_: base())[1:2], aedat4),
    "prophesee": (lambda: corpus.prophesee(lambda *_: base()), prophesee),
    "npy": (lambda: [npy_file(base().events())], npy),
    "text": (lambda: [text_file(base().events())], text),
    "rpg": (lambda: corpus.rpg(lambda *_: base()), rpg),
    "ros1": (lambda: corpus.ros1(lambda *_: base()), bags),
    "ros2": (lambda: corpus.ros2(lambda *_: base()), bags),
    ".png": (lambda: [image(".png")], png),
} | {suffix: (lambda suffix=suffix: [image(suffix)], pictures)
     for suffix in (".tiff", ".bmp", ".pgm", ".jpg", ".webp")}
"""Makers of whole files, and where they may lie, by format."""
_WHOLE = {}


def whole(name):
    """Return for each whole file its bytes, its lies, and the times of its events."""
    if name not in _WHOLE:
        make, lies = FORMATS[name]
        with tempfile.TemporaryDirectory() as folder:
            _WHOLE[name] = [(data, list(lies(data)), read(data, Path(folder), name)[0])
                            for data in make()]
    return _WHOLE[name]


def made(name, number, rng):
    """Return a file with a lie, the lie, and the times of the events of the whole."""
    files = whole(name)
    data, lies, good = files[number % len(files)]
    lie = some(lies, rng)
    data = told(data, lie, rng)
    if name == ".png":
        with contextlib.suppress(IndexError):
            data = checked_png(data)
    return data, lie, good


def check(name, number, rng, folder):
    """Read a file with a lie; raise AssertionError if it costs what it may not."""
    data, lie, good = made(name, number, rng)
    try:
        got, problems = read(data, folder, name)
    except pdavis_cv.RecordingError:
        assert lie.costs is None, f"{lie}: refused"
        return
    missing = np.setdiff1d(good, got)
    if lie.costs is not None:
        missing = np.setdiff1d(missing, lie.costs)
        # Of two times that are not in order it is unknown which is wrong.
        assert len(missing) <= bool(lie.costs), f"{lie}: {len(missing)} others are lost"
    assert not lie.said or not len(missing) or problems, (
        f"{lie}: {len(missing)} are lost, which is not said")


def read(data, folder, name):
    """Read a file in several ways; return times of events, and what was reported."""
    found, middle, database = data.partition(b"SQLite format 3")
    path = folder if middle else folder / "file"
    if middle:
        (folder / "metadata.yaml").write_bytes(found)
        (folder / "bag.db3").write_bytes(middle + database)
    else:
        path = folder / f"file{name}"
        path.write_bytes(data)
    options = {"layout": "sony"} if name.startswith(".") else {}
    with looked() as sizes, open_recording(path, **options) as recording:
        packets = [packet.events for packet in recording.packets()]
        events = np.concatenate([np.empty(0, pdavis_cv.EVENT_DTYPE), *packets])
        assert sum(sizes) <= WORK * len(data) + LEAST, (sum(sizes), len(data))
        problems = tuple(recording.problems)
        np.testing.assert_array_equal(recording.events(), events)
        for share in (.2, .6):
            if not len(events):
                break
            start, stop = (int(events["t"][int(k * len(events))])
                           for k in (share, share + .2))
            part = events[(events["t"] >= start) & (events["t"] < stop)]
            with open_recording(path, **options) as fresh:
                for one in (recording, fresh):
                    np.testing.assert_array_equal(one.events(start, stop), part)
                    got = [p.events for p in one.packets(start, stop)]
                    np.testing.assert_array_equal(
                        np.concatenate([part[:0], *got]), part)
    return events["t"], problems


@contextlib.contextmanager
def looked():
    """Give a list of the sizes of what is read."""
    sizes, plain, into = [], FileReader.read, FileReader.read_into

    def read_(self, *arguments):
        data = plain(self, *arguments)
        sizes.append(len(data))
        return data

    def read_into(self, *arguments):
        sizes.append(into(self, *arguments))
        return sizes[-1]

    FileReader.read, FileReader.read_into = read_, read_into
    try:
        yield sizes
    finally:
        FileReader.read, FileReader.read_into = plain, into
