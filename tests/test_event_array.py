"""Recording.events: what packets hold, as one array."""
import numpy as np
import pytest
from aedat2_bytes import HEADER, WIDTH, dvs, global_frame, reads
from aedat31_bytes import aedat31_file
from streams import random_events
from test_aedat4_jaer import events as jaer_events, jaer_file

from pdavis_cv import (
    ApsFrame,
    DamagedFileWarning,
    RecordingError,
    open_recording,
    recording_from_arrays,
    write_aedat2,
    write_aedat4,
)
from pdavis_cv.recording.hdf5.writer import write_hdf5


def sample(count=5000):
    """Return a recording that every format can hold."""
    size = (128, 128)
    frames = [ApsFrame(np.full(size, 300 + k), t, t + 4_000) for k, t in enumerate(
        (10_000, 50_000))]
    return recording_from_arrays(
        random_events(count, size, seed=2, stop_us=100_000), frames, sensor_size=size)


def from_packets(recording, *interval):
    return np.concatenate([p.events for p in recording.packets(*interval)])


def write_aedat31(path, recording):
    path.write_bytes(aedat31_file(recording))


@pytest.fixture(params=[write_aedat4, write_aedat2, write_aedat31, write_hdf5, None],
                ids=["aedat4", "aedat2", "aedat31", "hdf5", "memory"])
def recording(request, tmp_path):
    if request.param is None:
        yield sample()
        return
    if request.param is write_hdf5:
        pytest.importorskip("h5py")
    request.param(tmp_path / "x", sample())
    with open_recording(tmp_path / "x") as opened:
        yield opened


def test_events_are_those_of_the_packets(recording):
    wanted = from_packets(sample())
    got = recording.events()
    np.testing.assert_array_equal(got, wanted)
    got["x"] = 0  # it belongs to the caller
    np.testing.assert_array_equal(recording.events(), wanted)
    first, last = int(wanted["t"][0]), int(wanted["t"][-1])
    for interval in ((None, None), (first + 1, None), (None, last), (last + 1, None),
                     (first + 40_000, first + 90_001), (last, first)):
        start = -1 << 60 if interval[0] is None else interval[0]
        stop = 1 << 60 if interval[1] is None else interval[1]
        inside = (wanted["t"] >= start) & (wanted["t"] < stop)
        np.testing.assert_array_equal(recording.events(*interval), wanted[inside])


def test_events_of_a_real_recording(data_dir):
    with open_recording(data_dir / "davis346.aedat4") as recording:
        wanted = from_packets(recording)
        np.testing.assert_array_equal(recording.events(), wanted)
        middle = int(wanted["t"][40_000])
        np.testing.assert_array_equal(
            recording.events(middle, middle + 500_000),
            from_packets(recording, middle, middle + 500_000))


def test_frames_and_samples_between_events_change_nothing(tmp_path):
    # Frames of several chunks: 180,000 words each.
    data = [HEADER]
    for k in range(3):
        data += [dvs(3, 5 + k, 1, 100_000 * k + 1),
                 global_frame(*reads(k), 100_000 * k + 10, 5000),
                 dvs(7, WIDTH - 1 - k, 0, 100_000 * k + 90_000)]
    (tmp_path / "x").write_bytes(b"".join(data))
    with open_recording(tmp_path / "x") as recording:
        got = recording.events()
        np.testing.assert_array_equal(got, from_packets(recording))
    assert got.tolist() == [
        row for k in range(3) for row in (
            (100_000 * k + 1, 5 + k, 3, 1),
            (100_000 * k + 90_000, WIDTH - 1 - k, 7, 0))]


def test_segments_follow_one_another_as_in_the_packets(tmp_path):
    t = 50_000_000
    rows = [[(t, 1, 1, 1), (t + 10, 2, 1, 1)], [(5, 1, 1, 1), (9, 2, 2, 0)]]
    (tmp_path / "x").write_bytes(jaer_file([jaer_events(part) for part in rows]))
    with open_recording(tmp_path / "x") as recording:
        got = recording.events()
        np.testing.assert_array_equal(got, from_packets(recording))
    assert got["t"].tolist() == [t, t + 10, t + 11, t + 15]


@pytest.mark.parametrize("events", [200, 5000])
@pytest.mark.filterwarnings("ignore::pdavis_cv.DamagedFileWarning")
def test_an_index_that_promises_too_few_or_too_many_events_does_no_harm(
        tmp_path, events):
    path = tmp_path / "x"
    write_aedat4(path, sample(events))
    with open_recording(path) as recording:
        wanted, entries = recording.events(), recording._streams["EVTS"].entries
        for count in (0, 1, 1 << 61):
            recording._file.index[entries[0].stream][:, 2] = count
            entries[:] = [entry._replace(samples=count) for entry in entries]
            np.testing.assert_array_equal(recording.events(), wanted)
            for start in range(0, 100_000, 3_333):
                np.testing.assert_array_equal(
                    recording.events(start), wanted[wanted["t"] >= start])
        [problem] = recording.problems
        assert "events, 0 by the index" in problem.message


def test_a_damaged_packet_costs_its_events_only(tmp_path):
    path = tmp_path / "x"
    write_aedat4(path, sample(), compression="none")
    with open_recording(path) as recording:
        wanted = recording.events()
        entry = recording._streams["EVTS"].entries[3]
    data = bytearray(path.read_bytes())
    data[entry.offset + 8:entry.offset + 12] = b"EVNT"
    path.write_bytes(data)
    with open_recording(path) as recording:
        with pytest.warns(DamagedFileWarning, match=f"byte {entry.offset - 8}"):
            got = recording.events()
        assert len(got) == len(wanted) - entry.samples
        assert np.isin(got, wanted).all()


def test_a_strict_reader_names_the_first_bad_event(tmp_path):
    (tmp_path / "x").write_bytes(
        jaer_file([jaer_events([(1, 1, 1, 1), (2, 400, 1, 1)])]))
    with (pytest.raises(RecordingError, match=r"event 1 of the packet at \(t=2"),
          open_recording(tmp_path / "x", bad_events="raise") as recording):
        recording.events()


def test_a_strict_reader_names_an_event_before_its_predecessor(tmp_path):
    rows = [(10 * k, 1, 1, 1) for k in range(1, 40)]
    rows[20] = 5, 1, 1, 1
    (tmp_path / "x").write_bytes(jaer_file([jaer_events(rows)]))
    with (pytest.raises(RecordingError, match=r"event 20 of the packet at \(t=5"),
          open_recording(tmp_path / "x", bad_events="raise") as recording):
        recording.events()


def test_a_closed_recording_is_refused(recording, tmp_path):
    if recording.path is None:
        pytest.skip("memory stays")
    recording.close()
    with pytest.raises(ValueError, match="recording is closed"):
        recording.events()
