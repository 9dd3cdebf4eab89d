"""AEDAT-2.0: words, frames, time; files are made byte by byte."""
import struct

import numpy as np
import pytest
import reference_files
from aedat2_bytes import (
    CHIP,
    END,
    HEADER,
    HEIGHT,
    START,
    WIDTH,
    aps,
    column_reads,
    dvs,
    global_frame,
    imu,
    reads,
    rolling_frame,
    word,
)
from test_aedat4 import joined

from pdavis_cv import DamagedFileWarning, Layout, RecordingError, fuse, open_recording


@pytest.fixture
def read(tmp_path):
    """Return a function that reads a file of given bytes, and its recording."""
    opened = []

    def do(data, **arguments):
        path = tmp_path / f"Davis346red-{len(opened)}.aedat"
        path.write_bytes(data)
        opened.append(open_recording(path, **arguments))
        return joined(opened[-1].packets()), opened[-1]

    yield do
    for recording in opened:
        recording.close()


# Words -------------------------------------------------------------------------


@pytest.mark.parametrize(("address", "x", "up", "on"), [
    (0x0514F800, 10, 20, 1), (0x00159000, 0, 0, 0), (0x40C00000, 345, 259, 0)])
def test_published_event_addresses_decode(read, address, x, up, on):
    (events, *_), recording = read(HEADER + word(address, 7))
    assert events.tolist() == [(7, x, 259 - up, on)]
    assert not recording.problems


def test_published_sample_addresses_decode(read):
    reset, signal = np.full((260, 346), 800), np.full((260, 346), 300)
    data = global_frame(reset, signal, 0, 100)
    assert aps(259 - 20, 10, 0, 800, 0)[:4].hex() == "8500a320"
    assert aps(259 - 20, 10, 1, 300, 0)[:4].hex() == "8500a52c"
    (_, [frame], _, _), _ = read(HEADER + data)
    assert (frame.dn == 500).all()


def test_published_imu_words_decode(read):
    raw = [1, 2, 8192, 340, -131, 5, 6]
    assert imu(2, 8192, 0)[:4].hex() == "a2000c00"
    assert imu(4, -131, 0)[:4].hex() == "cff7dc00"
    prefs = (b'#<entry key="IMU.AccelFullScale" value="0"/>\r\n'
             b'#<entry key="IMU.GyroFullScale" value="0"/>\r\n')
    data = b"".join(imu(code, value, 5) for code, value in enumerate(raw))
    (_, _, samples, _), _ = read(START + CHIP + prefs + END + data)
    [sample] = samples
    assert sample["t"] == 5
    np.testing.assert_allclose(sample["accel"], [-1 / 16384, 2 / 16384, 0.5])
    np.testing.assert_allclose(sample["gyro"], [1.0, 5 / 131, -6 / 131], rtol=1e-6)
    assert sample["temperature"] == 36


def test_imu_words_out_of_sequence_are_rejected(read):
    good = b"".join(imu(code, 100 * code, 20) for code in range(7))
    torn = b"".join(imu(code, 7, 10) for code in (0, 1, 3, 4, 5, 6))
    (events, _, samples, _), recording = read(HEADER + imu(5, 1, 1) + torn + good)
    assert samples["t"].tolist() == [20]
    assert len(events) == 0
    assert [p.kind for p in recording.problems] == ["unknown words"]


def test_external_events_are_triggers_not_pixels(read):
    data = word(0x402, 1) + word(0x403, 2) + word(0x404, 3) + word(0x401, 4)
    (events, _, _, triggers), recording = read(HEADER + data)
    assert len(events) == 0
    assert triggers.tolist() == [(1, 2), (2, 1), (3, 3)]
    assert [p.count for p in recording.problems] == [1]


def test_v2e_s_noise_label_keeps_the_event(read):
    data = dvs(3, 4, 1, 10, flag=1) + dvs(259, 345, 0, 11, flag=1)
    (events, _, _, triggers), recording = read(HEADER + data)
    assert events.tolist() == [(10, 4, 3, 1), (11, 345, 259, 0)]
    assert len(triggers) == 0
    assert [(p.kind, p.count) for p in recording.problems] == [("labelled events", 2)]


