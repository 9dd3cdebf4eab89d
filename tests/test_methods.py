"""How a method is chosen, made and asked what it needs; snapshots and their size."""
import ast
import pickle
import re
from collections import deque
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from ideal import rotating_polarizer

from pdavis_cv import (
    METHODS,
    ApsFrame,
    Estimate,
    KalmanFilter,
    LayoutError,
    Needs,
    Reconstructor,
    fuse,
)
from pdavis_cv.reconstruct.base import nbytes
from pdavis_cv.reconstruct.methods import make_reconstructor
from pdavis_cv.sensor import Layout

ROOT = Path(__file__).resolve().parents[1]


class Mean(Reconstructor):
    """The mean of all frames so far: a method of a user's own."""

    method = "mean"
    needs = Needs(events=False)

    def __init__(self, shape, *, floor=1.0):
        self.shape, self._floor = shape, floor
        self._sum, self._count = np.zeros(shape), 0

    @property
    def parameters(self):
        return {"floor": self._floor}

    def add_events(self, events):
        raise AssertionError("it needs no events")

    def add_frame(self, frame):
        self._sum += np.maximum(frame.dn, self._floor) / frame.exposure_ms
        self._count += 1

    def read(self, t_us, out=None):
        log = np.log(self._sum / max(self._count, 1) + 1e-9).astype(np.float32)
        return Estimate(log, None, np.full(self.shape, self._count > 0))

    def _state(self):
        return {"sum": self._sum.copy(), "count": self._count}

    def _restore(self, state):
        self._sum[:], self._count = state["sum"], state["count"]


def mean(shape, *, theta_on, theta_off, floor=1.0):
    assert theta_on == theta_off == pytest.approx(0.2)
    return Mean(shape, floor=floor)


@pytest.fixture(scope="module")
def recording():
    return rotating_polarizer(202.6, 0.5, size=(8, 8))[0]


@pytest.mark.parametrize("factory", [Mean, mean])
@pytest.mark.parametrize("causal", [False, True])
def test_a_reconstructor_of_one_s_own_goes_through_fuse(recording, factory, causal):
    frames = [f for packet in recording.packets() for f in packet.frames]
    t = frames[4].available_us + 1
    image, = fuse(recording, method=factory, floor=2.0, times_us=[t], causal=causal,
                  demosaic="superpixel")
    expected = np.mean([f.dn / f.exposure_ms for f in frames if f.mid_us <= t], axis=0)
    i0 = expected[1::2, 0::2]           # PDAVIS: row 1 of the cell is 0, 45 degrees
    np.testing.assert_allclose(image.quad[0], i0, rtol=1e-5)
    assert image.provenance["method"] == "mean"
    assert image.provenance["parameters"]["floor"] == 2.0


def test_a_method_s_own_parameters_are_checked(recording):
    with pytest.raises(TypeError, match="'Mean' has no parameter 'roof'; it takes flo"):
        fuse(recording, method=Mean, roof=1)
    with pytest.raises(TypeError, match="must make a Reconstructor, got dict"):
        fuse(recording, method=lambda shape: {})
    with pytest.raises(TypeError, match="name or make a Reconstructor, got int"):
        fuse(recording, method=7)


def test_needs_say_what_a_method_is_fed():
    made = {name: make_reconstructor(name, (4, 4), 0.2, 0.2, {}).needs
            for name in METHODS if name not in ("firenet", "joint")}
    assert not made["frames"].events
    assert not made["events"].frames
    assert made["kalman"].learned == {"model", "ratio_sigma"}
    assert made["kalman"].lamp
    assert not made["cf"].learned
    cells = make_reconstructor("events", (4, 4), 0.2, 0.2, {"offsets": "redundancy"})
    assert cells.needs.lamp
    assert cells.needs.learned == {"ratio_sigma"}


def test_a_method_for_crossed_diagonals_refuses_another_layout(recording):
    class Crossed(Mean):
        needs = Needs(crossed_diagonal=True)
    other = rotating_polarizer(60, 0.1, size=(8, 8), layout=Layout((0, 90), (45, 135)))
    with pytest.raises(LayoutError, match="'mean' needs a layout in which 0 and 90"):
        fuse(other[0], method=Crossed)


def test_what_cannot_be_learned_is_not_retuned():
    with pytest.raises(TypeError, match="'mean' has no parameters that can be learned"):
        Mean((2, 2)).retune(bandwidth=(1, 2))


def test_assigned_states_are_equal_and_apart():
    one, other = (KalmanFilter((4, 4), theta_on=0.2, theta_off=0.2) for _ in range(2))
    frame = ApsFrame(np.full((4, 4), 200.0), 0, 10_000)
    one.add_frame(frame)
    other.assign(one)
    one.add_frame(ApsFrame(np.full((4, 4), 900.0), 20_000, 30_000))
    levels = [x.read(100_000).log_intensity[0, 0] for x in (one, other)]
    assert levels[1] == pytest.approx(np.log(20))
    assert levels[0] > levels[1] + 0.5


def test_bytes_are_counted_however_deep_they_lie():
    @dataclass
    class Data:
        array: np.ndarray

    class Slots:
        __slots__ = ("array",)

    slots = Slots()
    slots.array = np.zeros(10, np.uint8)
    shared = np.zeros(100, np.uint8)
    value = {"a": [Data(np.zeros(1000, np.uint8)), (slots, b"bytes")],
             "b": deque([shared, shared[:50], None, 1.5, "text"])}
    assert nbytes(value) == 1000 + 10 + 5 + 100


@pytest.mark.parametrize("mode", ["buffered", "causal", "offline"])
def test_a_snapshot_s_size_is_about_that_of_its_pickle(recording, mode):
    method = KalmanFilter((8, 8), theta_on=0.2, theta_off=0.2, mode=mode)
    for packet in recording.packets():
        if len(packet.events):
            method.add_events(packet.events)
    snapshot = method.snapshot()
    assert snapshot.nbytes == pytest.approx(len(pickle.dumps(snapshot)), rel=0.1)


def test_no_method_is_asked_for_its_name():
    """A method says what it needs; only the table of methods knows names."""
    asked = re.compile(r"method\b.*(==|!=| in )")
    found = []
    for path in (ROOT / "pdavis_cv").rglob("*.py"):
        if "reconstruct" in path.parts:
            continue
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Compare) and any(
                    isinstance(part, ast.Constant) and part.value in METHODS
                    for part in ast.walk(node)):
                text = ast.unparse(node)
                if asked.search(text):
                    found.append(f"{path.name}:{node.lineno}: {text}")
    assert not found
