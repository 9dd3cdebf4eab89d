"""The lag of the photoreceptor is undone, also where time stamps jitter."""
import numpy as np
import pytest

from pdavis_cv import EVENT_DTYPE, ApsFrame, KalmanFilter

THETA, HZ = 0.2, 8.0
TAU_S = 1 / (2 * np.pi * HZ)
STEADY = ApsFrame(np.full((1, 40), 100.0), 0, 1000)
BEGIN_US, EVERY_US, EVENTS = 100_000, 4000, 40
RATE = THETA / (1e-6 * EVERY_US)        # of ln intensity, 1/s


def rising(jitter_us, on=1):
    """Events of pixels whose light changes at a constant rate from BEGIN_US on."""
    rng = np.random.default_rng(3)
    times = BEGIN_US + EVERY_US * np.arange(1, EVENTS + 1)[:, None] + rng.normal(
        0, jitter_us, (EVENTS, 40))
    events = np.zeros(times.size, EVENT_DTYPE)
    events["t"], events["x"] = times.ravel(), np.tile(np.arange(40), EVENTS)
    events["p"] = on
    return events[np.argsort(events["t"], kind="stable")]


def lags(mode, events):
    """What images show beyond the pixels' output, in the middle of the rise."""
    method = KalmanFilter(STEADY.dn.shape, theta_on=THETA, theta_off=THETA, mode=mode,
                          bandwidth=(HZ, 0.0))
    method.add_frame(STEADY)
    sign, fed, found = 1 if events["p"][0] else -1, 0, []
    for t in range(BEGIN_US + 60_000, BEGIN_US + 100_000, 1111):
        known = np.searchsorted(events["t"], t + method.lookahead_us, "right")
        method.add_events(events[fed:known])
        fed = known
        output = np.log(100) + sign * RATE * 1e-6 * (t - BEGIN_US)
        found.append(method.read(t).log_intensity[0] - output)
    return np.array(found)


@pytest.mark.parametrize("mode", ["buffered", "offline"])
@pytest.mark.parametrize("on", [1, 0])
def test_a_constant_rate_lags_by_rate_times_time_constant(mode, on):
    lag = RATE * TAU_S if on else -RATE * TAU_S
    np.testing.assert_allclose(lags(mode, rising(0, on)), lag, rtol=1e-3)


@pytest.mark.parametrize("mode", ["buffered", "offline"])
def test_jitter_moves_a_lag_by_its_share_of_the_time_constant(mode):
    """Stamps off by s: the output by RATE s, the mean slope by sqrt(2) RATE s / TAU.

    A gap between two of these events says nothing of the slope: its error is RATE.
    """
    jitter_s = 2e-3
    found = lags(mode, rising(1e6 * jitter_s)) / RATE - TAU_S
    assert abs(found.mean()) < 0.5 * jitter_s
    assert found.std() < (1 + np.sqrt(2)) * jitter_s
