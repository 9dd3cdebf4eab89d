"""Limits: files that would take memory or work out of proportion are refused."""
import bz2
import contextlib
import itertools
import sqlite3
import struct
import subprocess
import sys
import warnings
import zipfile
import zlib
from pathlib import Path

import lz4.frame
import numpy as np
import pytest

import pdavis_cv
from pdavis_cv import Calibration, Limits, RecordingError, open_recording
from pdavis_cv.recording.bag_writer import write_rosbag
from pdavis_cv.recording.file_reader import FileReader
from pdavis_cv.recording.limits import Budget
from pdavis_cv.recording.packetise import Batch, packetise
from pdavis_cv.recording.registry import writer_for
from pdavis_cv.recording.scratch import Gathering
from pdavis_cv.tools.main import main

EVENT = np.dtype([("t", "<i8"), ("x", "<i2"), ("y", "<i2"), ("p", "u1"), ("pad", "V3")])
BASE = 1_700_000_000_000_000
ZSTD, LZ4 = 3, 1


def aedat4(payloads, compression=0, kinds=("EVTS",)):
    """Return an AEDAT-4 file of (stream, payload), made byte by byte."""
    text = "".join(
        f'<node name="{k}"><attr key="typeIdentifier">{kind}</attr><node name="info">'
        '<attr key="sizeX">16</attr><attr key="sizeY">12</attr></node></node>'
        for k, kind in enumerate(kinds))
    text = f'<dv version="2.0"><node name="outInfo">{text}</node></dv>'.encode()
    body = (struct.pack("<I4s5Hxx", 20, b"IOHE", 10, 20, 4, 8, 16)
            + struct.pack("<iiqI", 12, compression, -1, 4)
            + struct.pack("<I", len(text)) + text + b"\0")
    return b"#!AER-DAT4.0\r\n" + struct.pack("<I", len(body)) + body + b"".join(
        struct.pack("<ii", stream, len(data)) + data for stream, data in payloads)


def events(t):
    """Return the FlatBuffer of events at pixel (1, 1)."""
    a = np.zeros(len(t), EVENT)
    a["t"], a["x"], a["y"], a["p"] = t, 1, 1, 1
    body = struct.pack("<I4s4H", 16, b"EVTS", 6, 8, 4, 0) + struct.pack(
        "<iIII", 8, 8, 0, len(a)) + a.tobytes()
    return struct.pack("<I", len(body)) + body


def imu(count):
    """Return the FlatBuffer of IMU samples that are all one table."""
    head = struct.pack("<I4s4H", 16, b"IMUS", 6, 8, 4, 0) + struct.pack(
        "<iII", 8, 4, count)
    table = len(head) + 4 * count + 24
    places = table - (len(head) + 4 * np.arange(count))
    body = (head + places.astype("<u4").tobytes()
            + struct.pack("<11H2x", 22, 40, 4, 12, 16, 20, 24, 28, 32, 36, 0)
            + struct.pack("<iq7f", 24, BASE, *[1.0] * 7))
    return struct.pack("<I", len(body)) + body


def of_zstd(path):
    zstandard = pytest.importorskip("zstandard")
    one = zstandard.ZstdCompressor().compress(events(np.full(4_000_000, BASE)))
    path.write_bytes(aedat4([(0, one)] * 30, ZSTD))


def of_small_packets(path):
    one = lz4.frame.compress(events(np.full(1_000_000, BASE)))
    path.write_bytes(aedat4([(0, one)] * 300, LZ4))


def of_imu(path):
    path.write_bytes(aedat4([(0, events(BASE + np.arange(9))), (1, imu(20_000_000))],
                            kinds=("EVTS", "IMUS")))


def of_png(path, side=20_000):
    def chunk(kind, data):
        return (struct.pack(">I", len(data)) + kind + data
                + struct.pack(">I", zlib.crc32(kind + data)))

    path.write_bytes(b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", struct.pack(
        ">IIBBBBB", side, side, 8, 0, 0, 0, 0)) + chunk(b"IDAT", zlib.compress(
            bytes(side * (side + 1)), 9)) + chunk(b"IEND", b""))


