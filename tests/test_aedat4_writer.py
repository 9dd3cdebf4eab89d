"""Writing AEDAT-4: ours is read by others and by us."""
import aedat
import numpy as np
import pytest
from streams import random_events
from test_aedat4 import assert_same, joined

import pdavis_cv
from pdavis_cv import (
    Aedat4Writer,
    ApsFrame,
    DamagedFileWarning,
    Layout,
    LayoutError,
    Packet,
    open_recording,
    recording_from_arrays,
    write_aedat4,
)
from pdavis_cv.recording.limits import Budget, Limits

SIZE = (12, 16)


def small(frames=3, *, layout=None):
    """Return a recording of every kind of sample, with 10-bit frames."""
    rng = np.random.default_rng(1)
    events = random_events(5000, SIZE, seed=2, start_us=0, stop_us=100_000)
    images = [ApsFrame(rng.integers(0, 1024, SIZE).astype(np.float32),
                       k * 30_000 + 5_000, k * 30_000 + 15_000,
                       available_us=k * 30_000 + 20_000) for k in range(frames)]
    imu = np.zeros(50, pdavis_cv.IMU_DTYPE)
    imu["t"] = np.arange(50) * 2_000
    for name in ("temperature", "accel", "gyro"):
        imu[name] = rng.normal(size=imu[name].shape)
    triggers = np.zeros(5, pdavis_cv.TRIGGER_DTYPE)
    triggers["t"], triggers["type"] = [3, 50, 50, 9_000, 99_000], [1, 2, 3, 0, 9]
    return recording_from_arrays(events, images, sensor_size=SIZE, imu=imu,
                                 triggers=triggers, layout=layout)


@pytest.mark.parametrize("compression", ["lz4", "none", "zstd"])
def test_what_is_written_reads_back(tmp_path, compression):
    path, recording = tmp_path / "x.aedat4", small(layout=Layout.SONY)
    assert write_aedat4(path, recording, compression=compression) == {}
    with open_recording(path) as again:
        assert_same(joined(again.packets()), joined(recording.packets()))
        assert again.info.layout == Layout.SONY
        report, info = again.scan(), again.info
        assert (info.start_us, info.stop_us) == (report.start_us, report.stop_us)
        assert (info.event_count, info.frame_count) == (5000, 3)
        assert not again.problems


def test_frames_of_zstd_are_unpacked_alike_whatever_came_before():
    zstandard = pytest.importorskip("zstandard")
    from pdavis_cv.recording.aedat4.container import PayloadError, decompressed
    data = (100_000).to_bytes(4, "little") + np.arange(25_000, dtype="<u4").tobytes()
    stated = zstandard.ZstdCompressor().compress(data)
    unknown = zstandard.ZstdCompressor(write_content_size=False).compress(data)
    summed = zstandard.ZstdCompressor(write_checksum=True).compress(data)
    bad = summed[:-1] + bytes([summed[-1] ^ 1])
    budget = Budget("x", Limits())
    for good, damaged in ((stated, bad), (unknown, stated[:-9]), (summed, b""),
                          (unknown, unknown[:-9]), (stated, b"x"), (unknown, bad)):
        assert decompressed(good, "ZSTD", budget) == data
        with pytest.raises(PayloadError):
            decompressed(damaged, "ZSTD", budget)
    longer = zstandard.ZstdCompressor().compress(data + b"more")
    assert decompressed(longer, "ZSTD", budget) == data


