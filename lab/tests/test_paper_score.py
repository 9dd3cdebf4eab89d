"""Scores by left-out frames beside scores by the truth, and the edges they share."""
import csv
import math

import numpy as np
import pytest

from lab.paper import command
from lab.paper.light import edges


def test_edges_pass_at_their_speed():
    light = edges(200.0, 30.0)
    x = np.arange(0, 60, 0.25)
    s0, s1, s2 = light.stokes(0, x, 3.0)
    assert [s0.min() / 30, s0.max() / 30] == pytest.approx([0.25, 1], abs=0.001)
    aop = np.rad2deg(np.arctan2(s2, s1) / 2)
    assert [aop.min(), aop.max()] == pytest.approx([20, 70], abs=0.1)
    # 200 pixels per second along 20 degrees from a row.
    moved = light.stokes(50_000, x + 10 / math.cos(math.radians(20)), 3.0)[0]
    np.testing.assert_allclose(moved, s0, atol=1e-9)


@pytest.mark.gate
def test_frames_left_out_and_the_truth_put_methods_in_the_same_order(tmp_path, capsys):
    stem = tmp_path / "both"
    assert command.main(["score", "-o", str(stem), "--camera", "nominal", "--rpm",
                           "60", "--seconds", "1.5"]) == 0
    with open(f"{stem}.csv") as file:
        rows = [line for line in csv.DictReader(file) if "polarizer" in line["scene"]]
    frame, light, aop = ([float(line[name]) for line in rows] for name in (
        "frame_in_cell", "light_in_cell", "aop_error_deg"))
    np.testing.assert_allclose(frame, light, atol=0.02)  # blur and noise of frames
    least = rows[int(np.argmin(frame))]
    assert least["method"] == "kalman offline"
    assert float(least["aop_error_deg"]) <= 1.1 * min(aop)
    assert rows[1]["frame_moving"] == ""   # redundancy knows no level
    said = capsys.readouterr().out
    correlation = float(said.rsplit("over the methods is ")[1].split()[0])
    assert correlation > 0.8
