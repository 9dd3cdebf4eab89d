"""Transfer functions: what is measured is what theory says."""
import cmath
import csv
import math

import numpy as np
import pytest

from lab.paper import command
from lab.paper.transfer import WAYS, expected_of_cf, measured


def test_the_theory_has_its_limits():
    # Slow light comes by frames, fast light by events; at the corner both add to 1.
    assert expected_of_cf(1e-4) == pytest.approx(1, abs=0.01)
    fast = expected_of_cf(250.0)  # the photoreceptor's own corner
    assert abs(fast) == pytest.approx(math.sqrt(0.5), rel=0.01)
    assert math.degrees(cmath.phase(fast)) == pytest.approx(-45, abs=3)
    # A frame that is held lags by half of 50 ms: it shows where frames decide.
    assert math.degrees(cmath.phase(expected_of_cf(0.8))) == pytest.approx(
        -0.8 * 360 * 0.025 * 1 / (1 + 0.25), abs=1.0)


@pytest.mark.parametrize("hz", [1.62, 6.08, 76.0])
def test_the_complementary_filter_passes_what_theory_says(hz):
    found, theory = measured(hz, WAYS["cf"]), expected_of_cf(hz)
    assert abs(found) == pytest.approx(abs(theory), abs=0.015)
    assert math.degrees(cmath.phase(found / theory)) == pytest.approx(0, abs=1.0)


def test_kalman_passes_all_of_it():
    assert measured(6.08, WAYS["kalman"]) == pytest.approx(1, abs=0.02)


@pytest.mark.gate
def test_the_command_writes_them_side_by_side(tmp_path):
    stem = tmp_path / "transfer"
    assert command.main(["transfer", "-o", str(stem), "--quick",
                           "--methods", "cf", "kalman offline"]) == 0
    page = (tmp_path / "transfer.md").read_text()
    assert page.rstrip().endswith("| agrees |")
    with open(f"{stem}.csv") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 10
    mine = [row for row in rows if row["method"] == "cf"]
    np.testing.assert_allclose([float(row["gain"]) for row in mine],
                               [float(row["expected_gain"]) for row in mine], atol=0.02)
    assert "| cf, theory |" in stem.with_suffix(".md").read_text()
