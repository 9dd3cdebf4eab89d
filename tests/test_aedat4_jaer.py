"""AEDAT-4 as jAER writes it: files are made byte by byte."""
import struct

import lz4.frame
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


def tables(identifier, structs):
    """Return a size-prefixed vector of tables, each a vtable and a table's bytes."""
    # size, root, identifier | vtable of the root at 12, root at 18, vector at 26
    at = 30 + 4 * len(structs)
    offsets, body = [], b""
    for vtable, data in structs:
        body += bytes(-(at + len(body) + len(vtable)) % 8) + vtable
        offsets.append(at + len(body))
        body += struct.pack("<i", len(vtable)) + data
    out = struct.pack("<I4s3HiII", 14, identifier, 6, 8, 4, 6, 4, len(structs))
    for i, offset in enumerate(offsets):
        out += struct.pack("<I", offset - (30 + 4 * i))
    return struct.pack("<I", len(out) + len(body)) + out + body


def index(entries):
    """Return jAER's index: (offset, stream, size, count, first, last) of packets."""
    vtable = struct.pack("<7H", 14, 44, 4, 12, 20, 28, 36)
    return tables(b"FTAB", [(vtable, struct.pack("<qiiqqq", *entry))
                            for entry in entries])


def imu_samples(rows):
    """Return a packet of IMU samples: time, temperature, acceleration, rotation."""
    vtable = struct.pack("<10H", 20, 40, 4, *range(12, 40, 4))
    return 2, tables(b"IMUS", [(vtable, struct.pack("<q7f", *row)) for row in rows])