def test_events_outside_the_sensor_are_dropped_or_refused(read):
    bad = word(300 << 22 | 5 << 12, 2) + word(7 << 22 | 400 << 12, 3)
    data = HEADER + dvs(1, 1, 1, 1) + bad + dvs(2, 2, 1, 4)
    (events, *_), recording = read(data)
    assert events["t"].tolist() == [1, 4]
    assert [(p.kind, p.count) for p in recording.problems] == [("outside sensor", 2)]
    with pytest.raises(RecordingError, match=f"byte {len(HEADER) + 32}: 2 events"):
        read(data, bad_events="raise")


# Header ------------------------------------------------------------------------

ENTRY = b'#<entry key="%sAPS.Exposure" value="12345"/>\r\n'


@pytest.mark.parametrize("header", [
    HEADER,
    START + CHIP,                                             # v2e: no end marker
    START + CHIP + b"# End of ASCII Header\r\n",              # aedat4to2
    (START + CHIP + END).replace(b"\r\n", b"\n"),
    START + CHIP + b"# Hostname: m\xfcller \xb5\r\n" + END,   # latin-1
    START + CHIP + b"#\r\n" * 4000 + END,
])
@pytest.mark.parametrize("row", [5, 259 - 141])
def test_the_words_begin_where_the_header_ends(read, header, row):
    # Rows 259-140 .. 259-143 make a first byte of 0x23, which is '#'.
    data = dvs(row, 3, 1, 100) + dvs(row, 4, 0, 200)
    assert (data[:1] == b"#") == (row != 5)
    (events, *_), recording = read(header + data)
    assert events.tolist() == [(100, 3, row, 1), (200, 4, row, 0)]
    assert recording.info.header["data_start"] == len(header)


@pytest.mark.parametrize("prefix", [b"", b"Davis346red."])
def test_preferences_of_this_chip_are_read(read, prefix):
    others = ENTRY.replace(b"12345", b"999") % b"Davis346blue."
    more = (b'#<entry key="%sAPS.GlobalShutter" value="false"/>\r\n'
            b'#<entry key="%sAddressedIPotCF.DiffBn.BitValueCoarse" value="3"/>\r\n'
            b'#<entry key="%sAddressedIPotCF.DiffBn.BitValueFine" value="138"/>\r\n'
            ).replace(b"%s", prefix)
    clock = b"# DataStartTime: System.currentTimeMillis() 1600000000123\r\n"
    header = START + CHIP + others + ENTRY % prefix + more + clock + END
    _, recording = read(header + dvs(0, 0, 1, 50))
    info = recording.info
    assert (info.format, info.camera) == ("AEDAT-2.0", "Davis346red")
    assert info.exposure_us == 12345
    assert info.header["shutter"] == "rolling"
    assert info.start_us == 50
    assert info.wall_clock_us + 50 == 1_600_000_000_123_000
    # 389 nA * 8 ** (4 - 5) * 138 / 256
    assert info.biases["DiffBn"] == pytest.approx(26.21e-9, rel=1e-3)


def test_java_xml_of_all_chips_is_read(read):
    lines = [b'<?xml version="1.0" encoding="UTF-8" standalone="no"?>',
             b'<node name="davis">', b"<map>"]
    lines += [b'  <entry key="%s.APS.Exposure" value="%d"/>' % (chip, i)
              for i, chip in enumerate([b"DAVIS240C", b"Davis346red", b"Davis346blue"])]
    header = START + CHIP + b"".join(b"#" + line + b"\r\n" for line in lines) + END
    _, recording = read(header + dvs(0, 0, 1, 0))
    assert recording.info.exposure_us == 1


