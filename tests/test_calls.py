"""Calls of the public names with values that their stubs' types suggest, and others."""
import enum
import inspect
import itertools
import os
import re
import traceback
import warnings
from collections.abc import Iterable
from pathlib import Path

import boundaries
import numpy as np
import pytest

import pdavis_cv
from pdavis_cv import analysis, batch, calibration, export, render, simulation
from pdavis_cv._door import fits

ROOMS = (pdavis_cv, analysis, batch, calibration, export, render, simulation)
NAMES = [(room, name) for room in ROOMS for name in sorted(room.__all__)]
HOME = str(Path(pdavis_cv.__file__).parent)
ANY = (None, "x", -1, 0, np.nan, (), [], {}, object(), np.zeros(2), b"1", 1j, 2**70)
BY_PYTHON = "required positional|Protocols cannot|abstract class|must be"


@pytest.fixture(scope="module")
def values():
    """Return values by a pattern of annotations that they fit."""
    events, frame = boundaries.some_events(), boundaries.some_frame()
    recording = pdavis_cv.recording_from_arrays(
        events, [boundaries.some_frame(20_000), frame], layout=boundaries.LAYOUT,
        sensor_size=boundaries.SIZE)
    images = list(itertools.islice(pdavis_cv.fuse(recording, method="frames"), 2))
    plane = np.random.default_rng(0).uniform(0, 1, boundaries.SIZE).astype(np.float32)
    return {
        "Array|Image|Picture|Grey": [
            plane, np.zeros((4, *plane.shape), "f4"), np.arange(10) * 1000, np.zeros(3),
            np.zeros((*plane.shape, 3), "u1"), np.zeros(plane.shape, "u1"),
            np.array([]), [1, 2], 1.0, plane > .5, np.zeros((0, 0)),
            np.full((3, 4), np.nan), events],
        r"\bint\b": [0, 1, -1, 3, 1000, 2**40, True, 12],
        r"\bfloat\b": [0.0, 1.0, -1.0, .5, 1e9, 1e-9, np.nan, np.inf, 2],
        r"\bstr\b|Literal": ["", "x", "aop", "dolp", "sony", "kalman", "1", "a/b"],
        "Path": [Path("none.csv"), Path(), "x.txt", "there/x.png"],
        r"\bbool\b": [True, False],
        "tuple|Sequence|Iterable|list": [
            (), (1, 2), (0, 0, 4, 4), [1.0, 2.0], ["a"], [plane], images, [None]],
        "Mapping|dict": [{}, {"a": 1}],
        "Recording|Source": [recording], "Frame": [frame, *images],
        "Layout": [boundaries.LAYOUT, "sony"], "None": [None]}


def inside(error):
    """Return where an error comes from, None if this library raised it by intent."""
    frames = traceback.extract_tb(error.__traceback__)
    own = [one for one in frames if one.filename.startswith(HOME)]
    by_intent = isinstance(
            error, pdavis_cv.PdavisError | OSError | ImportError | MemoryError) or (
        type(error).__module__ == "cv2") or (
        isinstance(error, TypeError | ValueError) and (
            re.search(BY_PYTHON, str(error)) or (
                own and own[-1] is frames[-1] and own[-1].line.startswith("raise"))))
    return None if by_intent else f"{type(error).__name__}: {error} {frames[-1]}"


@pytest.mark.parametrize(("room", "name"), NAMES, ids=[name for _, name in NAMES])
def test_errors_say_what_is_wrong_with_an_argument(
        room, name, values, tmp_path, monkeypatch):
    try:
        one = getattr(room, name)
    except ImportError as error:
        pytest.skip(str(error))
    if not inspect.isfunction(one) and (
            not inspect.isclass(one) or issubclass(one, Exception | enum.Enum)):
        return
    monkeypatch.chdir(tmp_path)
    rng = np.random.default_rng(NAMES.index((room, name)))
    parameters = inspect.signature(one).parameters.values()
    for _ in range(40):
        given = {}
        for each in parameters:
            if each.kind in (each.VAR_POSITIONAL, each.VAR_KEYWORD) or (
                    each.default is not each.empty and rng.random() < .6):
                continue
            drawn = [value for pattern, some in values.items() for value in some
                     if re.search(pattern, str(each.annotation))]
            drawn = ANY if not drawn or rng.random() < .15 else drawn
            given[each.name] = drawn[rng.integers(len(drawn))]
        with warnings.catch_warnings(), np.errstate(all="ignore"):
            warnings.simplefilter("ignore")
            try:
                got = one(**given)
                if hasattr(got, "__next__"):
                    next(got, None)
                for end in ("discard", "close"):
                    getattr(got, end, lambda: None)()
            except Exception as error:
                where = inside(error)
                assert where is None, f"{name}({given}): {where}"
    assert os.getcwd() == str(tmp_path)


