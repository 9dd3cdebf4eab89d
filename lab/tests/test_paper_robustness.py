"""The table of robustness: its conditions, its judgement, and the command."""
import csv
import math

import numpy as np
import pytest

from lab.paper import command, robustness
from lab.paper.robustness import (
    ALL,
    CAUSAL,
    RECORDED,
    robustness_cases,
    robustness_rows,
)
from lab.paper.robustness_page import (
    against,
    cells,
    robustness_figure,
    robustness_page,
)
from lab.paper.run import Row, Settings

QUICK = Settings(quick=True, methods=tuple(ALL), step_us=50_000, rpms=(200.0,))

BLANK = dict.fromkeys(Row.__dataclass_fields__, float("nan")) | {
    "scene": "drift", "region": "all", "camera": "nominal", "rpm": 200.0, "seed": 1}


def row(method, aop, dolp, **more):
    return Row(**{**BLANK, "method": method, "aop_error_deg": aop,
                  "dolp_error": dolp, **more})


def case_of(scene, **settings):
    return next(case for case in robustness_cases(Settings(**settings))
                if case.scene == scene)


@pytest.mark.parametrize(("scene", "part", "parameter", "value"), [
    ("frame stamps -10 ms", "faults", "frame_offset_us", -10_000),
    ("frame stamps +5 ms", "faults", "frame_offset_us", 5000),
    ("refractory period 3 ms", "dvs", "refractory_us", 3000),
    ("10 % of events lost", "faults", "lost", 0.1),
    ("drift of thresholds, ON +15 %, OFF -5 %", "faults", "drift_off", -0.05),
    ("jitter 1 ms", "faults", "jitter_us", 1000),
    ("5 % hot pixels, 1 kHz", "dvs", "hot_fraction", 0.05),
    ("second pole, 250 Hz", "dvs", "second_pole_hz", 250)])
def test_a_camera_departs_as_its_name_says_and_in_nothing_else(
        scene, part, parameter, value):
    usual, case = case_of("unchanged"), case_of(scene)
    camera, other = (each.specimen(ALL["cf"]) for each in (case, usual))
    assert getattr(getattr(camera, part), parameter) == value
    assert getattr(getattr(other, part), parameter) != value
    np.testing.assert_array_equal(camera.maps["theta_on"], other.maps["theta_on"])
    assert (case.seed, case.start_deg, case.seconds) == (
        usual.seed, usual.start_deg, usual.seconds)


def test_bandwidth_in_proportion_to_light_is_80_hz_in_the_mean_light():
    camera = case_of("bandwidth 80 Hz, in proportion to light").specimen(ALL["cf"])
    light = camera.maps["analyser"][..., 0].mean() * 30.75
    assert camera.dvs.cutoff_hz is None
    assert camera.dvs.cutoff_hz_per_dn_ms * light == pytest.approx(80, rel=0.03)


def test_every_specimen_has_a_camera_and_an_angle_of_its_own():
    made = [case for case in robustness_cases(Settings(seeds=(1, 2, 3)))
            if case.scene == "unchanged" and case.camera == "davis346"]
    assert len(made) == 9
    assert len({case.start_deg for case in made}) == 3
    assert len({case.specimen(ALL["cf"]).dvs.theta_on for case in made}) == 3


def test_edges_pass_at_their_speed():
    light = case_of("edges, 200 pixels/s").light(30.0)
    x = np.arange(0, 60, 0.25)
    s0, s1, s2 = light.stokes(0, x, 3.0)
    assert [s0.min() / 30, s0.max() / 30] == pytest.approx([0.25, 1], abs=0.001)
    aop = np.rad2deg(np.arctan2(s2, s1) / 2)
    assert [aop.min(), aop.max()] == pytest.approx([20, 70], abs=0.1)
    # 200 pixels per second along 20 degrees from a row.
    moved = light.stokes(50_000, x + 10 / math.cos(math.radians(20)), 3.0)[0]
    np.testing.assert_allclose(moved, s0, atol=1e-9)


def test_after_the_turn_light_rests_while_it_is_scored():
    case = case_of("at rest after a turn of 40 degrees")
    before, *rest = (np.arctan2(s2, s1) for _, s1, s2 in (
        case.light(30.0).stokes(t, 0, 0) for t in (0, 1_000_000, 1_300_000, 1_440_000)))
    np.testing.assert_allclose((np.array(rest) - before) % (2 * np.pi),
                               np.deg2rad(80), atol=1e-9)


