"""Images that a second thread finishes: the same bits, in order, and no thread left."""
import gc
import multiprocessing
import os
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from itertools import islice

import numpy as np
import pytest

from pdavis_cv import (
    Calibration,
    Layout,
    _kernels,
    fuse,
    open_recording,
    source_from_packets,
)
from pdavis_cv._kernels import ImageQueue
from pdavis_cv._workers import Workers
from pdavis_cv.analyser import Analyser
from pdavis_cv.data import example_recording
from pdavis_cv.fusion.iteration import DEPTH, ReadAhead
from pdavis_cv.mosaic import places_of, scratch_rows
from pdavis_cv.recording.base import RecordingInfo
from pdavis_cv.simulation import FULL, Camera, RotatingPolarizer

SHAPES = [(2, 2), (3, 5), (17, 33), (64, 70)]
IDEAL = np.ascontiguousarray(Analyser.ideal().null().reshape(4, 1, 1), np.float32)
SPREAD = np.array([0.02, 0.012, 0.004], np.float32)


def samples(shape, seed=0):
    """Return log intensity and its variance."""
    rng = np.random.default_rng(seed)
    return (rng.normal(3, 1, shape).astype(np.float32),
            rng.uniform(1e-4, 1e-1, shape).astype(np.float32))


def planes(shape):
    """Return arrays for channels, variances, angle and degree."""
    return *np.full((2, 4, *shape), np.nan, np.float32), *np.full(
        (2, *shape), np.nan, np.float32)


def expected(log, variance, gain):
    """Return what the kernels give one after another."""
    quad, out, aop, dolp = planes(log.shape)
    mosaic = np.empty_like(log)
    _kernels.exp(log, mosaic)
    _kernels.bilinear_weighted(
        mosaic, variance, places_of(Layout.PDAVIS), SPREAD, IDEAL, (0, len(log)),
        scratch_rows(2, log.shape[1]), quad, out)
    _kernels.aop_dolp(quad.reshape(4, -1), gain, aop.ravel(), dolp.ravel())
    return quad, out, aop, dolp


def post(queue, log, variance, got, gain=1.02, mosaic=None):
    """Post an image: of log intensity, or of the mosaic if there is one."""
    quad, out, aop, dolp = got
    return queue.post(
        log if mosaic is None else None,
        np.empty_like(log) if mosaic is None else mosaic, variance,
        places_of(Layout.PDAVIS), SPREAD, IDEAL, scratch_rows(6, log.shape[1]), quad,
        out, gain, aop, dolp)


@pytest.fixture
def served():
    """A queue with a thread that finishes its images."""
    queue = ImageQueue()
    thread = threading.Thread(target=queue.serve)
    thread.start()
    yield queue
    queue.end()
    thread.join(20)
    assert not thread.is_alive()


@pytest.mark.parametrize("with_log", [True, False])
@pytest.mark.parametrize("shape", SHAPES)
def test_a_queue_finishes_images_in_the_order_of_their_numbers(
        served, shape, with_log):
    for k in range(20):
        log, variance = samples(shape, k)
        mosaic = None
        if not with_log:
            mosaic = np.empty_like(log)
            _kernels.exp(log, mosaic)
        got = planes(shape)
        while served.late:      # the thread has to leave a slot
            time.sleep(1e-3)
        assert post(served, log, variance, got, mosaic=mosaic) == k
        served.wait(k)
        for mine, other in zip(got, expected(log, variance, 1.02), strict=True):
            np.testing.assert_array_equal(mine, other)


def test_waiting_for_a_later_image_waits_for_all_before(served):
    log, variance = samples((64, 70))
    many = [planes(log.shape) for _ in range(10)]
    numbers = [post(served, log, variance, got) for got in many]
    served.wait(numbers[-1])
    for got in many:
        assert not np.isnan(got[3]).any()


def test_who_waits_takes_part_in_the_work():
    queue = ImageQueue()    # without a thread in `serve`
    log, variance = samples((64, 70))
    got = planes(log.shape)
    queue.wait(post(queue, log, variance, got))
    for mine, other in zip(got, expected(log, variance, 1.02), strict=True):
        np.testing.assert_array_equal(mine, other)
    assert not queue.late
    for _ in range(14):     # as nobody is in `serve`, the slots are used up
        queue.wait(post(queue, log, variance, planes(log.shape)))
    assert queue.late
    with pytest.raises(ValueError, match="neither full nor ended"):
        post(queue, log, variance, got)


def test_nothing_is_left_to_a_thread_without_a_processor(turning, monkeypatch):
    class Late:
        late = True

    fusion = fuse(turning, fps=100)
    assert fusion.advance()
    want = fusion.image()
    monkeypatch.setattr(Workers, "queue", Late())
    got = fusion.image()
    for name in ("quad", "aop", "variance"):
        np.testing.assert_array_equal(getattr(got, name), getattr(want, name))


