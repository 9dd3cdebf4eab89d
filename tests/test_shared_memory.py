"""Values that processes pass through shared memory arrive unchanged; none is left."""
import errno
import gc
import multiprocessing
import os
import pickle
import signal
from concurrent.futures import Executor, Future, ProcessPoolExecutor, ThreadPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path

import numpy as np
import pytest
import tile_workers
from test_tiles import assert_same_bits

from pdavis_cv import fuse, open_recording
from pdavis_cv.data import example_recording
from pdavis_cv.fusion import shared_memory
from pdavis_cv.fusion.shared_memory import (
    ArrayWriter,
    SharedFile,
    SharedValue,
    load_shared,
    share,
    shared_files,
)

pytestmark = pytest.mark.skipif(
    SharedFile.create() is None, reason="this system has no files in memory")

FRAMES = {"method": "frames", "fps": 80, "layout": "pdavis", "roi": (10, 20, 40, 30)}


class InProcessPool(ProcessPoolExecutor):
    """A process pool whose only worker is this process."""

    def submit(self, function, /, *args):
        future = Future()
        future.set_result(function(*args))
        return future


@pytest.fixture(autouse=True)
def _files_are_closed(monkeypatch):
    monkeypatch.setattr(SharedFile, "_opened", {})


@pytest.fixture
def writer():
    return ArrayWriter(SharedFile.create())


@pytest.fixture
def recording():
    with open_recording(example_recording()) as found:
        yield found


@pytest.fixture
def short_tasks(monkeypatch):
    """Let tasks be of three images, so that there are several rounds of them."""
    monkeypatch.setattr("pdavis_cv.fusion.stripes._IMAGES_PER_TASK", 3)


@pytest.fixture
def full(monkeypatch):
    def fail(*_):
        raise OSError(errno.ENOSPC, "No space left on device")
    monkeypatch.setattr(os, "posix_fallocate", fail)


@pytest.fixture
def received(monkeypatch):
    """Return the types of what workers sent in place of planes."""
    found, read_into = set(), ArrayWriter.read_into

    def seen(self, out, sent):
        found.add(type(sent))
        read_into(self, out, sent)
    monkeypatch.setattr(ArrayWriter, "read_into", seen)
    return found


def spawned(**more):
    return ProcessPoolExecutor(
        2, mp_context=multiprocessing.get_context("spawn"), **more)


def mapped():
    """Return how many files of this library the process has open, or mapped."""
    gc.collect()
    links = [os.readlink(entry) for entry in Path("/proc/self/fd").iterdir()
             if entry.is_symlink()]
    maps = Path("/proc/self/maps").read_text().splitlines()
    return sum("memfd:pdavis_cv" in line or "/dev/shm/#" in line
               for line in [*links, *maps])


def assert_same_images(images, recording, **options):
    count = 0
    for one, other in zip(images, fuse(recording, **options), strict=True):
        assert_same_bits(one, other)
        count += 1
    assert count > 12


def value():
    rows = np.arange(60, dtype=np.float32).reshape(6, 10)
    return {"row": rows[1:3], "column": rows[:, 2:4], "none": np.zeros((0, 3), bool),
            "text": "x", "twice": (rows, rows)}


def test_a_loaded_value_equals_what_was_shared(writer):
    writer.put(np.ones(3, np.uint8))
    sent = pickle.loads(pickle.dumps(share(value(), writer)))
    assert isinstance(sent, SharedValue)
    assert all(start % 64 == 0 for start, _ in sent.spans)
    got = load_shared(sent)
    for name, wanted in value().items():
        np.testing.assert_array_equal(got[name], wanted)
    assert got["twice"][0] is got["twice"][1]
    with pytest.raises(ValueError, match="read-only"):
        got["twice"][0][:] = -1


@pytest.mark.parametrize("nothing", [None, "no arrays", []])
def test_a_value_without_arrays_is_shared_too(nothing, writer):
    assert load_shared(share(nothing, writer)) == nothing


def test_without_a_file_the_value_itself_is_sent():
    sent = value()
    assert share(sent, ArrayWriter(None)) is sent
    assert load_shared(sent) is sent


@pytest.mark.usefixtures("full")
def test_without_room_the_value_itself_is_sent(writer):
    sent = value()
    assert share(sent, writer) is sent
    assert writer.place[1] == 0


def planes():
    rows = np.arange(60, dtype=np.float32).reshape(6, 10)
    return [rows, rows[1:3], rows[:, 2:4], rows > 7]


