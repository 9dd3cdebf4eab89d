"""Writing AEDAT-2.0: read back by us, and its events by an independent decoder."""
import numpy as np
import pytest
from aedat2_bytes import reads
from streams import random_events
from test_aedat4 import joined

import pdavis_cv
from pdavis_cv import (
    Aedat2Writer,
    ApsFrame,
    Packet,
    open_recording,
    recording_from_arrays,
    write_aedat2,
)
from pdavis_cv.tools.main import main

SIZE = (260, 346)


def decoded(path):
    """Return (t, x, row, p) of the events of a file, by its description alone."""
    data = path.read_bytes()
    data = data[data.index(b"#End Of ASCII Header\r\n") + 22:]
    words = np.frombuffer(data, ">u4").reshape(-1, 2).astype(np.int64)
    address, t = words.T
    events = (address < 1 << 31) & (address & 0x400 == 0)
    address, t = address[events], t[events]
    return (t, 345 - (address >> 12 & 0x3FF), 259 - (address >> 22 & 0x1FF),
            address >> 11 & 1)


def recording(*, rolling=False, frames=3):
    rng = np.random.default_rng(3)
    events = random_events(20_000, SIZE, seed=1, start_us=0, stop_us=400_000)
    images = []
    for k in range(frames):
        dn = rng.integers(-600, 1021, SIZE).astype(np.float32)
        valid = rng.random(SIZE) > 0.1
        dn[~valid] = rng.integers(-1000, 1024, int((~valid).sum()))
        start = 100_000 * k + 20_000
        starts = start + 20 * np.arange(346) if rolling else start
        images.append(ApsFrame(dn, starts, starts + 9_000, valid=valid,
                               available_us=start + 20 * 345 + 9_000))
    imu = np.zeros(300, pdavis_cv.IMU_DTYPE)
    imu["t"] = np.arange(300) * 1000
    imu["accel"] = rng.integers(-9999, 9999, (300, 3)) / 4096
    imu["gyro"] = rng.integers(-9999, 9999, (300, 3)) / 32.8
    imu["temperature"] = 30
    triggers = np.zeros(4, pdavis_cv.TRIGGER_DTYPE)
    triggers["t"], triggers["type"] = [5, 6, 7, 8], [1, 2, 3, 6]
    return recording_from_arrays(events, images, sensor_size=SIZE, imu=imu,
                                 triggers=triggers)


def test_published_words_are_written(tmp_path):
    events = np.array([(10, 10, 239, 1), (11, 0, 259, 0), (12, 345, 0, 0)],
                      pdavis_cv.EVENT_DTYPE)
    reset, signal = np.full(SIZE, 900, np.uint16), np.full(SIZE, 100, np.uint16)
    reset[239, 10], signal[239, 10] = 800, 300
    frame = ApsFrame(reset.astype(float) - signal, 100, 200, reset=reset,
                     signal=signal)
    imu = np.zeros(1, pdavis_cv.IMU_DTYPE)
    # In the writer's 8 g and 1000 degrees per second: raw 8192 and -131.
    imu["t"], imu["accel"], imu["gyro"] = 13, (0, 0, 2), (131 / 32.8, 0, 0)
    triggers = np.array([(14, 1)], pdavis_cv.TRIGGER_DTYPE)
    with Aedat2Writer(tmp_path / "x", sensor_size=SIZE) as writer:
        writer.add(Packet(events, (), imu, triggers))
        writer.add(Packet(frames=(frame,)))
    data = (tmp_path / "x").read_bytes()
    data = data[data.index(b"#End Of ASCII Header\r\n") + 22:]
    words = [data[i:i + 8] for i in range(0, len(data), 8)]
    times = {word[:4].hex(): int.from_bytes(word[4:], "big") for word in words}
    assert times["0514f800"] == 10
    assert times["00159000"] == 11
    assert times["40c00000"] == 12
    assert times["a2000c00"] == times["cff7dc00"] == 13
    assert times["00000403"] == 14
    # A global shutter: the last reset is read when the exposure begins.
    assert 0 <= times["8500a320"] <= 100
    assert times["8500a52c"] == 200


@pytest.mark.parametrize("rolling", [False, True])
def test_what_is_written_reads_back(tmp_path, rolling):
    path, source = tmp_path / "x.aedat2", recording(rolling=rolling)
    losses = write_aedat2(path, source)
    assert losses == {"triggers that are not external edges or pulses": 1}
    wanted = joined(source.packets())
    with open_recording(path) as again:
        got = joined(again.packets())
        assert not again.problems
        assert again.info.header["shutter"] == ("rolling" if rolling else "global")
        assert again.info.exposure_us == 9000
    np.testing.assert_array_equal(got[0], wanted[0])
    for frame, other in zip(got[1], wanted[1], strict=True):
        np.testing.assert_array_equal(frame.dn, other.dn)
        np.testing.assert_array_equal(frame.valid, other.valid)
        np.testing.assert_array_equal(frame.exposure_start_us, other.exposure_start_us)
        np.testing.assert_array_equal(frame.exposure_end_us, other.exposure_end_us)
        assert frame.available_us == other.available_us
    np.testing.assert_array_equal(got[2]["t"], wanted[2]["t"])
    np.testing.assert_array_equal(got[2]["accel"], wanted[2]["accel"])
    np.testing.assert_allclose(got[2]["gyro"], wanted[2]["gyro"], atol=1e-4)
    assert got[3].tolist() == wanted[3][:3].tolist()