def test_a_queue_is_bounded_and_checks_what_it_is_handed():
    queue = ImageQueue()
    log, variance = samples((4, 6))
    with pytest.raises(ValueError, match="that was posted"):
        queue.wait(0)
    for name, bad in (("aop and dolp", (*planes((4, 6))[:3], planes((4, 5))[3])),
                      ("quad and out", (planes((5, 6))[0], *planes((4, 6))[1:]))):
        with pytest.raises(ValueError, match=name):
            post(queue, log, variance, bad)
    with pytest.raises(ValueError, match="log must have"):
        queue.post(log[:3], log.copy(), variance, places_of(Layout.PDAVIS), SPREAD,
                   IDEAL, scratch_rows(6, 6), *planes((4, 6))[:2], 1.0,
                   *planes((4, 6))[2:])
    with pytest.raises(ValueError, match="scratch must"):
        queue.post(log, log.copy(), variance, places_of(Layout.PDAVIS), SPREAD, IDEAL,
                   scratch_rows(2, 6), *planes((4, 6))[:2], 1.0, *planes((4, 6))[2:])
    many = [planes((4, 6)) for _ in range(15)]
    for got in many:
        post(queue, log, variance, got)
    with pytest.raises(ValueError, match="neither full nor ended"):
        post(queue, log, variance, planes((4, 6)))
    queue.finish_here()
    for got in many:
        np.testing.assert_array_equal(got[2], expected(log, variance, 1.02)[2])
    with pytest.raises(ValueError, match="neither full nor ended"):
        post(queue, log, variance, planes((4, 6)))


@pytest.fixture(scope="module")
def turning():
    camera = Camera.preset("nominal", size=(32, 36))
    return camera.record(RotatingPolarizer(rpm=240, s0=FULL), 0.3)[0]


def calibrated(turning):
    shape = turning.info.sensor_size
    rng = np.random.default_rng(3)
    return Calibration(layout=Layout.PDAVIS, sensor_size=shape,
                       gain=rng.uniform(0.9, 1.1, shape).astype(np.float32))


@pytest.mark.parametrize("options", [
    {}, {"causal": True}, {"mode": "offline"}, {"denoise": True},
    {"demosaic": "superpixel"}, {"demosaic": "guided"}, {"roi": (3, 5, 20, 10)},
    {"extinction_ratio": None}, {"method": "frames"}, {"method": "cf"},
    {"method": "events", "offsets": "redundancy"}, {"calibrated": True}], ids=str)
def test_images_of_two_threads_are_those_of_one(turning, options):
    options = {"method": "kalman", "fps": 150, **options}
    if options.pop("calibrated", False):
        options["calibration"] = calibrated(turning)
    one, two = (list(fuse(turning, threads=n, **options)) for n in (1, 2))
    assert len(one) == len(two) > 10
    for mine, other in zip(one, two, strict=True):
        assert (mine.t_us, mine.frame_us) == (other.t_us, other.frame_us)
        assert str(mine.provenance) == str(other.provenance)
        for name in ("quad", "aop", "dolp", "valid", "variance", "sigma_aop"):
            one_of, other_of = getattr(mine, name), getattr(other, name)
            assert (one_of is None) == (other_of is None)
            if one_of is not None:
                np.testing.assert_array_equal(one_of, other_of)


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="needs Linux")
def test_two_threads_on_one_core_give_the_same_images(turning):
    def images(threads):
        return [(image.quad, image.aop) for image in islice(
            fuse(turning, fps=1000, threads=threads), 40)]

    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {min(before)})      # of the thread that is started as well
    try:
        got = images(2)
    finally:
        os.sched_setaffinity(0, before)
    for mine, other in zip(got, images(1), strict=True):
        for one, two in zip(mine, other, strict=True):
            np.testing.assert_array_equal(one, two)


def test_arrays_of_images_of_two_threads_are_read_only(turning):
    image = next(fuse(turning, threads=2, fps=100))
    for array in (image.quad, image.aop, image.dolp, image.variance):
        assert not array.flags.writeable


class Breaking:
    """A Fusion that fails at its n-th image."""

    def __init__(self, fusion, n):
        self._fusion, self._left = fusion, n

    def advance(self):
        self._left -= 1
        if self._left == 0:
            raise OSError("the disk is gone")
        return self._fusion.advance()

    def begin_image(self):
        return self._fusion.begin_image()

    def close(self):
        self._fusion.close()


@pytest.mark.parametrize("n", [1, 2, 3, 4, 9])
def test_an_error_is_raised_after_the_images_that_precede_it(turning, n):
    images = ReadAhead(Breaking(fuse(turning, fps=100), n))
    assert len(list(islice(images, n - 1))) == n - 1
    with pytest.raises(OSError, match="the disk is gone"):
        next(images)
    assert next(images).t_us is not None


