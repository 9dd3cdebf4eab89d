"""Pixels at rest: what silence and frames say of light that does not move."""
import numpy as np
import pytest
from streams import feed
from test_kalman import long_stream, make, make_again, same

from pdavis_cv import EVENT_DTYPE, ApsFrame, fuse
from pdavis_cv._workers import Workers
from pdavis_cv.analysis import Scorer
from pdavis_cv.reconstruct.kalman import KalmanFilter
from pdavis_cv.reconstruct.redundancy import EventRedundancy
from pdavis_cv.simulation import Camera, FlatLight


def test_a_pixel_at_rest_is_read_as_if_it_were_listed():
    """Which pixels the reader has found at rest changes no bit."""
    events, frames = long_stream(n=3000)
    shape = (4, 6)
    often, once = make(shape, offset_dn=0.5), make(shape, offset_dn=0.5)
    for stop in range(0, 3_000_000, 20_000):
        part = (events["t"] >= stop) & (events["t"] < stop + 20_000)
        for method in (often, once):
            feed(method, events[part],
                 [f for f in frames if stop <= f.mid_us < stop + 20_000])
        if often._clock.last_us > 0:
            often.read(often._clock.last_us)
    last = events[:1].copy()
    last["t"] = 4_400_000
    for method in (often, once):
        method.add_events(last)
    for t in (4_500_000, 9_000_000, 4_360_000):
        assert same(often.read(t), once.read(t))
        assert same(often.read(t), make_again(often).read(t))
    assert often._reader.n == 1


@pytest.mark.parametrize(("kind", "changes"), [
    (KalmanFilter, {"mode": "buffered", "bandwidth": (200.0, 1.0)}),
    (KalmanFilter, {"mode": "causal", "bandwidth": (200.0, 0.0), "offset_dn": 0.5}),
    (KalmanFilter, {"mode": "causal", "refractory_us": 900.0}),
    (KalmanFilter, {"mode": "offline"}),
    (EventRedundancy, {}), (EventRedundancy, {"lookahead_us": 0})])
