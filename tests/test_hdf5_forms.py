"""HDF5 of Metavision, and files that name others or contradict themselves."""
import numpy as np
import pytest
from test_aedat4 import joined
from test_event_files import SIZE, some_events

from pdavis_cv import RecordingError, open_recording

h5py = pytest.importorskip("h5py")

CD = np.dtype([("x", "<u2"), ("y", "<u2"), ("p", "<i2"), ("t", "<i8")])
TRIGGER = np.dtype([("p", "<i2"), ("t", "<i8"), ("id", "<i2")])


@pytest.fixture
def path(tmp_path):
    return tmp_path / "x.h5"


def columns(path, events, names="txyp", **changed):
    with h5py.File(path, "w") as file:
        for name in names:
            file[f"events/{name}"] = changed.get(name, events[name[0]])


@pytest.mark.parametrize("compression", [None, "gzip"])
def test_events_and_triggers_of_metavision_are_read(path, compression):
    events = some_events()
    records = np.zeros(len(events), CD)
    for name in "txyp":
        records[name] = events[name]
    with h5py.File(path, "w") as file:
        file.attrs["geometry"] = "640x480"
        file.create_dataset("CD/events", data=records, chunks=(1000,),
                            compression=compression)
        file["EXT_TRIGGER/events"] = np.array([(1, 6000, 0), (0, 7000, 0)], TRIGGER)
    with open_recording(path) as recording:
        assert recording.info.format == "HDF5 (Metavision)"
        assert recording.info.sensor_size == SIZE
        assert recording.info.trigger_count == 2
        found, _, _, triggers = joined(recording.packets())
        np.testing.assert_array_equal(found, events)
        np.testing.assert_array_equal(recording.events(6000, 7000), events[
            (events["t"] >= 6000) & (events["t"] < 7000)])
        assert triggers.tolist() == [(6000, 1), (7000, 2)]
        assert not recording.problems


def test_triggers_of_one_channel_are_read(path):
    with h5py.File(path, "w") as file:
        file.attrs["geometry"] = "640x480"
        file["CD/events"] = np.array([(3, 2, 1, 5000)], CD)
        file["EXT_TRIGGER/events"] = np.array(
            [(1, 6000, 0), (1, 6500, 6), (0, 7000, 0)], TRIGGER)
    for channel, wanted in (0, [(6000, 1), (7000, 2)]), (6, [(6500, 1)]), (3, []):
        with open_recording(path, trigger_channel=channel) as recording:
            assert joined(recording.packets())[3].tolist() == wanted
            assert [problem.count for problem in recording.problems] == [
                3 - len(wanted)]


def test_a_codec_that_is_not_installed_is_named_with_the_way_out(path):
    with h5py.File(path, "w") as file:
        plist = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
        plist.set_chunk((10,))
        plist.set_filter(0x8ECF, h5py.h5z.FLAG_OPTIONAL)
        h5py.h5d.create(file.create_group("CD").id, b"events",
                        h5py.h5t.py_create(CD), h5py.h5s.create_simple((10,)), plist)
    with pytest.raises(RecordingError, match=r"Metavision, compressed by ECF.*"
                       r"HDF5_PLUGIN_PATH .* hdf5_ecf, .* metavision_file_to_dat"):
        open_recording(path)


def test_what_lies_in_another_file_is_refused_by_name(path, tmp_path):
    events = some_events(200)
    table = np.stack([events[name] for name in "txyp"], 1).astype(np.int64)
    with h5py.File(tmp_path / "other.h5", "w") as file:
        file["events"] = table

    def link(file):
        file["events"] = h5py.ExternalLink("other.h5", "/events")

    def soft(file):
        file["away"] = h5py.ExternalLink("other.h5", "/")
        file["events"] = h5py.SoftLink("/away/events")

    def virtual(file):
        layout = h5py.VirtualLayout(table.shape, "i8")
        layout[:] = h5py.VirtualSource("none.h5", "events", shape=table.shape)
        file.create_virtual_dataset("events", layout)

    def storage(file):
        file.create_dataset("events", table.shape, "i8", external=[
            (str(tmp_path / "other.h5"), 0, table.nbytes)])

    def frames(file):
        file["events"] = table
        file["frame"] = h5py.ExternalLink("other.h5", "/events")

    for make, message in (
            (link, "/events is an external link to other.h5:/events, which is not"),
            (soft, "/events is a soft link to the file:/away/events"),
            (virtual, "/events is a virtual data set: its data lie in other files"),
            (storage, "/events is external storage: its data lie in other files"),
            (frames, "/frame is an external link to other.h5:/events")):
        with h5py.File(path, "w") as file:
            make(file)
        with pytest.raises(RecordingError, match=message):
            open_recording(path)


@pytest.mark.parametrize("names", [("t", "x", "y", "p"), ("ts", "xs", "ys", "ps")])
def test_columns_of_unequal_length_are_refused(path, names):
    events = some_events(200)
    columns(path, events, names, **{names[1]: events["x"][:100]})
    with pytest.raises(RecordingError, match=f"one length, got /events/{names[0]} 200, "
                       f"/events/{names[1]} 100, /events/{names[2]} 200"):
        open_recording(path)


@pytest.mark.parametrize("text", ["260x346", b"346x260", "(260, 346)"])
def test_a_size_that_is_text_is_read_and_said(path, text):
    columns(path, some_events(200, (200, 300)))
    with h5py.File(path, "a") as file:
        file.attrs["sensor_size"] = text
    with open_recording(path) as recording:
        assert recording.info.sensor_size == (260, 346)
        assert len(recording.events()) == 200
        assert "taken as 346x260" in recording.problems[0].message


@pytest.mark.parametrize(
    "size", ["DAVIS", [260], "1x2x3", "-260x346", [260.5, 346], "0x5"])
def test_a_size_that_is_not_two_numbers_is_asked_for(path, size):
    columns(path, some_events(200, (200, 300)))
    with h5py.File(path, "a") as file:
        file.attrs["sensor_size"] = size
    with pytest.raises(RecordingError, match=r"sensor_size must be two numbers, "
                       r"height and width, it is .*; sensor_size= states it"):
        open_recording(path)
    with open_recording(path, sensor_size=(260, 346)) as recording:
        assert len(recording.events()) == 200


@pytest.mark.parametrize("count", [0, 3])
def test_frames_without_as_many_times_are_said(path, count):
    columns(path, some_events(200))
    with h5py.File(path, "a") as file:
        file["frame"] = np.zeros((5, *SIZE), "u1")
        if count:
            file["frame_ts"] = np.arange(count) * 1000
    with open_recording(path) as recording:
        assert sum(len(packet.frames) for packet in recording.packets()) == count
        problems = recording.problems
        assert any(f"5 frames have {count} times" in p.message for p in problems)
        recording.scan()
        assert recording.problems == problems


@pytest.mark.parametrize("offset", [2**62, -2**62, 1e300, np.inf, np.nan])
def test_an_offset_that_is_no_time_is_refused(path, offset):
    columns(path, some_events())
    with h5py.File(path, "a") as file:
        file["t_offset"] = offset
    with pytest.raises(RecordingError, match=r"t_offset of|cannot convert float"):
        open_recording(path)
