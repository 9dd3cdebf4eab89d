"""Parts of files whose samples depend on all before: equal to the whole, and cheap."""
import numpy as np
import pytest
from aedat31_bytes import aedat31_file
from streams import random_events
from test_aedat4 import assert_same, joined
from test_aedat4_jaer import events as jaer_events, imu_samples, jaer_file

from pdavis_cv import IMU_DTYPE, ApsFrame, open_recording, recording_from_arrays
from pdavis_cv.recording.file_reader import FileReader

SIZE = (12, 16)


def long_recording(stop_us=6_000_000):
    rng = np.random.default_rng(3)
    frames = [ApsFrame(rng.integers(100, 900, SIZE), t, t + 8_000,
                       available_us=t + 12_000)
              for t in range(2_000, stop_us - 20_000, 40_000)]
    imu = np.zeros(stop_us // 5_000, IMU_DTYPE)
    imu["t"] = 5_000 * np.arange(len(imu))
    return recording_from_arrays(random_events(80_000, SIZE, stop_us=stop_us), frames,
                                 sensor_size=SIZE, imu=imu)


def aedat31(path):
    path.write_bytes(aedat31_file(long_recording()))


def jumping(path):
    """Write AEDAT-4 whose time falls by 3 s, and by 30 ms where samples are dropped."""
    packets, facts = [], []
    for k in range(240):
        t = 10_000_000 + 25_000 * k - 3_000_000 * (k >= 90) - 30_000 * (k >= 180)
        packets.append(jaer_events(
            [(t + 500 * i, (k + i) % 346, i, i % 2) for i in range(50)]))
        packets.append(imu_samples([(t + 1, *[k] * 7), (t + 12_000, *[k] * 7)]))
        facts += [(50, t, t + 24_500), (2, t + 1, t + 12_000)]
    path.write_bytes(jaer_file(packets, compression=1, closed=facts))


@pytest.fixture
def bytes_read(monkeypatch):
    counts = [0]
    plain = FileReader.read

    def read(self, offset, size):
        data = plain(self, offset, size)
        counts[0] += len(data)
        return data

    monkeypatch.setattr(FileReader, "read", read)
    return counts


@pytest.mark.parametrize("write", [aedat31, jumping])
def test_a_part_equals_that_part_of_the_whole(tmp_path, write):
    write(tmp_path / "x")
    with open_recording(tmp_path / "x") as recording:
        whole = list(recording.packets())
        first, last = whole[0].start_us, whole[-1].start_us
        for share in (0.9, 0.1, 0.97):
            start = first + round(share * (last - first))
            start -= start % 10_000
            got = list(recording.packets(start))
            want = [p for p in whole if p.start_us >= start]
            assert len(got) == len(want)
            for one, other in zip(got, want, strict=True):
                assert_same(joined([one]), joined([other]))
    with open_recording(tmp_path / "x") as fresh:  # the part before the whole
        assert_same(joined(fresh.packets(start)), joined(want))
        np.testing.assert_array_equal(
            fresh.events(start), joined(want)[0])


@pytest.mark.parametrize("write", [aedat31, jumping])
def test_a_second_seek_does_not_read_from_the_beginning(tmp_path, write, bytes_read):
    write(tmp_path / "x")
    size = (tmp_path / "x").stat().st_size
    with open_recording(tmp_path / "x") as recording:
        packets = list(recording.packets())
        late = packets[-20].start_us
        for start in (late, late - 50_000):
            bytes_read[0] = 0
            assert next(recording.packets(start)).start_us >= start
            assert bytes_read[0] < 0.5 * size
