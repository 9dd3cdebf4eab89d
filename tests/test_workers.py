import gc
import multiprocessing
import os
import pickle
import sys
import threading
import time
import weakref
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from pdavis_cv import FusionOptions, _workers, fuse
from pdavis_cv._workers import (
    LEAST_BAND_NS,
    LEAST_ROWS,
    SpareTime,
    Workers,
    take_turn,
    usable_cores,
    yield_to_others,
)
from pdavis_cv.simulation import FULL, Camera, RotatingPolarizer

OPTIONS = [{"method": "cf"}, {"method": "kalman"},
           {"method": "kalman", "mode": "offline"},
           {"method": "events", "offsets": "redundancy"},
           {"method": "kalman", "causal": True, "denoise": True}]


@pytest.fixture(scope="module", params=[1, 300], ids=["moderate", "saturated"])
def tall(request):
    camera = Camera.preset("nominal", size=(4 * LEAST_ROWS, 6))
    recording, _ = camera.record(
        RotatingPolarizer(rpm=240, s0=request.param * FULL), 0.3)
    return recording


@pytest.mark.parametrize("options", OPTIONS, ids=str)
def test_images_have_the_same_bits_for_any_number_of_threads(
        tall, options, monkeypatch):
    monkeypatch.setattr("pdavis_cv._workers.LEAST_BAND_NS", 0)   # share all there is
    monkeypatch.setattr("pdavis_cv.reconstruct.kalman.saturation.COLUMNS", 3)
    want, *others = (
        list(fuse(tall, fps=150, thresholds=(0.15, 0.15), threads=n, **options))
        for n in (1, 2, 8))
    for got in others:
        assert len(got) == len(want) > 10
        for one, other in zip(want, got, strict=True):
            for name in ("quad", "aop", "dolp", "valid"):
                np.testing.assert_array_equal(getattr(one, name), getattr(other, name))
            if one.variance is not None:
                np.testing.assert_array_equal(one.variance, other.variance)


def of_the_second_thread(threads_before):
    """Return the cores that the thread started since may use."""
    new, = (thread for thread in threading.enumerate()
            if thread.name == "pdavis_cv-images" and thread not in threads_before)
    return os.sched_getaffinity(new.native_id)


@pytest.mark.skipif(sys.platform != "linux" or usable_cores() < 2,
                    reason="cores can be chosen under Linux; needs two")
def test_the_second_thread_is_kept_off_the_core_of_the_first(tall):
    mine = os.sched_getaffinity(0)
    before = threading.enumerate()
    try:
        images = fuse(tall, fps=150, thresholds=(0.15, 0.15), threads=2)
        next(images)
        for core in mine:
            # A core is looked at again at once when the first thread has moved.
            os.sched_setaffinity(0, {core})
            os.sched_setaffinity(0, mine)
            for _ in range(3):
                next(images)
            theirs = of_the_second_thread(before)
            assert theirs < mine
            assert len(theirs) == len(mine) - 1
    finally:
        os.sched_setaffinity(0, mine)


@pytest.mark.skipif(sys.platform != "linux", reason="cores can be chosen under Linux")
def test_on_one_core_nothing_is_left_to_a_second_thread(tall, monkeypatch):
    mine = os.sched_getaffinity(0)
    posted = []

    class Noted(_workers.ImageQueue):
        def post(self, *args):
            posted.append(args)
            return super().post(*args)

    monkeypatch.setattr(_workers, "ImageQueue", Noted)
    try:
        os.sched_setaffinity(0, {min(mine)})
        images = fuse(tall, fps=150, thresholds=(0.15, 0.15), threads=2)
        posted.append(None)
        while posted:           # until the thread has started
            posted.clear()
            next(images)
            time.sleep(0.01)
        assert len(list(images)) > 10
        assert not posted
    finally:
        os.sched_setaffinity(0, mine)


