"""Values that processes pass through shared memory arrive unchanged; none is left."""
import pickle
import signal
import subprocess
import sys
from concurrent.futures import Executor, Future, ProcessPoolExecutor, ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from test_tiles import assert_same_bits

from pdavis_cv import fuse, open_recording
from pdavis_cv.data import example_recording
from pdavis_cv.fusion import shared_memory
from pdavis_cv.fusion.shared_memory import (
    ArrayReader,
    ArrayWriter,
    SharedArray,
    SharedValue,
    load_shared,
    share,
    shared_folder,
)

pytestmark = pytest.mark.skipif(not Path("/dev/shm").is_dir(), reason="/dev/shm")


class InProcessPool(ProcessPoolExecutor):
    """A process pool whose only worker is this process."""

    def submit(self, function, /, *args):
        future = Future()
        future.set_result(function(*args))
        return future


@pytest.fixture(autouse=True)
def memory(tmp_path, monkeypatch):
    """Return a folder used in place of /dev/shm, which is left alone."""
    monkeypatch.setattr(shared_memory, "_MEMORY", tmp_path)
    return tmp_path


def value():
    rows = np.arange(60, dtype=np.float32).reshape(6, 10)
    return {"row": rows[1:3], "column": rows[:, 2:4], "none": np.zeros((0, 3), bool),
            "text": "x", "twice": (rows, rows)}


def test_a_loaded_value_equals_what_was_shared(memory):
    sent = share(value(), str(memory / "file"))
    assert isinstance(sent, SharedValue)
    assert all(start % 64 == 0 for start, _ in sent.spans)
    got = load_shared(sent)
    for name, wanted in value().items():
        np.testing.assert_array_equal(got[name], wanted)
    assert got["twice"][0] is got["twice"][1]
    got["twice"][0][:] = -1             # changes the loaded copy, not the file
    np.testing.assert_array_equal(load_shared(sent)["twice"][0], value()["twice"][0])


@pytest.mark.parametrize("nothing", [None, "no arrays", []])
def test_a_value_without_arrays_is_shared_too(nothing, memory):
    assert load_shared(share(nothing, str(memory / "file"))) == nothing


def test_without_a_path_or_room_the_value_itself_is_sent(memory):
    sent = value()
    assert share(sent, None) is sent
    assert share(sent, "/dev/full") is sent
    assert load_shared(sent) is sent


def planes():
    rows = np.arange(60, dtype=np.float32).reshape(6, 10)
    return [rows, rows[1:3], rows[:, 2:4], rows > 7]


@pytest.mark.parametrize("turns", [1, 2])
def test_arrays_are_read_into_their_destination(turns, memory):
    for _ in range(turns):                          # the second time over the first
        writer = ArrayWriter(str(memory / "file"))
        sent = pickle.loads(pickle.dumps([writer.put(plane) for plane in planes()]))
        writer.close()
    assert all(isinstance(place, SharedArray) for place in sent)
    with ArrayReader() as reader:
        for place, plane in zip(sent, planes(), strict=True):
            out = np.empty(place.shape, place.dtype)
            reader.read_into(out, place)
            np.testing.assert_array_equal(out, plane)


@pytest.mark.parametrize("path", [None, "/dev/full", "/nowhere/file"])
def test_arrays_themselves_are_sent_where_there_is_no_room(path):
    writer = ArrayWriter(path)
    out = np.empty((6, 10), np.float32)
    sent = writer.put(planes()[0])
    with ArrayReader() as reader:
        reader.read_into(out, sent)
    assert sent is not out
    np.testing.assert_array_equal(out, planes()[0])
    writer.close()


def test_a_truncated_array_is_an_error(memory):
    writer = ArrayWriter(str(memory / "file"))
    sent = writer.put(planes()[0])
    writer.close()
    (memory / "file").write_bytes(b"short")
    with ArrayReader() as reader, pytest.raises(OSError, match="must hold 240 bytes"):
        reader.read_into(np.empty((6, 10), np.float32), sent)


@pytest.mark.parametrize("kind", [Executor, lambda: ThreadPoolExecutor(1)])
def test_only_processes_of_this_machine_share_its_memory(kind, memory):
    with shared_folder(kind()) as folder:
        assert folder is None
    with InProcessPool(1) as pool, shared_folder(pool) as folder:
        assert Path(folder).parent == memory
    assert list(memory.iterdir()) == []


def test_folders_of_killed_processes_are_removed_and_no_others(memory):
    code = ("import sys, time; from pathlib import Path;"
            "from concurrent.futures import ProcessPoolExecutor;"
            "from pdavis_cv.fusion import shared_memory;"
            "shared_memory._MEMORY = Path(sys.argv[1]);"
            "context = shared_memory.shared_folder(ProcessPoolExecutor(1));"
            "print(context.__enter__(), flush=True); time.sleep(60)")
    with subprocess.Popen([sys.executable, "-P", "-c", code, memory], text=True,
                          stdout=subprocess.PIPE) as process, InProcessPool(1) as pool:
        left = Path(process.stdout.readline().strip())
        with shared_folder(pool):
            assert left.is_dir()
        process.send_signal(signal.SIGKILL)
        process.wait()
        with shared_folder(pool) as folder:
            assert [path.name for path in memory.iterdir()] == [Path(folder).name]


@pytest.mark.parametrize("options", [
    {"method": "frames", "fps": 80}, {"method": "cf", "fps": 80, "by_time": True}],
    ids=lambda options: options["method"])
def test_stripes_and_pieces_are_the_same_bits_through_memory(
        options, memory, monkeypatch):
    monkeypatch.setattr("pdavis_cv.fusion.stripes._IMAGES_PER_TASK", 3)
    options = {"layout": "pdavis", "roi": (10, 20, 40, 30), **options}
    by_time = options.pop("by_time", False)
    with open_recording(example_recording()) as recording, InProcessPool(1) as pool:
        shared = list(fuse(recording, executor=pool, tiles=2, by_time=by_time,
                           **options))
        alone = list(fuse(recording, **options))
    assert len(alone) > 12              # several rounds through each file
    for one, other in zip(alone, shared, strict=True):
        assert_same_bits(one, other)
    assert list(memory.iterdir()) == []
