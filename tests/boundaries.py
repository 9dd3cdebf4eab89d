"""Hostile values for each argument of the public callables, one at a time.

python tests/boundaries.py [--seed N] [--without-memory] [NAME ...]

A table says how each is called rightly; values are put in the place of one argument
after the other.  A call must return, or raise what its docstring says.
"""
import gc
import importlib
import inspect
import itertools
import math
import signal
import sys
import time
import tracemalloc
import warnings
from pathlib import Path

import numpy as np

sys.path[:0] = [str(Path(__file__).parent)]

import boundary_scenes  # noqa: E402

import pdavis_cv  # noqa: E402
from pdavis_cv import analysis, render  # noqa: E402
from pdavis_cv.reconstruct.denoise import EventDenoiser  # noqa: E402
from pdavis_cv.reconstruct.events import EventHighPass  # noqa: E402
from pdavis_cv.reconstruct.frames import FrameHold  # noqa: E402
from pdavis_cv.reconstruct.redundancy import EventRedundancy  # noqa: E402

SPOKEN = {"packet": "event", "picture": "frame"}
"""What errors call an argument of the calls below."""
ALLOWED = (TypeError, ValueError, pdavis_cv.PdavisError)
LONGEST_S = 5.0      # of processor time
WAIT_S = 60
MOST_BYTES = 200 << 20
DRAWN = None
"""Generator of the numbers, where others than the written ones are asked for."""
LONG = {("EventRedundancy", "shape"), ("Camera.stream", "step_us")}
"""Arguments for which a large number is a large task, no mistake: not drawn."""
SIZE = (12, 14)
LAYOUT = pdavis_cv.Layout.PDAVIS


def some_events(n=200, size=SIZE):
    """Return events in order on a small sensor."""
    rng = np.random.default_rng(0)
    events = np.zeros(n, pdavis_cv.EVENT_DTYPE)
    events["t"] = np.sort(rng.integers(0, 100_000, n))
    events["y"], events["x"] = rng.integers(0, size[0], n), rng.integers(0, size[1], n)
    events["p"] = rng.integers(0, 2, n)
    return events


def some_frame(t=50_000):
    """Return a frame of a small sensor."""
    dn = np.random.default_rng(1).uniform(100, 200, SIZE).astype(np.float32)
    return pdavis_cv.ApsFrame(dn, t - 1000, t + 1000, available_us=t + 2000)


def _times(*values):
    """Return copies of events at such times."""
    for value in values:
        events = some_events(len(value))
        events["t"] = value
        yield events


def hostile_events():
    """Yield events that are wrong, or at the limits, in some way."""
    good, low, high = some_events(), -2**63, 2**63 - 1
    if DRAWN is not None:
        for _ in range(12):
            yield from _times((DRAWN.choice((-1, 1), 3) * 2.0 ** DRAWN.uniform(
                0, 62.99, 3)).astype(np.int64))
    yield from _times(
        [low, high], [high, low], [low, low], [high, high], [0, high], [low, 0],
        [-2**61, 2**61], [2**61, 2**61 + 1], [-2**61 - 1, 0], [0, high, 5],
        [0, 2**62, 2**62 + 1], [-2**62, 2**62], [5, 4], [0] * 50, [2**53, 2**53 + 1])
    for field, value in itertools.product("xy", (65535, 14, 12)):
        bad = good.copy()
        bad[field][-1] = value
        yield bad
    bad = good.copy()
    bad["p"] = 255
    yield bad
    yield good[:0]
    yield good[:1]
    yield good[::-1]
    yield good[::2]
    yield np.lib.stride_tricks.as_strided(good, (50,), (0,))
    locked = good.copy()
    locked.flags.writeable = False
    yield locked
    yield good.astype(good.dtype.newbyteorder(">"))
    yield np.zeros(5, [("t", "f8"), ("x", "u2"), ("y", "u2"), ("p", "u1")])
    yield np.zeros((2, 2), good.dtype)
    yield np.zeros((), good.dtype)
    yield {"t": [0, 1], "x": [0], "y": [0], "p": [0]}
    yield {"t": [2**70], "x": [0], "y": [0], "p": [0]}
    yield {"t": [0.5], "x": [0], "y": [0], "p": [0]}
    yield {"t": [0], "x": [-1], "y": [0], "p": [0]}
    yield {}


