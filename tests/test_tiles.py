"""One recording by several workers: the same bits as by one."""
import itertools
import pickle
from concurrent.futures import Executor, Future

import numpy as np
import pytest
from batch_works import Inline

from pdavis_cv import FusionOptions, KalmanFilter, fuse, open_recording
from pdavis_cv.data import example_recording
from pdavis_cv.fusion import tiles
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


@pytest.mark.parametrize("options", [
    {"method": "cf"}, {"method": "cf", "causal": True}, {"method": "frames"},
    {"method": "events"}, {"method": "cf", "demosaic": "superpixel"},
    pytest.param({"method": "events", "offsets": "redundancy"}, marks=pytest.mark.gate),
    {"method": "cf", "demosaic": "guided"},
    {"method": "cf", "denoise": True}, {"method": "cf", "roi": (11, 7, 101, 63)}],
    ids=lambda options: " ".join(map(str, options.values())))
def test_stripes_are_the_same_bits(options, recording, monkeypatch):
    monkeypatch.setattr("pdavis_cv.fusion.stripes._IMAGES", 5)
    options = FusionOptions(fps=80, layout="pdavis").replace(**options)
    executor = Pickling()
    count = 0
    for one, other in itertools.zip_longest(
            fuse(recording, options),
            fuse(recording, options, executor=executor, tiles=3)):
        assert_same_bits(one, other)
        count += 1
    assert count > 10
    assert executor.sent == 3 * (count // 5 + 1)     # the state was handed on


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


def test_a_method_that_looks_at_all_pixels_says_what_to_do(recording):
    with pytest.raises(ValueError, match=r"kalman depends on all others .threads="):
        fuse(recording, method="kalman", layout="pdavis", executor=Inline())


def test_what_is_read_once_is_refused(recording):
    source = source_from_packets(recording.info, recording.packets())
    with pytest.raises(TypeError, match="executor needs a Recording"):
        fuse(source, method="cf", executor=Inline())


def test_a_method_of_ones_own_says_by_its_margin(recording):
    class Bounded(KalmanFilter):
        margin = 0

    assert fuse(recording, method=Bounded, layout="pdavis", executor=Inline())


@pytest.mark.gate
def test_export_by_processes_writes_the_same_arrays(tmp_path):
    for jobs in "12":
        assert main([
            "export", str(example_recording()), "--method", "cf", "--layout", "pdavis",
            "--jobs", jobs, "-o", str(tmp_path / f"{jobs}.npy")]) == 0
    np.testing.assert_array_equal(
        np.load(tmp_path / "1.npy"), np.load(tmp_path / "2.npy"))
