"""AEDAT-3.1 import; files are made byte by byte."""
import struct
import warnings

import numpy as np
import pytest
from aedat31_bytes import aedat31_file, packet
from test_aedat4 import assert_same, joined, read
from test_aedat4_writer import small

from pdavis_cv import (
    EVENT_DTYPE,
    IMU_DTYPE,
    DamagedFileWarning,
    RecordingError,
    open_recording,
    recording_from_arrays,
)


@pytest.fixture
def path(tmp_path):
    path = tmp_path / "x.aedat"
    path.write_bytes(aedat31_file(small()))
    return path


def test_import_keeps_everything_upright(path):
    wanted = joined(small().packets())
    with open_recording(path) as recording:
        got = joined(recording.packets())
        assert recording.info.format == "AEDAT-3.1"
        assert recording.info.sensor_size == (12, 16)
        assert not recording.problems
    edges = wanted[3][np.isin(wanted[3]["type"], (1, 2, 3))]
    assert_same(got, (*wanted[:3], edges))


def test_events_rarer_than_the_clock_s_reach_are_delivered(tmp_path):
    events, imu = np.zeros(200, EVENT_DTYPE), np.zeros(4000, IMU_DTYPE)
    events["t"], imu["t"] = 200_000 * np.arange(200), 10_000 * np.arange(4000)
    (tmp_path / "x").write_bytes(aedat31_file(recording_from_arrays(
        events, sensor_size=(12, 16), imu=imu)))
    (found, _, samples, _), problems = read(tmp_path / "x")
    assert found["t"].tolist() == events["t"].tolist()
    assert len(samples) == 4000
    assert {p.kind for p in problems} <= {"unknown size"}


def test_few_events_that_come_late_do_not_go_back_in_time(tmp_path):
    def some(t):
        return packet(1, 8, 4, 0, [struct.pack("<Ii", 1 | 2 << 2 | 3 << 17, one)
                                   for one in t])

    def inertial(t):
        return packet(4, 48, 4, 0, [struct.pack("<ii10f", 1, one, *[1] * 10)
                                    for one in t])

    (tmp_path / "x").write_bytes(
        b"#!AER-DAT3.1\r\n#Source 1: DAVIS346\r\n#!END-HEADER\r\n"
        + some(range(0, 900, 50)) + b"".join(
            inertial(range(t, t + 90_000, 10_000))
            for t in range(0, 4_000_000, 100_000))
        + some([1000, 1100, 1200]))
    with open_recording(tmp_path / "x") as recording:
        starts = [one.start_us for one in recording.packets()]
        assert starts == sorted(starts)
        assert len(recording.events()) >= 18
        assert sum(p.count for p in recording.problems) >= 21 - len(recording.events())


def test_the_nine_values_of_imu9_are_read_without_the_compass(tmp_path):
    words = [struct.pack("<ii10f", valid, t, *range(1, 7), 36.5, 7, 8, 9)
             for valid, t in ((1, 100), (0, 200), (1, 300))]
    event = struct.pack("<Ii", 1 | 1 << 1 | 2 << 2 | 3 << 17, 250)
    (tmp_path / "x").write_bytes(
        b"#!AER-DAT3.1\r\n#Source 1: DAVIS346\r\n#!END-HEADER\r\n"
        + packet(4, 48, 4, 0, words[:2]) + packet(1, 8, 4, 0, [event])
        + packet(4, 48, 4, 0, words[2:]))
    (events, _, imu, _), problems = read(tmp_path / "x")
    assert events.tolist() == [(250, 3, 2, 1)]
    assert imu["t"].tolist() == [100, 300]
    for sample in imu:
        assert sample["accel"].tolist() == [1, 2, 3]
        assert sample["gyro"].tolist() == [4, 5, 6]
        assert sample["temperature"] == 36.5
    assert not problems