def of_chunk(path):
    of_png(path, 8)
    data = path.read_bytes()
    path.write_bytes(data[:33] + b"\xff" * 4 + data[37:])


def of_strip(path):
    cv2 = pytest.importorskip("cv2")
    assert cv2.imwrite(str(path), np.eye(64, dtype=np.uint8))
    data = path.read_bytes()
    at, = struct.unpack_from("<I", data, 4)
    at = data.index(struct.pack("<H", 279), at) + 8     # StripByteCounts
    path.write_bytes(data[:at] + b"\xff" * 4 + data[at + 4:])


def of_webp(path):
    cv2 = pytest.importorskip("cv2")
    assert cv2.imwrite(str(path), np.zeros((16_000, 16_000), np.uint8), [
        cv2.IMWRITE_WEBP_QUALITY, 101])


def of_scans(path):
    cv2 = pytest.importorskip("cv2")
    data = cv2.imencode(".jpg", np.zeros((64, 64), np.uint8), [
        cv2.IMWRITE_JPEG_PROGRESSIVE, 1])[1].tobytes()
    scan = data[data.rindex(b"\xff\xda"):-2]
    path.write_bytes(data[:-2] + 100 * scan + data[-2:])


def of_another_kind(path):      # a Sun raster, which cv2 would decode
    path.write_bytes(struct.pack(">8I", 0x59A66A95, 40_000, 40_000, 8, 0, 2, 0, 0)
                     + b"\x80\xff\0" * 3000)


def of_header(path):
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive, archive.open(
            "t.npy", "w", force_zip64=True) as file:
        file.write(b"\x93NUMPY\x02\x00" + struct.pack("<I", 2**32 - 1))
        for _ in range(3):
            file.write(b" " * (1 << 26))


def of_columns(path):
    np.savez_compressed(path, **{name: np.zeros(30_000_000, kind) for name, kind in (
        ("t", "i8"), ("x", "u2"), ("y", "u2"), ("p", "u1"))})


def of_bag(path, compression=b"bz2"):
    pytest.importorskip("rosbags")

    def record(fields, data):
        head = b"".join(struct.pack("<I", len(k) + 1 + len(v)) + k + b"=" + v
                        for k, v in fields)
        return struct.pack("<I", len(head)) + head + struct.pack("<I", len(data)) + data

    def number(value):
        return struct.pack("<I", value)

    raw = record([(b"op", b"\x02"), (b"conn", number(0)), (b"time", bytes(8))], b"0")
    if compression == b"bz2":
        packer = bz2.BZ2Compressor()
        packed = b"".join([packer.compress(raw), *(
            packer.compress(bytes(1 << 24)) for _ in range(60)), packer.flush()])
    else:
        packed = lz4.frame.compress(raw + bytes(1 << 30))
    chunk = record([(b"op", b"\x05"), (b"compression", compression),
                    (b"size", number(1000))], packed)
    index = record([(b"op", b"\x04"), (b"ver", number(1)), (b"conn", number(0)),
                    (b"count", number(1))], struct.pack("<QI", 0, 0))
    about = b"".join(number(len(one)) + one for one in (
        b"topic=/e", b"type=dvs_msgs/EventArray", b"md5sum=0", b"message_definition=x"))
    connection = record([(b"op", b"\x07"), (b"conn", number(0)), (b"topic", b"/e")],
                        about)
    magic = b"#ROSBAG V2.0\n"
    known = [(b"op", b"\x03"), (b"conn_count", number(1)), (b"chunk_count", number(1)),
             (b"index_pos", bytes(8))]
    at = len(magic) + len(record(known, b""))
    known[3] = b"index_pos", struct.pack("<Q", at + len(chunk) + len(index))
    path.write_bytes(magic + record(known, b"") + chunk + index + connection + record(
        [(b"op", b"\x06"), (b"ver", number(1)), (b"chunk_pos", struct.pack("<Q", at)),
         (b"start_time", bytes(8)), (b"end_time", bytes(8)), (b"count", number(1))],
        number(0) + number(1)))


