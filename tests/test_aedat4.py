"""AEDAT-4 as DV writes it."""
import itertools
import struct
import threading
import tracemalloc
import warnings

import aedat
import numpy as np
import pytest
from streams import random_events

import pdavis_cv
from pdavis_cv import (
    EVENT_DTYPE,
    DamagedFileWarning,
    RecordingError,
    open_recording,
    recording_from_arrays,
    write_aedat4,
)
from pdavis_cv.recording.file_reader import FileReader

FULL = "davis346.aedat4"


@pytest.fixture
def real(data_dir):
    with open_recording(data_dir / FULL) as recording:
        yield recording


def joined(packets):
    """Return events, frames, IMU samples and triggers of packets."""
    packets = list(packets) or [pdavis_cv.Packet()]
    arrays = [np.concatenate([getattr(p, name) for p in packets])
              for name in ("events", "imu", "triggers")]
    return arrays[0], [f for p in packets for f in p.frames], *arrays[1:]


def read(path):
    """Return all samples and problems of a file."""
    with open_recording(path) as recording:
        return joined(recording.packets()), recording.problems


def assert_same(one, other):
    for a, b in zip((one[0], *one[2:]), (other[0], *other[2:]), strict=True):
        np.testing.assert_array_equal(a, b)
    assert len(one[1]) == len(other[1])
    for f, g in zip(one[1], other[1], strict=True):
        np.testing.assert_array_equal(f.dn, g.dn)
        assert (f.exposure_start_us, f.exposure_end_us, f.available_us) == (
            g.exposure_start_us, g.exposure_end_us, g.available_us)


def test_the_real_recording_equals_the_aedat_package(real, data_dir):
    events, frames, imu, triggers = joined(real.packets())
    theirs = {"events": [], "frame": [], "imus": [], "triggers": []}
    for packet in aedat.Decoder(data_dir / FULL):
        for name, parts in theirs.items():
            if name in packet:
                parts.append(packet[name])
    their_events = np.concatenate(theirs["events"])
    assert len(events) == 78_830
    for name, other in (("t", "t"), ("x", "x"), ("y", "y"), ("p", "on")):
        np.testing.assert_array_equal(events[name], their_events[other])
    assert len(frames) == len(theirs["frame"]) == 59
    for frame, other in zip(frames, theirs["frame"], strict=True):
        np.testing.assert_array_equal(frame.dn, other["pixels"] * np.float32(4))
        np.testing.assert_array_equal(frame.valid, other["pixels"] < 255)
        assert frame.exposure_start_us == other["exposure_begin_t"]
        assert frame.exposure_end_us == other["exposure_end_t"]
        assert frame.available_us == other["end_t"]
    their_imu, their_triggers = (
        np.concatenate(theirs[name]) for name in ("imus", "triggers"))
    np.testing.assert_array_equal(imu["t"], their_imu["t"])
    np.testing.assert_array_equal(imu["temperature"], their_imu["temperature"])
    for i, axis in enumerate("xyz"):
        np.testing.assert_array_equal(
            imu["accel"][:, i], their_imu[f"accelerometer_{axis}"])
        np.testing.assert_array_equal(
            imu["gyro"][:, i], their_imu[f"gyroscope_{axis}"])
    np.testing.assert_array_equal(triggers["t"], their_triggers["t"])
    np.testing.assert_array_equal(triggers["type"], their_triggers["source"])
    assert not real.problems


def test_the_real_recording_equals_dv_processing(real, data_dir):
    dv = pytest.importorskip("dv_processing")
    reader = dv.io.MonoCameraRecording(str(data_dir / FULL))
    events, frames, _, _ = joined(real.packets())
    parts = []
    while (batch := reader.getNextEventBatch()) is not None:
        parts.append(batch.numpy())
    theirs = np.concatenate(parts)
    assert len(theirs) == len(events)
    for name, other in (
            ("t", "timestamp"), ("x", "x"), ("y", "y"), ("p", "polarity")):
        np.testing.assert_array_equal(events[name], theirs[other])
    for frame in frames:
        np.testing.assert_array_equal(
            frame.dn, reader.getNextFrame().image * np.float32(4))
    assert reader.getNextFrame() is None