@pytest.mark.parametrize("compression", ["lz4", "none", "zstd"])
def test_others_read_what_is_written(tmp_path, compression):
    dv = pytest.importorskip("dv_processing")
    path, recording = tmp_path / "x.aedat4", small()
    write_aedat4(path, recording, compression=compression)
    events, frames, imu, triggers = joined(recording.packets())
    got = {"events": [], "frame": [], "imus": [], "triggers": []}
    for packet in aedat.Decoder(path):
        for name in got.keys() & packet.keys():
            got[name].append(packet[name])
    theirs = np.concatenate(got["events"])
    for name, other in (("t", "t"), ("x", "x"), ("y", "y"), ("p", "on")):
        np.testing.assert_array_equal(events[name], theirs[other])
    for frame, other in zip(frames, got["frame"], strict=True):
        np.testing.assert_array_equal(frame.dn, other["pixels"])
        assert frame.exposure_start_us == other["exposure_begin_t"]
        assert frame.exposure_end_us == other["exposure_end_t"]
        assert frame.available_us == other["end_t"]
    theirs = np.concatenate(got["imus"])
    np.testing.assert_array_equal(imu["t"], theirs["t"])
    np.testing.assert_array_equal(imu["gyro"][:, 2], theirs["gyroscope_z"])
    theirs = np.concatenate(got["triggers"])
    np.testing.assert_array_equal(triggers["t"], theirs["t"])
    np.testing.assert_array_equal(triggers["type"], theirs["source"])

    reader = dv.io.MonoCameraRecording(str(path))
    assert reader.getEventResolution() == (16, 12)
    parts = []
    while (batch := reader.getNextEventBatch()) is not None:
        parts.append(batch.numpy())
    theirs = np.concatenate(parts)
    for name, other in (
            ("t", "timestamp"), ("x", "x"), ("y", "y"), ("p", "polarity")):
        np.testing.assert_array_equal(events[name], theirs[other])
    for frame in frames:
        np.testing.assert_array_equal(frame.dn, reader.getNextFrame().image)
    times = []
    while (samples := reader.getNextImuBatch()) is not None:
        times += [s.timestamp for s in samples]
    assert times == imu["t"].tolist()


def test_we_read_what_dv_processing_writes(tmp_path):
    dv = pytest.importorskip("dv_processing")
    path = tmp_path / "theirs.aedat4"
    events = random_events(3000, SIZE, seed=5, start_us=10, stop_us=90_000)
    image = np.arange(SIZE[0] * SIZE[1], dtype=np.uint8).reshape(SIZE)
    config = dv.io.MonoCameraWriter.Config("DAVIS346_00001234")
    config.addEventStream((16, 12))
    config.addFrameStream((16, 12))
    writer = dv.io.MonoCameraWriter(str(path), config)
    store = dv.EventStore()
    for t, x, y, p in events.tolist():
        store.push_back(t, x, y, bool(p))
    writer.writeEvents(store)
    writer.writeFrame(dv.Frame(50_000, 4_000, 0, 0, image, dv.FrameSource.SENSOR))
    del writer
    with open_recording(path) as recording:
        got, [frame], _, _ = joined(recording.packets())
        assert recording.info.serial == "00001234"
        assert not recording.problems
    np.testing.assert_array_equal(got, events)
    np.testing.assert_array_equal(frame.dn, image * np.float32(4))
    assert (frame.exposure_start_us, frame.exposure_end_us) == (50_000, 54_000)


def test_the_real_recording_survives_a_round_trip(data_dir, tmp_path):
    with open_recording(data_dir / "davis346.aedat4") as recording:
        write_aedat4(tmp_path / "x.aedat4", recording)
        with open_recording(tmp_path / "x.aedat4") as again:
            assert_same(joined(again.packets()), joined(recording.packets()))
            assert again.info.camera == recording.info.camera


def test_another_layout_than_the_file_s_is_refused(tmp_path):
    path = tmp_path / "x.aedat4"
    write_aedat4(path, small(layout=Layout.PDAVIS))
    with pytest.raises(LayoutError, match="layout argument says"):
        open_recording(path, layout=Layout.SONY)