def of_mcap(path, repeated=False):
    rosbag2 = pytest.importorskip("rosbags.rosbag2")
    events = np.zeros(9, pdavis_cv.EVENT_DTYPE)
    write_rosbag(path, pdavis_cv.recording_from_arrays(events, sensor_size=(4, 4)))

    def record(kind, *parts):
        return bytes([kind]) + struct.pack("<Q", len(b"".join(parts))) + b"".join(parts)

    data = path.read_bytes()
    at, = struct.unpack("<Q", data[-28:-20])
    raw = record(0x99, bytes(15 << 20))
    packed = rosbag2.storage_mcap.zstd.compress(raw)
    times, kind = struct.pack("<QQ", 0, 1 << 62), struct.pack("<I4s", 4, b"zstd")
    sizes = struct.pack("<QQ", len(packed), len(raw))
    chunk = record(6, times, sizes[8:], bytes(4), kind, sizes[:8], packed)
    index = b"".join(record(
        8, times, struct.pack("<QQIHQQ", at + k * len(chunk) * (not repeated),
                              len(chunk), 10, 1, 0, 0), kind, sizes)
        for k in range(200))
    chunks = chunk * (1 if repeated else 200)
    path.write_bytes(data[:at] + chunks + index + data[at:-28] + struct.pack(
        "<Q", at + len(chunks)) + data[-20:])


def of_two_chunks(path):        # which are unpacked in turns
    rosbag1 = pytest.importorskip("rosbags.rosbag1")
    bag = rosbag1.Writer(path)
    bag.set_compression(rosbag1.Writer.CompressionFormat.BZ2)
    with bag:
        topic = bag.add_connection(
            "/e", "dvs_msgs/msg/EventArray", msgdef="x", md5sum="0" * 32)
        for first in (0, 1):
            for k in range(2000):
                bag.write(topic, 2 * k + first, np.array(
                    [0, 0, 0, 0, 4, 4, 0], "<u4").tobytes())
            bag.write(topic, 10**6 + first, bytes(14 << 20))


def of_expression(path):
    pytest.importorskip("rosbags")
    events = np.zeros(9, pdavis_cv.EVENT_DTYPE)
    write_rosbag(path, pdavis_cv.recording_from_arrays(events, sensor_size=(4, 4)))
    with contextlib.closing(sqlite3.connect(path)) as file:
        file.executescript("""
            alter table messages rename to old;
            create table messages(id integer primary key, topic_id int, timestamp int,
                data blob generated always as (zeroblob(900000000)) virtual);
            insert into messages(topic_id, timestamp) select topic_id, timestamp
                from old;
            drop table old;""")


def of_hdf5(path):
    h5py = pytest.importorskip("h5py")
    with h5py.File(path, "w") as file:
        file.create_dataset("events", (66_000_000, 4), "<i8", chunks=(33_000_000, 1),
                            compression="gzip", fillvalue=3)


BOMBS = {"zstd.aedat4": (of_zstd, "ratio"), "lz4.aedat4": (of_small_packets, "memory"),
         "imu.aedat4": (of_imu, "memory"), "bomb.png": (of_png, "memory"),
         "chunk.png": (of_chunk, "a chunk of 4294967295 bytes in a file of"),
         "strip.tiff": (of_strip, "memory"), "large.webp": (of_webp, "memory"),
         "scans.jpg": (of_scans, "a JPEG of more than 100 scans"),
         "sun.png": (of_another_kind, "of no kind that is read"),
         "header.npz": (of_header, "a header of 4294967295 bytes"),
         "columns.npz": (of_columns, "ratio"), "bz2.bag": (of_bag, "ratio"),
         "at_once.mcap": (of_mcap, "memory"), "turns.bag": (of_two_chunks, "ratio"),
         "again.mcap": (lambda path: of_mcap(path, True),
                        "index names more bytes than there are"),
         "expression.db3": (of_expression, "string or blob too big"),
         "lz4.bag": (lambda path: of_bag(path, b"lz4"), "memory"),
         "chunk.h5": (of_hdf5, "memory")}
