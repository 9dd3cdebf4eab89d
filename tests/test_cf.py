import pickle
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import reference
from hypothesis import given, settings, strategies as st
from streams import feed, random_events, random_frame

import pdavis_cv
from pdavis_cv import ApsFrame, ComplementaryFilter
from pdavis_cv.reconstruct.cf import RULES
from pdavis_cv.reconstruct.frames import FrameHold

SHAPE = (6, 8)
OPTIONS = [(adaptive, rule) for adaptive in (True, False) for rule in RULES]
MAPS = np.random.default_rng(9).uniform(0.1, 0.3, (2, *SHAPE))


def make(shape=SHAPE, on=0.2, off=0.25, **options):
    return ComplementaryFilter(shape, theta_on=on, theta_off=off, **options)


def frames_of(times, shape=SHAPE):
    return [random_frame(shape, t, seed=i) for i, t in enumerate(times)]


@st.composite
def recordings(draw):
    origin = draw(st.sampled_from([0, 10_000, 1_600_000_000_000_000]))
    seconds = draw(st.sampled_from([0.001, 0.1, 3.0, 4000.0]))
    stop = origin + int(seconds * 1e6)
    events = random_events(draw(st.integers(0, 400)), SHAPE, start_us=origin,
                           stop_us=stop, seed=draw(st.integers(0, 99)))
    mids = sorted(draw(st.sets(st.integers(origin, stop - 1), max_size=5)))
    read = stop + draw(st.sampled_from([0, 1, 20_000, 10_000_000]))
    return events, frames_of(mids), read


@settings(max_examples=150)
@given(recordings(), st.sampled_from(OPTIONS), st.booleans(),
       st.sampled_from([0.5, 1.6, 30.0]))
def test_it_equals_float64_evaluation_of_the_equations(stream, options, maps, cutoff):
    events, frames, read_us = stream
    on, off = MAPS if maps else (0.2, 0.25)
    adaptive, rule = options
    mine = make(on=on, off=off, cutoff_hz=cutoff, adaptive_gain=adaptive,
                rule=rule)
    exact = reference.ComplementaryFilter(SHAPE, on, off, cutoff, adaptive, rule)
    feed(mine, events, frames)
    feed(exact, events, frames)
    estimate = mine.read(read_us)
    np.testing.assert_allclose(estimate.log_intensity, exact.read(read_us), atol=1e-4,
                               rtol=0)
    np.testing.assert_array_equal(estimate.valid, exact.valid)
    assert estimate.variance is None


@pytest.mark.parametrize("options", OPTIONS)
def test_busy_pixels_stay_within_the_tolerance(options):
    events = random_events(30_000, (1, 1), stop_us=3_000_000)
    frames = frames_of([100_000, 1_000_000, 2_000_000], (1, 1))
    adaptive, rule = options
    mine = make((1, 1), adaptive_gain=adaptive, rule=rule)
    exact = reference.ComplementaryFilter((1, 1), 0.2, 0.25, 1.6, adaptive, rule)
    feed(mine, events, frames)
    feed(exact, events, frames)
    np.testing.assert_allclose(mine.read(3_000_000).log_intensity,
                               exact.read(3_000_000), atol=1e-4, rtol=0)


@settings(max_examples=40)
@given(recordings(), st.sampled_from(OPTIONS), st.lists(st.integers(0, 400)))
def test_how_the_stream_is_cut_changes_no_bit(stream, options, cuts):
    events, frames, read_us = stream
    adaptive, rule = options
    whole, cut = (make(adaptive_gain=adaptive, rule=rule) for _ in range(2))
    feed(whole, events, frames)
    at = 0
    for frame in frames:
        end = int(np.searchsorted(events["t"], frame.mid_us))
        for i in [*sorted(c for c in cuts if at < c < end), end]:
            cut.add_events(events[at:i])
            at = i
        cut.add_frame(frame)
    for i in [*sorted(c for c in cuts if at < c < len(events)), len(events)]:
        cut.add_events(events[at:i])
        at = i
    np.testing.assert_array_equal(cut.read(read_us).log_intensity,
                                  whole.read(read_us).log_intensity)