@pytest.mark.parametrize(("value", "hint", "expected"), [
    (np.array(1), Iterable[int], False), (np.array([1]), Iterable[int], True),
    (1, int, True), (np.int8(1), int, True), (1.0, int, False), (1, float, True),
    ("x", float, False), (None, int | None, True), ("x", str | None, True),
    (np.zeros(2), np.ndarray[tuple[int], np.dtype[np.float64]], True),
    (np.zeros(2, "i8,f4"), np.ndarray[tuple[int], np.dtype[np.bool_]], False),
    (np.zeros(2, "U1"), np.ndarray[tuple[int], np.dtype[np.float64]], False),
    ((1, 2), tuple[int, int], True), ((1, 2, 3), tuple[int, int], False),
    ([1], list[int], True), (["a"], list[int], False), ("a", list[str], False)])
def test_what_fits_an_annotation(value, hint, expected):
    assert fits(value, hint) is expected


@pytest.mark.parametrize("wrong", ["x", [], {}, np.nan, np.zeros(2), b"1", 1j])
def test_times_of_an_interval_are_numbers(wrong, tmp_path):
    events = boundaries.some_events()
    memory = pdavis_cv.recording_from_arrays(events, sensor_size=boundaries.SIZE)
    pdavis_cv.write_aedat4(tmp_path / "a.aedat4", memory)
    with pdavis_cv.open_recording(tmp_path / "a.aedat4") as file:
        for recording in (memory, file):
            for name in ("start_us", "stop_us"):
                for read in (recording.events, recording.packets):
                    with pytest.raises(TypeError, match=f"{name} must be a time in us"):
                        read(**{name: wrong})
            assert len(recording.events(0.5, np.int64(2**40))) == len(events)


@pytest.mark.parametrize(("of", "name", "wrong", "said"), [
    ("layout", "rot90", "x", "k"), ("layout", "crop", {}, "x"),
    ("frame", "moved", "x", "us"), ("filter", "restore", 3, "snapshot")])
def test_errors_of_methods_say_which_argument_is_wrong(of, name, wrong, said):
    one = {"layout": lambda: boundaries.LAYOUT, "frame": boundaries.some_frame,
           "filter": lambda: pdavis_cv.ComplementaryFilter(
               boundaries.SIZE, theta_on=.2, theta_off=.2)}[of]()
    with pytest.raises(TypeError, match=rf"^{said} must be .*, got "):
        getattr(one, name)(*([wrong, 1] if name == "crop" else [wrong]))


def test_errors_of_methods_name_arrays_that_do_not_fit():
    method = pdavis_cv.ComplementaryFilter((4, 6), theta_on=.2, theta_off=.2)
    kalman = pdavis_cv.KalmanFilter((4, 6), theta_on=.2, theta_off=.2)
    fan = simulation.Fan(rpm=10)
    for call, said in (
            (lambda: fan.stokes(np.zeros(3), np.zeros((3, 4)), [0]),
             r"t_us \(3,\), x \(3, 4\), y list: shape mismatch"),
            (lambda: method.intensity(np.zeros(3, "f4")), r"log_intensity \(3,\): B"),
            (lambda: method.intensity(np.zeros((4, 6))), r"log_intensity \(4, 6\): B"),
            (lambda: method.intensity(np.zeros((4, 6), "f4")[:, ::2]),
             "log_intensity .*contiguous"),
            (lambda: kalman.settle(2**70), "t_us int: Python int too large")):
        with pytest.raises(ValueError, match=f"^{said}"):
            call()
    with pytest.raises(TypeError, match=r"^t_us must be ArrayLike, got str"):
        fan.stokes("x", 0, 0)
    with pytest.raises(TypeError, match=r"^snapshot must be a FusionSnapshot, got int"):
        pdavis_cv.fuse(pdavis_cv.recording_from_arrays(
            boundaries.some_events(), layout=boundaries.LAYOUT,
            sensor_size=boundaries.SIZE)).restore(3)
