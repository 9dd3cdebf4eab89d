"""What processes hand each other through memory: the same values, and nothing left."""
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
from pdavis_cv.fusion import handover
from pdavis_cv.fusion.handover import (
    Handed,
    Place,
    Reading,
    Shelf,
    hand_over,
    memory_for,
    taken,
)

pytestmark = pytest.mark.skipif(not Path("/dev/shm").is_dir(), reason="/dev/shm")


class HereButApart(ProcessPoolExecutor):
    """A pool whose one worker is this process, which is told as little as another."""

    def submit(self, function, /, *args):
        future = Future()
        future.set_result(function(*args))
        return future


@pytest.fixture(autouse=True)
def memory(tmp_path, monkeypatch):
    """Return the folder that stands for the memory, so that others' is left alone."""
    monkeypatch.setattr(handover, "_MEMORY", tmp_path)
    return tmp_path


def value():
    rows = np.arange(60, dtype=np.float32).reshape(6, 10)
    return {"row": rows[1:3], "column": rows[:, 2:4], "none": np.zeros((0, 3), bool),
            "text": "x", "twice": (rows, rows)}


def test_what_is_taken_equals_what_was_handed_over(memory):
    sent = hand_over(value(), str(memory / "slot"))
    assert isinstance(sent, Handed)
    assert all(start % 64 == 0 for start, _ in sent.places)
    got = taken(sent)
    for name, wanted in value().items():
        np.testing.assert_array_equal(got[name], wanted)
    assert got["twice"][0] is got["twice"][1]
    got["twice"][0][:] = -1             # changes what was taken, not what lies there
    np.testing.assert_array_equal(taken(sent)["twice"][0], value()["twice"][0])


@pytest.mark.parametrize("nothing", [None, "no arrays", []])
def test_what_has_no_arrays_is_handed_over_too(nothing, memory):
    assert taken(hand_over(nothing, str(memory / "slot"))) == nothing


def test_without_a_slot_or_room_the_value_goes_itself(memory):
    sent = value()
    assert hand_over(sent, None) is sent
    assert hand_over(sent, "/dev/full") is sent
    assert taken(sent) is sent


def planes():
    rows = np.arange(60, dtype=np.float32).reshape(6, 10)
    return [rows, rows[1:3], rows[:, 2:4], rows > 7]


@pytest.mark.parametrize("turns", [1, 2])
def test_planes_are_read_to_where_they_belong(turns, memory):
    for _ in range(turns):                          # over what lay there before
        shelf = Shelf(str(memory / "slot"))
        sent = pickle.loads(pickle.dumps([shelf.put(plane) for plane in planes()]))
        shelf.close()
    assert all(isinstance(place, Place) for place in sent)
    with Reading() as reading:
        for place, plane in zip(sent, planes(), strict=True):
            out = np.empty(place.shape, place.dtype)
            reading.into(out, place)
            np.testing.assert_array_equal(out, plane)


@pytest.mark.parametrize("slot", [None, "/dev/full", "/nowhere/slot"])
def test_planes_go_themselves_where_there_is_no_room(slot):
    shelf = Shelf(slot)
    out = np.empty((6, 10), np.float32)
    sent = shelf.put(planes()[0])
    with Reading() as reading:
        reading.into(out, sent)
    assert sent is not out
    np.testing.assert_array_equal(out, planes()[0])
    shelf.close()


def test_a_plane_that_is_cut_off_is_an_error(memory):
    shelf = Shelf(str(memory / "slot"))
    sent = shelf.put(planes()[0])
    shelf.close()
    (memory / "slot").write_bytes(b"short")
    with Reading() as reading, pytest.raises(OSError, match="must hold 240 bytes"):
        reading.into(np.empty((6, 10), np.float32), sent)


@pytest.mark.parametrize("kind", [Executor, lambda: ThreadPoolExecutor(1)])
def test_only_processes_of_this_machine_share_its_memory(kind, memory):
    with memory_for(kind()) as folder:
        assert folder is None
    with HereButApart(1) as pool, memory_for(pool) as folder:
        assert Path(folder).parent == memory
    assert list(memory.iterdir()) == []


def test_what_a_killed_process_left_is_removed_and_no_other(memory):
    code = ("import sys, time; from pathlib import Path;"
            "from concurrent.futures import ProcessPoolExecutor;"
            "from pdavis_cv.fusion import handover;"
            "handover._MEMORY = Path(sys.argv[1]);"
            "context = handover.memory_for(ProcessPoolExecutor(1));"
            "print(context.__enter__(), flush=True); time.sleep(60)")
    with subprocess.Popen([sys.executable, "-P", "-c", code, memory], text=True,
                          stdout=subprocess.PIPE) as process, HereButApart(1) as pool:
        left = Path(process.stdout.readline().strip())
        with memory_for(pool):
            assert left.is_dir()
        process.send_signal(signal.SIGKILL)
        process.wait()
        with memory_for(pool) as folder:
            assert [path.name for path in memory.iterdir()] == [Path(folder).name]


@pytest.mark.parametrize("options", [
    {"method": "frames", "fps": 80}, {"method": "cf", "fps": 80, "by_time": True}],
    ids=lambda options: options["method"])
def test_stripes_and_pieces_are_the_same_bits_through_memory(
        options, memory, monkeypatch):
    monkeypatch.setattr("pdavis_cv.fusion.stripes._IMAGES", 3)
    options = {"layout": "pdavis", "roi": (10, 20, 40, 30), **options}
    by_time = options.pop("by_time", False)
    with open_recording(example_recording()) as recording, HereButApart(1) as pool:
        shared = list(fuse(recording, executor=pool, tiles=2, by_time=by_time,
                           **options))
        alone = list(fuse(recording, **options))
    assert len(alone) > 12              # several rounds through each slot
    for one, other in zip(alone, shared, strict=True):
        assert_same_bits(one, other)
    assert list(memory.iterdir()) == []
