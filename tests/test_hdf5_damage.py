"""Damaged HDF5: what HDF5 itself can still read is delivered, the rest is told."""
import struct

import numpy as np
import pytest
from streams import random_events
from test_aedat4 import joined
from test_aedat4_writer import small

from pdavis_cv import (
    DamagedFileWarning,
    RecordingError,
    open_recording,
    recording_from_arrays,
)
from pdavis_cv.recording import sandbox
from pdavis_cv.recording.hdf5.reader import Hdf5Recording
from pdavis_cv.recording.hdf5.writer import write_hdf5
from pdavis_cv.tools.main import main

h5py = pytest.importorskip("h5py")


def spoil(path, name, number):
    """Overwrite the middle of a dataset's chunk."""
    with h5py.File(path) as file:
        chunk = file[name].id.get_chunk_info(number)
    data = bytearray(path.read_bytes())
    middle = chunk.byte_offset + chunk.size // 2
    data[middle:middle + 8] = b"\xff" * 8
    path.write_bytes(data)


@pytest.mark.parametrize(("flavour", "name"), [("e2p", "events"), ("dsec", "events/x")])
def test_a_broken_chunk_costs_its_events_only(tmp_path, flavour, name):
    path, n = tmp_path / "x.h5", 1 << 16
    events = random_events(2 * n + 1000, (12, 16), seed=4)
    write_hdf5(path, recording_from_arrays(events, sensor_size=(12, 16)),
               flavour=flavour)
    spoil(path, name, 1)
    match = f"events {n} .. {2 * n} cannot be read"
    with open_recording(path) as recording:
        with pytest.warns(DamagedFileWarning, match=match):
            got = recording.events()
        assert [p.kind for p in recording.problems] == ["damage"]
    np.testing.assert_array_equal(got, np.concatenate([events[:n], events[2 * n:]]))


def test_chunks_smaller_than_what_is_read_at_once_cost_no_more(tmp_path):
    events = random_events(5000, (12, 16), seed=4)
    with h5py.File(tmp_path / "x.h5", "w") as file:
        table = np.stack([events[k].astype(np.int64) for k in "txyp"], 1)
        file.create_dataset("events", data=table, chunks=(1000, 4), compression="gzip")
    spoil(tmp_path / "x.h5", "events", 2)
    with open_recording(tmp_path / "x.h5") as recording, \
            pytest.warns(DamagedFileWarning, match=r"events 2000 \.\. 3000"):
        got = recording.events()
    np.testing.assert_array_equal(got, np.delete(events, np.s_[2000:3000]))


@pytest.mark.parametrize("names", ["txyp", ("ts", "xs", "ys", "ps"), None])
@pytest.mark.parametrize("fault", ["one late", "one early", "segment", "falls", "none"])
def test_a_window_of_damaged_times_is_that_part_of_the_whole(
        fault, names, tmp_path, monkeypatch):
    monkeypatch.setattr("pdavis_cv.recording.hdf5.reader.CHUNK", 128)
    t = 10_000 * np.arange(2000)
    if fault.startswith("one"):
        t[1024] += 10**9 if fault == "one late" else -10**9
    elif fault == "segment":
        t[700:] -= t[700]
    elif fault == "falls":
        t[700:760] = t[700:760][::-1]
    path = tmp_path / "x.h5"
    with h5py.File(path, "w") as file:
        file.attrs["sensor_size"] = [12, 16]
        values = (t, *np.random.default_rng(0).integers(0, 2, (3, len(t))))
        if names is None:
            file["events"] = np.stack(values, 1)
        else:
            for name, column in zip(names, values, strict=True):
                file[f"events/{name}"] = column
    with open_recording(path) as recording:
        whole = recording.events()
        assert len(whole) >= 1900
        assert bool(recording.problems) == (fault != "none")
        starts = whole["t"][::97]
        for start, stop in zip(starts, starts[3:], strict=False):
            part = whole[(whole["t"] >= start) & (whole["t"] < stop)]
            for one in (recording, open_recording(path)):
                np.testing.assert_array_equal(one.events(start, stop), part)
                np.testing.assert_array_equal(joined(one.packets(start, stop))[0], part)
                if one is not recording:
                    one.close()


