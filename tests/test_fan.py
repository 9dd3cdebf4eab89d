"""Sectors of a turning wheel of polarizers."""
import numpy as np
import pytest

from pdavis_cv import PolarFrame
from pdavis_cv.analysis import Wheel, summarise_sectors

SHAPE = (120, 140)
CENTRE = (70.3, 58.8)


def fan(t_us, rpm=200.0, start=0.4, noise=0.0, tilt=0.0, rng=None):
    """A wheel whose sector k holds a polarizer at k 30 degrees, plus tilt in 2."""
    y, x = np.mgrid[:SHAPE[0], :SHAPE[1]]
    turned = start + 2 * np.pi * rpm / 60e6 * t_us
    angle = np.arctan2(CENTRE[1] - y, x - CENTRE[0]) - turned
    k = np.mod(np.rint(angle / (np.pi / 3)), 6)
    aop = turned + k * np.pi / 6 + tilt * (k == 2)
    channels = np.deg2rad([0, 45, 90, 135])[:, None, None]
    quad = 20 * (1 + 0.9 * np.cos(2 * (aop - channels)))
    if noise:
        quad = quad + rng.normal(0, noise, quad.shape)
    return PolarFrame(quad, t_us=t_us)


def wheel(**changes):
    return Wheel(**{"centre": CENTRE, "radius": 50, "hub": 10, "rpm": 200.0,
                    "start_angle": 0.4, **changes})


def test_each_sector_has_its_own_angle_while_the_wheel_turns():
    rows = [wheel().measure(fan(t)) for t in range(0, 600_000, 37_000)]
    for summary in summarise_sectors(wheel(), rows):
        assert summary.images == len(rows)
        assert summary.aop == pytest.approx(summary.sector * np.pi / 6, abs=1e-5)
        assert summary.aop_sd < 1e-3
        assert abs(summary.error) < 1e-5
        assert summary.dolp == pytest.approx(0.9, rel=1e-5)


def test_a_polarizer_that_is_glued_askew_is_found():
    rows = [wheel().measure(fan(t, tilt=np.deg2rad(3)))
            for t in range(0, 60_000, 9_000)]
    errors = np.rad2deg([s.error for s in summarise_sectors(wheel(), rows)])
    np.testing.assert_allclose(errors[2] - errors[[0, 1, 3, 4, 5]], 3, atol=0.01)


def test_the_stated_error_is_that_of_noise():
    rng = np.random.default_rng(1)
    rows = [wheel().measure(fan(t, noise=3.0, rng=rng))
            for t in range(0, 900_000, 9_000)]
    summaries = summarise_sectors(wheel(), rows)
    for summary in summaries:
        off = (summary.aop - summary.sector * np.pi / 6 + np.pi / 2) % np.pi - np.pi / 2
        assert abs(off) < 5 * summary.aop_se
    single = np.array(rows)["aop_se"].mean()
    assert np.mean([s.aop_sd for s in summaries]) == pytest.approx(single, rel=0.2)


def test_standing_sectors_and_super_pixels_hold_their_place():
    standing = wheel(rpm=0.0, start_angle=0.0)
    labels = standing.labels(5_000_000, SHAPE)
    assert labels[59, 110] == 0
    assert labels[20, 93] == 1  # 60 degrees counter-clockwise
    assert labels[58, 70] == -1  # the hub
    half = standing.labels(0, (60, 70), scale=2)
    assert np.mean(half == labels[::2, ::2]) > 0.95
    counts = np.bincount(labels[labels >= 0])
    assert counts.min() > 0.95 * counts.max()


def test_a_wheel_that_leaves_the_image_and_impossible_numbers_are_refused():
    with pytest.raises(ValueError, match="must lie inside the 140x120 image"):
        wheel(radius=65).measure(fan(0))
    for name, value in (("radius", 5), ("sectors", 0), ("margin", 0.5),
                        ("rpm", np.inf)):
        with pytest.raises(ValueError, match=f"^{name} must"):
            wheel(**{name: value})
    with pytest.raises(ValueError, match="rows must hold"):
        summarise_sectors(wheel(), [])