READ = """
import sys, warnings
import pdavis_cv
warnings.simplefilter("ignore")
try:
    with pdavis_cv.open_recording(sys.argv[1], **({"layout": "sony"} if sys.argv[
            1].endswith(("png", "tiff", "webp", "jpg")) else {})) as recording:
        for _ in recording.packets():
            pass
        recording.events()
except pdavis_cv.RecordingError as error:
    taken = open("/proc/self/status").read().partition("VmHWM:")[2].split()[0]
    print(int(taken) >> 10, error)
"""


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="Linux tells it")
@pytest.mark.parametrize("name", [
    name if name in ("zstd.aedat4", "chunk.png", "strip.tiff", "chunk.h5", "sun.png",
                     "scans.jpg", "expression.db3", "again.mcap") else
    pytest.param(name, marks=pytest.mark.gate) for name in BOMBS])  # long to make
def test_a_bomb_is_refused_and_takes_no_memory(name, tmp_path):
    build, said = BOMBS[name]
    build(tmp_path / name)
    done = subprocess.run([sys.executable, "-P", "-c", READ, str(tmp_path / name)],
                          capture_output=True, text=True, timeout=120, check=True)
    megabytes, _, message = done.stdout.partition(" ")
    assert said in message
    assert (f" Limits({said}=...)" in message) == (said in ("ratio", "memory"))
    assert int(megabytes) < 100 + 512 + 512


@pytest.mark.skipif(not Path("/proc/self/io").exists(), reason="Linux tells it")
def test_chunks_of_hdf5_are_read_once(tmp_path):
    h5py = pytest.importorskip("h5py")
    rng = np.random.default_rng(0)
    with h5py.File(tmp_path / "x.h5", "w") as file:
        for name, kind in (("t", "i8"), ("x", "u2"), ("y", "u2"), ("p", "u1")):
            values = np.arange(600_000) if name == "t" else rng.integers(0, 2, 600_000)
            file.create_dataset(f"events/{name}", data=values.astype(kind),
                                chunks=(600_000,), compression="gzip")

    def read():
        return int(Path("/proc/self/io").read_text().split()[1])

    with pdavis_cv.open_recording(tmp_path / "x.h5", sensor_size=(2, 2)) as recording:
        before = read()
        assert len(recording.events()) == 600_000
        assert read() - before <= 2 * (tmp_path / "x.h5").stat().st_size


@pytest.mark.parametrize("path", ["/dev/zero", "zeros"])
def test_a_calibration_is_not_read_before_it_is_known(path, tmp_path):
    if path == "zeros":
        path = tmp_path / "zeros"
        with path.open("wb") as file:
            file.truncate(6 << 30)
    with pytest.raises(pdavis_cv.CalibrationError, match="not a calibration file"):
        Calibration.load(path)


def test_a_limit_can_be_raised_and_lowered(tmp_path):
    path = tmp_path / "a.aedat4"
    one = lz4.frame.compress(events(np.full(2_000_000, BASE)))
    path.write_bytes(aedat4([(0, one)], LZ4))
    with pytest.raises(RecordingError, match=r"a packet of .* ratio=100 allows"):
        open_recording(path)
    with open_recording(path, limits=Limits(ratio=300)) as recording:
        assert len(recording.events()) == 2_000_000
    with pytest.raises(RecordingError, match="memory=1e"):
        open_recording(path, limits=Limits(ratio=300, memory=10**7))


def test_times_may_not_lie_further_apart_than_the_limit(tmp_path):
    path = tmp_path / "a.aedat4"
    path.write_bytes(aedat4([(0, events(BASE + np.arange(2) * 10**9))]))
    with open_recording(path, limits=Limits(time_span=10**8)) as recording:
        with pytest.raises(RecordingError, match="time_span=1e"):
            list(recording.packets())
        with pytest.raises(RecordingError, match="time_span=1e"):
            recording.events()
    with open_recording(path) as recording:
        assert sum(len(packet.events) for packet in recording.packets()) == 2