def lz4_frame(data):
    """Return independent blocks: literals, one sequence with a match, stored bytes."""
    # Version 1, independent blocks, blocks of up to 4 MB, header checksum.
    out = b"\x04\x22\x4d\x18\x60\x70\x73"

    def length(n):
        return b"" if n < 15 else b"\xff" * ((n - 15) // 255) + bytes([(n - 15) % 255])

    third = len(data) // 3
    parts = [data[:third], data[third:2 * third], data[2 * third:]]
    literals = bytes([min(third, 15) << 4]) + length(third) + parts[0]
    out += struct.pack("<I", len(literals)) + literals
    # The block's own beginning again is a match; it refers to no other block.
    n = next((n for n in range(third // 2, 3, -1)
              if parts[1][:n] == parts[1][n:2 * n]), 0)
    rest = parts[1][2 * n:]
    if n >= 4 and len(rest) > 12:
        block = (bytes([min(n, 15) << 4 | min(n - 4, 15)]) + length(n) + parts[1][:n]
                 + struct.pack("<H", n) + length(n - 4)
                 + bytes([min(len(rest), 15) << 4]) + length(len(rest)) + rest)
    else:
        block = bytes([min(third, 15) << 4]) + length(third) + parts[1]
    out += struct.pack("<I", len(block)) + block
    return out + struct.pack("<I", len(parts[2]) | 1 << 31) + parts[2] + bytes(4)


def jaer_file(packets, *, position=-2, compression=0, closed=False):
    """Return a file of jAER with (stream, payload) packets, unclosed if not told."""
    nodes = "".join(
        f'<node name="{i}"><attr key="originalModuleName" type="string">jAER</attr>'
        f'<attr key="typeIdentifier" type="string">{kind}</attr><node name="info">'
        '<attr key="sizeX" type="int">346</attr><attr key="sizeY" type="int">260</attr>'
        '<attr key="source" type="string">Davis346red</attr></node></node>'
        for i, kind in enumerate(KINDS))
    xml = (f'<dv version="2.0"><node name="outInfo">{nodes}'
           '<node name="snapshot"><attr key="x" type="int">1</attr></node>'
           "</node></dv>").encode()
    def header(position):
        return b"#!AER-DAT4.0\r\n" + table(b"IOHE", [
            ("i", compression), ("q", position), ("vector", (len(xml), xml))])

    if compression:
        packets = [(stream, lz4_frame(data)) for stream, data in packets]
    places, body = [], b""
    for stream, data in packets:
        places.append((len(header(0)) + len(body), stream, len(data)))
        body += struct.pack("<ii", stream, len(data)) + data
    if not closed:
        return header(position) + body
    # jAER does not compress the index, and counts from the packets' headers.
    entries = [(*place, *facts) for place, facts in zip(places, closed, strict=True)]
    return header(len(header(0)) + len(body)) + body + index(entries)


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


def test_the_index_of_jaer_is_not_compressed_and_points_at_headers(read):
    rows = [(5000 + k, k, 2 * k, k % 2) for k in range(60)]
    image = np.full((260, 346), 99)
    packets = [events(rows[:40]), frame(image, 1000, 9000, 2000), events(rows[40:])]
    facts = [(40, 5000, 5039), (1, 5000, 5000), (20, 5040, 5059)]
    for compression in (0, 1):
        data = jaer_file(packets, compression=compression, closed=facts)
        (got, [one], _, _), recording = read(data)
        assert got.tolist() == [(t, x, 259 - y, p) for t, x, y, p in rows]
        assert (one.dn == 99).all()
        info = recording.info
        assert (info.event_count, info.frame_count) == (60, 1)
        assert (info.start_us, info.stop_us) == (5000, 9001)
        assert [p.kind for p in recording.problems] == ["frame times"]


def test_imu_samples_of_jaer_keep_its_signs(read):
    rows = [(6000, 36.5, 1, 2, 3, 4, 5, 6), (7000, 37, -1, -2, -3, -4, -5, -6)]
    (_, _, got, _), recording = read(
        jaer_file([events([(5000, 1, 1, 1)]), imu_samples(rows)]))
    for sample, row in zip(got, rows, strict=True):
        assert (sample["t"], sample["temperature"]) == row[:2]
        assert tuple(sample["accel"]) == row[2:5]
        assert tuple(sample["gyro"]) == row[5:]
    assert recording.info.header["imu_axes"] == "jAER"


def test_independent_lz4_blocks_are_read(read):
    rows = [(5000 + k, 7 * k % 346, k % 260, k % 2) for k in range(3000)]
    image = np.tile(np.arange(346) % 1024, (260, 1))  # repeats: with matches
    stream, data = frame(image, 9000, 19000, 2000)
    assert lz4.frame.decompress(lz4_frame(data)) == data
    assert len(lz4_frame(data)) < len(data)
    (got, [one], _, _), recording = read(
        jaer_file([events(rows), (stream, data)], compression=1))
    assert got.tolist() == [(t, x, 259 - y, p) for t, x, y, p in rows]
    np.testing.assert_array_equal(one.dn, image[::-1])
    assert recording.info.header["compression"] == "LZ4"


def test_old_files_that_jump_back_by_a_counter_s_range_go_on(read):
    t = 1_600_000_000_000_000
    data = jaer_file([events([(t, 1, 1, 1), (t + 10, 1, 1, 1)]),
                      events([(t + 20 - 2**32, 1, 1, 1), (t + 30 - 2**32, 2, 2, 0)])])
    (got, *_), recording = read(data)
    assert got["t"].tolist() == [t, t + 10, t + 20, t + 30]
    assert [p.kind for p in recording.problems] == ["segment"]


def test_wild_times_of_an_unclosed_file_are_dropped(read):
    packets, wanted = [], []
    for k in range(6):
        rows = [(10_000 * k + 100 * i, i, k, 1) for i in range(50)]
        times = [10_000 * k + 2_000 * i for i in range(5)]
        if k in (1, 3):  # in the middle, and at the end
            i = 20 if k == 1 else 49
            rows[i] = (rows[i][0] + (1 << 40), *rows[i][1:])
            times[i // 12] -= 1 << 33
        wanted += [t for t, *_ in rows if t < 1 << 20]
        packets += [events(rows), imu_samples([(t, *[1] * 7) for t in times])]
    (got, _, imu, _), recording = read(jaer_file(packets))
    assert got["t"].tolist() == wanted
    assert len(wanted) == 298
    assert len(imu) == 28
    assert imu["t"].max() < 60_000
    assert "segment" not in {p.kind for p in recording.problems}


def test_one_wild_time_at_the_end_of_a_packet_costs_no_sample_of_the_next(read):
    times = [[10_000 * k + 2_000 * i for i in range(5)] for k in range(4)]
    wanted = [t for part in times for t in part if t != 18_000]
    times[1][4] += 1 << 33
    packets = [events([(0, 1, 1, 1), (39_000, 1, 1, 1)])]
    packets += [imu_samples([(t, *[1] * 7) for t in part]) for part in times]
    (_, _, imu, _), recording = read(jaer_file(packets))
    assert imu["t"].tolist() == wanted
    assert [(p.kind, p.count) for p in recording.problems] == [("backward time", 1)]