def test_chips_have_their_sizes(read):
    for chip, size in ((b"Davis240C", (180, 240)), (b"Davis346mini", (260, 346))):
        _, recording = read(HEADER.replace(b"Davis346red", chip))
        assert recording.info.sensor_size == size
    # The Zynq board has no frames; its events have the same addresses.
    zynq = HEADER.replace(b"Davis346red", b"Davis346Zynq") + word(0x0514F800, 7)
    (events, frames, *_), recording = read(zynq)
    assert recording.info.camera == "Davis346Zynq"
    assert (recording.info.sensor_size, frames) == ((260, 346), [])
    assert events.tolist() == [(7, 10, 239, 1)]
    for chip in (b"SBret10", b"SBret20", b"eu.seebetter.ini.chips.sbret10.SBret21"):
        name = HEADER.replace(b"eu.seebetter.ini.chips.davis.Davis346red", chip)
        (events, *_), recording = read(name + word(166 << 22 | 155 << 12, 1011))
        assert recording.info.sensor_size == (180, 240)
        assert events.tolist() == [(1011, 84, 13, 0)]
        assert not recording.problems
    with pytest.raises(RecordingError, match="chip Cochlea is not known: if its"):
        read(HEADER.replace(b"Davis346red", b"Cochlea"))


def dvs128_word(row, column, on, t):
    """Return a word of a DVS128 as jAER has them: x mirrored, y up, bit 0 is OFF."""
    return word((127 - row) << 8 | (127 - column) << 1 | (not on), t)


def test_addresses_of_a_dvs128_say_so(read, tmp_path):
    rng = np.random.default_rng(0)
    rows = [(k, *rng.integers(0, 128, 2).tolist(), k % 3 == 0) for k in range(3000)]
    data = b"".join(dvs128_word(y, x, on, t) for t, x, y, on in rows)
    data += word(0x8000, 3000)      # a falling edge at its input
    for header in (START, HEADER.replace(b"Davis346red", b"DVS128"),
                   HEADER.replace(b"Davis346red", b"Tmpdiff128")):
        (events, frames, _, triggers), recording = read(header + data)
        assert recording.info.sensor_size == (128, 128)
        assert events.tolist() == rows
        assert triggers.tolist() == [(3000, 2)]
        assert not frames
        assert ["size measured: 128x128" in p.message for p in recording.problems
                ] == [True] * (header == START)
    (tmp_path / "y.aedat").write_bytes(START + data)
    with open_recording(tmp_path / "y.aedat", sensor_size=(128, 128)) as recording:
        assert recording.events().tolist() == rows
        assert not recording.problems


def v2e_file(size, n=5000, reach=1.0):
    """Return a file of v2e: no chip's name, the image turned by 180 degrees."""
    rng = np.random.default_rng(1)
    height, width = size
    x, y = (rng.integers(0, int(reach * side), n) for side in (width, height))
    words = np.zeros((n, 2), ">u4")
    words[:, 0] = y << 22 | x << 12 | rng.integers(0, 2, n) << 11
    words[:, 1] = np.arange(n)
    return START + words.tobytes(), width - 1 - x, height - 1 - y


@pytest.mark.parametrize("size", [(180, 240), (260, 346), (480, 640)])
def test_the_size_of_a_camera_without_a_name_is_assumed_and_said(read, size):
    data, x, y = v2e_file(size)
    (events, *_), recording = read(data)
    assert recording.info.sensor_size == size
    np.testing.assert_array_equal(events["x"], x)
    np.testing.assert_array_equal(events["y"], y)
    [problem] = recording.problems
    assert f"size assumed: {size[1]}x{size[0]}; sensor_size=" in problem.message


