"""Noise of frames that `kalman` learns, told apart from light that moves."""
import math

import numpy as np
import pytest
import reference_kalman
from streams import feed

from pdavis_cv import EVENT_DTYPE, ApsFrame, KalmanFilter, fuse
from pdavis_cv.reconstruct.kalman import filter as kalman_filter
from pdavis_cv.reconstruct.kalman.frame_noise import _SHARED
from pdavis_cv.reconstruct.lamp import BLOCK_US, Wave
from pdavis_cv.simulation import Camera, RotatingPolarizer

EVERY_US, EXPOSURE_US = 50_000, 5_000


def frames_of(light, read_dn, per_shot, n=40, seed=1):
    """Frames of light(t_s) in DN, with noise, at 20/s."""
    rng, frames = np.random.default_rng(seed), []
    for k in range(n):
        mean = light(1e-6 * EVERY_US * k)
        spread = np.sqrt(read_dn**2 + mean / per_shot)
        dn = mean + spread * rng.normal(size=mean.shape)
        start = EVERY_US * k - EXPOSURE_US // 2
        frames.append(ApsFrame(dn.astype(np.float32), start, start + EXPOSURE_US))
    return frames


def learned(method, dn):
    """Variance that the method assumes for samples of light of so many DN."""
    tuning = method._tuning[0]
    return float(tuning["read_variance"] + dn * tuning["shot_variance"]
                 + (dn * tuning["frame_sigma"])**2)


@pytest.mark.parametrize("mode", ["causal", "buffered"])
@pytest.mark.parametrize("hz", [0.0, 0.5, 1.0, 2.0])
@pytest.mark.parametrize(("read_dn", "per_shot"), [(3.0, 20.0), (6.0, 5.0)])
def test_light_that_moves_without_an_event_is_no_noise(mode, hz, read_dn, per_shot):
    """It swings by half a threshold; noise is learned as if it were at rest."""
    rng = np.random.default_rng(3)
    shape = 24, 24
    rest, phase = rng.uniform(60, 300, shape), rng.uniform(0, math.tau, shape)
    method = KalmanFilter(shape, theta_on=0.2, theta_off=0.2, mode=mode)
    feed(method, np.empty(0, EVENT_DTYPE), frames_of(
        lambda t: rest * np.exp(0.1 * np.sin(math.tau * hz * t + phase)),
        read_dn, per_shot))
    method.settle(2_000_000)
    for dn in (60, 150, 300):
        assert abs(math.log(learned(method, dn) / (read_dn**2 + dn / per_shot))) < 0.3


def test_light_that_moves_up_to_an_event_is_no_noise(monkeypatch):
    """A polarizer at 30 RPM, whose light has no event for some frames at its maxima."""
    shots = []
    adapt = kalman_filter.adapt

    def watched(innovations, tuning, per_event):
        adapt(innovations, tuning, per_event)
        shots.append(float(tuning["shot_variance"][0]))

    monkeypatch.setattr(kalman_filter, "adapt", watched)
    camera = Camera.preset("nominal", seed=2, size=(12, 12))
    recording, _ = camera.record(RotatingPolarizer(rpm=30.0), 1.5)
    for causal in (True, False):
        shots.clear()
        for _ in fuse(recording, fps=30, causal=causal):
            pass
        assert len(shots) > 20
        assert max(shots[10:]) < 0.05       # from innovations: 1


def test_the_noise_under_a_lamp_is_that_without_its_ripple():
    """Samples have the ripple at another phase in each frame."""
    hz, ripple = 100.7, 0.1
    method = KalmanFilter((16, 16), theta_on=0.2, theta_off=0.2, mode="causal")
    for k in range(-1, 2_000_000 // BLOCK_US + 1):
        start = k * BLOCK_US
        turn = math.tau * hz * 1e-6 * start
        method.add_wave(Wave(start, hz, ripple * math.cos(turn),
                             -ripple * math.sin(turn), True))
    rest = np.random.default_rng(3).uniform(60, 300, (16, 16))

    def light(t):
        return rest * np.exp(ripple * math.cos(math.tau * hz * t))

    feed(method, np.empty(0, EVENT_DTYPE), frames_of(light, 3.0, 20.0))
    method.settle(2_000_000)
    for dn in (60, 150, 300):
        assert abs(math.log(learned(method, dn) / (9 + dn / 20))) < 0.5


@pytest.mark.parametrize("offline", [False, True])
def test_it_equals_float64_evaluation_where_some_pixels_rest(offline):
    shape = 3, 4
    rng = np.random.default_rng(5)
    rest = rng.uniform(60, 300, shape)
    frames = frames_of(lambda t: rest, 8.0, 2.0, n=12)
    frames[6] = frames[6].replace(valid=rng.random(shape) < 0.5)
    events = np.zeros(12, EVENT_DTYPE)      # of two pixels, one of them for a while
    events["t"] = np.sort(rng.integers(20_000, 500_000, 12))
    events["x"], events["p"] = events["t"] < 200_000, rng.integers(0, 2, 12)
    mine = KalmanFilter(shape, theta_on=0.2, theta_off=0.25,
                        mode="offline" if offline else "buffered")
    mine._saturated.add_events = lambda events, workers: None
    feed(mine, events, frames)
    t = 600_000
    estimate = reference_kalman.alone(mine, t - mine.lookahead_us)
    log, variance, _ = reference_kalman.kalman(
        events, frames, shape, 0.2, 0.25, t - mine.lookahead_us, sigma=0.035,
        lookahead_us=mine.lookahead_us, offline=offline)
    np.testing.assert_allclose(estimate.log_intensity, log, atol=1e-4)
    np.testing.assert_allclose(estimate.variance, variance, rtol=2e-3)


def test_frames_that_are_stated_to_be_exact_teach_nothing():
    method = KalmanFilter((4, 4), theta_on=0.2, theta_off=0.2,
                          noise=(0.0, 0.02, 0.0, 0.0))
    feed(method, np.empty(0, EVENT_DTYPE), frames_of(
        lambda t: np.full((4, 4), 100.0), 3.0, 20.0, n=12))
    method.settle(600_000)
    assert learned(method, 100) == 4 + 100 / 10
    assert np.all(np.isfinite(method.read(550_000).log_intensity))


def test_third_differences_that_share_samples_tell_less():
    """The variance of their mean square, relative to that of independent ones."""
    noise = np.random.default_rng(1).normal(size=(20_000, 103))
    third = np.diff(noise, 3) ** 2 / 20
    assert abs(third.mean() - 1) < 0.01
    assert abs(100 * third.mean(1).var() / 2 / _SHARED - 1) < 0.05
