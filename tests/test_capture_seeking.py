"""VideoCapture goes to any image exactly, and reads little for it."""
import os
import pickle

import numpy as np
import pytest
from ideal import rotating_polarizer

import pdavis_cv as p
from pdavis_cv import Layout, VideoCapture
from pdavis_cv.capture import seeking
from pdavis_cv.capture.seeking import Cursor
from pdavis_cv.data import example_recording
from pdavis_cv.fusion import Fusion

POS_MSEC, POS_FRAMES, COUNT = 0, 1, 7
METHODS = [
    *({"method": method, "causal": causal} for method in p.METHODS
      for causal in (False, True)),
    {"method": "kalman", "mode": "offline", "lookahead_us": 120_000}]
NETWORKS = ("firenet", "joint")


LEARNS = {"method": "kalman", "causal": True}


def cases(long):
    """Return the methods as parameters; those that are long are the gate's."""
    return pytest.mark.parametrize("method", [
        pytest.param(method, id="-".join(map(str, method.values())),
                     marks=pytest.mark.gate if long(method) else ())
        for method in METHODS])


CASES = cases(lambda method: method == LEARNS)
CASES_OF_A_FILE = cases(lambda method: method["method"] in (*NETWORKS, "kalman"))


@pytest.fixture(scope="module")
def ideal():
    return rotating_polarizer(50, 7.0, size=(10, 12))[0]


def everything(cap):
    """Return what the last grabbed image is, all planes and its time."""
    planes = [cap.retrieve(None, flag)[1].tobytes() for flag in (
        p.CAP_PDAVIS_QUAD, p.CAP_PDAVIS_STOKES, p.CAP_PDAVIS_VALID)]
    return cap.get(p.CAP_PROP_PDAVIS_POS_US), *planes


