"""Noise of events: how far their sum is off per event, learned from frames."""
import numpy as np
import pytest

from pdavis_cv import EVENT_DTYPE, ApsFrame, KalmanFilter
from pdavis_cv.reconstruct.kalman.event_noise import event_noise
from pdavis_cv.reconstruct.kalman.threshold_drift import (
    drift_product,
    drift_variance,
    frame_drift,
)
from pdavis_cv.selfcal import SelfCalibration
from pdavis_cv.simulation import Camera, RotatingPolarizer, Texture


@pytest.mark.parametrize(("motion", "each"), [(0.3, 0.1), (0.0, 0.2), (0.5, 0.0003)])
def test_both_parts_are_told_apart_by_the_number_of_events(motion, each):
    rng = np.random.default_rng(1)
    u, w = rng.uniform(1, 2, 5000), rng.integers(1, 60, 5000).astype(float)
    excess = motion * u + each * w
    got = event_noise((u @ excess, w @ excess, u @ u, u @ w, w @ w), 0.0003)
    assert got == pytest.approx((motion, each), abs=0.01)


def test_nothing_seen_is_the_prior():
    assert event_noise((0, 0, 0, 0, 0), 0.0003) == pytest.approx((0.002, 0.0003))


@pytest.mark.parametrize(("lost", "low", "high"), [(0.0, 0.0, 0.1), (0.1, 4.0, 9.0)])
def test_lost_events_are_learned(lost, low, high):
    """Of 60 events 6 are lost, steps of either sign: a variance of 6 thresholds^2.

    With the same number everywhere, motion and events share it.
    """
    rng, shape, theta = np.random.default_rng(3), (16, 16), 0.05
    method = KalmanFilter(shape, theta_on=theta, theta_off=theta, mode="causal",
                          threshold_sigma=0.0)
    level = np.full(shape, 5.0)
    for k in range(20):
        t = 50_000 * k
        dn = np.exp(level) * 10
        method.add_frame(ApsFrame(dn.astype(np.float32), t, t + 100))
        events = np.zeros(256 * 60, EVENT_DTYPE)
        place = np.repeat(np.arange(256), 60)
        events["y"], events["x"] = np.divmod(place, 16)
        events["p"] = rng.integers(0, 2, len(events))
        np.add.at(level, (events["y"], events["x"]), theta * (2.0 * events["p"] - 1))
        events["t"] = t + 10_000 + rng.integers(0, 30_000, len(events))
        kept = events[rng.random(len(events)) >= lost]
        method.add_events(kept[np.argsort(kept["t"], kind="stable")])
    method.settle(1_100_000)
    tuning = method._tuning[0]
    assert low <= (1 - lost) * 60 * tuning["noise_per_event"] + 2 * tuning[
        "motion_variance"] < high
    assert tuning["noise_per_event"] > 0.03 or not lost


def drifting(per_frame, frames=30, shape=(12, 12), theta=0.2):
    """A filter after frames with 20 events up and 10 down between two, and in turn.

    Half of the pixels begin with more down.  ON thresholds change by ``per_frame``,
    relatively, from one frame to the next.
    """
    method = KalmanFilter(shape, theta_on=theta, theta_off=theta, mode="causal",
                          threshold_sigma=0.01)
    n, rng = shape[0] * shape[1], np.random.default_rng(1)
    y, x = np.divmod(np.arange(n), shape[1])
    level = np.where(y % 2, 1.0, 3.0)
    for k in range(frames):
        t, on = 50_000 * k, theta * (1 + per_frame * k)
        dn = 10 * np.exp(level).reshape(shape) + 2 * rng.normal(size=shape)
        method.add_frame(ApsFrame(dn.astype(np.float32), t, t + 100))
        up = np.where((y + k) % 2, 20, 10)
        events = np.zeros((30, n), EVENT_DTYPE)
        events["t"] = t + 1000 + 1500 * np.arange(30)[:, None]
        events["y"], events["x"] = y, x
        events["p"] = np.arange(30)[:, None] < up
        method.add_events(events.ravel())
        level += up * on - (30 - up) * theta
    method.settle(50_000 * frames)
    return method, on / theta


def test_thresholds_that_drift_are_followed():
    """15 % in 1.5 s; without process noise they lag behind."""
    method, ratio = drifting(0.005)
    learned = method._states["theta_on"] / method._states["theta_off"]
    assert np.mean(learned) == pytest.approx(ratio, abs=0.02)
    assert method._tuning["threshold_drift"][0] > 0.003**2


