"""Exposures with events, whose segments are evaluated together (_segments.pxd)."""
import numpy as np
import pytest
import reference_kalman
from streams import feed, random_events, random_frame
from test_kalman import BANDWIDTHS, SHAPE, make

from pdavis_cv.reconstruct.lamp import BLOCK_US, Wave

MIDS = [12_000, 32_000, 52_000, 61_000]    # the last two exposures overlap
UNLIT = {"unlit_log", "first_difference", "second_difference", "quiet"}


def stream(shape, n):
    return (random_events(n, shape, stop_us=80_000, seed=5),
            [random_frame(shape, t, seed=i, low=50) for i, t in enumerate(MIDS)])


@pytest.mark.parametrize("n", [60, 900, 20_000])
@pytest.mark.parametrize("bandwidth", BANDWIDTHS)
@pytest.mark.parametrize("shape", [(4, 6), (2, 150)])
def test_segments_together_have_the_bits_of_one_by_one(shape, bandwidth, n):
    # They are evaluated one by one if the lamp flickers, though not yet.
    events, frames = stream(shape, n)
    together, single = (make(shape, bandwidth=bandwidth) for _ in range(2))
    single.add_wave(Wave(0))
    single.add_wave(Wave(BLOCK_US, 100.0, 0.1, 0.1))
    for method in (together, single):
        method._tuning["still_us"] = 1e30   # light at rest is a matter of the lamp
        feed(method, events, frames)
        method.settle(150_000)
    assert len(single._lamp.waves) > 0
    assert int(together._states["samples"].max()) == len(MIDS)
    for name in set(together._states.dtype.names) - UNLIT:
        np.testing.assert_array_equal(together._states[name], single._states[name])


@pytest.mark.parametrize("mode", ["causal", "buffered", "offline"])
@pytest.mark.parametrize("refractory", [0.0, 40.0])
def test_more_segments_than_fit_at_once_equal_the_equations(mode, refractory):
    events, frames = stream(SHAPE, 5000)    # 200 of a row in an exposure
    mine = make(mode=mode, refractory_us=refractory)
    mine._saturated.add_events = lambda events, workers: None
    feed(mine, events, frames)
    t = 80_007
    _, variance, _ = want = reference_kalman.kalman(
        events, frames, SHAPE, 0.2, 0.25, t, lookahead_us=mine.lookahead_us,
        offline=mode == "offline", refractory_us=refractory)
    measured = variance > 0
    mine.settle(t + mine.lookahead_us)
    got = reference_kalman.alone(mine, t)
    np.testing.assert_allclose(
        got.log_intensity[measured], want[0][measured], atol=2e-3, rtol=1e-4)
    np.testing.assert_allclose(
        got.variance[measured], variance[measured], atol=1e-5, rtol=5e-3)