@pytest.mark.parametrize("rule", RULES)
def test_a_snapshot_survives_pickling_and_restores_every_bit(rule):
    events = random_events(2000, SHAPE)
    frames = frames_of([200_000, 700_000])
    first = make(rule=rule)
    feed(first, events[:900], frames[:1])
    snapshot = first.snapshot()
    kept = pickle.dumps(snapshot)
    feed(first, events[900:], frames[1:])
    want = first.read(1_000_000)
    assert pickle.dumps(snapshot) == kept  # deep: feeding did not touch it
    for _ in range(2):  # restoring does not use it up
        other = make(rule=rule)
        other.restore(pickle.loads(kept))
        feed(other, events[900:], frames[1:])
        got = other.read(1_000_000)
        np.testing.assert_array_equal(got.log_intensity, want.log_intensity)
        np.testing.assert_array_equal(got.valid, want.valid)


@pytest.mark.parametrize(("other", "message"), [
    (make((8, 6)), "shape"),
    (make(on=0.21), "theta_on"),
    (make(on=np.full(SHAPE, 0.2)), "theta_on"),
    (make(rule="printed"), "rule"),
    (FrameHold(SHAPE), "method"),
])
def test_a_foreign_snapshot_is_refused(other, message):
    with pytest.raises(ValueError, match=message):
        make().restore(other.snapshot())


def test_reading_does_not_change_the_state():
    events = random_events(500, SHAPE)
    read_often, read_once = make(), make()
    for start in range(0, 500, 50):
        part = events[start:start + 50]
        if start == 100:
            for method in (read_often, read_once):
                method.add_frame(random_frame(SHAPE, int(part["t"][0])))
        read_often.add_events(part)
        read_often.read(int(part["t"][-1]) + 10_000_000)
        read_once.add_events(part)
    np.testing.assert_array_equal(read_often.read(2_000_000).log_intensity,
                                  read_once.read(2_000_000).log_intensity)


def test_eight_filters_in_eight_threads_give_the_same_bits():
    events = random_events(200_000, (64, 80))
    frames = frames_of([100_000, 500_000, 900_000], (64, 80))

    def run(_):
        method = make((64, 80))
        feed(method, events, frames)
        return method.read(1_000_000).log_intensity

    with ThreadPoolExecutor(8) as pool:
        results = list(pool.map(run, range(8)))
    for result in results[1:]:
        np.testing.assert_array_equal(result, results[0])


def test_it_starts_at_the_first_frame():
    frame = random_frame(SHAPE, 500_000)
    method = make()
    method.add_events(random_events(300, SHAPE, stop_us=400_000))
    before = method.read(400_000)
    assert not before.valid.any()
    assert before.log_intensity.any()
    method.add_frame(frame)
    estimate = method.read(9_000_000)
    want = np.log(np.maximum(frame.dn, 1) / frame.exposure_ms)
    np.testing.assert_allclose(estimate.log_intensity, want, atol=1e-6)
    np.testing.assert_array_equal(estimate.valid, frame.valid & (frame.dn >= 1))


def test_without_exposure_the_unit_is_dn():
    method = make()
    method.add_frame(ApsFrame(np.full(SHAPE, 50.0), 7, 7))
    np.testing.assert_allclose(method.read(7).log_intensity, np.log(50), rtol=1e-6)


def test_a_nan_sample_is_the_floor_and_not_valid():
    dn = np.full(SHAPE, 50.0)
    dn[2, 3] = np.nan
    method = make()
    method.add_frame(ApsFrame(dn, 0, 1000))
    estimate = method.read(1000)
    assert np.argwhere(~estimate.valid).tolist() == [[2, 3]]
    assert np.isfinite(estimate.log_intensity).all()


