"""pdavis convert, and HDF5 in the layouts of E2P and DSEC."""
import json

import numpy as np
import pytest
from test_aedat2_writer import recording as davis
from test_aedat4 import assert_same, joined
from test_aedat4_writer import small

import pdavis_cv
from pdavis_cv import Layout, RecordingError, open_recording, write_aedat4
from pdavis_cv.recording.hdf5.writer import write_hdf5
from pdavis_cv.tools.convert import main
from pdavis_cv.tools.export import main as export_main

h5py = pytest.importorskip("h5py")


def test_e2p_files_keep_everything(tmp_path):
    source = small(layout=Layout.SONY)
    assert write_hdf5(tmp_path / "x.h5", source) == {}
    with open_recording(tmp_path / "x.h5") as again:
        assert_same(joined(again.packets()), joined(source.packets()))
        assert again.info.layout == Layout.SONY
        assert again.info.event_count == 5000
        whole = joined(again.packets())
        part = joined(again.packets(40_000, 60_000))
    inside = (whole[0]["t"] >= 40_000) & (whole[0]["t"] < 60_000)
    np.testing.assert_array_equal(part[0], whole[0][inside])
    with h5py.File(tmp_path / "x.h5") as file:
        assert file["events"].shape == (5000, 4)
        assert file["frame"].shape == (3, 12, 16)
        times, index = file["frame_ts"][()], file["frame_idx"][()]
        t = file["events"][:, 0]
    assert times.tolist() == [10_000, 40_000, 70_000]
    np.testing.assert_array_equal(index, [
        np.searchsorted(t, 30_000 * k + 20_000, "right") for k in range(3)])


def test_dsec_files_keep_the_events(tmp_path):
    source = small()
    assert write_hdf5(tmp_path / "x.h5", source, flavour="dsec") == {"frames": 3}
    events = joined(source.packets())[0]
    with h5py.File(tmp_path / "x.h5") as file:
        t = file["events/t"][()]
        offset = int(file["t_offset"][()])
        np.testing.assert_array_equal(t + offset, events["t"])
        index = file["ms_to_idx"][()]
        np.testing.assert_array_equal(
            index, np.searchsorted(t, 1000 * np.arange(len(index))))
    with open_recording(tmp_path / "x.h5") as again:
        np.testing.assert_array_equal(joined(again.packets())[0], events)


def test_e2p_times_in_seconds_and_signed_polarity_are_understood(tmp_path):
    with h5py.File(tmp_path / "x.h5", "w") as file:
        file["events"] = np.array(
            [[0.5, 1, 2, 1], [0.500001, 3, 4, -1], [0.6, 9, 9, 1]])
        file["frame"] = np.full((1, 8, 10), 255, np.uint8)
        file["frame_ts"] = np.array([0.55])
    with open_recording(tmp_path / "x.h5") as recording:
        events, [frame], _, _ = joined(recording.packets())
        assert [p.kind for p in recording.problems] == ["outside sensor"]
    assert events.tolist() == [(500_000, 1, 2, 1), (500_001, 3, 4, 0)]
    assert frame.mid_us == 550_000
    assert not frame.valid.any()


def test_other_hdf5_files_are_refused(tmp_path):
    with h5py.File(tmp_path / "x.h5", "w") as file:
        file["picture"] = np.zeros(3)
    with pytest.raises(RecordingError, match=r"no /events of E2P.*picture"):
        open_recording(tmp_path / "x.h5")
    (tmp_path / "y.h5").write_bytes((tmp_path / "x.h5").read_bytes()[:700])
    with pytest.raises(RecordingError, match="HDF5 cannot read it"):
        open_recording(tmp_path / "y.h5")


@pytest.mark.parametrize("chain", [
    ["a.aedat2", "b.aedat4", "c.h5", "d.aedat2"], ["a.h5", "b.aedat", "c.aedat4"]])
def test_conversions_keep_events_frames_and_times(tmp_path, chain, capsys):
    source = davis(frames=2)
    write_aedat4(tmp_path / "start.aedat4", source)
    with open_recording(tmp_path / "start.aedat4") as first:
        wanted = joined(first.packets())
    before = tmp_path / "start.aedat4"
    for name in chain:
        assert main([str(before), str(tmp_path / name)]) == 0
        before = tmp_path / name
    with open_recording(before) as last:
        events, frames, _, _ = joined(last.packets())
    np.testing.assert_array_equal(events, wanted[0])
    for frame, other in zip(frames, wanted[1], strict=True):
        # A valid pixel above 1020 DN would need a signal read of 2 or less.
        np.testing.assert_array_equal(
            frame.dn, np.where(other.dn < 1023, np.minimum(other.dn, 1020), 1023))
        assert (frame.mid_us, frame.available_us) == (other.mid_us, other.available_us)
    assert "not kept: 1 triggers" in capsys.readouterr().out


def test_what_was_assumed_of_frames_is_said_beside_the_output(tmp_path, capsys):
    np.save(tmp_path / "x.npy", np.full((3, 8, 12), 700, np.uint16))
    given = [str(tmp_path / "x.npy"), "--layout", "sony"]
    assert main([*given, str(tmp_path / "a.aedat4")]) == 0
    assert "rate assumed (25 per second)" in capsys.readouterr().out
    assert main([*given, str(tmp_path / "b.aedat4"), "--json",
                 "--source-fps", "50", "--bits", "10"]) == 0
    assert json.loads(capsys.readouterr().out)["assumed"] == []
    assert export_main([*given, "-o", str(tmp_path / "x.h5")]) == 0
    with h5py.File(tmp_path / "x.h5") as file:
        assert file["s0"].attrs["units"] == "DN"
        assert file["aop"].attrs["units"] == "rad"
    assert export_main([*given, "-o", str(tmp_path / "y.h5"),
                 "--exposure-us", "10000"]) == 0
    with h5py.File(tmp_path / "y.h5") as file:
        assert file["s0"].attrs["units"] == "DN/ms"


def test_mistakes_are_one_line(tmp_path, capsys):
    path = tmp_path / "x.aedat4"
    write_aedat4(path, small())
    for arguments, message in (
            ([path, tmp_path / "x.xyz"], "the name must end in .aedat4, .aedat,"),
            ([path, path], "is the recording that is read"),
            ([tmp_path / "none", tmp_path / "y.aedat4"], "No such file"),
            ([path, tmp_path / "y.aedat2"], "that of a DAVIS")):
        assert main([str(a) for a in arguments]) == 2
        assert message in capsys.readouterr().err
    assert sorted(p.name for p in tmp_path.iterdir()) == ["x.aedat4"]
    assert pdavis_cv.EVENT_DTYPE.itemsize == 13
