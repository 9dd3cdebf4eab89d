"""What is fuzzed: a corpus of whole files and one entry per parser."""
import contextlib
import importlib.util
import tempfile
import warnings
from pathlib import Path

import numpy as np

import pdavis_cv
from pdavis_cv import open_recording, recording_from_arrays, write_aedat2, write_aedat4

MOST_SAMPLES = 5_000_000


def recording(size, frames):
    """Return a small recording of every kind of sample."""
    rng = np.random.default_rng(0)
    n = 3000
    events = np.zeros(n, pdavis_cv.EVENT_DTYPE)
    events["t"] = np.sort(rng.integers(0, 200_000, n))
    events["y"], events["x"] = rng.integers(0, size[0], n), rng.integers(0, size[1], n)
    events["p"] = rng.integers(0, 2, n)
    images = [pdavis_cv.ApsFrame(
        rng.integers(0, 1000, size).astype(np.float32), 50_000 * k + 9_000,
        50_000 * k + 19_000, available_us=50_000 * k + 25_000) for k in range(frames)]
    imu = np.zeros(40, pdavis_cv.IMU_DTYPE)
    imu["t"] = 5_000 * np.arange(40)
    triggers = np.zeros(4, pdavis_cv.TRIGGER_DTYPE)
    triggers["t"], triggers["type"] = [1, 9_000, 90_000, 199_000], [1, 2, 3, 1]
    return recording_from_arrays(events, images, sensor_size=size, imu=imu,
                                 triggers=triggers)


def _written(write, *arguments, **options):
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "x"
        write(path, *arguments, **options)
        return path.read_bytes()


def _aedat4():
    return [_written(write_aedat4, recording((12, 16), 4), compression=name)
            for name in ("lz4", "none", "zstd")]


def _aedat2():
    return [_written(write_aedat2, recording((128, 128), 2))]


def _aedat31():
    from aedat31_bytes import aedat31_file
    return [aedat31_file(recording((12, 16), 3))]


def _hdf5():
    if importlib.util.find_spec("h5py") is None:
        return []
    from pdavis_cv.recording.hdf5.writer import write_hdf5
    return [_written(write_hdf5, recording((12, 16), 3), flavour=name)
            for name in ("e2p", "dsec")]


def fuzz_one(data):
    """Read what may be a recording from end to end; only our errors are allowed.

    Bytes with a database in them are a folder: metadata.yaml, then the database.
    """
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        metadata, found, database = data.partition(b"SQLite format 3")
        path = Path(folder)
        if found:
            (path / "metadata.yaml").write_bytes(metadata)
            (path / "bag.db3").write_bytes(found + database)
        else:
            path /= "file.bin"
            path.write_bytes(data)
        with contextlib.suppress(pdavis_cv.RecordingError):
            return _read(path)
    return 0


def _read(path):
    """Return the number of events, after checks of what every packet promises."""
    count, before = 0, None
    with open_recording(path) as recording:
        height, width = recording.info.sensor_size
        for packet in recording.packets():
            events = packet.events
            assert len(events) <= 65_536
            assert len(packet.frames) <= 1
            assert packet.stop_us - packet.start_us <= 10_000
            assert before is None or packet.start_us >= before
            before = packet.stop_us - 1
            if len(events):
                assert events["x"].max() < width
                assert events["y"].max() < height
                assert events["p"].max() <= 1
                assert np.all(events["t"][1:] >= events["t"][:-1])
            for frame in packet.frames:
                assert frame.shape == (height, width)
            count += len(events)
            assert count < MOST_SAMPLES
        assert len(recording.problems) < 100
        middle = None if before is None else before // 2
        for _ in recording.packets(middle, before):
            break
        recording.events(middle, before)
    return count


def _prophesee():
    from event_bytes import dat_file, evt2_file, evt3_file
    source = recording((12, 16), 0).events()
    return [make(source, (12, 16)) for make in (evt2_file, evt3_file, dat_file)]


def _lists():
    from event_bytes import npy_file, npz_file, text_file
    source = recording((12, 16), 0).events()
    return [npy_file(source), npz_file(source), text_file(source)]


def _rpg():
    if importlib.util.find_spec("h5py") is None:
        return []
    from event_bytes import rpg_file
    return [_written(rpg_file, recording((12, 16), 3))]


def _ros1():
    if importlib.util.find_spec("rosbags") is None:
        return []
    from event_bytes import ros1_file
    return [_written(ros1_file, recording((12, 16), 0).events(), (12, 16))]


def _ros2():
    if importlib.util.find_spec("rosbags") is None:
        return []
    from event_bytes import ros2_bytes
    return [ros2_bytes(recording((12, 16), 0).events(), (12, 16))]


def _usb():
    from pdavis_cv.live.usb import SimulatedDavis346
    from pdavis_cv.recording.davis_trace import TraceWriter

    def write(path, device):
        with TraceWriter(path, device.info, device.orientation) as trace:
            while (transfers := device.read(1)) is not None:
                for one in transfers:
                    trace.add(one)
    return [_written(write, SimulatedDavis346(recording((12, 16), 3), speed=0))]


TARGETS = {"aedat4": _aedat4, "aedat2": _aedat2, "aedat31": _aedat31, "hdf5": _hdf5,
           "prophesee": _prophesee, "lists": _lists, "rpg": _rpg, "ros1": _ros1,
           "ros2": _ros2, "usb": _usb}
"""Name of a parser -> its corpus; each is read by `fuzz_one`."""