def test_a_window_of_a_sound_file_is_read_without_what_lies_before(
        tmp_path, monkeypatch):
    events = random_events(1 << 20, (12, 16), seed=4)
    write_hdf5(tmp_path / "x.h5", recording_from_arrays(events, sensor_size=(12, 16)),
               flavour="dsec")
    read = []
    columns = Hdf5Recording._events
    monkeypatch.setattr(Hdf5Recording, "_events", lambda self, row, *rest: (
        read.append(row), columns(self, row, *rest))[1])
    with open_recording(tmp_path / "x.h5") as recording:
        start = int(events["t"][-1000])
        assert len(recording.events(start)) == np.count_nonzero(events["t"] >= start)
    assert read[0] == 14 << 16


def test_a_broken_frame_costs_itself(tmp_path):
    write_hdf5(tmp_path / "x.h5", small())
    wanted = joined(small().packets())
    spoil(tmp_path / "x.h5", "frame", 1)
    with open_recording(tmp_path / "x.h5") as recording, \
            pytest.warns(DamagedFileWarning, match="frame 1 cannot be read"):
        events, frames, *_ = joined(recording.packets())
    np.testing.assert_array_equal(events, wanted[0])
    for frame, other in zip(frames, wanted[1][::2], strict=True):
        np.testing.assert_array_equal(frame.dn, other.dn)
        assert frame.available_us == other.available_us


def test_what_the_file_cannot_hold_is_refused(tmp_path):
    for name, shape, chunks in (
            ("events", (1 << 50, 4), (1 << 16, 4)), ("events", (9, 4), (1 << 26, 4)),
            ("frame", (1 << 40, 12, 16), (1, 12, 16))):
        with h5py.File(tmp_path / "x.h5", "w") as file:
            file.create_dataset(name, shape, "i8", chunks=chunks,
                                maxshape=(None, *shape[1:]))
            if name != "events":
                file["events"] = np.zeros((2, 4))
        with pytest.raises(RecordingError, match="more than the limit"):
            open_recording(tmp_path / "x.h5")


def test_other_kinds_of_values_are_refused(tmp_path):
    for values in (np.array([b"text"] * 4).reshape(1, 4), np.zeros((2, 4), "c16")):
        with h5py.File(tmp_path / "x.h5", "w") as file:
            file["events"] = values
        with pytest.raises(RecordingError, match="must be numbers"):
            open_recording(tmp_path / "x.h5")
    with h5py.File(tmp_path / "x.h5", "w") as file:
        file["events"] = np.zeros((2, 4))
        file.attrs["sensor_size"] = (1 << 40, 3)
    with pytest.raises(RecordingError, match=r"must lie in 1\.\.8192"):
        open_recording(tmp_path / "x.h5")


def test_times_that_are_no_times_are_dropped(tmp_path):
    rows = [[0.5, 1, 1, 1], [np.nan, 1, 1, 1], [np.inf, 1, 1, 1], [0.75, 2, 2, 0]]
    with h5py.File(tmp_path / "x.h5", "w") as file:
        file["events"] = np.array(rows)
        file["frame"] = np.full((1, 12, 16), np.nan, np.float32)
        file["frame_ts"] = np.array([600_000])
    with open_recording(tmp_path / "x.h5") as recording:
        events, [frame], *_ = joined(recording.packets())
    assert events["t"].tolist() == [500_000, 750_000]
    assert not frame.valid.any()


@pytest.mark.parametrize("dtype", ["f2", "f4", "f8"])
@pytest.mark.parametrize("names", ["txyp", ("ts", "xs", "ys", "ps")])
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_numbers_that_are_none_cost_their_events(names, value, dtype, tmp_path):
    with h5py.File(tmp_path / "x.h5", "w") as file:
        for column, name in enumerate(names):
            values = np.array([1, 1, 1, 1, 1, 1], dtype)
            values[column + 1] = value
            file[f"events/{name}"] = values
        file.attrs["sensor_size"] = (12, 16)
    with open_recording(tmp_path / "x.h5") as recording:
        assert len(recording.events()) == 2


@pytest.mark.parametrize(("times", "first_us"), [
    (1_700_000_000_000_000_000 + np.arange(90) * 1000, 1_700_000_000_000_000),
    (np.r_[7.5, 1_000 + np.arange(89.)], 8), (1 + np.arange(90) * 1e-4, 1_000_000)])
