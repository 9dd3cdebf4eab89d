"""The filter of learned increments equals its plain version, and what it promises."""
import pickle

import numpy as np
import pytest
import reference_increments
from streams import feed, random_events, random_frame

from pdavis_cv import EVENT_DTYPE, ApsFrame, Estimate, KalmanFilter, _kernels
from pdavis_cv._workers import Workers
from pdavis_cv.pixel.model import PixelModel, lags_of
from pdavis_cv.reconstruct.lamp import BLOCK_US, Wave

SHAPE = (4, 6)
MODES = ("causal", "buffered", "offline")
RNG = np.random.default_rng(5)
PLAIN = PixelModel(theta=np.array([0.2, 0.16]))
TABLE = PLAIN.replace(
    end=RNG.uniform(0, 0.6, (4, 5)), bow=RNG.uniform(0, 0.3, (4, 5)),
    open_variance=RNG.uniform(0.02, 0.1, (4, 5)), rest_s=0.1,
    by_class=RNG.normal(0, 0.02, (2, 5)), theta_cov=np.diag([1e-3, 5e-4]))
WHOLE = TABLE.replace(
    lags_s=lags_of(50_000),
    own=RNG.normal(0, 0.03, (5, 2)), cell=RNG.normal(0, 0.03, (5, 2)),
    near=RNG.normal(0, 0.03, (5, 2)),
    cell_now=RNG.normal(0, 0.03, 2), near_now=RNG.normal(0, 0.03, 2), dead_s=1e-3,
    black=4.0)
MODELS = {"plain": PLAIN, "table": TABLE, "whole": WHOLE,
          "slow": WHOLE.replace(bandwidth=(15.0, 0.0), rest_s=0.5)}


def make(shape=SHAPE, model=WHOLE, **options):
    return KalmanFilter(shape, theta_on=0.2, theta_off=0.2, model=model, **options)


def stream(seed=0, *, n=500, exposures=10_000, events_us=900_000):
    """Events of a second and frames, of which one is rolling and one is missing."""
    events = random_events(n, SHAPE, seed=seed, stop_us=events_us)
    frames = [random_frame(SHAPE, t, seed=seed + t, exposure_us=exposures, low=50,
                           high=900)
              for t in (40_000, 90_000, 140_000, 460_000, 510_000, 900_000)]
    rolling = frames[2]
    move = 700 * np.arange(SHAPE[1])
    frames[2] = ApsFrame(rolling.dn, rolling.exposure_start_us + move,
                         rolling.exposure_end_us + move, valid=rolling.valid)
    return events, frames


def fed(method, events, frames, seen_us, cuts=()):
    """Feed what precedes a time, in packets; frames in order of their middle."""
    at = 0
    todo = sorted([(f.mid_us, f) for f in frames if f.mid_us < seen_us]
                  + [(t, None) for t in cuts if t < seen_us], key=lambda x: x[0])
    for t, frame in todo:
        end = int(np.searchsorted(events["t"], t))
        method.add_events(events[at:end])
        at = end
        if frame is not None:
            method.add_frame(frame)
    method.add_events(events[at:int(np.searchsorted(events["t"], seen_us))])
    return method


def bits(estimate):
    return tuple(np.asarray(part).tobytes() for part in estimate)


def read(method, t):
    """What the filter says, without redundancy and without the lasting degree."""
    log, variance = np.empty((2, *method.shape), np.float32)
    valid = np.empty(method.shape, bool)
    seen = t + method.lookahead_us
    method._at(t, seen)._show(t, seen, log, variance, valid)
    return Estimate(log, variance, valid)


@pytest.mark.parametrize("exposure", [1000, 30_000])
@pytest.mark.parametrize("name", MODELS)
@pytest.mark.parametrize("mode", MODES)
def test_it_equals_its_plain_version(mode, name, exposure):
    model = MODELS[name]
    events, frames = stream(seed=MODES.index(mode), exposures=exposure)
    twin = reference_increments.Filter(events, frames, model, SHAPE, mode=mode)
    one = make(model=model, mode=mode)
    for t in (35_000, 163_017, 700_000):
        seen = t + one.lookahead_us
        got = read(fed(make(model=model, mode=mode), events, frames, seen), t)
        log, variance = twin.read(t)
        known = variance < 1e3
        np.testing.assert_allclose(got.log_intensity[known], log[known], atol=3e-4,
                                   err_msg=str(t))
        np.testing.assert_allclose(got.variance[known], variance[known], rtol=2e-3,
                                   err_msg=str(t))
        assert not got.valid[~known].any()
    assert known.all()


