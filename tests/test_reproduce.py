import csv

import pytest

from pdavis_cv.simulation import Camera, RotatingPolarizer
from pdavis_cv.tools import reproduce


def test_every_method_is_scored_and_written(tmp_path, capsys):
    stem = tmp_path / "fig2"
    assert reproduce.main(["fig2", "-o", str(stem), "--rpm", "200", "--seconds", "1.6",
                           "--step-us", "9000"]) == 0
    with open(stem.with_suffix(".csv")) as file:
        rows = {row["method"]: row for row in csv.DictReader(file)}
    assert list(rows) == list(reproduce.METHODS)
    assert float(rows["kalman"]["aop_error_deg"]) < 1.3
    assert float(rows["kalman"]["dolp_error"]) < 0.03
    assert float(rows["frames"]["aop_error_deg"]) > 25
    page = stem.with_suffix(".md").read_text()
    assert "The paper states" in page
    assert page in capsys.readouterr().out


def test_a_figure_is_drawn(tmp_path):
    pytest.importorskip("matplotlib")
    stem = tmp_path / "fig3"
    assert reproduce.main(["fig3", "-o", str(stem), "--rpm", "100", "--seconds", "1.2",
                           "--step-us", "20000"]) == 0
    assert stem.with_suffix(".png").read_bytes().startswith(b"\x89PNG")
    assert b"<svg" in stem.with_suffix(".svg").read_bytes()


def test_the_score_of_the_kalman_method_is_below_the_goal_on_nominal_cameras():
    recording, truth = Camera.preset("nominal", seed=5).record(
        RotatingPolarizer(rpm=506.5), 2.0)
    aop, dolp = reproduce.score(recording, truth, step_us=5000, method="kalman",
                                thresholds="in-situ", nominal_thresholds=(0.16, 0.18))
    assert aop < 0.0227     # 1.3 degrees
    assert dolp < 0.03


def test_an_unknown_figure_is_one_line(capsys):
    assert reproduce.main(["fig9", "-o", "x"]) == 2
    assert len(capsys.readouterr().err.splitlines()) == 1