@pytest.mark.parametrize("far", [1 << 53, 1 << 60])
def test_a_window_of_far_times_is_a_part_of_the_whole(far, tmp_path):
    """A few times and many more, centuries later, agree among themselves."""
    def from_packets(recording, *window):
        return np.concatenate([[], *(
            packet.events["t"] for packet in recording.packets(*window))])

    path = tmp_path / "a.aedat4"
    times = np.r_[[213_573, 314_846, 627_075, 1_323_488, 1_508_357],
                  far + 10 * np.arange(46)]
    path.write_bytes(aedat4([(0, events(times[:20])), (0, events(times[20:]))]))
    with open_recording(path) as recording:
        whole = recording.events()["t"]
        assert len(whole) > 40
        assert whole[0] < far < whole[-1]
        np.testing.assert_array_equal(from_packets(recording), whole)
        for start, stop in itertools.combinations([0, *whole[::5], far + 10**6], 2):
            part = whole[(whole >= start) & (whole < stop)]
            with open_recording(path) as fresh:
                for one in (recording, fresh):
                    np.testing.assert_array_equal(one.events(start, stop)["t"], part)
                    np.testing.assert_array_equal(from_packets(one, start, stop), part)


@pytest.fixture
def looked_at(monkeypatch):
    """Return a list of the sizes of what is read of files."""
    read, sizes = FileReader.read, []

    def counted(*arguments):
        data = read(*arguments)
        sizes.append(len(data))
        return data

    monkeypatch.setattr(FileReader, "read", counted)
    return sizes


@pytest.mark.parametrize(("suffix", "step"), [("aedat4", 24), ("aedat", 60)])
def test_what_is_searched_grows_with_the_file(suffix, step, tmp_path, looked_at):
    """Each packet says that it reaches to the end of the file."""
    def searched(count):
        path = tmp_path / f"{count}.{suffix}"
        if suffix == "aedat4":
            data = aedat4([], LZ4) + b"".join(
                struct.pack("<ii", 0, k * step - 8) + b"\x04\x22\x4d\x18"
                + bytes(step - 12) for k in range(count, 0, -1))
        else:
            data = b"#!AER-DAT3.1\r\n#Source 1: DAVIS346\r\n#!END-HEADER\r\n"
            for k in range(count, 0, -1):
                n = (k * step - 28) // 8
                data += struct.pack("<hhiiiiii", 1, 1, 8, 4, 0, n, n, n) + bytes(
                    step - 28)
        path.write_bytes(data)
        looked_at.clear()
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", pdavis_cv.DamagedFileWarning)
            recording = open_recording(path)
            if suffix == "aedat":       # a reading searches, opening has searched
                looked_at.clear()
            with contextlib.suppress(RecordingError):
                list(recording.packets())
        return (sum(looked_at) - (1 << 20)) / len(data)

    assert searched(400) <= 4
    assert searched(1600) <= 4
    assert searched(6400) <= 4


@pytest.mark.filterwarnings("ignore::pdavis_cv.DamagedFileWarning")
def test_packets_that_all_moved_are_found_without_searching_for_each(
        tmp_path, looked_at):
    path = tmp_path / "a.aedat4"
    times = 10**9 + np.arange(2000) * 10_000
    rows = np.zeros(2000, pdavis_cv.EVENT_DTYPE)
    rows["t"] = times
    pdavis_cv.write_aedat4(path, pdavis_cv.recording_from_arrays(
        rows, sensor_size=(12, 16)), compression="none")
    data = path.read_bytes()
    begin, last = (data.index(struct.pack("<q", t)) for t in times[[0, -1]])
    at = begin + 16
    path.write_bytes(data[:at] + bytes(16) + data[at:last] + data[last + 16:])
    with open_recording(path) as recording:
        looked_at.clear()
        assert len(recording.events()) == 1999
    assert sum(looked_at) < 4 * len(data)


FORMS = ("lz4.aedat4", "none.aedat4", "zstd.aedat4", "x.aedat", "x.raw", "x.h5",
         "x.es", "x.csv", "x.npy", "x.parquet", "x.mcap", "x.db3", "x.ome.tif")


