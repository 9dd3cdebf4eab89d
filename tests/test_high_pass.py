import pickle

import numpy as np
import pytest
import reference
from hypothesis import given, settings, strategies as st
from streams import feed, random_events, random_frame

from pdavis_cv import _kernels
from pdavis_cv.reconstruct.cf import CELL_DTYPE
from pdavis_cv.reconstruct.events import EventHighPass

SHAPE = (6, 8)
MAPS = np.random.default_rng(9).uniform(0.1, 0.3, (2, *SHAPE))


def make(shape=SHAPE, on=0.2, off=0.25, **options):
    return EventHighPass(shape, theta_on=on, theta_off=off, **options)


@settings(max_examples=60)
@given(st.integers(0, 200), st.integers(0, 99), st.integers(0, 5), st.booleans(),
       st.sampled_from([SHAPE, (2, 2), (1, 1), (3, 9)]),
       st.sampled_from([0, 1_600_000_000_000_000]), st.booleans())
def test_it_equals_float64_evaluation_of_the_equation(
        n, seed, radius, maps, shape, start, hold):
    events = random_events(n, shape, seed=seed, start_us=start, stop_us=start + 10**6)
    on, off = MAPS if maps and shape == SHAPE else (0.2, 0.25)
    method = make(shape, on, off, radius=radius, hold=hold)
    method.add_events(events)
    t = start + 1_200_000
    want, seen = reference.event_high_pass(
        events, shape, on, off, 0.5, radius, t, hold)
    estimate = method.read(t)
    np.testing.assert_allclose(estimate.log_intensity, want, atol=1e-5)
    np.testing.assert_array_equal(estimate.valid, seen)


def test_a_step_decays_with_the_time_constant():
    method = make(radius=0, hold=False)
    event = random_events(1, SHAPE, stop_us=1)
    method.add_events(event)
    y, x = int(event["y"][0]), int(event["x"][0])
    tau_us = round(1e6 / np.pi)
    first, later = (method.read(t).log_intensity[y, x] for t in (0, tau_us))
    assert later / first == pytest.approx(np.exp(-1), rel=1e-5)


def test_frames_change_nothing_but_the_time():
    events = random_events(200, SHAPE, stop_us=900_000)
    with_frames, without = make(), make()
    feed(with_frames, events, [random_frame(SHAPE, 500_000)])
    without.add_events(events)
    np.testing.assert_array_equal(with_frames.read(10**6).log_intensity,
                                  without.read(10**6).log_intensity)
    late = make()
    late.add_frame(random_frame(SHAPE, 500_000))
    with pytest.raises(ValueError, match="comes after t=500000"):
        late.add_events(events)


def test_the_margin_is_what_a_result_depends_on():
    shape = (12, 14)
    events = random_events(2000, shape)
    whole = make(shape)
    whole.add_events(events)
    rows, columns = slice(4, 8), slice(4, 10)
    m = whole.margin
    x, y = events["x"].astype(int) - (4 - m), events["y"].astype(int) - (4 - m)
    inside = (x >= 0) & (y >= 0) & (x < 6 + 2 * m) & (y < 4 + 2 * m)
    cut = events[inside]
    cut["x"], cut["y"] = x[inside], y[inside]
    part = make((4 + 2 * m, 6 + 2 * m))
    part.add_events(cut)
    np.testing.assert_array_equal(part.read(10**6).log_intensity[m:-m, m:-m],
                                  whole.read(10**6).log_intensity[rows, columns])


def test_a_snapshot_survives_pickling_and_restores_every_bit():
    events = random_events(1000, SHAPE)
    method, other = make(), make()
    method.add_events(events[:400])
    snapshot = pickle.loads(pickle.dumps(method.snapshot()))
    method.add_events(events[400:])
    other.restore(snapshot)
    other.add_events(events[400:])
    want, got = method.read(10**6), other.read(10**6)
    np.testing.assert_array_equal(got.log_intensity, want.log_intensity)
    np.testing.assert_array_equal(got.valid, want.valid)
    with pytest.raises(ValueError, match="other parameters: radius"):
        make(radius=2).restore(snapshot)


@pytest.mark.parametrize(("options", "message"), [
    ({"radius": -1}, "radius must be a whole number of 0..32, got -1"),
    ({"radius": 0.5}, "radius must be a whole number of 0..32, got 0.5"),
    ({"cutoff_hz": 0}, "cutoff_hz must be positive"),
    ({"on": -1}, "theta_on must be positive"),
])
def test_an_impossible_parameter_is_refused(options, message):
    with pytest.raises(ValueError, match=message):
        make(**options)


def test_out_receives_the_result():
    method = make()
    method.add_events(random_events(100, SHAPE))
    out = np.full(SHAPE, np.nan, np.float32)
    assert method.read(10**6, out=out).log_intensity is out
    np.testing.assert_array_equal(out, method.read(10**6).log_intensity)


def test_the_kernels_check_shapes():
    image, flags = np.zeros((2, 3), np.float32), np.zeros((2, 3), np.uint8)
    with pytest.raises(ValueError, match="leak_shown:"):
        _kernels.leak_shown(
            random_events(3, SHAPE), np.zeros((2, 2), CELL_DTYPE), image, flags)
    offsets = np.zeros((1, 2), np.intp)
    for own, count, steps in ((image[:1], image, offsets), (image, image[:1], offsets),
                              (image, image, offsets[:, :1].copy())):
        with pytest.raises(ValueError, match="mean_around:"):
            _kernels.mean_around(own, count, steps, image.copy())