def test_the_first_image_is_not_delayed_by_others(turning):
    class Counting(Breaking):
        count = 0

        def advance(self):
            self.count += 1
            return self._fusion.advance()

    fusion = Counting(fuse(turning, fps=100), 0)
    images = ReadAhead(fusion)
    read = []
    for _ in range(6):
        next(images)
        read.append(fusion.count)
    assert read == [1, 3, 4, 5, 6, 7]
    assert DEPTH == 2


def threads_of_images():
    return [thread for thread in threading.enumerate()
            if thread.name == "pdavis_cv-images"]


def test_no_thread_is_left_at_the_end_or_when_nobody_goes_on(turning):
    gc.collect()
    images = fuse(turning, threads=2, fps=100)
    assert not threads_of_images()
    next(images)
    assert len(threads_of_images()) == 1
    for _ in images:
        pass
    assert not threads_of_images()
    with pytest.raises(StopIteration):
        next(images)
    images = fuse(turning, threads=2, fps=100)
    next(images)
    next(images)
    del images
    gc.collect()
    assert not threads_of_images()


def test_a_source_that_is_read_once_is_not_read_ahead(turning):
    info = RecordingInfo(format="x", sensor_size=turning.info.sensor_size,
                         layout=Layout.PDAVIS)
    for source, kind in ((turning, ReadAhead), (
            source_from_packets(info, turning.packets()), object)):
        images = fuse(source, threads=2, fps=100, method="cf")
        assert isinstance(images, ReadAhead) == (kind is ReadAhead)


@pytest.mark.parametrize("options", [{}, {"causal": True}, {"mode": "offline"}])
def test_two_threads_share_the_images_of_a_source(turning, options):
    gc.collect()
    info = RecordingInfo(format="x", sensor_size=turning.info.sensor_size,
                         layout=Layout.PDAVIS)

    def images(threads):
        return fuse(source_from_packets(info, turning.packets()), threads=threads,
                    fps=100, method="kalman", thresholds=(0.15, 0.15), **options)

    two = images(2)
    next(two)
    assert len(threads_of_images()) == 1
    rest = list(two)
    two.close()
    assert not threads_of_images()
    want = list(images(1))[1:]
    assert len(rest) == len(want) > 10
    for mine, other in zip(rest, want, strict=True):
        for name in ("quad", "aop", "dolp", "variance", "valid"):
            np.testing.assert_array_equal(getattr(mine, name), getattr(other, name))


@pytest.mark.gate
def test_eight_threads_may_share_an_iterator():
    with open_recording(example_recording()) as recording:
        options = {"layout": Layout.PDAVIS, "fps": 300, "method": "kalman"}
        want = [image.aop for image in fuse(recording, **options)]
        images = fuse(recording, threads=2, **options)
        with ThreadPoolExecutor(8) as pool:
            got = [image for part in pool.map(lambda _: list(images), range(8))
                   for image in part]
    got.sort(key=lambda image: image.t_us)
    assert len(got) == len(want)
    for mine, other in zip(got, want, strict=True):
        np.testing.assert_array_equal(mine.aop, other)


def _rest_of(images, queue):
    queue.put([image.aop for image in images])


@pytest.mark.skipif("fork" not in multiprocessing.get_all_start_methods(),
                    reason="this system does not fork")
@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
def test_a_forked_child_goes_on_with_a_thread_of_its_own(turning):
    want = [image.aop for image in fuse(turning, fps=100)]
    images = fuse(turning, fps=100, threads=2)
    for _ in range(5):
        next(images)
    context = multiprocessing.get_context("fork")
    queue = context.Queue()
    child = context.Process(target=_rest_of, args=(images, queue))
    child.start()
    got = queue.get(timeout=60)
    child.join(20)
    assert child.exitcode == 0
    mine = [image.aop for image in images]
    for rest in (got, mine):
        assert len(rest) == len(want) - 5
        for one, other in zip(rest, want[5:], strict=True):
            np.testing.assert_array_equal(one, other)


def test_a_program_may_end_while_images_are_in_work():
    program = """
import pdavis_cv
from pdavis_cv.data import example_recording
recording = pdavis_cv.open_recording(example_recording())
images = pdavis_cv.fuse(recording, fps=1000, threads=2,
                        layout=pdavis_cv.Layout.PDAVIS)
for _ in range(9):
    image = next(images)
"""
    for _ in range(3):
        run = subprocess.run([sys.executable, "-P", "-c", program],
                             capture_output=True, text=True, timeout=60, check=False)
        assert (run.returncode, run.stdout, run.stderr) == (0, "", "")
