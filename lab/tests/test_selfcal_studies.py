"""Constants of the self-calibration against the scripts that regenerate them."""
import importlib.util
from pathlib import Path

import numpy as np
import pytest

from pdavis_cv.selfcal import bandwidth

STUDIES = Path(__file__).resolve().parents[1] / "studies"


@pytest.fixture(scope="module")
def study():
    path = STUDIES / "selfcal_bandwidth.py"
    if not path.exists():
        pytest.skip("studies are not installed")
    spec = importlib.util.spec_from_file_location("selfcal_bandwidth", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.gate
def test_the_stated_sigma_of_a_bandwidth_is_as_large_as_its_error(study):
    _, error, curvature, stated = np.moveaxis(study.measure(4, (60, 100, 200)), 2, 0)
    assert 0.5 < study.rms((error / stated).ravel()) < 1.5
    # The inflation is what the curvature alone lacks, beside the model's error.
    lacking = np.sqrt(np.mean((error**2 - bandwidth._MODEL_SIGMA**2) / curvature**2))
    assert bandwidth._CURVATURE_INFLATION == pytest.approx(lacking, abs=0.5)


def test_interpolation_biases_the_bandwidth_at_slow_light_only(study):
    rate, error, _, _ = np.moveaxis(study.measure(3, (30, 500)), 2, 0)
    assert rate[:, 0].mean() == pytest.approx(bandwidth._TURN_RATE_HZ, rel=0.1)
    # As a lag, of both corner frequencies: between a third of the constant and thrice.
    lag_s = np.mean(1 - np.exp(-error[:, 0])) / (2 * np.pi * 250)
    assert bandwidth._TURN_LAG_S / 3 < lag_s < 3 * bandwidth._TURN_LAG_S
    assert abs(error[:, 1].mean()) < 0.03
