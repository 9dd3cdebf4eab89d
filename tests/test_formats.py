"""The table of formats: one list that every door reads, and that others add to."""
import pickle
import sys
import textwrap
import warnings

import numpy as np
import pytest
from test_aedat4 import joined
from test_aedat4_writer import small

import pdavis_cv
from pdavis_cv import FORMATS, Layout, VideoCapture, open_recording
from pdavis_cv.recording import registry
from pdavis_cv.recording.format import Format
from pdavis_cv.recording.hdf5.writer import write_hdf5
from pdavis_cv.registry import loaded
from pdavis_cv.tools.convert import main as convert

MODULE = '''
"""A format of ten bytes per event, from another package."""
import numpy as np

from pdavis_cv import EVENT_DTYPE, FileRecording, RecordingInfo
from pdavis_cv.recording.format import Format
from pdavis_cv.recording.facts import stated
from pdavis_cv.recording.packetise import Batch, packetise


class Reader(FileRecording):
    def _open(self, options):
        self._reader = self._bytes()
        side = options.parameters.get("side", 16)
        return RecordingInfo(format="ten", frame_count=0, **stated(
            options, sensor_size=(12, side)))

    def packets(self, start_us=None, stop_us=None):
        raw = self._reader.read(4, self._reader.size)
        rows = np.frombuffer(raw, "<i4", 4 * (len(raw) // 16)).reshape(-1, 4)
        events = np.zeros(len(rows), EVENT_DTYPE)
        for name, column in zip("txyp", rows.T):
            events[name] = column
        inside = (events["x"] < 16) & (events["y"] < 12)
        self._count(4, "outside sensor", int((~inside).sum()), "events lie outside")
        return packetise([Batch(events[inside])], start_us, stop_us)


def write(path, recording):
    with open(path, "wb") as file:
        file.write(b"TEN!")
        for packet in recording.packets():
            file.write(np.stack([packet.events[k] for k in "txyp"], 1).astype(
                "<i4").tobytes())
    return {"frames": 3}


TEN = Format(name="ten", title="Ten", magic=(b"TEN!",), suffixes=(".ten",),
             reader="ten_events:Reader", writer=write, read_options=("side",))
NOT_A_FORMAT = 10
TAKEN = Format(name="aedat4", title="Mine", reader="ten_events:Reader")
'''


@pytest.fixture
def added(tmp_path, monkeypatch):
    """Install a package that adds formats, as pip would lay it out."""
    def install(entries):
        site = tmp_path / "site"
        facts = site / "ten_events-1.0.dist-info"
        facts.mkdir(parents=True)
        (site / "ten_events.py").write_text(textwrap.dedent(MODULE))
        (facts / "METADATA").write_text(
            "Metadata-Version: 2.1\nName: ten-events\nVersion: 1.0\n")
        (facts / "entry_points.txt").write_text(f"[pdavis_cv.formats]\n{entries}\n")
        monkeypatch.syspath_prepend(str(site))
        return tmp_path

    yield install
    sys.modules.pop("ten_events", None)


def test_a_format_of_another_package_goes_through_every_door(added, capsys):
    folder = added("ten = ten_events:TEN")
    source = small()
    path = folder / "x.ten"
    write_to = folder / "in.h5"
    write_hdf5(write_to, source)
    assert convert([str(write_to), str(path)]) == 0
    assert "not kept: 3 frames" in capsys.readouterr().out
    events = joined(source.packets())[0]
    with open_recording(path) as recording:
        assert recording.info.format == "ten"
        np.testing.assert_array_equal(joined(recording.packets())[0], events)
        with pickle.loads(pickle.dumps(recording)) as again:
            np.testing.assert_array_equal(again.events(), events)
    with open_recording(path, side=20) as recording:
        assert recording.info.sensor_size == (12, 20)
    with VideoCapture(path, layout=Layout.PDAVIS) as capture:
        assert capture.isOpened(), capture.last_error
        assert capture.read()[0]
    assert ".ten" in registry.suffixes()
    assert registry.is_recording(path)
    assert convert([str(path), str(folder / "x.aedat4")]) == 0