def test_a_size_that_addresses_do_not_say_is_asked_for(read, tmp_path):
    data, x, y = v2e_file((260, 346), reach=.6)
    with pytest.raises(RecordingError, match=r"names no chip and its addresses reach "
                       r"x = 206, y = 155: the sensor is stated by sensor_size="):
        read(data)
    (tmp_path / "y.aedat").write_bytes(data)
    with open_recording(tmp_path / "y.aedat", sensor_size=(260, 346)) as recording:
        events = recording.events()
    np.testing.assert_array_equal(events["x"], x)
    np.testing.assert_array_equal(events["y"], y)
    noise = np.random.default_rng(0).integers(0, 1 << 32, (1000, 2)).astype(">u4")
    with pytest.raises(RecordingError, match="those of neither a DAVIS nor a DVS128"):
        read(START + noise.tobytes())
    (tmp_path / "y.aedat").write_bytes(HEADER)
    with pytest.raises(ValueError, match="sensor_size says 2x1, the file 346x260"):
        open_recording(tmp_path / "y.aedat", sensor_size=(1, 2))


def test_v2e_of_the_public_case(data_dir):
    with open_recording(data_dir / "public" / "v2e_240x180.aedat") as recording:
        events = recording.events()
        assert recording.info.sensor_size == (180, 240)
        assert "size assumed" in recording.problems[0].message
    assert (len(events), events["p"].sum()) == (5000, 2476)
    assert events[[0, -1]].tolist() == [(1011, 84, 13, 0), (999_387, 67, 140, 1)]


@pytest.mark.parametrize("header", [
    b"", b"#Some comment\r\n", b"# This is a raw AE data file - do not edit\r\n"])
def test_aedat_1_is_refused_by_name(read, header):
    # Big-endian int16 address, int32 time.
    data = header + b"".join(struct.pack(">Hi", 2 * i, 100 * i) for i in range(50))
    match = "AEDAT-1 of a DVS128" if header else "byte 0: not a recording"
    with pytest.raises(RecordingError, match=match):
        read(data)


def test_other_versions_are_refused_by_name(read):
    for version in (b"3.0", b"5", b""):
        with pytest.raises(RecordingError, match=r"AEDAT-(3.0|5|\?) is not read"):
            read(b"#!AER-DAT" + version + b"\r\n" + bytes(64))


# Frames ------------------------------------------------------------------------


@pytest.mark.parametrize("columns", [range(346), range(345, -1, -1)],
                         ids=["red", "blue"])
def test_a_global_shutter_frame_is_reset_minus_signal(read, columns):
    reset, signal = reads(0)
    reset[3, 4], signal[5, 6], signal[7, 8] = 383, 2, 3
    data = global_frame(reset, signal, 1000, 20_000, columns=columns)
    (_, [frame], _, _), recording = read(HEADER + data)
    np.testing.assert_array_equal(frame.dn, reset - signal)
    np.testing.assert_array_equal(frame.reset, reset)
    np.testing.assert_array_equal(frame.signal, signal)
    assert np.argwhere(~frame.valid).tolist() == [[3, 4], [5, 6]]
    # From the last reset to the first signal; over when the last signal is there.
    assert frame.exposure_start_us == 1000 + 3450
    assert frame.exposure_end_us == 1000 + 3450 + 20_000
    assert frame.available_us == 1000 + 2 * 3450 + 20_000
    assert not recording.problems


@pytest.mark.parametrize("columns", [range(346), range(345, -1, -1)],
                         ids=["red", "blue"])
@pytest.mark.parametrize("lag", [1, 100])
def test_a_rolling_shutter_frame_has_times_per_column(read, columns, lag):
    frames = [reads(seed) for seed in (1, 2)]
    data = b"".join(rolling_frame(*pair, 50_000 * i, lag, columns=columns)
                    for i, pair in enumerate(frames))
    (_, got, _, _), recording = read(HEADER + data)
    for i, ((reset, signal), frame) in enumerate(zip(frames, got, strict=True)):
        np.testing.assert_array_equal(frame.dn, reset - signal)
        start = np.empty(346, int)
        start[list(columns)] = 50_000 * i + 10 * np.arange(346)
        np.testing.assert_array_equal(frame.exposure_start_us, start)
        np.testing.assert_array_equal(frame.exposure_end_us, start + 10 * lag + 1)
        assert frame.available_us == 50_000 * i + 10 * (345 + lag) + 1
    assert not recording.problems