@pytest.mark.parametrize("mode", MODES)
def test_more_time_counts_where_events_are_missing_as_in_its_plain_version(mode):
    """One gap begins after the middle of an exposure, and is of no interval before."""
    events, frames = stream(n=8000, exposures=44_000)
    t = events["t"]
    for begin, end in ((91_000, 111_000), (150_000, 400_000), (465_000, 495_000)):
        events, t = (one[(t < begin) | (t > end)] for one in (events, t))
    model = WHOLE.replace(missing=0.7)
    twin = reference_increments.Filter(events, frames, model, SHAPE, mode=mode)
    changed = False
    for t in (300_017, 475_000, 700_000):
        one, other = (make(model=m, mode=mode) for m in (model, WHOLE))
        seen = t + one.lookahead_us
        got, old = (read(fed(each, events, frames, seen), t) for each in (one, other))
        log, variance = twin.read(t)
        np.testing.assert_allclose(got.log_intensity, log, atol=4e-4, err_msg=str(t))
        np.testing.assert_allclose(got.variance, variance, rtol=2e-3, err_msg=str(t))
        changed |= bool(np.any(np.abs(got.log_intensity - old.log_intensity) > 0.01))
    assert changed


def test_light_that_turns_in_a_parabola_is_exact_in_spite_of_dead_time():
    """(4) and (2b): J = 150 t - 2e4 t^2, thresholds of .2, 1 ms of reset."""
    rise, bend, dead, theta = 150.0, -2e4, 1e-3, 0.2
    live = (rise - np.sqrt(rise**2 - 4 * bend * theta)) / (2 * bend)
    after = np.roots([bend, rise, theta - rise * dead - bend * dead**2]).max()
    times = np.round(1e6 * np.array([-0.01, -live - dead, 0, after])).astype(int)
    pixel = reference_increments.Pixel(times, [1, 1, 1, -1], -20_000, PLAIN.replace(
        theta=np.full(2, theta), dead_s=dead))
    for share in (0.2, 0.5, 0.999, 1.0):
        t = share * times[-1]
        change = (pixel.y(t, 10**6)[0] - pixel.y(0, 10**6)[0]).sum()
        assert change == pytest.approx(1e-6 * t * (rise + bend * 1e-6 * t), abs=2e-3)


@pytest.mark.parametrize("mode", MODES)
def test_events_of_both_signs_at_one_time_leave_the_pixel_finite(mode):
    events, frames = stream(3)
    twice = np.repeat(events[100:300], 2)
    twice["p"][1::2] ^= 1
    events = np.sort(np.concatenate([events, twice]), order="t", kind="stable")
    one = make(mode=mode)
    fed(one, events, frames, 800_000)
    got = one.read(800_000 - one.lookahead_us)
    assert np.isfinite(got.log_intensity).all()
    assert np.isfinite(got.variance).all()


@pytest.mark.parametrize("mode", MODES)
def test_pixels_that_have_been_still_are_shown_as_others(mode, monkeypatch):
    """They are not looked at until an event comes (`increments_rest`)."""
    events, frames = stream(11, n=80, events_us=2_900_000)
    frames += [random_frame(SHAPE, t, seed=t, low=50, high=900)
               for t in range(1_000_000, 2_900_000, 100_000)]
    shown, quiet = {}, {}
    for all_ in (False, True):
        monkeypatch.setattr(KalmanFilter, "_lit", all_)
        one = make(mode=mode)
        shown[all_], quiet[all_], fed_us = [], 0, -1
        for t in range(30_000, 2_800_000, 37_000):
            now = t + one.lookahead_us
            new = (events["t"] > fed_us) & (events["t"] <= now)
            feed(one, events[new], [f for f in frames if fed_us < f.mid_us <= now])
            one.settle(now)
            fed_us = now
            shown[all_].append(read(one, t))
            quiet[all_] += one._store.awake.size - one._awake.size
    assert quiet[False] > 300
    assert quiet[True] == 0
    for some, others in zip(shown[False], shown[True], strict=True):
        np.testing.assert_allclose(some.log_intensity, others.log_intensity, atol=1e-6)
        np.testing.assert_allclose(some.variance, others.variance, rtol=1e-5)


