"""Images that another thread makes: the same bits, in order, and no thread left."""
import gc
import multiprocessing
import subprocess
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from itertools import islice

import numpy as np
import pytest

from pdavis_cv import Calibration, Layout, fuse, open_recording, source_from_packets
from pdavis_cv.data import example_recording
from pdavis_cv.fusion.engine import Fusion
from pdavis_cv.fusion.images import ImageMaker
from pdavis_cv.fusion.iteration import DEPTH, ReadAhead
from pdavis_cv.recording.base import RecordingInfo
from pdavis_cv.simulation import FULL, Camera, RotatingPolarizer

PATIENCE_S = 60     # longer than a loaded machine takes; nothing is asserted of time


@pytest.fixture(autouse=True)
def of_any_size(monkeypatch):
    """Give other threads small images and bands, too."""
    monkeypatch.setattr("pdavis_cv.fusion.iteration.LEAST_PIXELS", 0)
    monkeypatch.setattr("pdavis_cv._workers.LEAST_BAND_NS", 0)


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
    options = {"method": "kalman", "fps": 60, **options}
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
    images = ReadAhead(Breaking(Fusion(turning, fps=100, threads=2), n))
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

    fusion = Counting(Fusion(turning, fps=100, threads=2), 0)
    images = ReadAhead(fusion)
    read = []
    for _ in range(6):
        next(images)
        read.append(fusion.count)
    assert read == [1, 3, 5, 6, 7, 8]
    assert DEPTH == 3


def threads_of_images():
    return [thread for thread in threading.enumerate()
            if thread.name.startswith("pdavis_cv-images")]


@pytest.fixture
def no_others():
    """Let the threads of images that other tests dropped end."""
    gc.collect()
    for thread in threads_of_images():
        thread.join(PATIENCE_S)


@pytest.mark.usefixtures("no_others")
def test_no_thread_is_left_at_the_end_or_when_nobody_goes_on(turning, threads_ended):
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
    assert threads_ended(PATIENCE_S)


def test_small_images_are_left_to_the_caller(turning, monkeypatch):
    monkeypatch.setattr("pdavis_cv.fusion.iteration.LEAST_PIXELS", 32 * 36 + 1)
    assert isinstance(fuse(turning, threads=2, fps=100), Fusion)


def test_what_is_closed_gives_no_image_and_leaves_no_thread(turning, threads_ended):
    for threads, kind in ((1, Fusion), (2, ReadAhead)):
        images = fuse(turning, threads=threads, fps=100)
        assert isinstance(images, kind)
        next(images)
        images.close()
        assert threads_ended()
        assert list(images) == []
        images.close()


def test_the_state_moves_on_while_an_image_is_made(turning, monkeypatch):
    third, made, first_us = threading.Event(), ImageMaker._made, []

    def after_the_next_is_read(maker, *args, **about):
        assert not first_us or third.wait(PATIENCE_S)
        return made(maker, *args, **about)

    class Noting(Fusion):
        def advance(self):
            if self.index == 2:
                third.set()
            return super().advance()

    monkeypatch.setattr(ImageMaker, "_made", after_the_next_is_read)
    images = ReadAhead(Noting(turning, fps=100, threads=2))
    first_us.append(next(images).t_us)
    assert not third.is_set()
    assert next(images).t_us > first_us[0]


def test_a_source_that_is_read_once_is_not_read_ahead(turning):
    info = RecordingInfo(format="x", sensor_size=turning.info.sensor_size,
                         layout=Layout.PDAVIS)
    for source, kind in ((turning, ReadAhead), (
            source_from_packets(info, turning.packets()), object)):
        images = fuse(source, threads=2, fps=100, method="cf")
        assert isinstance(images, ReadAhead) == (kind is ReadAhead)


@pytest.mark.usefixtures("no_others")
@pytest.mark.parametrize("options", [{}, {"causal": True}, {"mode": "offline"}])
def test_two_threads_share_the_images_of_a_source(turning, options):
    info = RecordingInfo(format="x", sensor_size=turning.info.sensor_size,
                         layout=Layout.PDAVIS)

    def images(threads):
        return fuse(source_from_packets(info, turning.packets()), threads=threads,
                    fps=60, method="kalman", thresholds=(0.15, 0.15), **options)

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


def test_the_length_is_not_told_while_another_thread_reads(turning):
    """Both would read the beginning: `list` asks for the length."""
    reading, asked = threading.Event(), threading.Event()

    class Reading(Fusion):
        def advance(self):
            reading.set()
            assert not asked.wait(0.2)
            reading.clear()
            return super().advance()

        def __len__(self):
            assert not reading.is_set()
            asked.set()
            return super().__len__()

    images = ReadAhead(
        Reading(turning, threads=2, times_us=range(10_000, 30_000, 1000)))
    with ThreadPoolExecutor(2) as pool:
        first = pool.submit(next, images)
        assert reading.wait(PATIENCE_S)
        assert pool.submit(len, images).result() == 20
        assert first.result() is not None
    images.close()


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
images = pdavis_cv.fuse(recording, fps=1000, threads=2, method="cf",
                        layout=pdavis_cv.Layout.PDAVIS)
for _ in range(9):
    image = next(images)
"""
    for _ in range(2):
        run = subprocess.run([sys.executable, "-P", "-c", program],
                             capture_output=True, text=True, timeout=60, check=False)
        assert (run.returncode, run.stdout, run.stderr) == (0, "", "")


@pytest.mark.parametrize("threads", [1, 2])
@pytest.mark.parametrize("options", [
    {"fps": 10}, {"fps": 333.3}, {"fps": 1000}, {"fps": 100, "stop_us": 150_000},
    {"fps": 70, "start_us": 90_001}, {"fps": 20, "start_us": 400_000},
    {"times_us": [50_000, 60_000, 10**9]}], ids=str)
def test_the_length_is_the_number_of_images(turning, options, threads):
    images = fuse(turning, threads=threads, method="cf", **options)
    count = len(images)
    assert len(list(images)) == count == len(images)


def test_there_is_no_length_without_a_rate_or_an_end(turning):
    info = RecordingInfo(
        format="live", sensor_size=turning.info.sensor_size, layout=Layout.PDAVIS)
    once = source_from_packets(info, turning.packets())
    for images in fuse(turning), fuse(once, fps=100):
        with pytest.raises(TypeError, match="no length; without a rate, or an end"):
            len(images)
