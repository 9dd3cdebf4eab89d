"""Threads that share the work of images: the same bits, bands, exceptions, forks."""
import gc
import multiprocessing
import pickle
import threading
import weakref
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from pdavis_cv import FusionOptions, fuse
from pdavis_cv._workers import BANDS, LEAST_BAND_NS, LEAST_ROWS, Workers, usable_cores
from pdavis_cv.simulation import FULL, Camera, RotatingPolarizer

PATIENCE_S = 60     # longer than a loaded machine takes; nothing is asserted of time
OPTIONS = [{"method": "cf"}, {"method": "kalman"},
           {"method": "kalman", "mode": "offline"},
           {"method": "events", "offsets": "redundancy"},
           {"method": "kalman", "causal": True, "denoise": True}]
FORKS = [pytest.mark.skipif("fork" not in multiprocessing.get_all_start_methods(),
                            reason="this system does not fork"),
         pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")]


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
    monkeypatch.setattr("pdavis_cv.fusion.iteration.LEAST_PIXELS", 0)
    monkeypatch.setattr("pdavis_cv.reconstruct.kalman.saturation.COLUMNS", 3)
    want, *others = (
        list(fuse(tall, fps=60, thresholds=(0.15, 0.15), threads=n, **options))
        for n in (1, 2, 8))
    for got in others:
        assert len(got) == len(want) > 10
        for one, other in zip(want, got, strict=True):
            for name in ("quad", "aop", "dolp", "valid"):
                np.testing.assert_array_equal(getattr(one, name), getattr(other, name))
            if one.variance is not None:
                np.testing.assert_array_equal(one.variance, other.variance)


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
    most = BANDS * threads if threads > 1 else 1
    assert len(bands) == max(min(most, height // LEAST_ROWS), 1)


@pytest.mark.parametrize(("row_ns", "bands"), [
    (LEAST_BAND_NS, 6), (LEAST_BAND_NS / 50, 2), (LEAST_BAND_NS / 51, 1)])
def test_bands_take_as_long_as_their_hand_over(row_ns, bands):
    done = []
    Workers(4).rows(100, lambda first, last: done.append(last - first), row_ns=row_ns)
    assert len(done) == bands


def test_two_threads_are_at_work_at_the_same_time():
    together = threading.Barrier(2)
    Workers(2).rows(2 * LEAST_ROWS, lambda first, last: together.wait(PATIENCE_S))


def test_nobody_waits_for_a_thread_that_is_busy():
    workers, busy, free = Workers(2), threading.Event(), threading.Event()

    def long():
        busy.set()
        assert free.wait(PATIENCE_S)
        return threading.get_ident()

    first = workers.begin(long)
    assert busy.wait(PATIENCE_S)
    assert workers.begin(threading.get_ident).result() == threading.get_ident()
    done = []
    workers.rows(100, lambda first, last: done.append(last - first))
    assert sum(done) == 100
    free.set()
    assert first.result() != threading.get_ident()


@pytest.mark.parametrize("at", [0, 32, 48])
def test_what_a_band_raises_is_raised_when_no_other_is_at_work(at):
    at_work = []

    def work(first, last):
        at_work.append(first)
        try:
            if first == at:
                raise ValueError(f"row {first}")
        finally:
            at_work.remove(first)

    workers = Workers(2)
    gone = weakref.ref(workers)
    with pytest.raises(ValueError, match=f"row {at}") as caught:
        workers.rows(64, work)
    assert not at_work
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


def _in_a_child(workers, begun, queue):
    done = []
    workers.rows(64, lambda first, last: done.append(last - first))
    queue.put((sum(done), begun.result()))


@FORKS[0]
@FORKS[1]
def test_a_forked_child_does_its_parents_work_and_starts_threads_of_its_own():
    workers, free = Workers(2), threading.Event()
    busy = workers.begin(lambda: free.wait(PATIENCE_S))
    waiting = workers.begin(lambda: "done")
    context = multiprocessing.get_context("fork")
    queue = context.SimpleQueue()
    child = context.Process(target=_in_a_child, args=(workers, waiting, queue))
    child.start()
    child.join(PATIENCE_S)
    assert not child.is_alive()
    assert queue.get() == (64, "done")
    free.set()
    assert busy.result()
    assert waiting.result() == "done"


def test_threads_end_and_start_again(threads_ended):
    workers = Workers(3)
    for _ in range(2):
        assert workers.begin(lambda: 7).result() == 7
        workers.end()
        assert threads_ended()


@pytest.mark.parametrize("threads", [0, -1, 1.5, "two"])
def test_threads_must_be_a_whole_number_from_1(threads):
    with pytest.raises(ValueError, match="threads must be a whole number from 1, got"):
        FusionOptions(threads=threads)


def test_there_is_a_core_to_work_on():
    assert usable_cores() >= 1