@pytest.mark.parametrize("mode", MODES)
def test_packets_threads_and_other_images_change_no_bit(mode):
    events, frames = stream(3, n=900, exposures=20_000)
    rng = np.random.default_rng(0)
    ahead = make(mode=mode).lookahead_us
    times = np.sort(rng.integers(30_000, 800_000, 25))
    whole = {t: bits(read(fed(make(mode=mode), events, frames, t + ahead), t))
             for t in times}
    for seed, threads in ((0, 1), (1, 2), (2, 8)):
        cuts = [*np.random.default_rng(seed).integers(0, 900_000, 40), *(times + ahead)]
        one = make(mode=mode)
        one.workers = Workers(threads)
        at, todo = 0, sorted(
            [(f.mid_us, 0, f) for f in frames] + [(int(t), 1, None) for t in cuts]
            + [(int(t + ahead), 2, int(t)) for t in times[seed::2]],
            key=lambda x: x[:2])
        for t, kind, what in todo:
            end = int(np.searchsorted(events["t"], t))
            one.add_events(events[at:end])
            at = end
            if kind == 0:
                one.add_frame(what)
            elif kind == 2:
                if seed:
                    one.settle(t)
                assert bits(read(one, what)) == whole[what]
                light, *others = one.begin_read(what)()
                estimate = one.read(what)
                np.testing.assert_allclose(
                    np.log(light), estimate.log_intensity, rtol=0, atol=1e-5)
                assert bits(estimate[1:]) == bits(others)


@pytest.mark.parametrize("mode", MODES)
def test_snapshots_continue_with_the_same_bits(mode):
    events, frames = stream(4)
    half = 470_000 if mode != "offline" else 850_000
    one = fed(make(mode=mode), events, frames, half)
    one.settle(half)
    t = half - one.lookahead_us
    stored = pickle.loads(pickle.dumps(one.snapshot()))
    others = [make(mode=mode), make(mode=mode)]
    others[0].restore(stored)
    others[1].assign(one)
    before = bits(one.read(t))
    rest = events[events["t"] >= half]
    assert bits(one.read(t)) == before
    for each in (one, *others):
        assert bits(each.read(t)) == before
        feed(each, rest, [f for f in frames if f.mid_us >= half])
    assert len({bits(each.read(900_000)) for each in (one, *others)}) == 1


def test_reading_ahead_of_what_is_settled_changes_nothing():
    events, frames = stream(6)
    one, other = (fed(make(), events, frames, 300_000) for _ in range(2))
    for t in (600_000, 250_000, 450_000):       # no event has come so far
        one.read(t)
    assert bits(one.read(251_000)) == bits(other.read(251_000))
    for each in (one, other):
        feed(each, events[events["t"] >= 300_000], frames[3:])
    assert bits(one.read(880_000)) == bits(other.read(880_000))


def test_late_frames_count_as_those_in_order():
    events, frames = stream(7, exposures=20_000)
    late, order = make(mode="causal"), make(mode="causal")
    feed(order, events, frames)
    at = 0
    for frame in frames:
        end = int(np.searchsorted(events["t"], frame.available_us))
        late.add_events(events[at:end])
        late.add_frame(frame)
        at = end
    late.add_events(events[at:])
    for each in (late, order):
        each.settle(930_000)
    assert bits(late.read(930_000)) == bits(order.read(930_000))


def test_another_model_from_now_on():
    events, frames = stream(8)
    one = fed(make(model=PLAIN), events, frames, 600_000)
    one.retune(model=WHOLE, ratio_sigma=0.1)
    other = fed(make(model=WHOLE), events, frames, 600_000)
    parameters = one.parameters
    assert parameters["model"] is WHOLE
    assert parameters["ratio_sigma"] == 0.1
    for each in (one, other):
        feed(each, events[events["t"] >= 600_000], frames[5:])
    a, b = one.read(899_999), other.read(899_999)
    # What the earlier model made of earlier frames counts less and less.
    assert np.median(abs(a.log_intensity - b.log_intensity)) < 0.05
    with pytest.raises(TypeError, match=r"retune takes model, .* got beta"):
        one.retune(beta=1)