def test_a_long_rolling_exposure_is_known_from_the_header(read):
    reset, signal = reads(3)
    data = global_frame(reset, signal, 0, 9000)
    header = START + CHIP + b'#<entry key="APS.GlobalShutter" value="false"/>\r\n' + END
    (_, [frame], _, _), _ = read(header + data)
    start = 10 * np.arange(346)
    np.testing.assert_array_equal(frame.exposure_start_us, start)
    np.testing.assert_array_equal(frame.exposure_end_us, start + 3450 + 9000)


def test_events_between_the_samples_keep_their_places(read):
    reset, signal = reads(4)
    samples = global_frame(reset, signal, 0, 1000)
    parts, t = [], 0
    for i in range(0, len(samples), 8 * 1000):
        t = int.from_bytes(samples[i + 4:i + 8], "big")
        parts += [dvs(i // 8000 % 260, 7, 1, t), samples[i:i + 8000]]
    times = sorted(int.from_bytes(p[4:8], "big") for p in parts[::2])
    (events, [frame], _, _), recording = read(HEADER + b"".join(parts))
    # The thousandth sample may lie in the middle of a column: times still grow.
    assert len(events) + sum(p.count for p in recording.problems) == len(times)
    np.testing.assert_array_equal(frame.dn, reset - signal)


def test_missing_samples_are_not_valid_and_not_stale(read):
    first, second = reads(5), reads(6)
    columns = [c for c in range(346) if c not in (40, 41)]
    data = (global_frame(*first, 0, 1000)
            + global_frame(*second, 30_000, 1000, columns=columns)
            + global_frame(*first, 60_000, 1000))
    (_, frames, _, _), recording = read(HEADER + data)
    assert len(frames) == 3
    assert frames[0].valid is None
    assert np.unique(np.argwhere(~frames[1].valid)[:, 1]).tolist() == [40, 41]
    assert (frames[1].dn[:, 40:42] == 0).all()
    np.testing.assert_array_equal(frames[2].dn, first[0] - first[1])
    assert [(p.kind, p.count) for p in recording.problems] == [("incomplete frame", 1)]
    times = [f.available_us for f in frames]
    assert times == sorted(times)


def test_a_file_that_begins_or_ends_inside_a_frame(read):
    pair = reads(7)
    whole = global_frame(*pair, 0, 1000)
    late = b"".join(column_reads(1, pair[1], c, c) for c in range(200, 346))
    (_, frames, _, _), _ = read(
        HEADER + late + global_frame(*pair, 5000, 1000) + column_reads(
            0, pair[0], 0, 90_000))
    assert len(frames) == 1
    assert frames[0].valid is None
    (_, [frame], _, _), _ = read(HEADER + whole[:-8 * 260 * 6])
    assert np.unique(np.argwhere(~frame.valid)[:, 1]).tolist() == [*range(340, 346)]


def test_the_third_read_of_old_cameras_is_ignored(read):
    pair = reads(8)
    third = b"".join(aps(r, 3, 2, 100, 8000) for r in range(260))
    (_, [frame], _, _), _ = read(HEADER + global_frame(*pair, 0, 1000) + third)
    np.testing.assert_array_equal(frame.dn, pair[0] - pair[1])


# Time --------------------------------------------------------------------------


def test_a_wrap_goes_on(read):
    times = [k * 2**31 + by + 10 * i for k, by in ((1, -10**9), (1, 0), (2, 10**9),
                                                   (3, 5), (4, -3)) for i in range(9)]
    (events, *_), recording = read(
        HEADER + b"".join(dvs(1, 1, 1, t) for t in times))
    assert events["t"].tolist() == times
    assert not recording.problems


def test_a_reset_begins_a_new_segment(read):
    times = [5_000_000, 5_500_000, 6_000_000, 6_000_000, 3, 10, 20]
    (events, *_), recording = read(
        HEADER + b"".join(dvs(1, 1, 1, t) for t in times))
    assert events["t"].tolist() == [*times[:4], 6_000_001, 6_000_008, 6_000_018]
    assert [p.kind for p in recording.problems] == ["segment"]


def test_small_jumps_back_and_single_wild_times_are_dropped(read):
    times = [1000, 2000, 1500, 2500, 0, 3000, 2**30, 3500, 5_000_000, 4_900_000,
             5_000_001]
    (events, *_), recording = read(
        HEADER + b"".join(dvs(1, 1, 1, t) for t in times))
    assert events["t"].tolist() == [t for _, t in reference_files.settle(times)[0]]
    assert len(events) == 7
    assert [(p.kind, p.count) for p in recording.problems] == [("backward time", 4)]


def test_stale_words_at_the_end_are_dropped(read):
    data = b"".join(dvs(i % 260, 1, 1, 20_000 * i) for i in range(200))
    (events, *_), recording = read(HEADER + data + data[800:1200])
    assert len(events) == 200
    assert [(p.kind, p.count) for p in recording.problems] == [("stale words", 50)]


def test_a_file_that_ends_inside_a_word_warns(read):
    with pytest.warns(DamagedFileWarning, match=f"byte {len(HEADER) + 8}: the file"):
        (events, *_), _ = read(HEADER + dvs(1, 1, 1, 5) + b"\0\0\0")
    assert len(events) == 1


# v2e ---------------------------------------------------------------------------


def test_what_v2e_writes_decodes_upright(read):
    # v2e's aedat2_output.py: x and y flipped, then the DAVIS shifts; no end marker.
    x, y, p, t = (np.array(v) for v in ([0, 5, 345], [0, 3, 259], [1, 0, 1], [1, 2, 3]))
    address = ((259 - y) << 22) + ((345 - x) << 12) + (p << 11)
    words = np.stack([address, t], 1).astype(">i4").tobytes()
    header = (b"#!AER-DAT2.0\r\n# This is a raw AE data file created by AEDat2Output "
              b"in v2e\r\n# AEChip: eu.seebetter.ini.chips.davis.Davis346blue\r\n")
    (events, *_), recording = read(header + words)
    assert events.tolist() == list(zip(t, x, y, p, strict=True))
    assert recording.info.header["data_start"] == len(header)


# Reading -----------------------------------------------------------------------


def long_file():
    """Return 4 s of events with 40 frames, and the words' times."""
    pair = reads(9)
    rng = np.random.default_rng(0)
    parts = []
    for k in range(40):
        frame = np.frombuffer(global_frame(*pair, 100_000 * k, 20_000), ">u4")
        parts.append(frame.reshape(-1, 2))
        n = 5000
        events = np.empty((n, 2), ">u4")
        t = np.sort(rng.integers(100_000 * k, 100_000 * (k + 1), n))
        events[:, 0] = (rng.integers(0, 260, n) << 22 | rng.integers(0, 346, n) << 12
                        | rng.integers(0, 2, n) << 11)
        events[:, 1] = t
        parts.append(events)
    words = np.concatenate(parts)
    words = words[np.argsort(words[:, 1], kind="stable")]
    return HEADER + words.astype(">u4").tobytes()


def test_an_interval_holds_what_the_whole_holds(tmp_path):
    path = tmp_path / "x.aedat"
    path.write_bytes(long_file())
    with open_recording(path) as recording:
        whole = list(recording.packets())
    events, frames, _, _ = joined(whole)
    assert len(events) == 200_000
    assert len(frames) == 40
    with open_recording(path) as recording:
        for start, stop in ((3_100_000, 3_200_000), (0, 50), (2_345_678, 2_345_999),
                            (3_999_000, 10**9), (1_000_000, 1_030_001)):
            got = joined([*recording.packets(start, stop), *recording.packets(-9, -1),
                          whole[0]])
            n = len(got[0]) - len(whole[0].events)
            inside = (events["t"] >= start) & (events["t"] < stop)
            np.testing.assert_array_equal(got[0][:n], events[inside])
            wanted = [f for f in frames if start <= f.available_us < stop]
            times = [f.mid_us for f in got[1]][:len(wanted)]
            assert times == [f.mid_us for f in wanted]
        assert not recording.problems


def test_packets_keep_their_contract(tmp_path):
    path = tmp_path / "x.aedat"
    path.write_bytes(long_file())
    before = -1
    with open_recording(path) as recording:
        for packet in recording.packets():
            assert len(packet.events) <= 65_536
            assert len(packet.frames) <= 1
            assert packet.stop_us - packet.start_us <= 10_000
            assert packet.start_us >= before
            before = packet.stop_us - 1


def test_an_empty_recording_is_one(read):
    (events, frames, _, _), recording = read(HEADER)
    assert (len(events), len(frames)) == (0, 0)
    assert recording.scan().start_us is None
    assert recording.info.start_us is None


@pytest.mark.parametrize("order", ["rows", "rows upward", "shuffled", "pairs"])
def test_any_order_of_samples_within_a_frame_is_a_frame(tmp_path, order):
    # The INI's aedat4to2 writes samples row by row and calls the chip DAVI346.
    rng = np.random.default_rng(0)
    images = [reads(seed) for seed in (1, 2, 3)]
    places = [(y, x) for y in range(HEIGHT) for x in range(WIDTH)]
    data = []
    for k, (reset, signal) in enumerate(images):
        t = 40_000 * k
        if order == "rows upward":
            places.sort(key=lambda place: (-place[0], place[1]))
        elif order == "shuffled":
            places = [places[i] for i in rng.permutation(len(places))]
        first = [aps(y, x, 0, reset[y, x], t) for y, x in places]
        second = [aps(y, x, 1, signal[y, x], t + (0 if order == "pairs" else 9_000))
                  for y, x in places]
        data += [a + b for a, b in zip(first, second, strict=True)] if (
            order == "pairs") else first + second
        data.append(dvs(3, 4, 1, t + 20_000))
    path = tmp_path / "x.aedat"
    path.write_bytes(START + b"# AEChip: DAVI346\r\n# End of ASCII Header\r\n"
                     + b"".join(data))
    with open_recording(path) as recording:
        assert recording.info.sensor_size == (HEIGHT, WIDTH)
        events, frames, _, _ = joined(recording.packets())
        assert not recording.problems
    assert len(events) == 3
    assert len(frames) == 3
    for frame, (reset, signal) in zip(frames, images, strict=True):
        np.testing.assert_array_equal(frame.dn, reset - signal)
        assert frame.valid is None


def test_a_file_without_frames_says_so_and_is_reconstructed_from_events(tmp_path):
    rng = np.random.default_rng(0)
    data = b"".join(dvs(int(rng.integers(20)), int(rng.integers(20)), i % 2,
                        50 * i) for i in range(4000))
    path = tmp_path / "x.aedat"
    path.write_bytes(HEADER + data + imu(0, 5, 200_000))
    with open_recording(path, layout=Layout.PDAVIS) as recording:
        assert recording.info.frame_count == 0
        image = next(fuse(recording, fps=20, start_us=150_000))
        assert image.valid.any()
    path.write_bytes(HEADER + data + aps(0, 0, 0, 500, 200_000))
    with open_recording(path) as recording:
        assert recording.info.frame_count is None


def test_a_frame_in_which_time_jumps_is_in_its_window(tmp_path):
    reset, signal = reads(1)
    data = [column_reads(0, reset, 0, 100), 270_000 * dvs(0, 0, 1, 10_000),
            column_reads(1, signal, 0, 20_000_000)]
    (tmp_path / "x.aedat").write_bytes(HEADER + b"".join(data))
    with open_recording(tmp_path / "x.aedat") as recording:
        for _ in range(2):      # the first reading makes marks
            [frame] = [frame for packet in recording.packets(15_000_000)
                       for frame in packet.frames]
            assert frame.valid.sum() == HEIGHT
            recording.scan()
