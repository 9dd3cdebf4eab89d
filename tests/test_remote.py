"""Recordings in object storage: read by ranges, the same as from a disk."""
import os
import pickle
from pathlib import Path

import numpy as np
import pytest
from test_batch import run, write

from pdavis_cv import RecordingError, open_recording
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