def test_arrays_are_read_from_where_another_writer_put_them(writer):
    place = pickle.loads(pickle.dumps(writer.place))
    other = ArrayWriter.at(*place)          # opens the file, as another process does
    sent = [other.put(plane) for plane in planes()]
    assert sent == [0, 256, 384, 448]
    for start, plane in zip(sent, planes(), strict=True):
        out = np.empty(plane.shape, plane.dtype)
        writer.read_into(out, start)
        np.testing.assert_array_equal(out, plane)


def test_a_file_that_grows_keeps_what_it_holds(writer):
    reader = ArrayWriter.at(*writer.place)
    sent = []
    for number in range(5):                 # 15 MB: two steps
        sent.append(writer.put(np.full((1000, 3000), number, np.uint8)))
        out = np.empty((1000, 3000), np.uint8)
        reader.read_into(out, sent[-1])
        assert (out == number).all()
    reader.read_into(out, sent[0])
    assert (out == 0).all()
    assert writer.file.size == 16 << 20


def test_where_a_file_cannot_be_mapped_the_array_itself_is_sent(writer, monkeypatch):
    def fail(*_):
        raise OSError(errno.EMFILE, "Too many open files")
    monkeypatch.setattr(shared_memory.mmap, "mmap", fail)
    plane = planes()[0]
    assert writer.put(plane) is plane
    assert writer.place[1] == 0


@pytest.mark.usefixtures("full")
def test_arrays_themselves_are_sent_where_there_is_no_room(writer):
    for to in (writer, ArrayWriter(None)):
        plane = planes()[0]
        sent = to.put(plane)
        assert sent is plane
        out = np.empty((6, 10), np.float32)
        to.read_into(out, sent)
        np.testing.assert_array_equal(out, plane)


def test_a_python_without_memfd_create_has_nameless_files_too(monkeypatch):
    if not Path("/dev/shm").is_dir():
        pytest.skip("this system has no /dev/shm")
    monkeypatch.delattr(os, "memfd_create", raising=False)
    before = set(Path("/dev/shm").iterdir())
    writer = ArrayWriter(SharedFile.create())
    assert load_shared(share([1, "two"], writer)) == [1, "two"]
    got = load_shared(share(planes(), writer))
    for one, other in zip(got, planes(), strict=True):
        np.testing.assert_array_equal(one, other)
    assert set(Path("/dev/shm").iterdir()) == before


def test_after_a_change_of_user_there_are_no_files(monkeypatch):
    monkeypatch.setattr(os, "geteuid", lambda: os.stat("/proc/self/fd").st_uid + 1)
    assert SharedFile.create() is None


@pytest.mark.parametrize("kind", [Executor, lambda: ThreadPoolExecutor(1)])
def test_only_processes_of_this_machine_share_its_memory(kind):
    with shared_files(kind()) as files:
        assert files.writer(0).file is None
    with InProcessPool(1) as pool, shared_files(pool) as files:
        assert files.writer(0).file is not None


def test_files_are_used_again_by_one_recording_at_a_time():
    with InProcessPool(1) as pool:
        with shared_files(pool) as files:
            first = files.writer(0).place
            assert files.writer(1).place != first
            assert files.writer(0).place == first
            with shared_files(pool) as others:
                assert others.writer(0).place != first
        with shared_files(pool) as files:
            assert files.writer(0).place == first


@pytest.mark.usefixtures("short_tasks")
def test_further_stripes_do_without_a_file(recording, received, monkeypatch):
    monkeypatch.setattr(shared_memory, "_MOST_FILES", 2)
    with InProcessPool(1) as pool:
        assert_same_images(
            fuse(recording, executor=pool, tiles=3, **FRAMES), recording, **FRAMES)
        with shared_files(pool) as files:
            assert [files.writer(index).file is None for index in range(3)] == [
                False, False, True]
    assert received == {int, np.ndarray}


def test_files_of_a_task_that_was_left_behind_are_not_lent():
    with InProcessPool(1) as pool:
        task = Future()
        with shared_files(pool) as files:
            files.used_by(task)
            left = files.writer(0).place
        with shared_files(pool) as files:
            assert files.writer(0).place != left
        task.set_result(None)
        with shared_files(pool) as files:
            assert files.writer(0).place == left


def test_a_pool_keeps_only_so_much(monkeypatch):
    monkeypatch.setattr(shared_memory, "_KEPT", 20 << 20)
    plane = np.zeros(12 << 20, np.uint8)        # 16 MiB, as files grow by 8
    with InProcessPool(1) as pool:
        with shared_files(pool) as files:
            writers = [files.writer(index) for index in range(2)]
            for writer in writers:
                writer.put(plane)
        assert [writer.file.size for writer in writers] == [16 << 20, 0]
        with shared_files(pool), shared_files(pool) as others:
            others.writer(0).put(plane)
        # Of two recordings at a time, it keeps the files of the one that ended last.
        assert others.writer(0).file.size == 0
        assert writers[0].file.size == 16 << 20
        with shared_files(pool) as files:
            assert files.writer(1).put(plane) == 0      # it grows again