def test_events_and_frames_are_in_the_same_orientation(real):
    # Summed polarities follow the change of log intensity, in one orientation only.
    events, frames, _, _ = joined(real.packets())
    change, sums = [], []
    for one, two in itertools.pairwise(frames):
        between = events[(events["t"] >= one.mid_us) & (events["t"] < two.mid_us)]
        image = np.zeros((260, 346))
        np.add.at(image, (between["y"], between["x"]), between["p"] * 2.0 - 1)
        sums.append(image)
        change.append(np.log(two.dn + 8) - np.log(one.dn + 8))
    change, sums = np.array(change), np.array(sums)

    def likeness(turned):
        return np.corrcoef(turned.ravel(), change.ravel())[0, 1]

    assert likeness(sums) > 0.4
    for turned in (sums[:, ::-1], sums[:, :, ::-1], sums[:, ::-1, ::-1]):
        assert abs(likeness(turned)) < 0.05


def test_header_facts_come_without_reading(real):
    info = real.info
    assert (info.format, info.sensor_size) == ("AEDAT-4", (260, 346))
    assert (info.camera, info.serial) == ("DAVIS346_00000002", "00000002")
    assert info.sensor == pdavis_cv.Sensor.DAVIS346
    assert info.layout is None
    assert (info.event_count, info.frame_count) == (78_830, 59)
    assert (info.imu_count, info.trigger_count) == (2363, 236)
    report = real.scan()
    assert (report.event_count, report.frame_count) == (78_830, 59)
    assert (report.imu_count, report.trigger_count) == (2363, 236)
    assert (info.start_us, info.stop_us) == (report.start_us, report.stop_us)


def test_packets_keep_their_contract(real):
    before, last = None, np.empty(0, EVENT_DTYPE)
    for packet in real.packets():
        assert len(packet.events) <= 65_536
        assert len(packet.frames) <= 1
        assert packet.stop_us - packet.start_us <= 10_000
        assert before is None or packet.start_us >= before
        before = packet.stop_us
        assert packet.events.flags.writeable
        assert not np.shares_memory(packet.events, last)
        last = packet.events


def test_a_packet_that_is_kept_keeps_little_else(tmp_path):
    events = random_events(40_000, (10, 10), stop_us=10_000, read_only=False)
    events["t"][15_000:15_700] += np.repeat(np.arange(1, 8) * 10_000, 100)
    events["t"][15_700:] += 80_000
    events.sort(order="t")
    path = tmp_path / "x.aedat4"
    write_aedat4(path, recording_from_arrays(events, sensor_size=(10, 10)))
    with open_recording(path) as recording:
        kept = [(p.events.nbytes, p.events.base) for p in recording.packets()]
    assert min(own for own, _ in kept) == 1300 < 200_000 < max(own for own, _ in kept)
    assert all(base is None or base.nbytes <= 16 * own for own, base in kept)


def test_packets_of_arrays_are_copies():
    events = random_events(20_000, (10, 10), stop_us=15_000)
    for packet in recording_from_arrays(events, sensor_size=(10, 10)).packets():
        assert not np.shares_memory(packet.events, events)