def drawn_numbers(rng):
    """Yield numbers of any size and type, those near powers of two among them."""
    for _ in range(12):
        yield int(rng.choice((-1, 1))) * 2 ** int(rng.integers(70)) + int(
            rng.integers(-2, 3))
    for _ in range(16):
        value = float(rng.choice((-1, 1)) * 10.0 ** rng.uniform(-320, 308.2))
        yield value
        yield (np.float32, np.float64, np.float16)[int(rng.integers(3))](value)
    for dtype in ("i1", "u1", "i2", "u2", "i4", "u4", "i8", "u8"):
        limits = np.iinfo(dtype)
        yield np.dtype(dtype).type(rng.integers(
            limits.min, limits.max, endpoint=True, dtype=dtype))
    yield complex(*rng.normal(size=2))
    yield rng.normal(size=int(rng.integers(4)))
    yield rng.bytes(3)


def hostile_numbers():
    """Yield numbers that no sane program passes."""
    if DRAWN is not None:
        with np.errstate(all="ignore"), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield from drawn_numbers(DRAWN)
        return
    yield from (0, -1, 1, 2**31, 2**61, 2**61 + 1, 2**62, 2**63 - 1, -2**63, 2**64,
                10**30, 0.0, -0.0, 0.5, 1e-300, 1e300, -1e300, 5e-324, math.inf,
                -math.inf, math.nan, np.float32(3e38), np.int64(2**63 - 1), True,
                1j, "1", "", b"1", (), (1,), [], {}, np.array([]), np.array([1, 2]),
                np.array(math.nan), object())


def hostile_arrays(like):
    """Yield arrays that differ from one in shape, type, layout or values."""
    like = np.asarray(like)
    for value in (math.nan, math.inf, -math.inf, 0, -1, 3e38, 1e-45):
        with np.errstate(all="ignore"), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield np.full(like.shape, value).astype(like.dtype)
    yield like[:0]
    yield like[..., :0]
    yield like[:1]
    yield like[..., None]
    yield like[None]
    yield like[::-1]
    yield like[..., ::-2]
    yield like.astype(like.dtype.newbyteorder())
    yield np.asfortranarray(like)
    yield np.broadcast_to(like.flat[:1].reshape((1,) * like.ndim), like.shape)
    for dtype in ("f8", "f4", "f2", "u1", "i8", "u8", "?", "c16", "U1", "O", "M8[us]"):
        with np.errstate(all="ignore"), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            try:
                yield like.astype(dtype)
            except (TypeError, ValueError):
                continue
    locked = like.copy()
    locked.flags.writeable = False
    yield locked
    yield np.ma.masked_array(like)


def hostile(value):
    """Yield what is to be put in the place of an argument."""
    yield None
    yield from hostile_numbers()
    if isinstance(value, np.ndarray) and value.dtype.names:
        yield from hostile_events()
    elif isinstance(value, np.ndarray):
        yield from hostile_arrays(value)
    elif isinstance(value, tuple):
        for i, bad in itertools.product(range(len(value)), hostile_numbers()):
            yield (*value[:i], bad, *value[i + 1:])
        yield value + value
        yield value[:-1]


def cell_response():
    """Return what stands before the pixels of a cell, as methods are given it."""
    angles = np.deg2rad(2 * np.array(LAYOUT.angles_deg))
    return np.stack([np.ones((2, 2)), np.cos(angles), np.sin(angles)], -1) / 2


