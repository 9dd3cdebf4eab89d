"""The table of evidence: its cases, the peers against closed forms, its judgement."""
import json
import math
from pathlib import Path

import numpy as np
import pytest

import pdavis_cv
from lab.evidence import command, run
from lab.evidence.cases import CASES, NAMED, PRESETS, QUICK, REAL
from lab.evidence.page import beaten, means, page
from lab.evidence.peers import PEERS, Image, Stack, held, line, polarization
from lab.evidence.run import Row, known, real_rows, simulated_rows
from pdavis_cv.analysis import HALVES, LeftOutFrames, pooled
from pdavis_cv.recording.base import ApsFrame
from pdavis_cv.simulation import Camera, RotatingPolarizer, Scene

KEPT = range(71, 95)


def row(method, aop, dolp=0.01, ahead="buffered", seed=1, **more):
    return Row(**{"case": "texture-60", "preset": "typical", "seed": seed,
                  "method": method, "ahead": ahead, "aop_deg": aop, "dolp": dolp,
                  **more})


@pytest.mark.parametrize("name", list(CASES))
def test_every_case_is_light_before_a_camera_of_every_preset(name):
    case = CASES[name]
    assert isinstance(case.light(1001), Scene)
    assert case.seconds * 1e6 - case.start_us > 2 * case.step_us
    for preset in PRESETS:
        camera = Camera.preset(preset, seed=1001, size=case.size, origin=case.origin,
                               **case.changes)
        for part, given in case.changes.items():
            for parameter, value in given.items():
                assert getattr(getattr(camera, part), parameter) == value
        if case.mask is not None:
            assert case.mask(camera).shape == (case.size[0] // 2, case.size[1] // 2)


def test_named_and_quick_cells_are_cases():
    for name, preset in {*NAMED, *QUICK}:
        assert name in (REAL if preset == "real" else CASES)
        assert preset in (*PRESETS, "real")


@pytest.mark.parametrize(("name", "dolp"), [
    ("polarizer-60-0.3", 0.3), ("plate-60-0.3", 0.3), ("plate-60-1", 1.0)])
def test_the_degree_in_a_name_is_the_largest_degree(name, dolp):
    s0, s1, s2 = CASES[name].light(5).stokes(np.arange(0, 2e6, 1e3), 0, 0)
    assert np.max(np.hypot(s1, s2) / s0) == pytest.approx(dolp, rel=1e-3)


def test_seeds_of_others_are_never_simulated():
    for first in (command.FIRST_SEED, command.FIRST_DEVELOPMENT_SEED):
        assert not set(range(first, first + 50)) & set(KEPT)


def growing(rate, times_ms, shape=(2, 2)):
    """Frames of 2 ms of light that grows as exp(rate t), t in ms, and their stack."""
    frames = [ApsFrame(
        np.full(shape, 2 * math.exp(rate * (t + 1)) * math.sinh(rate) / rate),
        1000 * t, 1000 * (t + 2), available_us=1000 * (t + 6)) for t in times_ms]
    return Stack.of(frames)


def test_a_line_is_exact_on_exponential_light_and_a_held_frame_is_late():
    rate = 0.02
    stack = growing(rate, (0, 40, 80, 120))
    blur = math.log(math.sinh(rate) / rate)       # of the mean over an exposure
    for t in (1, 10.5, 41, 77, 121):
        np.testing.assert_allclose(line(stack, 1e3 * t), rate * t + blur, atol=1e-6)
    for t, mid in ((6, 1), (45.9, 1), (46, 41), (200, 121)):
        np.testing.assert_allclose(held(stack, 1e3 * t), rate * mid + blur, atol=1e-6)
    assert np.isnan(held(stack, 5.9e3)).all()
    assert line(growing(rate, (0,)), 9e3) == pytest.approx(rate + blur, abs=1e-6)


@pytest.mark.parametrize("angles", [(90, 45, 135, 0), (0, 45, 135, 90)])
def test_polarization_of_a_cell_is_that_of_malus_law(angles):
    aop, dolp = np.deg2rad(37.0), 0.6
    tiles = np.tile(np.reshape(np.deg2rad(angles), (2, 2)), (3, 4))
    light = 50 * (1 + 39 / 41 * dolp * np.cos(2 * (aop - tiles)))
    image = polarization(np.log(light), angles, 7)
    assert isinstance(image, Image)
    assert image.shape == (3, 4)
    np.testing.assert_allclose(image.s0, 100)
    np.testing.assert_allclose(image.aop, aop)
    np.testing.assert_allclose(image.dolp, dolp)
    # Of every pixel, of light that grows evenly: exact but for edges of the image.
    ramp = 1 + 0.02 * np.add.outer(np.arange(6), np.arange(8))
    whole = polarization(np.log(light * ramp), angles, 7, "bilinear")
    inner = np.s_[1:-1, 1:-1]
    assert whole.shape == (6, 8)
    np.testing.assert_allclose(whole.s0[inner], 100 * ramp[inner])
    np.testing.assert_allclose(whole.aop[inner], aop)
    np.testing.assert_allclose(whole.dolp[inner], dolp)


def test_the_held_frame_is_what_the_method_frames_shows():
    mine, theirs = simulated_rows("polarizer-200-0.5", "ideal", 1001, {
        "held frame": "causal", "frames": "causal"})
    for column in ("aop_deg", "dolp", "ln"):
        # fuse corrects for an extinction ratio of 40, as the peer does.
        assert getattr(mine, column) == pytest.approx(getattr(theirs, column), rel=1e-4)
    assert math.isnan(mine.aop_covered)


def test_lost_events_are_those_between_exposures():
    case = CASES["missing-half-60"]
    camera = Camera.preset("typical", seed=1001, size=(8, 8))
    recording, _ = camera.record(RotatingPolarizer(rpm=200.0), 0.4)
    events, frames = recording.events(), run._frames(recording)
    lost = events[~case.keep(events, frames, camera.faults.frame_offset_us)]["t"]
    # Exposures begin every 50 ms, on the clock of the events, and take 20 ms.
    assert len(lost) > 50
    assert np.all((lost % 100_000 >= 20_000) & (lost % 100_000 < 50_000))
    every = CASES["missing-60"].keep(events, frames, camera.faults.frame_offset_us)
    assert (~every).sum() > 1.5 * len(lost)


def test_a_cell_is_scored_by_every_method_and_the_best_is_marked(tmp_path, capsys):
    stem = tmp_path / "table"
    assert command.main([
        "polarizer-500-1", "--methods", "kalman*", "line", "frames", "--presets",
        "nominal", "--seeds", "1", "--development", "-o", str(stem), "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    rows = {one["method"]: one for one in said["rows"]}
    assert set(rows) == {"kalman", "kalman causal", "kalman offline", "line", "frames"}
    assert said["seeds"] == [1001]
    assert [rows[name]["ahead"] for name in (
        "frames", "kalman causal", "line", "kalman", "kalman offline")] == [
        "causal", "causal", "buffered", "buffered", "offline"]
    assert rows["kalman"]["aop_deg"] < 1.5 < 20 < rows["line"]["aop_deg"]
    for one in ("aop_covered", "dolp_covered", "ln_covered"):
        assert 0.3 < rows["kalman"][one] <= 1
        assert rows["line"][one] is None
    assert rows["kalman"]["valid"] == 1
    written = json.loads((tmp_path / "table.json").read_text())
    assert [one["aop_deg"] for one in written["rows"]] == [
        one["aop_deg"] for one in said["rows"]]
    text = (tmp_path / "table.md").read_text()
    assert text.count("| polarizer-500-1 | nominal |") >= 2
    assert "**" in text


def test_processes_give_the_same_rows(capsys, monkeypatch):
    monkeypatch.syspath_prepend(Path(__file__).parents[2])  # a worker's is the same
    found = []
    for jobs in ("1", "2"):
        assert command.main([
            "still-50", "--methods", "frames", "line", "--presets", "typical",
            "--seeds", "2", "--jobs", jobs, "--json"]) == 0
        found.append(json.loads(capsys.readouterr().out)["rows"])
    assert found[0] == found[1]
    assert len(found[0]) == 4


def test_what_is_not_there_is_a_mistake(capsys):
    assert command.main(["nothing-of-this-name"]) == 2
    assert "no case of this name" in capsys.readouterr().err
    assert command.main(["still-50", "--methods", "magic"]) == 2
    assert "--methods must name some of" in capsys.readouterr().err


def test_frames_left_out_are_scored_as_pdavis_score_does(tmp_path):
    path = tmp_path / "run.aedat4"
    recording, _ = Camera.preset("nominal", seed=1001, size=(12, 12)).record(
        RotatingPolarizer(rpm=60.0), 1.0)
    pdavis_cv.write_aedat4(path, recording)
    methods = {"line": "buffered", "kalman": "buffered"}
    mine, kalman = real_rows(path, "left-out", methods)
    with pdavis_cv.open_recording(path) as again:
        theirs = {each.kind: each for each in pooled(
            half.score(half.simple()["linear"]) for half in (
                LeftOutFrames(again, half=half) for half in HALVES))}
    assert mine.moving == pytest.approx(theirs["moving"].rmse, rel=1e-6)
    assert mine.in_cell == pytest.approx(theirs["moving, in cell"].rmse, rel=1e-6)
    assert kalman.moving < mine.moving
    assert 0 < kalman.moving_covered < 1
    # With three frames known, and with events missing, it is worse than with all.
    for name in ("left-out-first-5", "left-out-missing"):
        _, less = real_rows(path, name, methods)
        assert kalman.moving < less.moving


def test_the_default_is_beaten_by_what_knows_no_more_and_is_not_worse():
    rows = [row("kalman", 1.0, 0.10), row("kalman offline", 0.5, 0.05, "offline"),
            row("line", 0.85, 0.14), row("cf", 0.8, 0.2), row("frames", 2, 0.01)]
    (one,) = beaten(rows)
    assert (one.cell, one.column) == (("texture-60", "typical"), "aop_deg")
    assert (one.default, one.error, one.best, one.best_error) == (
        "kalman", 1.0, "line", 0.85)
    assert not list(beaten([row("kalman", 1.0), row("line", 0.95)]))
    # Errors that another score has are not compared.
    assert not list(beaten([row("kalman", math.nan, math.nan, moving=1.0, in_cell=1.0),
                            row("line", math.nan, math.nan, moving=0.95, in_cell=0.5,
                                ahead="offline")]))


def test_means_are_over_seeds_and_the_least_is_bold():
    rows = [row("kalman", 1.0), row("kalman", 2.0, seed=2), row("line", 1.4)]
    assert means(rows)["texture-60", "typical"]["kalman"]["aop_deg"] == 1.5
    assert "| texture-60 | typical | 1.50 / **0.010** | **1.40** / **0.010** |" in page(
        rows, (1, 2))


def test_all_usual_methods_and_peers_are_known():
    assert set(PEERS) < set(known())
    assert "firenet" not in known()
    assert "firenet" in known(slow=True)
    assert known()["kalman offline"] == "offline"