def test_what_was_read_before_changes_no_bit(kind, changes):
    """Pixels that stop, and go on, in turn; read in between, and for the first time."""
    shape = (32, 6)
    events, frames = long_stream(shape, n=4000, seconds=6.0)
    # Half of the pixels at a time, for 1.5 s, have no events.
    events = events[(events["t"] // 1_500_000 + events["x"] // 3 + events["y"]) % 2 > 0]

    def fresh():
        return kind(shape, theta_on=0.2, theta_off=0.25, **changes)

    often = fresh()
    often.workers = Workers(2)
    for stop in range(20_000, 5_800_000, 20_000):
        part = (events["t"] >= stop - 20_000) & (events["t"] < stop)
        feed(often, events[part],
             [f for f in frames if stop - 20_000 <= f.mid_us < stop])
        often.settle(stop)
        ahead = often.lookahead_us
        times = [stop] if ahead == 0 else [stop - ahead, stop - ahead // 2]
        for t in times:
            if t < 0:
                continue
            seen = often.read(t)
            if stop % 140_000 == 0:
                anew = fresh()
                anew.assign(often)
                assert same(anew.read(t), seen)


def test_pixels_without_a_sample_are_not_computed():
    """Something replaces them, so their events do not put them on the reader's list."""
    events, frames = long_stream(n=3000)
    valid = np.ones((4, 6), bool)
    valid[1] = False
    frames = [frame.replace(valid=valid) for frame in frames]
    method = make((4, 6), mode="causal")
    feed(method, events, frames)
    every_pixel = np.zeros(24, EVENT_DTYPE)
    every_pixel["y"], every_pixel["x"] = np.divmod(np.arange(24), 6)

    def listed(t):
        """Number of listed pixels when each has just had an event."""
        every_pixel["t"] = t
        method.add_events(every_pixel)
        method.read(t)
        return method._reader.n

    assert listed(3_000_000) == listed(3_000_100) == 18
    method.add_frame(ApsFrame(frames[-1].dn, 3_010_000, 3_020_000))
    method.add_events(np.array([(3_100_000, 0, 0, 1)], EVENT_DTYPE))
    assert listed(3_200_000) == 24


@pytest.mark.parametrize("mode", ["buffered", "causal", "offline"])
def test_light_that_has_stopped_is_shown_as_frames_have_it(mode):
    """Part of a threshold after the last event; frames then say where the light is."""
    method, theta, gap = make((1, 1), 0.2, 0.2, mode=mode), 0.2, 5_000
    events = np.zeros(8, EVENT_DTYPE)
    events["t"], events["p"] = np.arange(1, 9) * gap, 1
    stopped = 8.4 * gap     # .4 thresholds after the last event

    def log(t):
        return np.log(20) + theta * np.minimum(t, stopped) / gap

    frames = []
    for start in range(0, 2_000_000, 50_000):
        dn = 10 * np.exp(log(start + np.arange(50, 10_000, 100))).mean()
        frames.append(ApsFrame(np.full((1, 1), dn), start, start + 10_000))
    feed(method, events, frames)
    last = frames[-1].mid_us
    for t in (last + 10_000, last + 5_000_000):
        estimate = method.read(t)
        assert abs(estimate.log_intensity[0, 0] - log(t)) < 0.1 * theta
        assert estimate.variance[0, 0] < (0.3 * theta) ** 2 + 0.1 * theta**2 * 5


@pytest.mark.parametrize("t", [140_000, 340_000, 940_000, 1_140_000])
def test_a_stream_shows_light_that_stopped_as_frames_have_it(t):
    """Though frames are taken with more of a threshold crossed than silence leaves."""
    method, theta = make((1, 1), 0.2, 0.2, mode="causal"), 0.2
    events = np.zeros(8, EVENT_DTYPE)
    events["t"], events["p"] = np.arange(1, 9) * 10_000, 1
    # It stops .4 thresholds after the last event, before the exposure of 100 ms.
    dn = np.full((1, 1), 200 * np.exp(8.4 * theta))
    frames = [ApsFrame(np.full((1, 1), 200.0), -20_000, -10_000),
              *(ApsFrame(dn, s, s + 10_000) for s in range(100_000, t, 50_000))]
    feed(method, events, frames)
    shown = method.read(t).log_intensity[0, 0]
    assert abs(shown - np.log(dn / 10)) < 0.05 * theta


def test_light_at_rest_is_as_good_as_frames():
    """Noise events do not move it, and more than one frame tells of it."""
    recording, truth = Camera.preset("nominal", seed=4, size=(12, 12)).record(
        FlatLight(dolp=0.3, aop=0.5), 2.0)

    def error(**options):
        times = range(1_000_000, 1_900_000, 9_000)
        scorer = Scorer(truth, (6, 6))
        for image in fuse(recording, times_us=times, demosaic="superpixel",
                          nominal_thresholds=(0.16, 0.18), **options):
            scorer.add(image)
        return np.array([scorer.score.aop_error, scorer.score.dolp_error])

    frames = error(method="frames")
    assert np.all(error(method="kalman") < 1.1 * frames)
    assert np.all(error(method="kalman", causal=True) < 1.2 * frames)


def test_a_pixel_that_stopped_is_shown_at_rest():
    """Silence says so: what is extrapolated goes back to nothing."""
    method = make((1, 1), 0.2, 0.2, mode="causal")
    method.add_frame(ApsFrame(np.full((1, 1), 400.0), 0, 10_000))
    events = np.zeros(5, EVENT_DTYPE)
    events["t"], events["p"] = np.arange(20_000, 120_000, 20_000), 1
    method.add_events(events)
    shown = [float(method.read(t).log_intensity[0, 0])
             for t in (110_000, 400_000, 800_000)]
    at_event = shown[-1]
    assert shown[0] - at_event > 0.05
    assert abs(shown[1] - at_event) < 0.02