def test_gains_that_wrong_thresholds_told_are_forgotten():
    events, frames = stream(8)
    one = fed(make(model=PLAIN), events, frames, 600_000)
    told, p = one._anchors["gain"].copy(), one._anchors["p"].copy()
    variance = PLAIN.spread**2
    one.retune(model=PLAIN)
    np.testing.assert_array_equal(one._anchors["gain"], told)
    np.testing.assert_allclose(one._anchors["p"], p, rtol=1e-6)
    one.retune(model=PLAIN.replace(theta=np.exp(PLAIN.spread) * PLAIN.theta))
    np.testing.assert_allclose(one._anchors["gain"], told / 2, atol=1e-6)
    np.testing.assert_allclose(
        one._anchors["p"][..., [3, 5]], p[..., [3, 5]] / 4 + 0.75 * variance, rtol=1e-5)


@pytest.mark.parametrize("mode", MODES)
def test_events_that_are_dropped_are_not_missed(mode):
    """Long silences, frames absent for seconds, and a store that is packed often."""
    rng = np.random.default_rng(9)
    events = np.concatenate([
        random_events(300, SHAPE, seed=1, stop_us=300_000),
        random_events(60, (2, 3), seed=2, start_us=300_000, stop_us=3_000_000),
        random_events(3000, SHAPE, seed=3, start_us=3_000_000, stop_us=4_000_000)])
    frames = [random_frame(SHAPE, t, seed=t, low=50, high=900)
              for t in (50_000, 150_000, 2_500_000, 3_500_000)]
    for t in (200_000, 1_500_000, 2_600_000, 3_100_000, 3_900_000):
        seen = t + make(mode=mode).lookahead_us
        expected = read(fed(make(mode=mode, model=TABLE), events, frames, seen), t)
        for cuts in ((), np.unique(rng.integers(0, seen, 200))):
            small = make(mode=mode, model=TABLE)
            small._store.events = small._store.events[:64].copy()
            got = read(fed(small, events, frames, seen, cuts), t)
            assert small._store.stop < 3300
            assert len(small._store.events) < 5000
            np.testing.assert_allclose(
                got.log_intensity, expected.log_intensity, atol=1e-5)
            np.testing.assert_allclose(got.variance, expected.variance, rtol=1e-4)