@pytest.mark.parametrize("threads", [1, 2, 3, 8])
@pytest.mark.parametrize("height", [0, 1, 31, 32, 33, 260])
def test_bands_are_the_rows_of_the_image_in_as_many_threads_at_most(threads, height):
    bands, seen = [], set()

    def work(first, last):
        bands.append((first, last))
        seen.add(threading.get_ident())

    Workers(threads).rows(height, work)
    assert [row for band in sorted(bands) for row in range(*band)] == [*range(height)]
    assert len(seen) <= threads
    assert len(bands) == max(min(threads, height // LEAST_ROWS), 1)


@pytest.mark.parametrize(("row_ns", "bands"), [
    (LEAST_BAND_NS, 4), (LEAST_BAND_NS / 50, 2), (LEAST_BAND_NS / 51, 1)])
def test_bands_take_as_long_as_their_hand_over(row_ns, bands):
    done = []
    Workers(4).rows(100, lambda first, last: done.append(last - first), row_ns=row_ns)
    assert len(done) == bands


def test_what_a_band_raises_is_raised():
    def work(first, last):
        if first:
            raise ValueError(f"row {first}")

    workers = Workers(2)
    gone = weakref.ref(workers)
    with pytest.raises(ValueError, match="row 32") as caught:
        workers.rows(64, work)
    gc.collect()
    gc.disable()
    try:
        del caught, workers
        assert gone() is None
    finally:
        gc.enable()


def test_several_threads_may_share_workers_and_a_copy_works_on():
    workers = pickle.loads(pickle.dumps(Workers(3)))

    def total(_):
        done = []
        workers.rows(100, lambda first, last: done.append(last - first))
        return sum(done)

    with ThreadPoolExecutor(4) as pool:
        assert list(pool.map(total, range(50))) == [100] * 50


def _rows_in_a_child(workers, queue):
    done = []
    workers.rows(64, lambda first, last: done.append(last - first))
    queue.put(sum(done))


@pytest.mark.skipif("fork" not in multiprocessing.get_all_start_methods(),
                    reason="this system does not fork")
@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
def test_a_forked_child_starts_threads_of_its_own():
    workers = Workers(2)
    workers.rows(64, lambda first, last: None)
    context = multiprocessing.get_context("fork")
    queue = context.SimpleQueue()
    child = context.Process(target=_rows_in_a_child, args=(workers, queue))
    child.start()
    child.join(20)
    assert not child.is_alive()
    assert queue.get() == 64


@pytest.mark.parametrize("threads", [0, -1, 1.5, "two"])
def test_threads_must_be_a_whole_number_from_1(threads):
    with pytest.raises(ValueError, match="threads must be a whole number from 1, got"):
        FusionOptions(threads=threads)


@pytest.mark.skipif(sys.platform != "linux", reason="threads have no priority")
@pytest.mark.parametrize("allowed", [True, False])
def test_a_thread_that_yields_lowers_its_own_priority_only(monkeypatch, allowed):
    def refuse(*_):
        raise PermissionError(1, "not here")

    def own():
        yield_to_others()
        return os.getpriority(os.PRIO_PROCESS, threading.get_native_id())

    before = os.getpriority(os.PRIO_PROCESS, threading.get_native_id())
    if not allowed:
        monkeypatch.setattr(os, "setpriority", refuse)
    with ThreadPoolExecutor(1) as pool:
        assert pool.submit(own).result() == (max(before, 10) if allowed else before)
    assert os.getpriority(os.PRIO_PROCESS, threading.get_native_id()) == before


def test_time_is_spare_while_the_next_item_is_waited_for():
    spare, while_waiting = SpareTime(), []

    def source():
        for number in range(3):
            while_waiting.append(spare._spare.is_set())
            yield number

    for _ in spare.of(source()):
        assert not spare._spare.is_set()
    assert while_waiting == [True] * 3
    assert spare._spare.is_set()
    left = spare.of(iter([1, 2]))
    assert next(left) == 1
    left.close()
    assert spare._spare.is_set()


def test_work_waits_for_spare_time_but_not_for_long(monkeypatch):
    now, spare, waited = iter([10.0, 12.0, 20.0, 20.5, 22.5]), SpareTime(), []
    monkeypatch.setattr(_workers.time, "perf_counter", lambda: next(now))
    monkeypatch.setattr(spare, "wait", waited.append)

    def work():
        yield_to_others(spare)  # at 10 s
        take_turn()             # after 2 s of work
        take_turn()             # .5 s after that wait

    with ThreadPoolExecutor(1) as pool:
        pool.submit(work).result()
    assert waited == [8.0, 2.0]
    take_turn()                 # this thread does not yield


@pytest.mark.parametrize("ended", [False, True])
def test_a_wait_for_spare_time_ends(ended):
    spare = SpareTime()
    busy = spare.of(iter([1]))
    next(busy)
    if ended:
        spare.end()
    longest_s = 600.0 if ended else 1e-3
    begin_s = time.monotonic()
    spare.wait(longest_s)
    assert spare._spare.is_set() == ended
    assert time.monotonic() - begin_s < 60


def test_there_is_a_core_to_work_on():
    assert usable_cores() >= 1
