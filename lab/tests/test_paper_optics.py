"""Extinction ratios are those that were simulated."""
import itertools
import math

import numpy as np
import pytest

from lab.paper import optics_bench
from lab.paper.optics_bench import ShiftedOptics, expected_ratio
from lab.paper.run import Settings
from pdavis_cv.simulation import Optics

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


def test_between_published_ratios_the_truth_is_a_line_of_their_logarithm():
    for camera, known in optics_bench.PUBLISHED.items():
        for (a, low, _), (b, high, _) in itertools.pairwise(known):
            assert optics_bench.published_ratio(camera, a) == pytest.approx(low)
            assert optics_bench.published_ratio(camera, b) == pytest.approx(high)
            assert optics_bench.published_ratio(
                camera, (a + b) / 2) == pytest.approx(math.sqrt(low * high))


@pytest.mark.gate
def test_the_bench_measures_what_was_simulated():
    found = list(optics_bench.points(Settings(quick=True)))
    assert {(point.what, point.camera) for point in found} == {
        ("wavelength", "PDAVIS"), ("wavelength", "sony"), ("shift", "PDAVIS")}
    for point in found:
        assert point.ratio == pytest.approx(point.true, rel=0.04), point
    at_500 = {point.camera: point.true for point in found
              if point.what == "wavelength" and abs(point.at - 500) < 25}
    assert at_500["PDAVIS"] == pytest.approx(40, rel=0.05)
    page = "\n".join(optics_bench.bench_page(found))
    assert page.count("agrees") == 4
    assert "95 at 700 nm ([Gruev 2011]" in page
