import csv
import json
import re

import numpy as np
import pytest

import pdavis_cv
from lab.paper import command
from lab.paper.page import pivot
from lab.paper.run import SHOWN, Row, Take, score
from pdavis_cv.simulation import Camera, FlatLight, RotatingPolarizer


def rows_of(stem):
    with open(f"{stem}.csv") as file:
        return list(csv.DictReader(file))


@pytest.mark.gate
def test_every_method_is_scored_and_written(tmp_path, capsys):
    stem = tmp_path / "fig.2"
    assert command.main(["fig2", "-o", str(stem), "--rpm", "200", "--seconds", "1.6",
                           "--step-us", "9000", "--seeds", "1"]) == 0
    rows = {row["method"]: row for row in rows_of(stem)}
    assert list(rows) == list(SHOWN)
    assert 1 < float(rows["firenet"]["aop_error_deg"]) < 6
    assert 1 < float(rows["joint"]["aop_error_deg"]) < 4
    assert float(rows["kalman"]["aop_error_deg"]) < 1.3
    assert float(rows["kalman"]["dolp_error"]) < 0.03
    assert 0.5 < float(rows["kalman"]["aop_coverage"]) <= 1
    assert float(rows["frames"]["aop_error_deg"]) > 25
    assert 15 < float(rows["Sony 50 fps"]["aop_error_deg"]) < 30
    assert float(rows["Sony 50 fps, own times"]["aop_error_deg"]) < 1
    assert rows["Sony 50 fps"]["events_per_pixel_s"] == ""
    page = (tmp_path / "fig.2.md").read_text()
    assert "Beside the paper" in page
    left, before = re.search(
        r"([\d.]+) Hz under constant light, before denoising ([\d.]+)", page).groups()
    assert 0 < float(left) < 0.2 < 0.5 < float(before)
    assert page.strip() in capsys.readouterr().out
    with open(f"{stem}-traces.csv") as file:
        traces = list(csv.DictReader(file))
    truth = [float(row["aop_deg"]) for row in traces if row["method"] == "truth"]
    ours = [float(row["aop_deg"]) for row in traces if row["method"] == "kalman"]
    off = (np.array(ours) - truth + 90) % 180 - 90
    assert np.abs(off).mean() < 1


@pytest.mark.gate
def test_pictures_are_drawn_for_both_geometries(tmp_path):
    pytest.importorskip("matplotlib")
    stem = tmp_path / "fig3"
    assert command.main([
        "fig3", "-o", str(stem), "--rpm", "60", "200", "--seconds", "1.2",
        "--step-us", "20000", "--methods", "frames", "kalman", "--seeds", "1"]) == 0
    for name in ("rotating-plate", "rotating-polarizer"):
        assert (tmp_path / f"fig3-{name}.png").read_bytes().startswith(b"\x89PNG")
        assert b"<svg" in (tmp_path / f"fig3-{name}.svg").read_bytes()
    rows = rows_of(stem)
    assert {row["scene"] for row in rows} == {"rotating plate", "rotating polarizer"}
    rate = {(row["scene"], row["rpm"]): float(row["events_per_pixel_s"])
            for row in rows}
    for scene in ("rotating plate", "rotating polarizer"):
        assert rate[scene, "200.0"] / rate[scene, "60.0"] == pytest.approx(
            200 / 60, rel=0.1)


@pytest.mark.gate
def test_the_score_of_the_kalman_method_is_below_the_goal_on_nominal_cameras():
    recording, truth = Camera.preset("nominal", seed=5).record(
        RotatingPolarizer(rpm=506.5), 2.0)
    got = score(
        Take(recording, truth, 0, truth.stop_us), step_us=5000,
        method="kalman", nominal_thresholds=(0.16, 0.18))["all"]
    assert got.aop_error < 0.0227     # 1.3 degrees
    assert got.dolp_error < 0.03


def test_a_table_has_a_line_per_method_and_a_mean():
    blank = dict.fromkeys(Row.__dataclass_fields__, float("nan"))
    rows = [Row(**{**blank, "method": method, "rpm": rpm, "aop_error_deg": error})
            for method, rpm, error in (
                ("frames", 30, 1.0), ("frames", 30, 3.0), ("frames", 60, 5.0),
                ("kalman", 30, float("nan")))]
    assert pivot(rows, "rpm", ("aop_error_deg",)) == [
        "| method | 30 | 60 | mean |", "|---|---|---|---|",
        "| frames | 2.00 | 5.00 | 3.00 |", ""]


@pytest.mark.gate
def test_the_bright_half_of_the_fan_saturates_frames_only(tmp_path):
    stem = tmp_path / "fan"
    assert command.main([
        "fig4a", "-o", str(stem), "--quick", "--rpm", "200", "--seconds", "1.3",
        "--methods", "frames, own times", "events", "kalman"]) == 0
    rows = {(row["method"], row["region"]): row for row in rows_of(stem)}
    dark, bright = ({method: float(rows[method, half]["aop_error_deg"])
                     for method in ("frames, own times", "events", "kalman")}
                    for half in ("dark half", "bright half"))
    assert dark["kalman"] < 1.5
    assert dark["frames, own times"] < 1.5
    assert bright["frames, own times"] > 30
    assert float(rows["frames, own times", "bright half"]["valid"]) == 0
    assert max(dark["events"], bright["events"]) < 6
    assert rows["events", "dark half"]["dolp_error"] == ""