def test_what_cannot_be_stored_is_counted(tmp_path):
    dn = np.full(SIZE, 500, np.float32)
    dn[0, :3] = -5
    valid = np.ones(SIZE, np.bool_)
    valid[1, :4] = False
    starts = np.arange(SIZE[1]) * 10 + 1000
    frame = ApsFrame(dn, starts, starts + 500, valid=valid)
    with Aedat4Writer(tmp_path / "x.aedat4", sensor_size=SIZE) as writer:
        writer.add(Packet(frames=(frame,)))
    assert writer.losses == {
        "pixels with negative DN were stored as 0": 3,
        "invalid pixels are not marked as such in the file": 4,
        "frames with exposure times per column keep their mean": 1}
    with open_recording(tmp_path / "x.aedat4") as recording:
        _, [got], _, _ = joined(recording.packets())
    assert (got.mid_us, got.exposure_ms) == (frame.mid_us, 0.5)


def test_a_failing_write_leaves_nothing(tmp_path):
    def fail():
        with Aedat4Writer(tmp_path / "x.aedat4", sensor_size=SIZE) as writer:
            writer.add(next(iter(small().packets())))
            raise KeyError

    with pytest.raises(KeyError):
        fail()
    assert list(tmp_path.iterdir()) == []


def test_the_file_appears_when_it_is_whole(tmp_path):
    path = tmp_path / "x.aedat4"
    with Aedat4Writer(path, sensor_size=SIZE) as writer:
        writer.add(next(iter(small().packets())))
        assert not path.exists()
    assert path.exists()
    with pytest.raises(ValueError, match="closed"):
        writer.add(Packet())


def test_the_writer_refuses_what_it_must(tmp_path):
    with Aedat4Writer(tmp_path / "x.aedat4", sensor_size=SIZE) as writer:
        packets = list(small().packets())
        writer.add(packets[1])
        with pytest.raises(ValueError, match="time order"):
            writer.add(packets[0])
        events = packets[3].events.copy()
        events["x"][7] = 16
        with pytest.raises(ValueError, match=r"event 7 at \(x=16.*16x12 sensor"):
            writer.add(Packet(events))
        with pytest.raises(ValueError, match="frame is 2x2"):
            writer.add(Packet(frames=(ApsFrame(np.zeros((2, 2)), 10**6, 10**6),)))
    for arguments, match in (({"compression": "gz"}, "compression must be"),
                             ({"frame_bits": 12}, "frame_bits must be 8 or 16")):
        with pytest.raises(ValueError, match=match):
            Aedat4Writer(tmp_path / "y.aedat4", sensor_size=SIZE, **arguments)


def test_a_full_scale_that_no_frame_has_is_left_out(tmp_path):
    path = tmp_path / "x.aedat4"
    write_aedat4(path, small())
    whole = path.read_bytes()
    at = whole.index(b"fullScaleDN")
    stated = whole.index(b">1023<", at)
    path.write_bytes(whole[:stated] + b">0000<" + whole[stated + 6:])
    with open_recording(path) as recording:
        assert len(joined(recording.packets())[1]) == 3


@pytest.mark.parametrize(("first", "cut"), [(0, 1), (1, 12)])   # of the header, one
def test_packets_that_moved_are_found_at_each_reading(tmp_path, first, cut):
    path = tmp_path / "x.aedat4"
    events = random_events(90, SIZE, seed=2, start_us=0, stop_us=90_000)
    write_aedat4(path, recording_from_arrays(events, sensor_size=SIZE),
                 compression="none")
    with open_recording(path) as recording:
        places = [entry.offset - 8 for entry in recording._streams["EVTS"].entries]
    one, two, three = places[first], places[-3], places[-1]
    data = path.read_bytes()    # one part moves back, the next one forth
    path.write_bytes(data[:one - cut] + data[one:two] + bytes(cut + 7)
                     + data[two:three - 7] + data[three:])
    with open_recording(path) as recording:
        with pytest.warns(DamagedFileWarning):
            whole = joined(recording.packets())
        problems = recording.problems
        for _ in range(2):
            assert_same(joined(recording.packets()), whole)
            np.testing.assert_array_equal(recording.events(), whole[0])
        assert recording.problems == problems
    cells = events["t"] // 10_000       # only what was cut is lost
    assert set(cells) - set(whole[0]["t"] // 10_000) <= {first - 1, 7}
