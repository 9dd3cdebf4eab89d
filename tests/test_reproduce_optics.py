"""Extinction ratios of the simulated bench are those that were simulated."""
import math

import numpy as np
import pytest

from pdavis_cv.simulation import Optics
from pdavis_cv.tools.reproduce import optics_bench
from pdavis_cv.tools.reproduce.optics_bench import ShiftedOptics, expected_ratio
from pdavis_cv.tools.reproduce.run import Settings

KAPPA = 39 / 41


def test_a_shifted_array_has_the_contrast_of_theory():
    assert expected_ratio(KAPPA, 0.0) == pytest.approx(40)
    for shift in (0.0, 0.2, 0.5):
        maps = ShiftedOptics(shift=shift).maps(1, (4, 4), (0, 0), (260, 346))
        rows = maps["analyser"]
        contrast = np.hypot(rows[..., 1], rows[..., 2]) / rows[..., 0]
        np.testing.assert_allclose(
            (1 + contrast) / (1 - contrast), expected_ratio(KAPPA, shift))


def test_no_shift_changes_nothing():
    places = 1, (4, 6), (2, 4), (260, 346)
    spread = {"gain_sigma": 0.02, "angle_sigma": 0.01, "extinction_ratio_sigma": 3.0}
    one, other = Optics(**spread).maps(*places), ShiftedOptics(**spread).maps(*places)
    for name in one:
        np.testing.assert_array_equal(one[name], other[name])


@pytest.mark.gate
def test_the_bench_measures_what_was_simulated():
    found = list(optics_bench.points(Settings(quick=True)))
    assert {point.what for point in found} == {"wavelength", "shift"}
    for point in found:
        assert point.ratio == pytest.approx(point.true, rel=0.04), point
    assert math.isclose(min(p.at for p in found if p.what == "wavelength"), 500)