def test_kalman_is_judged_against_the_best_of_its_own_causality():
    rows = [
        row("frames", 1.0, 0.5), row("cf causal", 2.0, 0.1),
        row("kalman causal", 1.2, 0.105),
        row("cf", 0.5, 0.05), row("kalman", 0.54, 0.04),
        row("kalman offline", 0.6, 0.05)]
    judged = {(one.method, one.column): one for one in against(rows)}
    assert {key for key, one in judged.items() if one.lost} == {
        ("kalman causal", "aop_error_deg"), ("kalman offline", "aop_error_deg")}
    assert {key for key, one in judged.items() if one.won} == {
        ("kalman", "dolp_error")}
    assert judged["kalman causal", "dolp_error"].best == "cf causal"
    page = "\n".join(robustness_page(rows))
    assert "better than the best other method in 1, and more than 10 % worse in 2" in (
        page)
    for line in ("| drift, 200 RPM | 1.00 / 0.500 | 2.00 / 0.100 | **1.20 / 0.105** |",
                 "| drift, 200 RPM (`nominal`) | AoP | kalman offline | 0.60 | cf "
                 "| 0.50 |"):
        assert line in page


def test_specimens_are_joined_by_their_median_and_their_spread_is_shown():
    rows = [row(method, error * factor, 0.1, seed=seed)
            for seed, error in enumerate((1.0, 2.0, 9.0), 1)
            for method, factor in (("cf", 1.0), ("kalman", 0.5))]
    page = "\n".join(robustness_page(rows))
    assert "| drift, 200 RPM | 2.00 / 0.100 | 1.00 / 0.100 |" in page
    assert "| drift, 200 RPM (`nominal`) | - | 0.55 .. 4.15 / 0.100 .. 0.100 | - |" in (
        page)


@pytest.mark.gate
def test_the_picture_has_a_line_per_condition_and_frames_what_is_lost():
    pytest.importorskip("matplotlib")
    rows = [row(method, error, 0.1, scene=scene)
            for scene, errors in (("drift", (1.0, 2.0)), ("jitter", (2.0, 1.0)))
            for method, error in zip(("cf", "kalman"), errors, strict=True)]
    drawing = robustness_figure(rows)
    aop, dolp = drawing.axes[:2]
    assert drawing.get_size_inches()[0] * 25.4 == pytest.approx(183)   # a page's width
    assert [len(axes.patches) for axes in (aop, dolp)] == [1, 0]
    assert [text.get_text() for text in aop.get_yticklabels()] == [
        "drift, 200 RPM (nominal)", "jitter, 200 RPM (nominal)"]
    assert {text.get_text() for text in aop.texts} == {"1.00", "2.00"}


@pytest.mark.gate
def test_the_command_scores_every_condition_on_all_cores(tmp_path, capsys):
    stem = tmp_path / "robust"
    assert command.main([
        "robustness", "-o", str(stem), "--quick", "--rpm", "200", "--step-us", "50000",
        "--methods", "frames", "cf causal", "cf"]) == 0
    with open(f"{stem}.csv") as file:
        rows = list(csv.DictReader(file))
    scenes = {case.scene for case in robustness_cases(QUICK)}
    assert {line["scene"] for line in rows} == scenes
    assert {line["method"] for line in rows} == {"frames", "cf causal", "cf"}
    assert {line["region"] for line in rows} == {"all", "dark half", "bright half"}
    assert all(math.isfinite(float(line["dolp_error"])) for line in rows)
    said = capsys.readouterr().out
    for text in ("frame stamps -10 ms, 200 RPM", "fan, bright half, 200 RPM"):
        assert text in said
    static = {line["method"]: float(line["aop_error_deg"]) for line in rows
              if line["scene"].startswith("at rest, DoLP 0.3, 308")}
    assert static["frames"] < 3


@pytest.mark.gate
def test_one_process_gives_what_several_give(monkeypatch):
    settings = Settings(quick=True, methods=("frames", "cf"), step_us=100_000,
                        rpms=(200.0,), cameras=("davis346",))
    several = list(robustness_rows(settings))
    monkeypatch.setattr(robustness, "usable_cores", lambda: 1)
    alone = list(robustness_rows(settings))
    assert repr(alone) == repr(several)
    assert set(CAUSAL) & set(RECORDED) == set()
    assert len(cells(one for each in alone for one in each)) == len(alone) + 1


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