def quick(method, n):
    """Return a method's options, and fewer seeks where its images take long."""
    if method["method"] in NETWORKS:
        return {**method, "window_us": 50_000}, max(n // 20, 4)
    return method, n // 10 if method["method"] == "kalman" else n


def read_on(cap):
    found = []
    while cap.grab():
        found.append(everything(cap))
    return found


def check_random_seeks(cap, n, sequential=None):
    sequential = sequential or read_on(cap)
    assert len(sequential) == cap.get(COUNT)
    assert len(set(sequential)) == len(sequential)
    start = cap.get(p.CAP_PROP_PDAVIS_START_US)
    for i, k in enumerate(np.random.default_rng(0).integers(0, len(sequential), n)):
        if i % 2:
            assert cap.set(POS_FRAMES, k)
        else:
            assert cap.set(POS_MSEC, (sequential[k][0] - start) / 1000)
        assert cap.get(POS_FRAMES) == k
        assert cap.grab()
        assert everything(cap) == sequential[k]
    return sequential


class _Counted:
    """Counts what is read of files and of a recording in memory."""

    def __init__(self, monkeypatch):
        self.bytes = 0
        pread = os.pread

        def counting(descriptor, size, offset):
            data = pread(descriptor, size, offset)
            self.bytes += len(data)
            return data
        monkeypatch.setattr(os, "pread", counting)

    def of(self, call):
        """Return how many bytes a call reads, and what it returns."""
        self.bytes = 0
        found = call()
        return self.bytes, found


@CASES
@pytest.mark.parametrize(("grid", "n"), [
    pytest.param({}, 20, marks=pytest.mark.gate, id="per frame"),
    pytest.param({"fps": 18.5}, 50, id="18.5 fps")])
def test_random_seeks_equal_sequential_reading(ideal, method, grid, n):
    method, n = quick(method, n)
    with VideoCapture(ideal, **method, **grid) as cap:
        check_random_seeks(cap, n)


@pytest.mark.gate
@CASES_OF_A_FILE
def test_random_seeks_in_a_real_recording_read_at_most_two_snapshot_spacings(
        data_dir, monkeypatch, method):
    path = data_dir / "davis346.aedat4"
    counted = _Counted(monkeypatch)
    method, n = quick(method, 100)
    with VideoCapture(path, **method, fps=60, layout=Layout.PDAVIS,
                      roi=(100, 90, 32, 24)) as cap:
        cursor = cap._session.cursor
        cursor.spacing_us = 400_000     # 2 s would give one snapshot
        whole, sequential = counted.of(lambda: read_on(cap))
        assert whole > path.stat().st_size / 2
        spacing = whole / cap.get(COUNT) * 60 * 0.4
        check_random_seeks(cap, n, sequential)
        assert len(cursor.kept) >= 3    # fewer of those that are large
        for k in np.random.default_rng(1).integers(0, len(sequential), n // 5):
            cap.set(POS_FRAMES, len(sequential))
            read, _ = counted.of(lambda k=k: (cap.set(POS_FRAMES, k), cap.grab()))
            assert read <= 2 * spacing


@pytest.mark.gate
@pytest.mark.parametrize("suffix", [
    ".aedat", pytest.param(".aedat2", marks=pytest.mark.gate)])
def test_random_seeks_in_an_aedat2_file(tmp_path, suffix):
    path = tmp_path / f"run{suffix}"
    with p.open_recording(example_recording()) as recording:
        p.write_aedat2(path, recording)
    with VideoCapture(path, fps=500, layout=Layout.PDAVIS,
                      roi=(90, 70, 60, 48)) as cap:
        cap._session.cursor.spacing_us = 20_000
        check_random_seeks(cap, 40)
        assert len(cap._session.cursor.kept) >= 6


def test_seeks_with_given_times_equal_sequential_reading(ideal):
    times = np.sort(np.random.default_rng(3).integers(0, 6_900_000, 80))
    with VideoCapture(ideal, times_us=np.unique(times)) as cap:
        check_random_seeks(cap, 40)


@pytest.mark.gate
@CASES
def test_a_pickled_copy_goes_on_with_the_same_images(ideal, method):
    with VideoCapture(ideal, **method, fps=40) as cap:
        for _ in range(130):
            cap.grab()
        copy = pickle.loads(pickle.dumps(cap))
        assert everything(copy) == everything(cap)
        assert copy.get(POS_FRAMES) == cap.get(POS_FRAMES) == 130
        assert read_on(copy) == read_on(cap)
        copy.release()


@pytest.mark.gate
def test_a_pickled_copy_of_a_file_opens_it_again(data_dir):
    cap = VideoCapture(data_dir / "davis346.aedat4", fps=50, layout=Layout.PDAVIS,
                       gain=2.0, output=p.CAP_PDAVIS_DOLP_BGR)
    cap.set(POS_FRAMES, 100)
    copy = pickle.loads(pickle.dumps(cap))
    cap_images, copy_images = list(cap), list(copy)
    assert len(copy_images) == copy.get(COUNT) - 100
    np.testing.assert_array_equal(cap_images, copy_images)
    cap.release()
    copy.release()


def test_a_pickled_copy_of_a_lost_file_is_closed_and_says_why(data_dir, tmp_path):
    path = tmp_path / "moved.aedat4"
    path.write_bytes((data_dir / "davis346.aedat4").read_bytes())
    cap = VideoCapture(path, fps=50, layout=Layout.PDAVIS)
    stored = pickle.dumps(cap)
    cap.release()
    path.unlink()
    copy = pickle.loads(stored)
    assert not copy.isOpened()
    assert "moved.aedat4: cannot be opened" in copy.last_error


def test_snapshots_are_thinned_and_seeks_stay_exact(ideal, monkeypatch):
    monkeypatch.setattr(seeking, "MOST_SNAPSHOTS", 8)
    monkeypatch.setattr(seeking, "SPACING_US", 100_000)
    with VideoCapture(ideal, fps=40) as cap:
        check_random_seeks(cap, 50)
        cursor = cap._session.cursor
        assert 4 <= len(cursor.kept) <= 8
        assert cursor.spacing_us > 100_000
        assert np.diff(cursor.kept).min() >= cursor.spacing_us * 40 // 1_000_000 - 1


def test_snapshots_stay_within_their_memory(ideal, monkeypatch):
    cursor = Cursor(Fusion(ideal, method="cf", fps=40))
    cursor.spacing_us = 100_000
    begun = Fusion(ideal, method="cf", fps=40)
    begun.advance()
    size = begun.snapshot().nbytes
    assert size == pytest.approx(len(pickle.dumps(begun.snapshot())), rel=0.3)
    monkeypatch.setattr(seeking, "MOST_BYTES", 10 * size)
    while cursor.advance():
        pass
    assert 3 <= len(cursor.kept) <= 12


def test_going_forward_does_not_go_back_to_a_snapshot(ideal, monkeypatch):
    cursor = Cursor(Fusion(ideal, fps=40))
    while cursor.advance():
        pass
    restored = []
    restore = Fusion.restore
    monkeypatch.setattr(Fusion, "restore", lambda self, mark: (
        restored.append(mark.index), restore(self, mark)))
    cursor.seek(100)
    assert restored == [cursor.kept[0]]
    cursor.seek(110)   # from here, not from the snapshot before
    assert len(restored) == 1
    cursor.seek(250)   # over the snapshots between
    assert restored[1:] == [cursor.kept[2]]


@pytest.mark.parametrize("fps", [30, 29.97, 1000 / 3, 999])
def test_the_length_of_the_grid_is_counted_without_reading_images(ideal, fps):
    cursor = Cursor(Fusion(ideal, fps=fps, method="frames"))
    counted = cursor.count
    while cursor.advance():
        assert cursor.index_at(cursor.t_us) == cursor.index - 1
    assert cursor.index == counted


def test_a_window_of_time_has_its_own_grid(ideal):
    for window in ({"start_us": 100_000}, {"stop_us": 2_000_000},
                   {"start_us": 1_000_001, "stop_us": 1_000_002},
                   {"start_us": 5_000_000, "stop_us": 1_000_000}):
        for grid in ({}, {"fps": 60}):
            with VideoCapture(ideal, **window, **grid) as cap:
                n = cap.get(COUNT)
                assert n == len(list(cap))