@pytest.mark.parametrize("name", [FULL, "unclosed"])
def test_an_interval_is_cut_from_the_same_packets(data_dir, tmp_path, name):
    path = data_dir / FULL
    if name == "unclosed":
        path = tmp_path / "unclosed.aedat4"
        path.write_bytes(without_index((data_dir / FULL).read_bytes()))
    with open_recording(path) as recording:
        whole = list(recording.packets())
        base = whole[0].start_us
        for start, stop in ((0, 1), (5, 900_000), (1_000_000, 1_000_001),
                            (1_234_567, 2_345_678), (2_359_000, 10**7), (-9, 0)):
            got = list(recording.packets(base + start, base + stop))
            wanted = [p for p in whole if p.stop_us > base + start
                      and p.start_us < base + stop]
            inner = [p for p in wanted if p.start_us >= base + start
                     and p.stop_us <= base + stop]
            middle = [p for p in got if any(p.start_us == q.start_us
                                            and p.stop_us == q.stop_us for q in inner)]
            for p, q in zip(middle, inner, strict=True):
                assert_same(joined([p]), joined([q]))
            assert sum(len(p.events) for p in got) == sum(
                int(np.count_nonzero((p.events["t"] >= base + start)
                                     & (p.events["t"] < base + stop))) for p in wanted)
            assert all(p.start_us >= base + start and p.stop_us <= base + stop
                       for p in got)