def test_its_problems_are_counted_or_refused_as_ours(added):
    path = added("ten = ten_events:TEN") / "x"
    path.write_bytes(b"TEN!" + np.array(
        [[5, 1, 1, 1], [6, 16, 1, 0], [7, 1, 12, 1]], "<i4").tobytes())
    with open_recording(path) as recording:
        assert len(recording.events()) == len(recording.events()) == 1
        [problem] = recording.problems
        assert (problem.kind, problem.count, problem.offset) == ("outside sensor", 2, 4)
    with open_recording(path, bad_events="raise") as recording, pytest.raises(
            pdavis_cv.RecordingError, match="byte 4: 2 events lie outside"):
        recording.events()
    with pytest.raises(ValueError, match="recording is closed"):
        recording.events()


@pytest.mark.parametrize(("entry", "message"), [
    ("x = ten_events:NOT_A_FORMAT", "Format expected, got int"),
    ("x = ten_events:TAKEN", "its name is 'aedat4'"),
    ("aedat4 = ten_events:TAKEN", "the library has one of this name"),
    ("x = ten_events:MISSING", "has no attribute 'MISSING'"),
    ("x = no_such_module:X", "No module named 'no_such_module'"),
])
def test_an_entry_that_does_not_load_is_told_and_left_out(added, entry, message):
    added(entry)
    name = entry.split()[0]
    with pytest.warns(pdavis_cv.PdavisWarning, match=f"{name}.*{message}"):
        assert list(FORMATS.usable()) == list(FORMATS.known)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        FORMATS.usable()
    if name == "x":
        with pytest.raises(ImportError, match=message):
            FORMATS["x"]


def test_readers_load_and_names_are_those_of_the_table():
    for name, one in FORMATS.items():
        assert one.name == name
        for what in filter(None, (one.reader, one.writer, one.sniff)):
            assert callable(loaded(what))


@pytest.mark.parametrize(("wrong", "message"), [
    ({"name": "My Format"}, "name must be lower-case"),
    ({"suffixes": ("h5",)}, "suffixes must be lower case with a dot, got 'h5'"),
    ({"holds": frozenset(("sound",))}, "holds must be of events, frames, imu, trig"),
])
def test_a_wrong_format_says_what_is_wrong(wrong, message):
    with pytest.raises(ValueError, match=message):
        Format(**{"name": "x", "title": "X", "reader": "x:y"} | wrong)


def test_an_option_that_the_format_does_not_have_is_a_type_error(tmp_path):
    pdavis_cv.write_aedat4(tmp_path / "x", small())
    with pytest.raises(TypeError, match="side= is no option of AEDAT-4, which has"):
        open_recording(tmp_path / "x", side=3)
    with pytest.raises(TypeError, match="source_fps= is no option of AEDAT-4"):
        open_recording(tmp_path / "x", source_fps=30)


@pytest.mark.parametrize("name", ["x.h5", "x.bin"])
def test_hdf5_opens_as_video(tmp_path, name):
    pytest.importorskip("h5py")
    write_hdf5(tmp_path / name, small(layout=Layout.PDAVIS))
    with VideoCapture(tmp_path / name, fps=50) as capture:
        assert capture.isOpened(), capture.last_error
        ok, image = capture.read()
        assert ok
        assert image.shape == (12, 16, 3)
    if name == "x.h5":
        imageio = pytest.importorskip("imageio.v3")
        from pdavis_cv.adapters.imageio_plugin import register
        register()
        picture = imageio.imread(tmp_path / name, fps=50)
        np.testing.assert_array_equal(picture[..., ::-1], image)
        pims = pytest.importorskip("pims")
        import pdavis_cv.adapters.pims_reader  # noqa: F401
        with pims.open(str(tmp_path / name)) as frames:
            assert frames[0].shape == (12, 16)
            assert len(frames) > 1


def test_a_folder_is_no_recording_unless_a_format_says_so(tmp_path):
    with pytest.raises(pdavis_cv.RecordingError, match="that is not a recording"):
        open_recording(tmp_path)
    assert not registry.is_recording(tmp_path)
    assert not registry.is_recording("a\0b")


def test_the_page_of_formats_lists_the_table(root):
    page = (root / "docs" / "formats.md").read_text()
    table = next(part for part in page.split("\n\n") if part.startswith("| format |"))
    rows = [line.split("|") for line in table.splitlines()][2:]
    listed = {row[2].strip(" `"): row[4].strip() != "no" for row in rows}
    assert listed == {name: one.writer is not None for name, one in FORMATS.items()}