def table():
    """Return (name, callable, good keyword arguments) of what is tried."""
    events, frame = some_events(), some_frame()
    mosaic = np.random.default_rng(2).integers(0, 200, SIZE).astype(np.uint8)
    plane = np.random.default_rng(3).uniform(1, 2, SIZE).astype(np.float32)
    quad = np.stack([plane] * 4)
    both = {"shape": SIZE, "theta_on": 0.2, "theta_off": 0.2}
    recording = pdavis_cv.recording_from_arrays(
        events, [some_frame(20_000), frame], sensor_size=SIZE, layout=LAYOUT)
    span = {"start_us": 0, "stop_us": 100_000}
    p, a = pdavis_cv, analysis

    def fused(**arguments):
        return list(itertools.islice(p.fuse(recording, **arguments), 3))

    def read(make):
        def run(t_us=60_000, packet=events, picture=frame, **arguments):
            method = make(**arguments)
            method.add_events(packet[:0] if packet is events else packet)
            method.add_frame(picture)
            return method.read(t_us)
        return run

    def denoised(packet=events, **arguments):
        return EventDenoiser(**arguments).filter(packet)

    def angles(packet=events, **arguments):
        return p.AopEvents(**arguments).add(packet)

    rows = [
        ("accumulate", p.accumulate, {
            "events": events, "shape": SIZE, **span}),
        ("as_events", p.as_events, {"events": events}),
        ("aop", p.aop, {"s1": plane, "s2": plane}),
        ("dolp", p.dolp, {"s0": plane, "s1": plane, "s2": plane}),
        ("debias_dolp", p.debias_dolp, {"dolp": plane, "sigma": plane}),
        ("stokes", p.stokes, {"quad": quad, "extinction_ratio": 40.0}),
        ("demosaic", p.demosaic, {"mosaic": mosaic, "layout": LAYOUT,
                                  "method": "bilinear", "valid": mosaic > 3}),
        ("polarization", p.polarization, {
            "mosaic": mosaic, "layout": LAYOUT, "demosaic": "bilinear",
            "extinction_ratio": 40.0}),
        ("cds", p.cds, {"reset": mosaic.astype("u2") + 600,
                        "signal": mosaic.astype("u2"), "dark": plane, "gain": plane}),
        ("unpack", p.unpack, {"data": np.arange(36, dtype=np.uint8),
                              "packing": "12p", "shape": (4, 6)}),
        ("ApsFrame", p.ApsFrame, {
            "dn": plane, "exposure_start_us": 5, "exposure_end_us": 9,
            "valid": plane > 1, "available_us": 20, "full_scale_dn": 1023}),
        ("Layout", p.Layout, {"row0": (90, 45), "row1": (135, 0)}),
        ("recording_from_arrays", p.recording_from_arrays, {
            "events": events, "frames": (frame,), "sensor_size": SIZE}),
        ("EventDenoiser", denoised, {
            "packet": events, "shape": SIZE, "window_us": 5000, "support": 1}),
        ("AopEvents", angles, {
            "packet": events, **both, "layout": LAYOUT, "cutoff_hz": 0.5, "radius": 1}),
        ("fuse", fused, {
            "method": "cf", "fps": 50.0, "start_us": 0, "stop_us": 90_000,
            "roi": (0, 0, 4, 4), "extinction_ratio": 40.0, "demosaic": "bilinear",
            "thresholds": (0.2, 0.2), "causal": False, "denoise": False}),
        ("fuse at times", fused, {
            "method": "frames", "times_us": np.array([30_000, 60_000])}),
        ("fuse kalman", fused, {
            "method": "kalman", "mode": "offline", "lookahead_us": 100_000,
            "thresholds": (0.2, 0.2)}),
        ("axial_difference", a.axial_difference, {"a": plane, "b": plane}),
        ("retardance", a.retardance, {"dolp": plane / 4}),
        ("aop_bgr", render.aop_bgr, {"aop": plane, "valid": plane > 1}),
        ("dolp_bgr", render.dolp_bgr, {"dolp": plane, "valid": plane > 1}),
        ("grey_bgr", render.grey_bgr, {"intensity": plane, "white": 2.0}),
        ("events_on", render.events_on, {
            "picture": SIZE, "events": events, "origin": (0, 0)}),
    ]
    for name, method, more in (
            ("KalmanFilter", p.KalmanFilter, {"lookahead_us": 5000}),
            ("ComplementaryFilter", p.ComplementaryFilter, {"cutoff_hz": 1.0}),
            ("EventHighPass", EventHighPass, {"cutoff_hz": 0.5, "radius": 1}),
            ("EventRedundancy", EventRedundancy, {
                "cutoff_hz": 0.5, "response": cell_response()}),
            ("FrameHold", FrameHold, {})):
        accepted = inspect.signature(method).parameters
        given = {k: v for k, v in (both | more).items() if k in accepted}
        rows.append((name, read(method), {
            **given, "t_us": 60_000, "packet": events, "picture": frame}))
    return rows + boundary_scenes.rows()