def test_the_unit_of_times_is_that_of_most(times, first_us, tmp_path):
    with h5py.File(tmp_path / "x.h5", "w") as file:
        for name in "txyp":
            file[f"events/{name}"] = times if name == "t" else np.ones(90, "u1")
        file.attrs["sensor_size"] = (12, 16)
    with open_recording(tmp_path / "x.h5") as recording:
        t = recording.events()["t"]
    assert (len(t), t[0]) == (90, first_us)
    assert 80 < t[-1] - t[0] < 9_000


def test_fractions_of_pixels_cost_their_events(tmp_path):
    rows = np.array([[10, 1, 1, 1], [20, 1.5, 1, 1], [30, 2, 2, 0], [40, 2, 2, 0.5]])
    np.save(tmp_path / "x.npy", rows)
    with h5py.File(tmp_path / "x.h5", "w") as file:
        file["events"] = rows
    for name in ("x.npy", "x.h5"):
        with open_recording(tmp_path / name, sensor_size=(12, 16)) as recording:
            assert recording.events().tolist() == [(10, 1, 1, 1), (30, 2, 2, 0)]
            assert [(p.kind, p.count) for p in recording.problems] == [
                ("outside sensor", 2)]


def test_a_frame_beyond_single_precision_is_not_valid(tmp_path):
    with h5py.File(tmp_path / "x.h5", "w") as file:
        file["events"] = np.array([[1, 1, 1, 1]])
        file["frame"] = np.full((1, 12, 16), 1e300)
        file["frame_ts"] = np.array([600_000])
    with open_recording(tmp_path / "x.h5") as recording:
        _, [frame], *_ = joined(recording.packets())
    assert not frame.valid.any()


def test_a_part_that_begins_on_a_whole_second_keeps_its_unit(tmp_path):
    # Seconds with fractions; the row that a search looks at has none.
    t = np.arange(200_000) / 65_536
    table = np.stack([t, t * 0 + 1, t * 0 + 2, t * 0 + 1], 1)
    with h5py.File(tmp_path / "x.h5", "w") as file:
        file["events"] = table
        file.attrs["sensor_size"] = (12, 16)
    with open_recording(tmp_path / "x.h5") as recording:
        whole = recording.events()
        part = recording.events(2_500_000)
    np.testing.assert_array_equal(part, whole[whole["t"] >= 2_500_000])
    assert len(part)


def test_samples_with_other_fields_are_not_read(tmp_path):
    # Damage can make a record's fields overlap: then HDF5 itself writes where it must
    # not when it converts them.
    write_hdf5(tmp_path / "x.h5", small())
    fields = {"names": ["t", "temperature", "accel", "gyro"],
              "formats": ["<i8", "<f8", ("<f4", (3,)), ("<f4", (3,))]}
    with h5py.File(tmp_path / "x.h5", "r+") as file:
        count = len(file["pdavis/imu"])
        del file["pdavis/imu"]
        file["pdavis/imu"] = np.zeros(count, np.dtype(fields))
    with pytest.warns(DamagedFileWarning, match="imu cannot be read"):
        recording = open_recording(tmp_path / "x.h5")
    with recording:
        assert not len(joined(recording.packets())[2])


@pytest.mark.skipif(not sandbox.available(), reason="Linux 5.13")
@pytest.mark.parametrize("length", [
    pytest.param(0x20000009, marks=pytest.mark.gate), 0x3F000009,
    pytest.param(0xFF000009, marks=pytest.mark.gate)])
def test_a_text_of_a_damaged_length_is_refused_by_commands_without_the_memory(
        length, tmp_path, capsys):
    """HDF5 takes as much as a text is said to be long, before it looks for it."""
    resource = pytest.importorskip("resource")
    path = tmp_path / "x.h5"
    write_hdf5(path, small())
    data = bytearray(path.read_bytes())
    # How many letters a text has, and where they lie.
    at = data.index(struct.pack("<IQI", 9, data.index(b"GCOL"), 1))
    data[at:at + 12] = struct.pack("<IQ", length, 127)
    path.write_bytes(data)
    assert main(["info", str(path)]) == 2
    error = capsys.readouterr().err
    assert "the file is damaged" in error or "limit memory" in error
    # Of the process that reads it, in kB.
    assert resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss < 2 << 20