def test_a_damaged_packet_costs_itself_only(path):
    data = bytearray(path.read_bytes())
    wanted = joined(small().packets())[0]
    at = len(data) // 2
    # The next packet header after the middle: event size 8, time offset 4.
    at = data.index(b"\x08\0\0\0\x04\0\0\0", at) - 4
    data[at:at + 4] = b"\xff\xff\xff\xff"
    path.write_bytes(data)
    with pytest.warns(DamagedFileWarning, match=f"byte {at}: no whole packet"):
        (events, *_), _ = read(path)
    assert 4600 < len(events) < 5000
    assert np.isin(events, wanted).all()


def test_a_file_without_the_header_s_end_is_refused(tmp_path):
    (tmp_path / "x").write_bytes(b"#!AER-DAT3.1\r\n" + bytes(100))
    with pytest.raises(RecordingError, match="no #!END-HEADER"):
        open_recording(tmp_path / "x")


def event_packets(times, overflow=0):
    return packet(1, 8, 4, overflow, [
        struct.pack("<Ii", 1 | 2 << 2 | 3 << 17, t) for t in times])


def imu_packet(t):
    return packet(3, 36, 4, 0, [struct.pack("<ii7f", 1, t, *range(7))])


@pytest.mark.parametrize("damaged", ["event", "imu", "overflow"])
def test_a_wild_time_costs_its_sample_or_packet_only(tmp_path, damaged):
    parts = []
    for k in range(20):
        times = [1000 * k + 100 * i for i in range(10)]
        imu_us, overflow = 1000 * k, 0
        if k == 7:
            if damaged == "event":
                times[4] += 1 << 28
            elif damaged == "imu":
                imu_us += 1 << 28
            else:
                overflow = 3
        parts += [imu_packet(imu_us), event_packets(times, overflow)]
    (tmp_path / "x").write_bytes(
        b"#!AER-DAT3.1\r\n#Source 1: DAVIS346\r\n#!END-HEADER\r\n" + b"".join(parts))
    (events, _, imu, _), problems = read(tmp_path / "x")
    assert [(p.kind, p.count) for p in problems] == [
        ("wild time", 10 if damaged == "overflow" else 1)]
    assert len(events) == 200 - {"event": 1, "imu": 0, "overflow": 10}[damaged]
    assert len(imu) == 20 - (damaged == "imu")
    assert np.isin(events["t"], 100 * np.arange(200)).all()


def test_a_wild_time_of_the_last_imu_sample_costs_no_event(tmp_path):
    parts = [imu_packet(10_000), *(event_packets([t]) for t in (11_000, 12_000)),
             imu_packet(600_000), *(event_packets([t]) for t in (13_000, 14_000))]
    (tmp_path / "x").write_bytes(
        b"#!AER-DAT3.1\r\n#Source 1: DAVIS346\r\n#!END-HEADER\r\n" + b"".join(parts))
    (events, _, imu, _), problems = read(tmp_path / "x")
    assert events["t"].tolist() == [11_000, 12_000, 13_000, 14_000]
    assert imu["t"].tolist() == [10_000]
    assert [(p.kind, p.count) for p in problems] == [("wild time", 1)]


def test_a_time_ahead_of_its_successors_costs_itself_only(tmp_path):
    """1610 instead of 330: neither the events after it nor the next packet are late."""
    (tmp_path / "x").write_bytes(
        b"#!AER-DAT3.1\r\n#Source 1: DAVIS346\r\n#!END-HEADER\r\n" + b"".join(map(
            event_packets, ([54], [1610, 671, 818], [1503, 3501], [5000, 6000]))))
    (events, *_), problems = read(tmp_path / "x")
    assert events["t"].tolist() == [54, 671, 818, 1503, 3501, 5000, 6000]
    assert [(p.kind, p.count) for p in problems] == [("backward time", 1)]


def test_a_time_that_the_next_two_packets_are_before_costs_itself_only(tmp_path):
    """A second one after it is damaged as well."""
    (tmp_path / "x").write_bytes(
        b"#!AER-DAT3.1\r\n#Source 1: DAVIS346\r\n#!END-HEADER\r\n" + b"".join(map(
            event_packets, ([14_593], [15_297, 16_249, 147_382, 14_683],
                            [17_144, 18_238], [19_000]))))
    (events, *_), problems = read(tmp_path / "x")
    assert events["t"].tolist() == [14_593, 15_297, 16_249, 17_144, 18_238, 19_000]
    assert [(p.kind, p.count) for p in problems] == [
        ("wild time", 1), ("backward time", 1)]


