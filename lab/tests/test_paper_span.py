"""The range of irradiance in which the angle is right."""
import dataclasses
import math

import numpy as np
import pytest

from lab.paper import correct_span
from lab.paper.correct_span import Level, decibels
from lab.paper.light import EVENT_DN
from lab.paper.run import OFF_LOCK, Settings
from pdavis_cv.simulation import PRESETS


def lines(right):
    return [Level("c", "m", 10.0**k, 170.0, value, 1.0)
            for k, value in enumerate(right)]


def test_the_range_ends_where_a_straight_line_falls_below_160():
    low, high, range_db = decibels(lines([0, 180, 180, 140]))
    assert low == pytest.approx(10 ** (160 / 180))
    assert high == pytest.approx(10**2.5)
    assert range_db == pytest.approx(20 * (2.5 - 160 / 180))


def test_a_gap_ends_it_and_the_ends_of_what_was_done_are_its_ends():
    assert decibels(lines([180, 0, 180, 180, 180]))[1:] == (
        pytest.approx(10**4), pytest.approx(20 * (2 + 20 / 180)))
    assert decibels(lines([10, 20]))[2] == -math.inf


@pytest.mark.gate
def test_sony_frames_lose_the_angle_where_noise_or_clipping_says():
    # S1 of 40 nW/cm2 is half a DN: the noise of 400 super-pixels, .9 DN each.
    dim, good, bright = (correct_span.level_of(
        correct_span._take("sony", level, 1), "sony", "Sony 50 fps, own times", level)
        for level in (0.002, 30.0, 40_000.0))
    assert good.right_deg == 180
    assert max(dim.right_deg, bright.right_deg) < 120
    # The paper's axis does not show it.
    assert min(dim.span_deg, bright.span_deg) > 120


@pytest.mark.gate
def test_slow_photoreceptors_turn_the_angle_by_their_lag():
    # Intensity goes round at twice the polarizer's speed; its phase lags by
    # atan(f / fc), the angle by half of it.  Light varies, and the corner with it, by
    # ER 40: the lag at the mean light is an estimate.
    level = 0.08
    mean_dn_ms = EVENT_DN * level / 2
    corner = PRESETS["realistic"]["dvs"].cutoff_hz_per_dn_ms * mean_dn_ms
    lag = math.degrees(math.atan(2 * correct_span.RPM * OFF_LOCK / 60 / corner)) / 2
    take = correct_span._take("realistic", level, 1)
    late = correct_span.level_of(take, "realistic", "events, redundancy", level)
    assert late.error_deg == pytest.approx(lag, rel=0.3)


def test_the_page_sets_the_paper_beside():
    made = [dataclasses.replace(line, camera="sony", method="Sony 50 fps, own times")
            for line in lines([0, 180, 180, 0])]
    page = "\n".join(correct_span.span_page(made))
    assert "77.5 dB" in page
    assert "| right | 0 | 180 | 180 | 0 |" in page
    assert correct_span.count(Settings(quick=True)) == 33 + 3 * 5   # no network
    assert np.isfinite(decibels(made)[2])