def test_an_unusable_sample_makes_its_pixel_invalid_until_a_usable_one():
    usable, good = np.ones(SHAPE, bool), np.full(SHAPE, 400.0)
    usable[1, 1] = False
    method = make()
    seen = []
    for i, valid in enumerate([None, usable, None]):
        method.add_frame(ApsFrame(good, i * 50_000, i * 50_000 + 100, valid=valid))
        seen.append(bool(method.read(i * 50_000 + 100).valid[1, 1]))
    assert seen == [True, False, True]


def test_the_printed_equation_decays_towards_zero_and_cf_towards_the_frame():
    frame = ApsFrame(np.full(SHAPE, 500.0), 0, 1000)
    events = np.zeros(1, pdavis_cv.EVENT_DTYPE)
    events["t"] = 60_000_000
    values = {}
    for rule in RULES:
        method = make(rule=rule)
        method.add_frame(frame)
        method.add_events(events)
        values[rule] = method.read(60_000_000).log_intensity[0, 0]
    for rule in ("transfer", "authors"):
        assert values[rule] == pytest.approx(np.log(500) - 0.25, abs=1e-5)
    assert values["printed"] == pytest.approx(-0.25, abs=1e-5)


def test_the_authors_weigh_the_time_before_a_frame_by_that_frame():
    """After a long silence the new frame decides at once, not from then on."""
    frames = [ApsFrame(np.full(SHAPE, dn), t, t + 1000)
              for dn, t in ((100.0, 0), (500.0, 60_000_000))]
    values = {}
    for rule in ("transfer", "authors"):
        method = make(rule=rule)
        for frame in frames:
            method.add_frame(frame)
        values[rule] = method.read(60_000_500).log_intensity[0, 0]
    assert values["transfer"] == pytest.approx(np.log(100), abs=1e-5)
    assert values["authors"] == pytest.approx(np.log(500), abs=1e-5)


def test_each_column_of_a_rolling_shutter_acts_from_its_own_middle_on():
    start = 500_000 + np.arange(8) * 4_000
    rolling = ApsFrame(random_frame(SHAPE, 0, seed=5).dn, start, start + 10_000)
    first = random_frame(SHAPE, 0, seed=4)
    events = random_events(800, SHAPE, start_us=10_000, stop_us=900_000)
    method = make(adaptive_gain=False)
    feed(method, events, [first, rolling])
    got = method.read(1_000_000).log_intensity
    for column in range(8):
        exact = reference.ComplementaryFilter(
            SHAPE, 0.2, 0.25, 1.6, False, "transfer")
        middle = ApsFrame(rolling.dn, int(start[column]), int(start[column]) + 10_000)
        feed(exact, events, [first, middle])
        np.testing.assert_allclose(got[:, column], exact.read(1_000_000)[:, column],
                                   atol=1e-5)


def test_events_have_one_unit_whatever_their_field_names():
    events = random_events(100, SHAPE)
    renamed = events.view(
        [("timestamp", "<u8"), ("x", "<u2"), ("y", "<u2"), ("on", "?")])
    one, two = make(), make()
    one.add_events(events)
    two.add_events(renamed)
    np.testing.assert_array_equal(one.read(1_000_000).log_intensity,
                                  two.read(1_000_000).log_intensity)


def test_other_thresholds_hold_for_the_events_to_come():
    method = make(adaptive_gain=False, cutoff_hz=1e-6)
    method.add_frame(frames_of([1000])[0])
    events = np.zeros(2, pdavis_cv.EVENT_DTYPE)
    events["t"], events["p"] = (2000, 3000), 1
    method.add_events(events[:1])
    before = method.read(2500).log_intensity[0, 0]
    method.retune(theta_on=np.full(SHAPE, 0.5))
    assert method.read(2500).log_intensity[0, 0] == before
    method.add_events(events[1:])
    after = method.read(3000).log_intensity[0, 0]
    assert after - before == pytest.approx(0.5, abs=1e-6)
    with pytest.raises(TypeError, match="takes theta_on and theta_off, got bandwidth"):
        method.retune(bandwidth=(1, 0))