def test_an_independent_decoder_finds_the_events(tmp_path):
    source = recording(frames=2)
    write_aedat2(tmp_path / "x.aedat2", source)
    events = joined(source.packets())[0]
    for name, column in zip("txyp", decoded(tmp_path / "x.aedat2"), strict=True):
        np.testing.assert_array_equal(events[name], column)


def test_published_addresses_are_written(tmp_path):
    path = tmp_path / "x.aedat2"
    events = np.array([(7, 10, 259 - 20, 1), (8, 0, 259, 0), (9, 345, 0, 0)],
                      pdavis_cv.EVENT_DTYPE)
    write_aedat2(path, recording_from_arrays(events, sensor_size=SIZE))
    data = path.read_bytes()
    words = data[data.index(b"Header\r\n") + 8:]
    assert words[:8].hex() == "0514f80000000007"
    assert words[8:16].hex() == "0015900000000008"
    assert words[16:].hex() == "40c0000000000009"


def test_reads_of_a_file_are_kept(tmp_path):
    reset, signal = (a.astype(np.uint16) for a in reads(1))
    frame = ApsFrame(reset.astype(np.float32) - signal, 5000, 6000, reset=reset,
                     signal=signal)
    with Aedat2Writer(tmp_path / "x.aedat2", sensor_size=SIZE) as writer:
        writer.add(Packet(frames=(frame,)))
    with open_recording(tmp_path / "x.aedat2") as again:
        _, [got], _, _ = joined(again.packets())
    np.testing.assert_array_equal(got.reset, reset)
    np.testing.assert_array_equal(got.signal, signal)


@pytest.mark.gate
def test_unix_times_survive(data_dir, tmp_path):
    with open_recording(data_dir / "davis346.aedat4") as source:
        write_aedat2(tmp_path / "x.aedat2", source)
        wanted = joined(source.packets())
        with open_recording(tmp_path / "x.aedat2") as again:
            got = joined(again.packets())
            assert not again.problems
    np.testing.assert_array_equal(got[0], wanted[0])
    assert [f.mid_us for f in got[1]] == [f.mid_us for f in wanted[1]]
    for frame, other in zip(got[1], wanted[1], strict=True):
        np.testing.assert_array_equal(frame.dn, other.dn)


def test_times_beyond_32_bits_wrap_and_unwrap(tmp_path):
    events = np.zeros(5000, pdavis_cv.EVENT_DTYPE)
    events["t"] = np.arange(5000) * 4_000_000
    source = recording_from_arrays(events, sensor_size=SIZE)
    write_aedat2(tmp_path / "x.aedat2", source)
    with open_recording(tmp_path / "x.aedat2") as again:
        np.testing.assert_array_equal(joined(again.packets())[0], events)
        assert not again.problems


def test_biases_survive_and_tell_the_thresholds(tmp_path, capsys):
    write_aedat2(tmp_path / "x.aedat2", recording(frames=0))
    data = (tmp_path / "x.aedat2").read_bytes()
    entries = b"".join(
        b'#<entry key="AddressedIPotCF.%s.BitValue%s" value="%d"/>\r\n' % row
        for row in ((b"DiffBn", b"Coarse", 3), (b"DiffBn", b"Fine", 138),
                    (b"OnBn", b"Coarse", 1), (b"OnBn", b"Fine", 45),
                    (b"OffBn", b"Coarse", 5), (b"OffBn", b"Fine", 225)))
    (tmp_path / "y.aedat2").write_bytes(data.replace(b"#End of Pref", entries + b"#"))
    with open_recording(tmp_path / "y.aedat2") as first:
        write_aedat2(tmp_path / "z.aedat2", first)
        with open_recording(tmp_path / "z.aedat2") as second:
            assert len(first.info.biases) == 3
            assert second.info.biases == first.info.biases
            on, off = pdavis_cv.calibration.thresholds_from_biases(second.info.biases)
    assert (on, off) == pytest.approx((0.217, 0.262), abs=0.001)
    assert main(["info", str(tmp_path / "y.aedat2")]) == 0
    assert "ON 0.217, OFF 0.262, from its biases (file)" in capsys.readouterr().out


def test_sizes_and_values_that_do_not_fit(tmp_path):
    with pytest.raises(ValueError, match="that of a DAVIS"):
        Aedat2Writer(tmp_path / "x.aedat2", sensor_size=(10, 10))
    frame = ApsFrame(np.full(SIZE, 2000.0), 0, 10)
    with Aedat2Writer(tmp_path / "x.aedat2", sensor_size=SIZE) as writer:
        writer.add(Packet(frames=(frame,)))
    assert writer.losses == {
        "pixels outside the range of the converter were clipped": 260 * 346}


def test_a_failing_write_leaves_nothing(tmp_path):
    def fail():
        with Aedat2Writer(tmp_path / "x.aedat2", sensor_size=SIZE):
            raise KeyError

    with pytest.raises(KeyError):
        fail()
    assert list(tmp_path.iterdir()) == []
