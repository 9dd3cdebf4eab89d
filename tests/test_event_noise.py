"""Noise of events: how far their sum is off per event, learned from frames."""
import numpy as np
import pytest

from pdavis_cv import EVENT_DTYPE, ApsFrame, KalmanFilter
from pdavis_cv.reconstruct.kalman.event_noise import event_noise


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