def frame_of(log, mid_us, exposure_us=10_000, **options):
    dn = np.exp(np.broadcast_to(log, SHAPE)) * exposure_us / 1000
    return ApsFrame(dn, mid_us - exposure_us // 2, mid_us + exposure_us // 2, **options)


def test_a_straight_line_between_frames_without_events():
    one = make(model=PLAIN)
    for t, log in ((10_000, 3.0), (50_000, 3.1)):
        one.add_frame(frame_of(log, t))
    assert read(one, 30_000).log_intensity == pytest.approx(3.05, abs=5e-3)
    assert read(one, 30_000).valid.all()


def test_causal_pixels_without_events_follow_frames():
    one = make(model=PLAIN, mode="causal")
    for k in range(20):
        one.add_frame(frame_of(3.0 + 0.05 * (k % 2), 10_000 + 40_000 * k))
    one.settle(900_000)
    assert read(one, 900_000).log_intensity == pytest.approx(3.03, abs=0.025)


def test_columns_of_a_rolling_shutter_are_shown_at_their_own_time():
    """Light that grows alike everywhere, as events say it; frames see it by columns."""
    rate, theta = 4.0, 0.2                      # ln per s
    steps = np.arange(1, 18)
    events = np.zeros(len(steps) * SHAPE[0] * SHAPE[1], EVENT_DTYPE)
    t, y, x = np.meshgrid(steps * theta / rate * 1e6, *map(np.arange, SHAPE),
                          indexing="ij")
    events["t"], events["y"], events["x"] = t.ravel(), y.ravel(), x.ravel()
    events["p"] = 1
    begin = 100_000 + 5000 * np.arange(SHAPE[1])
    log = 2.0 + rate * 1e-6 * (begin + 500)
    frame = ApsFrame(np.tile(np.exp(log), (SHAPE[0], 1)), begin, begin + 1000)
    one = make(model=PLAIN.replace(theta=np.array([theta, theta])))
    got = read(fed(one, events, [frame], 450_000), 400_000).log_intensity
    assert got == pytest.approx(2.0 + rate * 0.4, abs=0.01)


@pytest.mark.parametrize("mode", MODES)
def test_events_of_a_hot_pixel_are_ignored(mode):
    """It fires steadily, and frames do not see it."""
    events = np.zeros(2000, EVENT_DTYPE)
    events["t"] = np.arange(2000) * 1000
    events["p"], events["x"], events["y"] = 1, 2, 1
    frames = [frame_of(3.0, 20_000 + 40_000 * k) for k in range(50)]
    one = make(model=WHOLE, mode=mode)
    feed(one, events, frames)
    got = read(one, 2_000_000 - max(one.lookahead_us, 1))
    shown, _ = WHOLE.in_frames(got.log_intensity, got.variance)
    assert shown == pytest.approx(3.0, abs=0.05)


def test_saturated_samples_are_not_believed():
    one = make(model=PLAIN, mode="causal")
    usable = np.ones(SHAPE, bool)
    usable[0, 0] = False
    one.add_frame(frame_of(3.0, 10_000, valid=usable))
    one.settle(60_000)
    got = one.read(60_000)
    assert not got.valid[0, 0]
    assert got.valid[1:].all()


def test_a_flickering_lamp_is_shown_and_taken_from_the_events():
    """Light of 100 Hz on a scene that stands still, and on one that grows."""
    theta, amplitude = 0.1, 0.35

    def scene(t, rate):
        return 3.0 + rate * t + amplitude * np.cos(2 * np.pi * 100 * t)
    for rate in (0.0, 1.0):
        t = np.arange(0, 0.6, 1e-5)
        log = scene(t, rate)
        reference, rows = log[0], []
        for now, value in zip(t, log, strict=True):
            while abs(value - reference) >= theta:
                sign = 1 if value > reference else -1
                reference += sign * theta
                rows.append((round(1e6 * now), sign > 0))
        events = np.zeros(len(rows) * 24, EVENT_DTYPE)
        events["t"] = np.repeat([r[0] for r in rows], 24)
        events["p"] = np.repeat([r[1] for r in rows], 24)
        events["y"] = np.tile(np.repeat(np.arange(4), 6), len(rows))
        events["x"] = np.tile(np.arange(6), 4 * len(rows))
        frames = []
        for k in range(12):
            begin = 20_000 + 50_000 * k
            inside = scene(begin * 1e-6 + np.arange(0, 7e-3, 1e-5), rate)
            frames.append(frame_of(np.log(np.exp(inside).mean()), begin + 3500, 7000))
        errors = []
        for waves in (True, False):
            one = make(model=PLAIN.replace(theta=np.array([theta, theta]), rest_s=0.5))
            for block in range(6 * waves):
                one.add_wave(Wave(block * BLOCK_US, 100.0, amplitude, 0.0, True))
            fed(one, events, frames, 500_000)
            errors.append(np.mean([
                abs(read(one, t).log_intensity - scene(1e-6 * t, rate)).mean()
                for t in range(450_000, 500_000, 1700)]))
        assert errors[0] < 0.003
        assert errors[0] < 0.5 * errors[1]


def test_it_refuses_what_it_cannot_use():
    with pytest.raises(ValueError, match=r"mode must be 'buffered', .* got 'live'"):
        make(mode="live")
    with pytest.raises(ValueError, match="lookahead_us must be positive in modes"):
        make(mode="buffered", lookahead_us=0)
    with pytest.raises(ValueError, match="theta_on must be"):
        KalmanFilter(SHAPE, theta_on=-1, theta_off=0.2)
    one = make()
    events, _ = stream()
    outside = events.copy()
    outside["x"][7] = 6
    with pytest.raises(ValueError, match=r"event 7 at \(x=6"):
        one.add_events(outside)
    assert one._store.stop == 7
    with pytest.raises(ValueError, match="event 0"):
        one.add_events(events[:3])
    with pytest.raises(ValueError, match="frame"):
        one.add_frame(random_frame((2, 2), 10**6))
    with pytest.raises(ValueError, match="t_us must not lie before"):
        one.read(-10**6)
    with pytest.raises(ValueError, match="equal KalmanFilter"):
        one.assign(make((2, 2)))
    with pytest.raises(ValueError, match="numbers must be those of a PixelModel"):
        _kernels.increments_push(events, 0, 0, 0, one._store.events,
                                 one._store.pixels, np.zeros(3), one._store.due,
                                 one._store.awake, 0)