def test_a_frame_that_its_bytes_do_not_fit_does_not_say_how_large_a_sensor_is(tmp_path):
    def frame(height):
        return packet(2, 36 + 2 * 16 * 12, 8, 0, [
            struct.pack("<9i", 1, 0, 5, 10, 15, 16, height, 0, 0) + bytes(2 * 16 * 12)])

    for heights, size in (((9, 12), (12, 16)), ((9,), (260, 346))):
        (tmp_path / "x").write_bytes(
            b"#!AER-DAT3.1\r\n#Source 1: test\r\n#!END-HEADER\r\n" + b"".join(
                [*map(frame, heights), event_packets([20, 30])]))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            with open_recording(tmp_path / "x") as recording:
                assert recording.info.sensor_size == size


def test_packets_inside_what_an_imu_packet_claims_are_found(tmp_path):
    """Its end is cut, its count damaged, and as many bytes are added further on."""
    imu, events = imu_packet(5000), event_packets([5388, 5544, 6148, 7881])
    more, count = event_packets([8000, 8100]), 4
    claims = packet(3, 36, 4, 0, [bytes(36)] * count)[:28]
    inside = imu[28:40] + events + more
    (tmp_path / "x").write_bytes(
        b"#!AER-DAT3.1\r\n#Source 1: DAVIS346\r\n#!END-HEADER\r\n" + b"".join((
            event_packets([100, 200]), claims, inside, bytes(36 * count - len(inside)),
            event_packets([20_000, 20_100]))))
    with pytest.warns(DamagedFileWarning, match="ends at 133"):
        (events, *_), problems = read(tmp_path / "x")
    assert events["t"].tolist() == [
        100, 200, 5388, 5544, 6148, 7881, 8000, 8100, 20_000, 20_100]
    assert "damage" in {p.kind for p in problems}


def test_a_header_s_line_that_begins_with_a_colon_says_nothing(tmp_path):
    (tmp_path / "x").write_bytes(
        b"#!AER-DAT3.1\r\n:Format RAW\r\n#Source 1: DAVIS346\r\n#!END-HEADER\r\n"
        + event_packets([5]))
    assert read(tmp_path / "x")[0][0]["t"].tolist() == [5]


def test_a_camera_s_reset_of_time_is_no_damage(tmp_path):
    parts = [event_packets([t, t + 10, t + 20])
             for t in (9_000_000, 9_001_000, 9_002_000, 0, 1_000, 2_000)]
    (tmp_path / "x").write_bytes(
        b"#!AER-DAT3.1\r\n#Source 1: DAVIS346\r\n#!END-HEADER\r\n" + b"".join(parts))
    (events, *_), problems = read(tmp_path / "x")
    assert len(events) == 18
    assert [p.kind for p in problems] == ["segment"]


@pytest.mark.parametrize("overflow", [2**31 - 1, 2**30])
def test_a_frame_of_a_time_that_no_clock_reaches_is_dropped(tmp_path, overflow):
    pixels = np.full((260, 346), 100 << 6, "<u2").tobytes()
    frame = struct.pack("<i4i4i", 1, 10, 40, 10, 30, 346, 260, 0, 0) + pixels
    (tmp_path / "x").write_bytes(
        b"#!AER-DAT3.1\r\n#Format: RAW\r\n#Source 1: DAVIS346\r\n#!END-HEADER\r\n"
        + packet(2, len(frame), 8, 0, [frame])
        + packet(2, len(frame), 8, overflow, [frame]))
    with open_recording(tmp_path / "x") as recording:
        assert [f.mid_us for f in joined(recording.packets())[1]] == [20]
        [problem] = recording.problems
        assert (problem.kind, problem.count) == ("backward time", 1)
