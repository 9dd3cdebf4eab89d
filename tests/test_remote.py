"""Object storage: recordings read by ranges, results put whole, as with a disk."""
import csv
import json
import os
import pickle
from pathlib import Path

import batch_works
import numpy as np
import pytest
from batch_works import Inline
from test_batch import PLAIN, files_in, run, write

from pdavis_cv import RecordingError, batch, open_recording
from pdavis_cv._remote import RemotePath, as_path, is_remote
from pdavis_cv.data import example_recording


@pytest.fixture
def memory():
    fsspec = pytest.importorskip("fsspec")
    store = fsspec.filesystem("memory")
    yield store
    store.rm("/lab", recursive=True)


def read(source):
    with open_recording(source) as recording:
        packets = list(recording.packets())
        events = np.concatenate([packet.events for packet in packets])
        frames = [frame.dn for packet in packets for frame in packet.frames]
        return recording.info, events, frames


def assert_same(one, other):
    assert one[0] == other[0]
    np.testing.assert_array_equal(one[1], other[1])
    np.testing.assert_array_equal(one[2], other[2])


def test_an_object_reads_as_a_file(memory, tmp_path):
    path = write(tmp_path / "run.aedat4")
    memory.pipe("/lab/run.aedat4", path.read_bytes())
    assert_same(read("memory://lab/run.aedat4"), read(path))


def test_bytes_are_asked_for_where_they_are_needed(memory, monkeypatch):
    path = as_path("memory://lab/long.bin")
    memory.pipe("/lab/long.bin", bytes(range(250)) * 20_000)
    asked = []
    plain = type(memory).cat_file

    def counted(self, name, start=None, end=None):
        asked.append((start, end))
        return plain(self, name, start=start, end=end)

    monkeypatch.setattr(type(memory), "cat_file", counted)
    block = path.ranges()
    for offset, size in ((0, 10), (1_048_570, 12), (4_999_995, 100), (2_500_000, 1)):
        assert path.read(block, offset, size) == (
            bytes(range(250)) * 20_000)[offset:offset + size]
    assert asked == [(0, 1 << 20), (1 << 20, 2 << 20), (4 << 20, 5_000_000),
                     (2 << 20, 3 << 20)]


def test_a_recording_of_a_store_pickles_by_its_name(memory, tmp_path):
    memory.pipe("/lab/run.aedat4", write(tmp_path / "run.aedat4").read_bytes())
    with open_recording("memory://lab/run.aedat4") as recording, \
            pickle.loads(pickle.dumps(recording)) as again:
        assert str(again.path) == "memory://lab/run.aedat4"
        assert again.path.name == "run.aedat4"
        assert len(again.events()) == 200


def test_what_is_not_there_is_named(memory):
    memory.pipe("/lab/other", b"")
    with pytest.raises(RecordingError, match=r"lab/gone.aedat4: cannot be op"):
        open_recording("memory://lab/gone.aedat4")


def test_formats_that_need_a_file_say_so(memory):
    memory.pipe("/lab/run.npy", b"\x93NUMPY" + bytes(100))
    with pytest.raises(RecordingError, match="cannot be read by ranges: copy it"):
        open_recording("memory://lab/run.npy")


def test_a_batch_reads_from_a_store(memory, tmp_path):
    path = write(tmp_path / "run.aedat4")
    memory.pipe("/lab/run.aedat4", path.read_bytes())
    memory.pipe("/lab/other.aedat4", write(tmp_path / "o.aedat4", 5).read_bytes())
    table = run(["memory://lab/run.aedat4", "memory://lab/other.aedat4", path],
                tmp_path / "out", work="export")
    assert [row["state"] for row in table] == ["done", "done"]
    assert len({row["name"] for row in table}) == 2     # the third is the first


# ---- results ---------------------------------------------------------------------

OF_THE_RUN = {"started", "wall_s", "cpu_s", "peak_mib", "name", "recording"}


def content_of(store, out):
    """Return the objects below a name, without what belongs to runs."""
    found = {name.partition(f"{out}/")[2]: store.cat_file(name)
             for name in store.find(out)}
    return {name: data for name, data in found.items() if ".batch" not in name}


