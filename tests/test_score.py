import numpy as np
import pytest

from pdavis_cv.analysis import axial_difference
from pdavis_cv.events import EVENT_DTYPE


def test_axial_differences_go_the_short_way():
    assert axial_difference(0.01, np.pi - 0.01) == pytest.approx(0.02)
    assert axial_difference(np.pi - 0.01, 0.01) == pytest.approx(-0.02)
    a, b = np.random.default_rng(0).uniform(0, np.pi, (2, 100))
    off = axial_difference(a, b)
    np.testing.assert_allclose(off, axial_difference(a, b + np.pi), atol=1e-12)
    np.testing.assert_allclose(np.cos(2 * off), np.cos(2 * (a - b)), atol=1e-12)
    assert np.all(np.abs(off) <= np.pi / 2)


def stream(rows):
    return np.array(rows, EVENT_DTYPE)