class Hang(Exception):
    """A call took longer than it may."""


def _stop(number, stack):
    raise Hang


def tried(name, function, arguments, changed):
    """Call once; return what is wrong with the outcome, or None."""
    begun = time.process_time()     # others' work on this machine does not count
    signal.setitimer(signal.ITIMER_REAL, WAIT_S)
    try:
        with warnings.catch_warnings(), np.errstate(all="ignore"):
            warnings.simplefilter("ignore")
            function(**arguments)
    except pdavis_cv.PdavisError:
        pass
    except ALLOWED as error:
        argument = changed.partition("=")[0]
        named = {argument, SPOKEN.get(argument, argument), *(
            word for word in argument.split("_") if len(word) > 3)}
        if isinstance(error, TypeError) and not any(n in str(error) for n in named):
            return f"{name}({changed}): an error of something inside: {error}"
    except Hang:
        return f"{name}({changed}): took more than {WAIT_S:g} s"
    except BaseException as error:
        return f"{name}({changed}): {type(error).__name__}: {error}"
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
    took = time.process_time() - begun
    return f"{name}({changed}): took {took:.1f} s" if took > LONGEST_S else None


def run(names=None, memory=False):
    """Try everything; return (calls, complaints)."""
    before = signal.signal(signal.SIGALRM, _stop)
    calls, wrong = 0, []
    importlib.import_module("scipy.signal")     # takes longer than a call may
    if memory:
        tracemalloc.start()
    try:
        for name, function, good in table():
            if names and name not in names:
                continue
            problem = tried(name, function, good, "as it should be called")
            if problem:
                wrong.append(problem)
            for argument, value in good.items():
                for bad in hostile(value):
                    if DRAWN is not None and (name, argument) in LONG:
                        continue
                    if memory and tracemalloc.get_traced_memory()[0] > MOST_BYTES // 4:
                        gc.collect()    # what refused calls left in cycles
                    if memory:
                        tracemalloc.reset_peak()
                    changed = f"{argument}={_short(bad)}"
                    problem = tried(name, function, {**good, argument: bad}, changed)
                    calls += 1
                    if memory and problem is None:
                        peak = tracemalloc.get_traced_memory()[1]
                        if peak > MOST_BYTES:
                            problem = f"{name}({changed}): {peak >> 20} MB"
                    if problem:
                        wrong.append(problem)
    finally:
        signal.signal(signal.SIGALRM, before)
        if memory:
            tracemalloc.stop()
    return calls, wrong


def _short(value):
    if isinstance(value, np.ndarray) and value.dtype.names and value.ndim == 1:
        return f"events at {value['t'][:3]}"
    return " ".join(repr(value).split())[:60]


if __name__ == "__main__":
    import argparse
    import faulthandler
    faulthandler.dump_traceback_later(600, exit=True)
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*")
    parser.add_argument("--without-memory", action="store_true",
                        help="sanitizers keep what is freed")
    parser.add_argument("--seed", type=int, help="draw the numbers")
    args = parser.parse_args()
    if args.seed is not None:
        DRAWN = np.random.default_rng(args.seed)
    number, found = run(args.names, memory=not args.without_memory)
    print(*found, sep="\n", end="\n" if found else "")
    print(number, "calls,", len(found), "complaints")
    sys.exit(bool(found))