def test_files_are_gone_with_their_pool():
    before = mapped()
    pool = InProcessPool(1)
    with shared_files(pool) as files:
        writer = files.writer(0)
        writer.put(planes()[0])
    assert mapped() > before
    file = os.dup(writer.file._file)            # as a process that was forked has it
    del pool, files, writer
    assert mapped() == before + 1
    assert os.fstat(file).st_size == 0
    os.close(file)


@pytest.mark.parametrize("options", [
    FRAMES, {**FRAMES, "method": "cf", "by_time": True}],
    ids=lambda options: options["method"])
@pytest.mark.usefixtures("short_tasks")
def test_stripes_and_pieces_are_the_same_bits_through_memory(options, recording):
    how = {"by_time": options.get("by_time", False), "tiles": 2}
    options = {name: options[name] for name in FRAMES}
    with InProcessPool(1) as pool:
        for _ in range(2):
            assert_same_images(
                fuse(recording, executor=pool, **how, **options), recording, **options)


@pytest.mark.parametrize("start", multiprocessing.get_all_start_methods())
@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
@pytest.mark.usefixtures("short_tasks")
def test_processes_make_the_same_bits_and_leave_nothing(start, recording):
    context = multiprocessing.get_context(start)
    with ProcessPoolExecutor(2, mp_context=context) as pool:
        pool.submit(int).result()       # starts helpers of this process, which stay
    del pool
    before, open_before = mapped(), len(os.listdir("/proc/self/fd"))
    with ProcessPoolExecutor(2, mp_context=context) as pool:
        images = fuse(recording, executor=pool, tiles=2, **FRAMES)
        image = next(images)
        kept = image.quad.copy()
        images.close()                          # while tasks go on
        both = zip(fuse(recording, executor=pool, tiles=2, **FRAMES),
                   fuse(recording, executor=pool, tiles=3, **FRAMES), strict=True)
        images = []
        for one, other in both:
            assert_same_bits(one, other)
            images.append(one)
        # Those that are kept stay as they were while later ones were made.
        assert_same_images(images, recording, **FRAMES)
        np.testing.assert_array_equal(image.quad, kept)
    del pool, both
    assert mapped() == before
    assert len(os.listdir("/proc/self/fd")) == open_before


@pytest.mark.usefixtures("short_tasks")
def test_where_workers_have_no_room_images_are_the_same(
        recording, received, monkeypatch):
    monkeypatch.setattr(shared_memory, "_GROWTH", 64)   # none left by this process
    with spawned(initializer=tile_workers.no_room) as pool:
        assert_same_images(
            fuse(recording, executor=pool, tiles=2, **FRAMES), recording, **FRAMES)
    assert np.ndarray in received


@pytest.mark.usefixtures("short_tasks", "full")
def test_where_only_workers_have_room_images_are_the_same(recording, received):
    with spawned() as pool:
        assert_same_images(
            fuse(recording, executor=pool, tiles=2, **FRAMES), recording, **FRAMES)
    assert received == {int}


def test_an_error_in_a_worker_is_raised_here(recording):
    before = mapped()
    with spawned(initializer=tile_workers.cannot_read) as pool:
        for _ in range(2):                      # the pool goes on
            with pytest.raises(RuntimeError, match="cannot read"):
                next(fuse(recording, executor=pool, tiles=2, **FRAMES))
    del pool
    assert mapped() == before


@pytest.mark.usefixtures("short_tasks")
def test_a_killed_worker_is_an_error_and_leaves_nothing(recording):
    before = mapped()
    with spawned() as pool:
        images = fuse(recording, executor=pool, tiles=2, **FRAMES)
        next(images)
        os.kill(next(iter(pool._processes)), signal.SIGKILL)
        with pytest.raises(BrokenProcessPool):
            list(images)
    del pool, images
    assert mapped() == before


@pytest.mark.gate
@pytest.mark.usefixtures("short_tasks")
def test_loky_makes_the_same_bits(recording):
    loky = pytest.importorskip("loky")
    with loky.ProcessPoolExecutor(2) as pool:
        assert_same_images(
            fuse(recording, executor=pool, tiles=2, **FRAMES), recording, **FRAMES)