def test_inputs_are_not_changed_and_strides_do_not_matter():
    events = random_events(100, SHAPE, read_only=False)
    kept, frame = events.copy(), random_frame(SHAPE, 500_000)
    dn = frame.dn.copy()
    one, two = make(), make()
    feed(one, events[::2], [frame])
    feed(two, events[::2].copy(), [frame])
    np.testing.assert_array_equal(events, kept)
    np.testing.assert_array_equal(frame.dn, dn)
    np.testing.assert_array_equal(one.read(1_000_000).log_intensity,
                                  two.read(1_000_000).log_intensity)


@pytest.mark.parametrize(("field", "value", "message"), [
    ("x", 8, r"event 7 at \(x=8, .* outside the 8x6 sensor"),
    ("y", 6, r"event 7 at \(x=.*y=6, .* outside the 8x6 sensor"),
    ("p", 2, r"event 7 at .*p=2\) lies outside"),
    ("t", -1, r"event 7 at t=-1 comes after t="),
])
@pytest.mark.parametrize("on", [0.2, np.full(SHAPE, 0.2)], ids=["scalar", "map"])
def test_a_bad_event_is_named_and_those_before_it_are_taken(field, value, message, on):
    events = random_events(10, SHAPE, read_only=False)
    bad = events.copy()
    bad[field][7] = value
    method, other = make(on=on), make(on=on)
    with pytest.raises(ValueError, match=message):
        method.add_events(bad)
    other.add_events(events[:7])
    np.testing.assert_array_equal(method.read(1_000_000).log_intensity,
                                  other.read(1_000_000).log_intensity)


def test_time_does_not_run_backward():
    method = make()
    events = random_events(1, SHAPE, start_us=1000, stop_us=1001)
    method.add_events(events)
    with pytest.raises(ValueError, match="event 0 at t=999 comes after t=1000"):
        method.add_events(random_events(1, SHAPE, start_us=999, stop_us=1000))
    with pytest.raises(ValueError, match="mid-exposure 900 us lies before"):
        method.add_frame(ApsFrame(np.ones(SHAPE), 900, 900))
    with pytest.raises(ValueError, match=r"t_us must not lie before .* 1000, got 999"):
        method.read(999)
    method.add_events(events)  # ties are in order


def test_a_frame_of_another_shape_is_refused():
    with pytest.raises(ValueError, match="frame must be 8x6, got 6x8"):
        make().add_frame(ApsFrame(np.ones((8, 6)), 0, 1))


@pytest.mark.parametrize(("options", "message"), [
    ({"on": 0}, "theta_on must be positive and finite, got 0"),
    ({"off": -0.2}, "theta_off must be positive and finite, got -0.2"),
    ({"on": np.ones((2, 2))}, r"theta_on must be a scalar or have shape \(6, 8\)"),
    ({"rule": "literal"}, r"rule must be one of .*, got 'literal'"),
    ({"cutoff_hz": float("nan")}, "cutoff_hz must be positive and finite, got nan"),
    ({"shape": (0, 4)}, r"shape must lie in 1..65536, got \(0, 4\)"),
    ({"shape": 4}, r"shape must be \(height, width\), got 4"),
])
def test_an_impossible_parameter_is_refused(options, message):
    with pytest.raises(ValueError, match=message):
        make(**options)


def test_out_receives_the_log_intensity():
    method = make()
    method.add_frame(random_frame(SHAPE, 0))
    out = np.full(SHAPE, np.nan, np.float32)
    for each in (method, make(rule="authors"), make(rule="printed")):
        each.read(10_000, out=out)
        np.testing.assert_array_equal(out, each.read(10_000).log_intensity)
    assert method.read(0, out=out).log_intensity is out
    with pytest.raises(TypeError, match="out must be float32, got float64"):
        method.read(0, out=np.zeros(SHAPE))
