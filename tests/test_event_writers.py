"""Writers of lists of events: what is written is read again, also by other readers.

What other writers write is in test_event_files.py, but for faery's.
"""
import subprocess
import sys

import numpy as np
import pytest
from test_aedat4 import assert_same, joined
from test_aedat4_writer import small
from test_event_files import some_events

from pdavis_cv import (
    EVENT_DTYPE,
    FORMATS,
    Layout,
    open_recording,
    recording_from_arrays,
)
from pdavis_cv.recording.base import TRIGGER_DTYPE
from pdavis_cv.recording.registry import writer_for
from pdavis_cv.tools.convert import main

SIZE = (480, 640)
NAMES = {"evt3.raw": {}, "evt2.raw": {"encoding": "evt2"}, "x.es": {}, "x.csv": {},
         "x.npy": {}, "x.parquet": {}}


def written(path, recording, **options):
    return dict(writer_for(path)[1](path, recording, **options))


def times(kind, n=4000):
    """Return events whose times test what a format does to them."""
    events = some_events(n)
    if kind == "gaps":      # longer than the turns of EVT3's 24 bits, and ties
        events["t"][n // 4:] += 3
        events["t"][n // 2:] += 40_000_000
        events["t"][3 * n // 4:] += (1 << 24) - 5
    elif kind == "late":
        events["t"] += (1 << 24) - 30_000
    elif kind == "unix":
        events["t"] += 1_700_000_000_000_000
    return events


@pytest.mark.parametrize("kind", ["usual", "gaps", "late", "unix"])
@pytest.mark.parametrize("name", NAMES)
def test_events_are_the_same_when_read_again(tmp_path, name, kind):
    events = times(kind)
    source = recording_from_arrays(events, sensor_size=SIZE)
    lost = written(tmp_path / name, source, **NAMES[name])
    origin = 0
    if name == "x.es" and kind == "unix":
        origin = int(events["t"][0])
        assert lost.popitem() == ("us before the first event: times begin at 0", origin)
    assert lost == {}
    options = {"sensor_size": SIZE} if name == "x.npy" else {}
    with open_recording(tmp_path / name, **options) as again:
        assert again.info.sensor_size == SIZE
        found = again.events()
        found["t"] += origin
        np.testing.assert_array_equal(found, events)
        np.testing.assert_array_equal(
            np.concatenate([p.events for p in again.packets()])[list("xyp")],
            events[list("xyp")])
        assert again.problems == ()


@pytest.mark.parametrize("name", NAMES)
def test_what_is_no_event_is_counted(tmp_path, name):
    source = small()
    events, frames, imu, triggers = joined(source.packets())
    lost = written(tmp_path / name, source, **NAMES[name])
    with open_recording(tmp_path / name, sensor_size=None if name != "x.npy" else (
            12, 16)) as again:
        found = joined(again.packets())
    np.testing.assert_array_equal(found[0], events)
    expected = {"frames": len(frames), "imu": len(imu), "triggers": len(triggers)}
    if name.endswith("raw"):
        kept = triggers[np.isin(triggers["type"], (1, 2))]
        np.testing.assert_array_equal(found[3], kept)
        expected["triggers that are not external edges"] = (
            expected.pop("triggers") - len(kept))
    assert lost == {what: n for what, n in expected.items() if n}


def test_triggers_of_raw_lie_between_its_events(tmp_path):
    events = some_events(2000)
    triggers = np.zeros(50, TRIGGER_DTYPE)
    triggers["t"] = np.sort(np.random.default_rng(1).integers(
        events["t"][0], events["t"][-1], 50))
    triggers["type"] = 1 + np.arange(50) % 2
    source = recording_from_arrays(events, sensor_size=SIZE, triggers=triggers)
    for name in ("evt3.raw", "evt2.raw"):
        assert written(tmp_path / name, source, **NAMES[name]) == {}
        with open_recording(tmp_path / name) as again:
            found = joined(again.packets())
        np.testing.assert_array_equal(found[0], events)
        np.testing.assert_array_equal(found[3], triggers)


@pytest.mark.parametrize("name", ["evt3.raw", "x.parquet", "rpg.h5"])
def test_facts_of_the_source_are_kept(tmp_path, name):
    source = small(layout=Layout.SONY)
    kind = FORMATS["rpg"].name if name == "rpg.h5" else None
    writer_for(tmp_path / name, kind)[1](tmp_path / name, source)
    with open_recording(tmp_path / name) as again:
        assert again.info.layout == Layout.SONY


def test_hdf5_of_rpg_keeps_everything(tmp_path):
    h5py = pytest.importorskip("h5py")
    source, path = small(layout=Layout.SONY), tmp_path / "x.h5"
    assert writer_for(path, "rpg")[1](path, source) == {}
    with open_recording(path) as again:
        assert again.info.format == "HDF5 (rpg)"
        assert_same(joined(again.packets()), joined(source.packets()))
    events, frames, _, _ = joined(source.packets())
    with h5py.File(path) as file:
        np.testing.assert_array_equal(
            np.rint(file["events/ts"][()] * 1e6), events["t"])
        assert file.attrs["sensor_resolution"].tolist() == [12, 16]
        assert [file[f"images/image{k:09d}"].attrs["timestamp"] for k in range(3)] == [
            frame.mid_us / 1e6 for frame in frames]


@pytest.mark.parametrize("name", [*NAMES])
def test_without_events_the_file_is_empty(tmp_path, name):
    source = recording_from_arrays(np.empty(0, EVENT_DTYPE), sensor_size=SIZE)
    assert written(tmp_path / name, source, **NAMES[name]) == {}
    if name != "x.csv":     # a text of a header only is nothing that is recognized
        with open_recording(tmp_path / name) as again:
            assert len(again.events()) == 0


FAERY = {"x.es": {}, "x.csv": {}, "x.aedat4": {}, "evt2.raw": {"version": "evt2"},
         "evt3.raw": {"version": "evt3"},
         "dat1": {"version": "dat1", "file_type": "dat"},
         "dat2": {"version": "dat2", "file_type": "dat"}}


@pytest.fixture(scope="module")
def of_faery(tmp_path_factory):
    """Return a folder of what faery writes, and the events.

    In a process of its own, as its writer of DAT changes NumPy 1.26's uint8 for all.
    """
    pytest.importorskip("faery")
    folder, events = tmp_path_factory.mktemp("faery"), some_events(3000, (240, 304))
    np.save(folder / "events.npy", events)
    subprocess.run([sys.executable, "-P", "-c", f"""
import faery, numpy
events = numpy.load("events.npy").astype(faery.EVENTS_DTYPE)
for name, given in {FAERY}.items():
    faery.events_stream_from_array(events, (304, 240)).to_file(name, **given)
"""], cwd=folder, check=True)
    return folder, events


@pytest.mark.parametrize("name", FAERY)
def test_what_faery_writes_is_read(of_faery, name):
    path, events = of_faery[0] / name, of_faery[1]
    expected = events.copy()
    if name == "x.es":      # which keeps no first time
        expected["t"] -= events["t"][0]
    with open_recording(path) as recording:
        assert recording.info.sensor_size == (240, 304)
        np.testing.assert_array_equal(recording.events(), expected)
        assert not recording.problems


@pytest.mark.parametrize("name", ["evt3.raw", "evt2.raw", "x.es", "x.csv"])
@pytest.mark.parametrize("kind", ["usual", "gaps", "late"])
def test_faery_reads_the_same(tmp_path, name, kind):
    faery = pytest.importorskip("faery")
    events = times(kind)
    written(tmp_path / name, recording_from_arrays(events, sensor_size=SIZE),
            **NAMES[name])
    found = faery.events_stream_from_file(tmp_path / name).to_array()
    for ours, theirs in zip("txyp", ("t", "x", "y", "on"), strict=True):
        column = found[theirs].astype(np.int64)
        np.testing.assert_array_equal(column, events[ours])


@pytest.mark.parametrize("name", ["evt3", "evt2"])
@pytest.mark.parametrize("kind", ["usual", "gaps", "late"])
def test_expelliarmus_reads_the_same(tmp_path, name, kind):
    wizard = pytest.importorskip("expelliarmus").Wizard(encoding=name)
    events, path = times(kind), tmp_path / "x.raw"
    written(path, recording_from_arrays(events, sensor_size=SIZE), encoding=name)
    found = wizard.read(path)
    # Its EVT3 adds each fall of the lower 12 bits to the upper ones, which say it too.
    turn = 1 << 12 if name == "evt3" else 1 << 62
    np.testing.assert_array_equal(found["t"] % turn, events["t"] % turn)
    for field in "xyp":
        np.testing.assert_array_equal(found[field], events[field])


def test_the_help_has_every_format_in_one_table(capsys):
    assert main(["--help"]) == 0
    table = capsys.readouterr().out.partition("formats:\n")[2].splitlines()
    assert [line.split()[0] for line in table] == ["name", *FORMATS.usable()]
    [raw] = [line for line in table if line.split()[0] == "prophesee"]
    assert raw.split()[1:4] == [".raw", ".dat", ".raw"]


def test_mistakes_are_one_line(tmp_path, capsys):
    np.save(tmp_path / "in.npy", some_events(200))
    for out, options, message in (
            ("x.raw", ["--encoding", "evt4"], "must be evt2 or evt3, got 'evt4'"),
            ("x.npy", ["--encoding", "evt3"], "--encoding is no option of NumPy"),
            ("x.dat", [], "the name must end in"), ("x.npz", [], "the name must end")):
        assert main([str(tmp_path / "in.npy"), str(tmp_path / out), *options]) == 2
        assert message in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["in.npy"]


def test_a_large_group_of_parquet_is_read_in_parts(tmp_path, monkeypatch):
    pytest.importorskip("pyarrow")
    from pyarrow import Table, parquet as pq

    from pdavis_cv.recording import parquet
    monkeypatch.setattr(parquet, "_MOST_ROWS", 64)
    t = np.arange(1000) * 1000
    rows = {"t": t, "x": t % 14, "y": t % 12, "p": t % 2}
    pq.write_table(Table.from_pydict(rows), tmp_path / "x.parquet", row_group_size=700)
    with open_recording(tmp_path / "x.parquet") as recording:
        column = recording._found()["t"]
        for start, stop in ((0, 1000), (650, 750), (10, 20), (900, 999), (699, 701)):
            np.testing.assert_array_equal(column.rows(start, stop), t[start:stop])
            assert len(column._part[1]) <= 64
        np.testing.assert_array_equal(recording.events()["t"], t)
        one, two = recording.packets(), recording.packets(500_000)
        found = [np.concatenate([p.events["t"] for p in each]) for each in (one, two)]
        np.testing.assert_array_equal(found[1], found[0][500:])
