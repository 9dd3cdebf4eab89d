"""Figure 1: a pixel's step follows theory, AoP events follow the polarizer."""
import math

import numpy as np
import pytest

from lab.paper import overview
from lab.paper.run import Settings


def test_events_of_a_step_come_when_the_photoreceptor_has_crossed_thresholds():
    step = overview.step_response()
    rate = 2e-6 * math.pi * step.cutoff_hz
    height = math.log(4)
    up = step.on_us[step.on_us > 20_000]
    n = 1 + np.arange(int(height / step.theta_on))
    expected = 20_000 - np.log(1 - n * step.theta_on / height) / rate
    np.testing.assert_allclose(up, expected, atol=15)   # light takes 20 us to rise
    assert up[0] - 20_000 == pytest.approx(overview.first_event_us(step), abs=15)
    left = height - n[-1] * step.theta_on     # where the last ON event left it
    down = int((height - 0.01) / step.theta_off)
    assert len(step.off_us) in (down, down + (left > 0))


def test_a_pixel_whose_bandwidth_follows_the_light_is_refused():
    with pytest.raises(ValueError, match="constant bandwidth, got 'realistic'"):
        overview.step_response("realistic")


@pytest.mark.gate
def test_aop_events_follow_the_polarizer():
    cloud = overview.aop_cloud(Settings())
    assert cloud.error_deg < 5
    assert cloud.inside.sum() > 1000
    # Of a half turn every angle is seen.
    assert len(np.unique((np.degrees(cloud.events["aop"]) // 30).astype(int))) >= 6
