"""One recording by several workers: the same bits as by one."""
import itertools
import pickle
from concurrent.futures import Executor, Future, ThreadPoolExecutor

import numpy as np
import pytest
from test_batch import write

from pdavis_cv import EVENT_DTYPE, FusionOptions, fuse, open_recording
from pdavis_cv.data import example_recording
from pdavis_cv.fusion import tiles
from pdavis_cv.fusion.window import Window
from pdavis_cv.recording.stream import source_from_packets
from pdavis_cv.tools.main import main

PARTS = ("quad", "s0", "s1", "s2", "aop", "dolp", "valid", "variance", "quality")


class Pickling(Executor):
    """Sends everything there and back as to a process, and counts."""

    def __init__(self):
        self.sent = 0

    def submit(self, function, /, *args):
        self.sent += 1
        future = Future()
        args = pickle.loads(pickle.dumps(args))
        future.set_result(pickle.loads(pickle.dumps(function(*args))))
        return future


@pytest.fixture(scope="module")
def recording():
    with open_recording(example_recording()) as found:
        yield found


def assert_same_bits(one, other):
    assert (one.t_us, one.frame_us) == (other.t_us, other.frame_us)
    for name in PARTS:
        mine, its = getattr(one, name), getattr(other, name)
        assert (mine is None) == (its is None)
        if mine is not None:
            assert mine.dtype == its.dtype
            np.testing.assert_array_equal(
                mine.view(np.uint8), its.view(np.uint8), err_msg=name)


def assert_same_images(options, source, monkeypatch, images=5, **shared):
    """Compare with what one alone makes; return how many images and calls there were.
    """
    monkeypatch.setattr("pdavis_cv.fusion.stripes._IMAGES_PER_TASK", images)
    options = FusionOptions(fps=80, layout="pdavis").replace(**options)
    executor = Pickling()
    count = 0
    for one, other in itertools.zip_longest(
            fuse(source, options),
            fuse(source, options, executor=executor, tiles=3, **shared)):
        assert_same_bits(one, other)
        assert repr(one.provenance) == repr(other.provenance)
        count += 1
    assert count > 10
    return count, executor.sent


@pytest.mark.parametrize("options", [
    {"method": "frames"}, {"method": "cf", "roi": (11, 7, 101, 63)},
    {"method": "cf", "demosaic": "superpixel", "causal": True}, *(
        pytest.param(one, marks=pytest.mark.gate) for one in (
            {"method": "cf"}, {"method": "events"},
            {"method": "events", "offsets": "redundancy"},
            {"method": "cf", "demosaic": "guided"},
            {"method": "cf", "denoise": True}))],
    ids=lambda options: " ".join(map(str, options.values())))
def test_stripes_are_the_same_bits(options, recording, monkeypatch):
    count, sent = assert_same_images(options, recording, monkeypatch)
    assert sent == 3 * (count // 5 + (count % 5 > 0))   # the state was handed on


def test_where_all_pixels_count_one_worker_is_ahead_to_the_same_bits(
        tmp_path, monkeypatch):
    with open_recording(write(tmp_path / "run.aedat4")) as small:
        count, sent = assert_same_images(
            {"method": "kalman", "fps": 300, "roi": (1, 2, 5, 4)}, small, monkeypatch)
    assert sent == count // 5 + (count % 5 > 0)


@pytest.mark.parametrize("options", [
    {"method": "frames"}, {"method": "cf"}, {"method": "cf", "causal": True},
    {"method": "kalman"}],
    ids=lambda options: " ".join(map(str, options.values())))
def test_pieces_of_time_of_any_method_are_the_same_bits(options, tmp_path, monkeypatch):
    with open_recording(write(tmp_path / "run.aedat4")) as small:
        count, sent = assert_same_images(
            {"fps": 300, **options}, small, monkeypatch, by_time=True)
    assert sent == count // 5 + (count % 5 > 0)


@pytest.mark.gate
@pytest.mark.parametrize("options", [{}, {"causal": True}, {"mode": "offline"}],
                         ids=lambda options: " ".join(options) or "buffered")
@pytest.mark.parametrize("by_time", [False, True])
def test_a_camera_s_images_are_the_same_bits(options, recording, monkeypatch, by_time):
    assert_same_images({"method": "kalman", **options}, recording, monkeypatch,
                       by_time=by_time)


@pytest.mark.parametrize("rows", [(0, 6), (2, 4), (4, 6)])
@pytest.mark.parametrize("columns", [(0, 8), (2, 6)])
def test_events_are_cut_to_a_window_at_the_same_events(rows, columns):
    rng = np.random.default_rng(0)
    events = np.zeros(50, EVENT_DTYPE)
    events["t"] = np.sort(rng.integers(0, 1000, 50))
    events["x"], events["y"] = rng.integers(0, 8, 50), rng.integers(0, 6, 50)
    before = events.copy()
    window = Window(slice(*rows), slice(*columns), (6, 8))
    edges = [0, 0, 7, 7, 30, 50]
    inside, cuts = window.cut_events(events, edges)
    np.testing.assert_array_equal(events, before)
    for (first, last), (start, stop) in zip(
            itertools.pairwise(edges), itertools.pairwise(cuts), strict=True):
        np.testing.assert_array_equal(
            inside[start:stop], window.events(events[first:last]))


@pytest.mark.parametrize("shape", [(260, 346), (7, 5), (2, 2), (1, 4)])
@pytest.mark.parametrize("n", [1, 2, 3, 50])
def test_stripes_are_whole_cells_and_cover_the_sensor(shape, n):
    found = tiles(shape, n)
    assert len(found) <= n
    assert found[0][1] == 0
    for (x, y, width, height), (_, below, _, _) in itertools.pairwise(found):
        assert (x, width) == (0, shape[1])
        assert height % 2 == 0
        assert y + height == below
    assert found[-1][1] + found[-1][3] == shape[0]


def test_no_stripe_is_refused():
    with pytest.raises(ValueError, match="n must be positive, got 0"):
        tiles((4, 4), 0)


@pytest.mark.parametrize("causal", [False, True])
def test_what_is_read_once_is_shared_too(causal, recording):
    def images(**shared):
        source = source_from_packets(recording.info, recording.packets())
        return list(fuse(source, method="cf", layout="pdavis", fps=20, causal=causal,
                         **shared))

    for one, other in zip(images(), images(executor=Pickling(), tiles=2), strict=True):
        assert_same_bits(one, other)


@pytest.mark.parametrize("method", ["cf", "frames"])
def test_threads_make_the_same_bits(method, recording, monkeypatch):
    monkeypatch.setattr("pdavis_cv.fusion.stripes._IMAGES_PER_TASK", 5)
    options = FusionOptions(method=method, layout="pdavis", fps=80)
    with ThreadPoolExecutor(3) as threads:
        for one, other in zip(
                fuse(recording, options),
                fuse(recording, options, executor=threads, tiles=3), strict=True):
            assert_same_bits(one, other)


@pytest.mark.gate
def test_export_by_threads_writes_the_same_arrays(tmp_path):
    for jobs in "12":
        assert main([
            "export", str(example_recording()), "--method", "cf", "--layout", "pdavis",
            "--jobs", jobs, "-o", str(tmp_path / f"{jobs}.npy")]) == 0
    np.testing.assert_array_equal(
        np.load(tmp_path / "1.npy"), np.load(tmp_path / "2.npy"))