@pytest.mark.parametrize(
    "isolated", [False, pytest.param(True, marks=pytest.mark.gate)])
@pytest.mark.parametrize("name", FORMS)
def test_a_limit_gives_the_whole_or_an_error_that_names_it(name, isolated, tmp_path):
    def read(**limits):
        try:
            with open_recording(path, layout="pdavis", isolated=isolated,
                                limits=Limits(**limits)) as recording:
                return [(packet.events.tobytes(), len(packet.frames))
                        for packet in recording.packets()]
        except RecordingError as error:
            return error

    path = tmp_path / name
    if name == "x.ome.tif":
        tifffile = pytest.importorskip("tifffile")
        tifffile.imwrite(path, np.ones((9, 24, 32), np.uint8), metadata={"axes": "TYX"})
    else:
        rows = np.zeros(300, pdavis_cv.EVENT_DTYPE)
        rows["t"], rows["x"] = 1000 * np.arange(300), np.arange(300) % 8
        _, write = writer_for(path)
        write(path, pdavis_cv.recording_from_arrays(rows, sensor_size=(128, 128)),
              **{"compression": name[:-7]} if name.endswith("aedat4") else {})
    whole = read()
    assert len(whole) > 1
    for limit, values in {"memory": (1, 24, 30, 10**4, 10**8),
                          "time_span": (1, 10**5, 10**9)}.items():
        found = [read(**{limit: value}) for value in values]
        refused = [isinstance(one, RecordingError) for one in found]
        assert refused == sorted(refused, reverse=True)
        assert sum(refused) < len(values)
        # The samples that a process sends together do not wait for each other.
        assert any(refused) or (isolated and limit == "memory")
        assert all(f" {limit}=" in str(one) if error else one == whole
                   for error, one in zip(refused, found, strict=True))


def test_a_search_beyond_the_limit_is_an_error(tmp_path):
    path = tmp_path / "a"
    path.write_bytes(bytes(1000))
    budget = Budget(path, Limits(work_per_byte=2))
    budget.searched(1 << 20)
    with pytest.raises(RecordingError, match="work_per_byte=2 allows"):
        budget.searched((1 << 20) + 2001)


def test_a_share_of_the_file_that_cannot_be_reserves_no_more_than_may_be(tmp_path):
    """Of a bag it is that of its times, which may be damaged."""
    path = tmp_path / "a"
    path.write_bytes(bytes(1000))
    events = np.zeros(100_000, pdavis_cv.EVENT_DTYPE)
    memory = Gathering(None, None, Budget(path))
    assert not memory.keep(events)
    memory.expect(1e-12)
    assert memory.room(0).base.nbytes <= 3 * events.nbytes
    np.testing.assert_array_equal(memory.events, events)


def test_frames_far_ahead_of_the_events_are_not_kept(tmp_path):
    path = tmp_path / "a"
    path.write_bytes(b"")
    frame = pdavis_cv.ApsFrame(np.zeros((100, 100), np.float32), 10**6, 10**6)
    batches = (Batch(frames=[frame], complete_us=0) for _ in range(1000))
    with pytest.raises(RecordingError, match="wait for earlier ones"):
        list(packetise(batches, budget=Budget(path, Limits(memory=10**7))))


@pytest.mark.parametrize(("wrong", "error"), [
    ({"memory": 0}, ValueError), ({"ratio": "3"}, TypeError), ({"files": 1}, TypeError),
    ({"time_span": float("nan")}, ValueError)])
def test_limits_are_checked(wrong, error):
    with pytest.raises(error):
        Limits(**wrong)


@pytest.mark.parametrize("wrong", ["x=1", "memory=0", "memory=1,y=2"])
def test_a_limit_that_there_is_not_is_told_those_there_are(wrong, capsys):
    assert main(["info", "--limits", wrong, "x"]) == 2
    said = capsys.readouterr().err
    assert f"memory, ratio, work_per_byte, time_span, got {wrong!r}" in said
    assert "__init__" not in said