def assert_as_local(store, out, local):
    """Compare all that a run has put with what the same one wrote on a disk."""
    remote = content_of(store, out)
    assert remote.keys() == files_in(local)
    for name, data in remote.items():
        if name.count("/"):
            if name.endswith(".json"):     # beside a table: where the recording lies
                continue
            assert data == (local / name).read_bytes(), name
        elif name.endswith(".json"):
            one, other = json.loads(data), json.loads((local / name).read_bytes())
            for fact in OF_THE_RUN - {"name"}:
                one["row"].pop(fact), other["row"].pop(fact)
            assert one["row"] == other["row"]
    rows = list(csv.DictReader(remote["summary.csv"].decode("utf-8").splitlines()))
    with (local / "summary.csv").open(newline="", encoding="utf-8") as file:
        for one, other in zip(rows, csv.DictReader(file), strict=True):
            assert {k: v for k, v in one.items() if k not in OF_THE_RUN} == {
                k: v for k, v in other.items() if k not in OF_THE_RUN}


def test_results_in_a_store_are_those_on_a_disk(memory, tmp_path):
    paths = [write(tmp_path / f"run{i}.aedat4", i) for i in range(2)]
    for out in ("memory://lab/out", tmp_path / "out"):
        table = run(paths, out, work="traces")
        assert [row["state"] for row in table] == ["done", "done"]
    assert_as_local(memory, "/lab/out", tmp_path / "out")


def test_a_store_too_is_done_once(memory, tmp_path):
    path = write(tmp_path / "run.aedat4")
    first = list(run([path], "memory://lab/out"))
    again = Inline()
    assert list(run([path], "memory://lab/out", executor=again)) == first
    assert again.sent == 0
    assert list(batch.status("memory://lab/out")) == first


def test_of_a_job_that_fails_a_store_holds_its_row_only(memory, tmp_path):
    table = run([write(tmp_path / "run.aedat4")], "memory://lab/out",
                work=batch_works.half)
    name = table[0]["name"]
    assert table[0]["error"] == "damaged in the middle"
    assert content_of(memory, "/lab/out").keys() == {
        f"{name}.json", "summary.csv", "index.html"}


def test_status_of_a_store_without_results_says_so(memory):
    memory.pipe("/lab/other", b"")
    with pytest.raises(FileNotFoundError, match="no results of pdavis batch"):
        batch.status("memory://lab/out")


@pytest.mark.parametrize(("path", "remote"), [
    ("s3://bucket/run.aedat4", True), ("run.aedat4", False), ("/a//b", False),
    (Path("a/b"), False), ("file:///tmp/x", False), ("C://x", True)])
def test_a_scheme_makes_a_path_remote(path, remote):
    assert is_remote(path) is remote
    assert isinstance(as_path(path), RemotePath) is remote
    if remote:
        assert os.fspath(as_path(path)) == path


@pytest.fixture(scope="module")
def bucket():
    """Serve S3 on this machine, by moto."""
    moto = pytest.importorskip("moto.server")
    s3fs = pytest.importorskip("s3fs")
    server = moto.ThreadedMotoServer(port=0, verbose=False)
    server.start()
    host, port = server.get_host_and_port()
    names = {"AWS_ACCESS_KEY_ID": "test", "AWS_SECRET_ACCESS_KEY": "test",
             "AWS_ENDPOINT_URL": f"http://{host}:{port}", "AWS_REGION": "us-east-1"}
    with pytest.MonkeyPatch.context() as patch:
        for name, value in names.items():
            patch.setenv(name, value)
        s3fs.S3FileSystem.clear_instance_cache()
        s3fs.S3FileSystem().mkdir("lab")
        yield s3fs.S3FileSystem()
        s3fs.S3FileSystem.clear_instance_cache()
    server.stop()


@pytest.mark.gate
@pytest.mark.filterwarnings("ignore")       # of moto and its server
def test_an_object_of_s3_reads_as_a_file(bucket):
    path = example_recording()
    bucket.put(str(path), "lab/run.aedat4")
    assert_same(read("s3://lab/run.aedat4"), read(path))


@pytest.mark.gate
@pytest.mark.filterwarnings("ignore")       # of moto and its server
def test_results_in_s3_are_those_on_a_disk(bucket, tmp_path):
    paths = [write(tmp_path / f"run{i}.aedat4", i) for i in range(3)]
    for out in ("s3://lab/out", tmp_path / "out"):
        table = batch.run(paths, PLAIN, out, work="export", workers=2, progress=False)
        assert [row["state"] for row in table] == ["done"] * 3
    assert_as_local(bucket, "lab/out", tmp_path / "out")
    bucket.put(str(paths[0]), "lab/run0.aedat4")
    stored = batch.run(["s3://lab/run0.aedat4"], PLAIN, "s3://lab/other",
                       work="export", workers=1, progress=False)
    assert stored[0]["figures"] == table[0]["figures"]
    again = Inline()
    assert list(run(["s3://lab/run0.aedat4"], "s3://lab/other", work="export",
                    executor=again)) == list(stored)
    assert again.sent == 0