def test_iterators_do_not_disturb_each_other(real):
    wanted = joined(real.packets())
    results = [None] * 4

    def work(i):
        results[i] = joined(real.packets())

    threads = [threading.Thread(target=work, args=(i,)) for i in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    for result in results:
        assert_same(result, wanted)


def test_a_recording_pickles_by_its_path(real):
    import pickle
    with pickle.loads(pickle.dumps(real)) as again:
        assert again.info == real.info


def test_reading_after_close_is_an_error(data_dir):
    recording = open_recording(data_dir / FULL)
    recording.close()
    with pytest.raises(ValueError, match="closed"):
        next(iter(recording.packets()))


def test_sixteen_bit_frames_and_unknown_types(data_dir):
    with open_recording(data_dir / "gray16.aedat4") as recording:
        _, [frame], _, _ = joined(recording.packets())
    np.testing.assert_array_equal(frame.dn, [[1, 2], [3, 1023]])
    np.testing.assert_array_equal(frame.valid, [[True, True], [True, False]])
    assert (frame.exposure_start_us, frame.exposure_end_us) == (950, 1050)
    with open_recording(data_dir / "unknown_then_gray16.aedat4") as recording:
        with pytest.warns(pdavis_cv.PdavisWarning, match="frame of OpenCV type"):
            _, frames, _, _ = joined(recording.packets())
        _, again, _, _ = joined(recording.packets(frames[0].available_us))
        assert len(frames) == len(again) == 1


# Damage ------------------------------------------------------------------------


def without_index(data):
    """Return a file as it is when the writer was killed: no table, position -1."""
    at = data.index(struct.pack("<q", table_position(data)))
    return data[:at] + struct.pack("<q", -1) + data[at + 8:table_position(data)]


def table_position(data):
    """Return where the index lies, by search: where its packets end."""
    at = 18 + struct.unpack_from("<I", data, 14)[0]
    while struct.unpack_from("<I", data, at)[0] < 4:
        at += 8 + struct.unpack_from("<I", data, at + 4)[0]
    return at


@pytest.mark.parametrize(("content", "message"), [
    (b"", "empty"),
    (b"hello, this is text", "not a recording, first bytes b'hello"),
    (b"\x89PNG\r\n\x1a\n" + bytes(100), "first bytes b'.x89PNG"),
    (b"#!AER-DAT4.0\r\n", "ends inside the header"),
    (b"#!AER-DAT4.0\r\n\x40\0\0\0abc", "ends inside the header"),
    (b"#!AER-DAT4.0\r\n\xff\xff\xff\xff", "cannot be 4294967295 bytes"),
    (b"#!AER-DAT4.0\r\n\x08\0\0\0\0\0\0\0IOHE", "is damaged: "),
])
def test_what_is_not_a_recording_says_so(tmp_path, content, message):
    path = tmp_path / "x.aedat4"
    path.write_bytes(content)
    with pytest.raises(RecordingError, match=message) as caught:
        open_recording(path)
    assert str(path) in str(caught.value)


def test_a_missing_file_is_a_recording_error(tmp_path):
    with pytest.raises(RecordingError, match="No such file"):
        open_recording(tmp_path / "none.aedat4")


def test_a_file_without_index_gives_the_same_samples(real, data_dir, tmp_path):
    path = tmp_path / "x.aedat4"
    path.write_bytes(without_index((data_dir / FULL).read_bytes()))
    with open_recording(path) as recording:
        assert recording.info.event_count is None
        assert recording.info.stop_us is None
        assert recording.info.start_us == real.info.start_us
        assert_same(joined(recording.packets()), joined(real.packets()))


def test_a_torn_index_is_replaced_by_a_search(real, data_dir, tmp_path):
    data = (data_dir / FULL).read_bytes()
    wanted = joined(real.packets())
    at = table_position(data)
    torn = [data[:at + 9], data[:-20], data[:at] + b"\xff" * (len(data) - at)]
    for content in torn:
        path = tmp_path / "x.aedat4"
        path.write_bytes(content)
        with pytest.warns(DamagedFileWarning, match=f"byte {at}: the index"):
            recording = open_recording(path)
        with recording:
            assert_same(joined(recording.packets()), wanted)


def test_a_file_cut_inside_a_packet_gives_the_packets_before(real, data_dir, tmp_path):
    data = (data_dir / FULL).read_bytes()[:3_000_000]
    path = tmp_path / "x.aedat4"
    path.write_bytes(data)
    with warnings.catch_warnings(record=True) as seen:
        warnings.simplefilter("always")
        with open_recording(path) as recording:
            events, frames, _, _ = joined(recording.packets())
            assert [p.kind for p in recording.problems] == ["damage"]
    assert [w.category for w in seen] == [DamagedFileWarning]
    wanted = joined(real.packets())
    assert 30_000 < len(events) < 78_830
    np.testing.assert_array_equal(events, wanted[0][:len(events)])
    assert 20 < len(frames) < 59


@pytest.mark.parametrize("indexed", [True, False])
def test_a_damaged_packet_costs_itself_only(real, data_dir, tmp_path, indexed):
    data = (data_dir / FULL).read_bytes()
    if not indexed:
        data = without_index(data)
    at = 18 + struct.unpack_from("<I", data, 14)[0]
    packets = []
    while at < len(data) and struct.unpack_from("<I", data, at)[0] < 4:
        stream, size = struct.unpack_from("<ii", data, at)
        packets.append((stream, at, size))
        at += 8 + size
    events = [p for p in packets if p[0] == 0]
    _, at, size = events[100]
    wanted = joined(real.packets())
    for broken in (
            data[:at] + b"\x7f\x7f\x7f\x7f" + data[at + 4:],       # stream
            data[:at + 4] + b"\xff\xff\xff\x7f" + data[at + 8:],   # size
            data[:at + 4] + struct.pack("<i", -5) + data[at + 8:],
            data[:at + 8] + b"\0\0\0\0" + data[at + 12:],          # magic
            data[:at + 20] + b"\xff" * (size - 12) + data[at + 8 + size:]):
        path = tmp_path / "x.aedat4"
        path.write_bytes(broken)
        with pytest.warns(DamagedFileWarning, match=f"byte {at}"):
            got, [problem] = read(path)
        assert problem.kind == "damage"
        assert 77_000 < len(got[0]) < 78_830
        assert np.isin(got[0], wanted[0]).all()
        assert_same((wanted[0], *got[1:]), wanted)


def test_memory_stays_flat(real):
    for _ in real.packets():
        pass
    tracemalloc.start()
    try:
        for i, _ in enumerate(real.packets()):
            if i == 50:
                tracemalloc.reset_peak()
                early = tracemalloc.get_traced_memory()[1]
        late = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert late < early + 4_000_000


def test_without_an_index_a_time_ahead_costs_itself_only(tmp_path):
    """The last of the first packet: nothing comes before, the next packet says it."""
    times = np.arange(100, 100_000, 500)
    events = random_events(len(times), (12, 16), seed=3, start_us=0, stop_us=1).copy()
    events["t"] = times
    write_aedat4(tmp_path / "whole", recording_from_arrays(
        events, sensor_size=(12, 16)), compression="none")
    data = bytearray(without_index((tmp_path / "whole").read_bytes()))
    at = data.index(struct.pack("<q", 9_600))
    data[at:at + 8] = struct.pack("<q", 663_241)
    (tmp_path / "x").write_bytes(data)
    (found, *_), problems = read(tmp_path / "x")
    assert found["t"].tolist() == [t for t in times if t != 9_600]
    assert ("backward time", 1) in {(p.kind, p.count) for p in problems}


def written(path, times, index=True, imu=()):
    """Write events at some times, and IMU samples; return the file's bytes."""
    events = np.zeros(len(times), pdavis_cv.EVENT_DTYPE)
    events["t"] = times
    samples = np.zeros(len(imu), pdavis_cv.IMU_DTYPE)
    samples["t"] = imu
    write_aedat4(path, recording_from_arrays(
        events, sensor_size=(12, 16), imu=samples), compression="none")
    data = path.read_bytes()
    return bytearray(data if index else without_index(data))


@pytest.mark.parametrize("index", [True, False])
def test_one_time_far_back_is_dropped_and_moves_nothing(tmp_path, index):
    times = 1_700_000_000_000_000 + 100 * np.arange(2000)
    imu_times = times[::10] + 7
    data = written(tmp_path / "x", times, index, imu=imu_times)
    for t in (int(times[50]), int(imu_times[105])):
        at = data.index(struct.pack("<q", t))
        data[at:at + 8] = struct.pack("<q", t - (1 << 34))      # 4.8 hours
    (tmp_path / "x").write_bytes(data)
    (found, _, imu, _), problems = read(tmp_path / "x")
    assert found["t"].tolist() == np.delete(times, 50).tolist()
    assert imu["t"].tolist() == np.delete(imu_times, 105).tolist()
    assert "segment" not in {p.kind for p in problems}


@pytest.mark.parametrize("index", [True, False])
def test_times_that_no_clock_has_end_in_a_dropped_event(tmp_path, index):
    times = [(1 << 61) - 10, (1 << 61) - 9, (1 << 61) - 8]
    data = written(tmp_path / "x", times, index)
    far = struct.pack("<q", -(1 << 61) - 8_000_000)
    for at in {data.index(struct.pack("<q", times[2])),
               data.rindex(struct.pack("<q", times[0]))}:
        if at != data.index(struct.pack("<q", times[0])):
            data[at:at + 8] = far       # the event, and the index if there is one
    (tmp_path / "x").write_bytes(data)
    (found, *_), problems = read(tmp_path / "x")
    assert found["t"].tolist() == times[:2]
    assert ("backward time", 1) in {(p.kind, p.count) for p in problems}


@pytest.mark.filterwarnings("ignore::pdavis_cv.DamagedFileWarning")
def test_packets_that_claim_the_rest_of_a_file_are_looked_at_once(
        tmp_path, monkeypatch):
    """Each holds a broken frame of LZ4; bytes that are read grow with the file."""
    write_aedat4(tmp_path / "x", recording_from_arrays(
        np.zeros(3, pdavis_cv.EVENT_DTYPE), sensor_size=(12, 16)))
    whole = without_index((tmp_path / "x").read_bytes())
    head = whole[:whole.index(b"\x04\x22\x4d\x18") - 8]
    read_once = FileReader.read
    looked = []

    def counted(reader, at, size):
        data = read_once(reader, at, size)
        looked[-1] += len(data)
        return data

    monkeypatch.setattr(FileReader, "read", counted)
    for count in (300, 1200):
        (tmp_path / "x").write_bytes(head + b"".join(
            struct.pack("<ii", 0, 24 * (count - k) - 8 - k % 2)
            + b"\x04\x22\x4d\x18" + bytes(12) for k in range(count)))
        looked.append(0)
        (found, *_), _ = read(tmp_path / "x")
        assert not len(found)
    assert looked[1] < 6 * looked[0]
