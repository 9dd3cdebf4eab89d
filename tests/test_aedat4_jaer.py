"""AEDAT-4 as jAER writes it: files are made byte by byte."""
import struct

import numpy as np
import pytest
from test_aedat4 import joined

from pdavis_cv import open_recording

KINDS = ("EVTS", "FRME", "IMUS")


def table(identifier, fields):
    """Return a size-prefixed table; its vtable stands after it, unlike in our writer.

    Each field is (struct code, value), bytes for a vector with its count, or None.
    """
    places, body, vectors = [], b"", []
    for field in fields:
        if field is None:
            places.append(0)
            continue
        code, value = field
        size = 4 if code == "vector" else struct.calcsize(code)
        body += bytes(-(len(body) + 4) % size)
        places.append(4 + len(body))
        if code == "vector":
            vectors.append((4 + len(body), value))
            body += bytes(4)
        else:
            body += struct.pack("<" + code, value)
    body = bytearray(bytes(4) + body)
    at = 12  # after size, root and identifier
    vtable_at = at + len(body)
    body[:4] = struct.pack("<i", -len(body))
    tail = struct.pack(f"<{2 + len(places)}H", 4 + 2 * len(places), len(body), *places)
    for place, (count, data) in vectors:
        tail += bytes(-(vtable_at + len(tail) + 4) % 8)
        where = vtable_at + len(tail)
        body[place:place + 4] = struct.pack("<I", where - (at + place))
        tail += struct.pack("<I", count) + data
    data = struct.pack("<I", at - 4) + identifier + bytes(body) + tail
    return struct.pack("<I", len(data)) + data


def jaer_file(packets, *, position=-2):
    """Return an unclosed file of jAER with (stream, payload) packets."""
    nodes = "".join(
        f'<node name="{i}"><attr key="originalModuleName" type="string">jAER</attr>'
        f'<attr key="typeIdentifier" type="string">{kind}</attr><node name="info">'
        '<attr key="sizeX" type="int">346</attr><attr key="sizeY" type="int">260</attr>'
        '<attr key="source" type="string">Davis346red</attr></node></node>'
        for i, kind in enumerate(KINDS))
    xml = (f'<dv version="2.0"><node name="outInfo">{nodes}'
           '<node name="snapshot"><attr key="x" type="int">1</attr></node>'
           "</node></dv>").encode()
    header = table(b"IOHE", [("i", 0), ("q", position), ("vector", (len(xml), xml))])
    body = b"".join(struct.pack("<ii", stream, len(data)) + data
                    for stream, data in packets)
    return b"#!AER-DAT4.0\r\n" + header + body


def events(rows):
    data = b"".join(struct.pack("<qhh?3x", t, x, y, p) for t, x, y, p in rows)
    return 0, table(b"EVTS", [("vector", (len(rows), data))])


def frame(image, sof, eof, exposure):
    mid = (sof + eof) // 2
    pixels = image.astype("<u2").tobytes()
    return 1, table(b"FRME", [
        ("q", mid), ("q", sof), ("q", eof), ("q", sof), ("q", eof), ("b", 2),
        ("h", 346), ("h", 260), None, None, ("vector", (len(pixels), pixels)),
        ("q", exposure), ("b", 1)])


@pytest.fixture
def read(tmp_path):
    def do(data):
        path = tmp_path / "x.aedat4"
        path.write_bytes(data)
        with open_recording(path) as recording:
            return joined(recording.packets()), recording
    return do


def test_rows_of_jaer_begin_at_the_bottom(read):
    image = np.arange(260 * 346).reshape(260, 346) % 1024
    data = jaer_file([events([(5000, 10, 20, 1), (5001, 345, 0, 0)]),
                      frame(image, 1000, 9000, 2000)])
    (got, [one], _, _), recording = read(data)
    assert got.tolist() == [(5000, 10, 239, 1), (5001, 345, 259, 0)]
    np.testing.assert_array_equal(one.dn, image[::-1])
    np.testing.assert_array_equal(one.valid, image[::-1] < 1023)
    assert recording.info.writer == "jAER"
    assert recording.info.header["first_row"] == "bottom"


def test_mid_exposure_is_the_middle_of_the_readout(read):
    # Global shutter: 3000 us of resets, 2000 us of exposure, 3000 us of signals.
    (_, [one], _, _), recording = read(
        jaer_file([frame(np.full((260, 346), 9), 1000, 9000, 2000)]))
    assert (one.exposure_start_us, one.exposure_end_us) == (4000, 6000)
    assert one.available_us == 9000
    [problem] = recording.problems
    assert (problem.kind, problem.count) == ("frame times", 1)
    assert "within 3000 us" in problem.message


def test_old_files_that_jump_back_by_a_counter_s_range_go_on(read):
    t = 1_600_000_000_000_000
    data = jaer_file([events([(t, 1, 1, 1), (t + 10, 1, 1, 1)]),
                      events([(t + 20 - 2**32, 1, 1, 1), (t + 30 - 2**32, 2, 2, 0)])])
    (got, *_), recording = read(data)
    assert got["t"].tolist() == [t, t + 10, t + 20, t + 30]
    assert [p.kind for p in recording.problems] == ["segment"]