@pytest.mark.gate
def test_frames_saturate_above_one_microwatt_and_events_do_not(tmp_path):
    stem = tmp_path / "dr"
    assert command.main([
        "dr", "-o", str(stem), "--quick", "--seconds", "1.6", "--step-us", "20000",
        "--methods", "Sony 50 fps, own times", "frames, own times", "events"]) == 0
    rows = rows_of(stem)
    levels = sorted({float(row["irradiance_uw_cm2"]) for row in rows})
    assert levels[0] == pytest.approx(0.04)
    assert levels[-1] == pytest.approx(42_000)
    errors = {method: [float(row["aop_error_roi_deg"]) for row in rows
                       if row["method"] == method and row["scene"] == "polarizer"]
              for method in ("Sony 50 fps, own times", "frames, own times", "events")}
    assert [error < 5 for error in errors["frames, own times"]] == [
        True, True, False, False, False]
    assert [error < 5 for error in errors["Sony 50 fps, own times"]] == [
        False, True, True, False, False]
    assert max(errors["events"]) - min(errors["events"]) < 1


@pytest.mark.accuracy
@pytest.mark.gate
def test_flicker_leaves_the_frames_alone(tmp_path):
    stem = tmp_path / "flicker"
    assert command.main([
        "flicker", "-o", str(stem), "--quick", "--rpm", "60", "--methods",
        "frames, own times", "kalman"]) == 0
    rows = {(row["method"], "flicker" in row["scene"]): float(row["aop_error_deg"])
            for row in rows_of(stem)}
    assert rows["frames, own times", True] == pytest.approx(
        rows["frames, own times", False], rel=0.1)
    assert rows["kalman", True] < 1.6 * rows["kalman", False]
    assert "over error without" in stem.with_suffix(".md").read_text()


@pytest.mark.gate
def test_one_command_does_all_of_it_and_sums_it_up(tmp_path, capsys):
    pytest.importorskip("matplotlib")
    stem = tmp_path / "all"
    asked = ["all", "-o", str(stem), "--quick", "--rpm", "200", "--seconds", "1.3",
             "--step-us", "20260", "--methods", "frames"]
    assert command.main(asked) == 0
    page = (tmp_path / "all.html").read_text()
    links = set(re.findall(r'(?:src|href)="([^"]+)"', page))
    assert {"all.md", "all-fig3-rotating-plate.png", "all-fan.csv",
            "all-videos-1.webm"} <= links
    assert all((tmp_path / link).exists() for link in links)
    for name in ("fig1", "fig2", "fig3", "fig4a", "fan", "tendon", "range", "dr",
                 "flicker", "optics", "transfer", "denoise", "network", "tables",
                 "videos"):
        assert (tmp_path / f"all-{name}.md").exists()
        assert (tmp_path / f"all-{name}.csv").exists()
    line = next(line for line in capsys.readouterr().out.splitlines()
                if line.startswith("| frames |"))
    polarizer, _, _, fan, *_ = line.split("|")[2:]
    mine = [row for row in rows_of(stem) if row["method"] == "frames"]
    errors = [float(row["aop_error_deg"]) for row in mine if row["region"] == "all"]
    assert polarizer.strip().startswith(f"{errors[0]:.2f} / ")
    halves = [f"{float(row['aop_error_deg']):.2f}" for row in mine
              if row["scene"] == "fan"]
    assert fan.strip() == " / ".join(halves)


@pytest.mark.parametrize(("quick", "of_figures"), [
    ([], tuple(range(1, 11))), (["--quick"], (1,)), (["--seeds", "4", "7"], (4, 7))])
def test_each_figure_of_all_has_its_own_specimens(
        tmp_path, monkeypatch, quick, of_figures):
    asked = {}

    def made(stems, settings, make):
        for name in ("fig2", "fig3", "fig4a"):
            monkeypatch.setitem(command.EXPERIMENTS, name, (
                "", lambda name, stem, settings: asked.setdefault(name, settings)))
            make(name, stems[name], settings)
        raise InterruptedError

    monkeypatch.setattr(command.together, "made", made)
    settings = command.settings_of(["all", "-o", str(tmp_path / "x"), *quick])
    with pytest.raises(InterruptedError):
        command.EXPERIMENTS["all"][1]("all", tmp_path / "x", settings)
    assert asked["fig2"].seeds == asked["fig3"].seeds == of_figures
    assert len({start for _, start in asked["fig3"].specimens}) == len(of_figures)
    assert asked["fig4a"].starts_deg == (17.0,)