def test_thresholds_that_stay_have_no_process_noise():
    method, _ = drifting(0.0)
    assert method._tuning["threshold_drift"][0] < 0.001**2


def test_a_common_change_of_thresholds_is_told_from_noise():
    rng = np.random.default_rng(2)
    by, v = rng.uniform(1, 5, (2, 4000)) * [[1], [-1]], 0.01
    e = np.array([0.02, -0.01]) @ by + rng.normal(0, v**0.5, 4000)
    normal = [*(by @ e / v), *(np.array([by[0] @ by[0], by[0] @ by[1],
                                         by[1] @ by[1]]) / v)]
    *weighted, on, both, off = frame_drift(normal)
    information = np.array([[on, both], [both, off]])
    assert np.linalg.solve(information, weighted) == pytest.approx(
        (0.02, -0.01), abs=0.003)
    spread = np.linalg.inv(np.array([[normal[2], normal[3]], [normal[3], normal[4]]])
                           + 0.1**-2 * np.eye(2)) + 0.002**2 * np.eye(2)
    np.testing.assert_allclose(np.linalg.inv(information), spread, rtol=1e-9)


def test_each_direction_of_a_drift_counts_by_its_information():
    def told(change, variances):
        """The ratio is known with one variance, the scale with another."""
        turn = np.array([[1, 1], [-1, 1]]) / 2**0.5
        w = turn @ np.diag(np.reciprocal(variances)) @ turn.T
        return (*(w @ np.asarray(change)), w[0, 0], w[0, 1], w[1, 1])

    same, other = told((0.01, 0.01), (1e-5, 1e-5)), told((-0.01, -0.01), (1e-5, 1e-5))
    assert drift_variance(drift_product(same, other)) == 0
    assert drift_variance(np.multiply(20, drift_product(same, same))) == pytest.approx(
        0.01**2, rel=0.01)
    assert drift_product(same, (0.0,) * 5) == (0, 0)
    # Of a scale that no frame tells, whatever is found of it is of no account.
    for scale in (-0.02, 0.0, 0.02):
        known = told((0.01 + scale, -0.01 + scale), (1e-5, 1e-2))
        assert drift_variance(np.multiply(20, drift_product(known, known))
                              ) == pytest.approx(2 * 0.01**2, rel=0.02)


def noise_found(scene, noise_hz, **faults):
    """Process noise found in 1.5 s of a scene, to which noise events are added."""
    recording, _ = Camera.preset(
        "nominal", seed=3, size=(8, 8), faults=faults).record(scene, 1.5)
    rng = np.random.default_rng(0)
    noise = np.zeros(round(noise_hz * 1.5 * 64), EVENT_DTYPE)
    noise["t"] = rng.integers(0, 1_500_000, len(noise))
    for name, end in (("x", 8), ("y", 8), ("p", 2)):
        noise[name] = rng.integers(0, end, len(noise))
    events = np.sort(np.concatenate([recording.events(), noise]), order="t")
    look = SelfCalibration((8, 8), (0.16, 0.18), every_pixel=False)
    for frame in (frame for packet in recording.packets() for frame in packet.frames):
        until = np.searchsorted(events["t"], frame.mid_us)
        look.add_events(events[:until])
        events = events[until:]
        look.add_frame(frame)
    look.add_events(events)
    return look.estimate(wanted={"noise"}, bandwidth=(250.0, 0.0)).noise


@pytest.mark.parametrize(("drift", "noise_hz", "found"), [
    (0.1, 0, {0.1}), (0.0, 10, {5.0, 15.0}), (0.1, 10, {5.0, 15.0})])
def test_thresholds_that_drift_are_no_noise_of_events(drift, noise_hz, found):
    """They move sums from frame to frame alike; 15 thresholds^2/s were found."""
    polarizer = RotatingPolarizer(rpm=202.6, start_angle=0.3)
    assert noise_found(polarizer, noise_hz, drift_on=drift, drift_off=-drift) in found


@pytest.mark.parametrize(("noise_hz", "found"), [(0, {0.1}), (10, {5.0, 15.0})])
def test_errors_of_de_blurring_are_no_noise_of_events(noise_hz, found):
    """A texture turns between events, which errs in one frame and not in the next."""
    texture = Texture(velocity=(576.0, 168.0), seed=4)
    assert noise_found(texture, noise_hz) in found