@pytest.mark.gate
def test_a_recording_without_truth_is_scored_against_its_own_fit(tmp_path, capsys):
    paths = []
    for rpm in (-60.78, 1013):
        recording, _ = Camera.preset("nominal", seed=9, size=(16, 20)).record(
            RotatingPolarizer(rpm=rpm, start_angle=0.7), 1.7)
        paths.append(str(tmp_path / f"at{abs(rpm):.0f}.aedat4"))
        pdavis_cv.write_aedat4(paths[-1], recording)
    stem = tmp_path / "mine"
    assert command.main([
        "fig2", "-o", str(stem), "--recording", *paths, "--step-us", "10130",
        "--roi", "2,4,8,8", "--nominal", ".16,.18", "--methods", "frames", "kalman",
        "Sony 50 fps"]) == 0
    page = capsys.readouterr().out
    assert "| at61.aedat4 | -60.78" in page
    assert "8x8 pixels at (2, 4)" in page
    rows = {(row["method"], float(row["rpm"])): row for row in rows_of(stem)}
    for rpm in (60.78, 1013.0):
        assert float(rows["kalman", rpm]["aop_error_deg"]) < 1.3
        assert float(rows["kalman", rpm]["dolp_error"]) < 0.03
        assert rows["kalman", rpm]["camera"] == "recording"
    assert float(rows["frames", 1013.0]["aop_error_deg"]) > 25
    assert float(rows["Sony 50 fps", 60.78]["aop_error_roi_deg"]) == pytest.approx(
        0.020 * 60.78 * 6, rel=0.1)  # half a frame of 20 ms, and half an exposure


@pytest.mark.gate
def test_a_recording_of_which_no_pixel_is_valid_is_told_with_the_reason(
        tmp_path, capsys):
    path = tmp_path / "in.aedat4"
    pdavis_cv.write_aedat4(path, Camera.preset("nominal", seed=9, size=(12, 12)).record(
        RotatingPolarizer(rpm=61.0), 1.7)[0])
    # Of a camera that clips at 1 DN every sample is a lower bound.
    clips = str(tmp_path / "clips.npz")
    pdavis_cv.Calibration(sensor_size=(12, 12), clip_dn=1.0).save(clips)
    assert command.main([
        "fig2", "-o", str(tmp_path / "x"), "--recording", str(path), "--step-us",
        "50000", "--layout", "pdavis", "--methods", "frames", "cf", "--calibration",
        clips, "--json"]) == 0
    # `frames` is compared as it comes, without a calibration.
    printed = capsys.readouterr()
    told = json.loads(printed.out)
    assert told["wrote"] == [str(tmp_path / "x.csv"), str(tmp_path / "x.md")]
    assert {row["method"] for row in told["rows"]} == {"frames", "cf"}
    [line] = printed.err.splitlines()
    assert line.startswith("pdavis: warning: no image has a valid pixel: 100% of")


@pytest.mark.gate
def test_denoising_is_measured_and_leaves_little_noise_and_most_of_the_light(
        tmp_path, capsys):
    stem = tmp_path / "denoise"
    assert command.main(["denoise", "-o", str(stem), "--rpm", "30", "1000",
                           "--seconds", "1.8", "--seeds", "4"]) == 0
    slow, fast = rows_of(stem)
    assert float(fast["true_hz"]) / float(slow["true_hz"]) == pytest.approx(
        1000 / 30, rel=0.1)
    for row in (slow, fast):
        assert float(row["noise_hz"]) > 2
        assert 0 < float(row["left_hz"]) < 0.1
        assert 0.95 < float(row["kept"]) <= 1
    page = capsys.readouterr().out
    assert page.strip() == (tmp_path / "denoise.md").read_text().strip()
    assert f"| 30 | {float(slow['noise_hz']):.2f} | {float(slow['left_hz']):.3f} |" in (
        page)


def test_a_recording_that_cannot_be_fitted_is_one_line(tmp_path, capsys):
    path = tmp_path / "still.aedat4"
    pdavis_cv.write_aedat4(path, Camera.preset("nominal").record(FlatLight(), 1.5)[0])
    for more, said in (([], "turns"), (["--roi", "1,0,4,4"], "even numbers")):
        assert command.main(
            ["fig2", "-o", str(tmp_path / "x"), "--recording", str(path), *more]) == 2
        text = capsys.readouterr().err
        assert said in text
        assert str(path) in text
    assert command.main(
        ["fig3", "-o", str(tmp_path / "x"), "--recording", str(path)]) == 2


@pytest.mark.parametrize("arguments", [
    ["fig9", "-o", "x"], ["fig2"], ["fig2", "-o", "x", "--seconds", "1"],
    ["fig2", "-o", "x", "--methods", "magic"], ["fig2", "-o", "x", "--rpm", "0"],
    ["fig2", "-o", "."]])
def test_a_mistake_is_one_line(arguments, capsys):
    assert command.main(arguments) == 2
    assert len(capsys.readouterr().err.splitlines()) == 1
