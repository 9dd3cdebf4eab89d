"""The benchmark runs, checks before it times, and judges as it says; no times here."""
import dataclasses
import json
import sys

import numpy as np
import pytest
import reference
from streams import random_events

from lab.bench import command, event_files, picture
from lab.bench.cases import CASES, Case, Comparison, event_input
from pdavis_cv import open_recording


@pytest.fixture
def floor_sum():
    return pytest.importorskip("pdavis_cv._kernels._floor").floor_sum


def test_without_the_sources_a_case_says_what_it_lacks(monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "pdavis_cv._kernels._floor", None)
    assert command.main(["cf", "kalman", "usb", "simulate", "aop-events"]) == 0
    said = capsys.readouterr().out
    assert said.count("skipped: its floor is compiled only where the sources are") == 5


@pytest.mark.parametrize("n", [0, 1, 1000])
def test_floor_sum_matches_reference(n, floor_sum):
    events, step = random_events(n, (5, 7)), np.array([-0.2, 0.3], np.float32)
    out, want = np.zeros((2, 5, 7), np.float32)
    assert floor_sum(events, step, out) == n
    reference.floor_sum(events, step, want)
    np.testing.assert_array_equal(out, want)


def test_floor_sum_stops_at_an_event_outside(floor_sum):
    events = random_events(9, (5, 7), read_only=False)
    events["x"][4] = 7
    step, out = np.ones(2, np.float32), np.zeros((5, 7), np.float32)
    assert floor_sum(events, step, out) == 4
    assert out.sum() == 4


def test_the_cf_case_runs_and_reports_both_inputs(floor_sum, capsys):
    assert command.main(["cf", "--pairs", "2", "--json"]) in (0, 1)
    report = json.loads(capsys.readouterr().out)
    assert [r["input"] for r in report["results"]] == ["uniform", "clustered"]
    assert all(r["ratio"] > 0 and r["goal"] == 0.25 for r in report["results"])


def test_the_polarization_case_agrees_with_malus_and_runs(capsys):
    pytest.importorskip("cv2")
    assert command.main(["polarization", "--pairs", "2"]) in (0, 1)
    assert "skipped" not in capsys.readouterr().out


def test_the_guided_case_runs_for_both_sensors(capsys):
    assert command.main(["guided", "--pairs", "2", "--json"]) in (0, 1)
    report = json.loads(capsys.readouterr().out)
    assert [r["input"] for r in report["results"]] == ["346x260", "2448x2048"]
    assert all(r["ratio"] > 0 and r["goal"] == 8 for r in report["results"])


def test_the_usb_case_runs_with_and_without_frames(floor_sum, capsys):
    assert command.main(["usb", "--pairs", "2", "--json"]) in (0, 1)
    report = json.loads(capsys.readouterr().out)
    assert [r["input"] for r in report["results"]] == [
        "1 Mev/s", "1 Mev/s, 25 frames/s", "10 Mev/s", "10 Mev/s, 25 frames/s"]
    assert all(r["ratio"] > 0 and r["goal"] == 0.25 for r in report["results"])


@pytest.mark.parametrize(("name", "inputs", "goal"), [
    ("aedat2", ["uniform", "clustered"], 3),
    ("aedat4", ["uniform", "clustered", "calm, with frames"], 1.2),
    ("aedat4_write", ["uniform", "clustered"], 1.0),
    pytest.param("aedat4_write_dv", ["uniform", "clustered"], 1.0,
                 marks=pytest.mark.gate),
])
def test_the_file_cases_run_or_say_what_is_not_installed(name, inputs, goal, capsys):
    assert command.main([name, "--pairs", "2", "--json"]) in (0, 1)
    report = json.loads(capsys.readouterr().out)
    if report["skipped"]:
        assert report["skipped"][name].endswith("is not installed")
        return
    assert [r["input"] for r in report["results"]] == inputs
    assert all(r["ratio"] > 0 and r["goal"] == goal for r in report["results"])


def test_images_are_timed_by_rate_of_events_and_of_images(monkeypatch, capsys):
    monkeypatch.setattr("lab.bench.images.RATES", (1e4,))
    assert command.main(["image-frames", "--pairs", "2", "--json"]) in (0, 1)
    report = json.loads(capsys.readouterr().out)
    assert [r["input"] for r in report["results"]] == [
        "0.01 Mev/s, 1000 images/s", "0.01 Mev/s, 50 images/s"]
    assert [r["reached"] is None for r in report["results"]] == [False, True]


def test_the_networks_are_timed_against_each_other_or_it_is_said_why_not(capsys):
    assert command.main(["joint", "--pairs", "2", "--json"]) in (0, 1)
    report = json.loads(capsys.readouterr().out)
    if report["skipped"]:
        assert "onnxruntime" in report["skipped"]["joint"]
        return
    result, = report["results"]
    assert result["goal"] == 0.35
    assert result["ratio"] > 0


def test_a_peer_that_is_not_installed_is_named(monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "faery", None)
    assert command.main(["aedat4_write"]) == 0
    assert "skipped: faery is not installed" in capsys.readouterr().out


def case_of(candidate, *, check=lambda: None, by_time=False, judged=True):
    times = iter([9.0, *candidate])  # the first pair is not counted
    comparison = Comparison("input", check, lambda: next(times), lambda: 1.0,
                            lambda seconds: 10 * seconds, "ds", judged)
    return Case("fake", "a fake", 0.5, lambda: iter([comparison]), by_time)


def test_a_ratio_is_the_median_over_pairs_of_speeds_or_times():
    speed, = command.measure(case_of([1.0, 2.0, 8.0]), 3)
    assert (speed.ratio, speed.reached, speed.candidate) == (0.5, True, 20.0)
    time, = command.measure(case_of([1.0, 2.0, 8.0], by_time=True), 3)
    assert (time.ratio, time.reached) == (2.0, False)
    unjudged, = command.measure(case_of([8.0, 8.0, 8.0], judged=False), 3)
    assert unjudged.reached is None


def test_a_wrong_result_is_not_timed():
    def check():
        raise AssertionError("not equal")

    with pytest.raises(AssertionError, match="not equal"):
        command.measure(case_of([], check=check))


@pytest.mark.parametrize(("candidate", "code", "word"), [
    ([1.0] * 3, 0, "reached"), ([9.0] * 3, 1, "MISSED")])
def test_the_exit_code_tells_whether_goals_are_reached(
        candidate, code, word, monkeypatch, capsys):
    monkeypatch.setitem(CASES, "fake", case_of(candidate))
    assert command.main(["fake", "--pairs", "3"]) == code
    assert word in capsys.readouterr().out


def test_results_and_a_picture_are_written(monkeypatch, tmp_path, capsys):
    pytest.importorskip("matplotlib")
    of = case_of([1.0] * 3)

    def comparisons():
        for x in (10.0, 100.0):
            comparison, = of.comparisons()
            yield dataclasses.replace(
                comparison, candidate=lambda x=x: 2e-3 * x, at=("pixels", x))

    monkeypatch.setitem(CASES, "fake", dataclasses.replace(of, comparisons=comparisons))
    assert command.main(["fake", "--pairs", "2", "-o", str(tmp_path / "x.y")]) == 0
    assert f"wrote {tmp_path / 'x.y.json'} {tmp_path / 'x.y.png'}" in (
        capsys.readouterr().out)
    report = json.loads((tmp_path / "x.y.json").read_text())
    assert [r["at"] for r in report["results"]] == [["pixels", 10], ["pixels", 100]]
    assert (tmp_path / "x.y.png").read_bytes().startswith(b"\x89PNG")


def test_the_picture_shows_time_against_each_axis():
    pytest.importorskip("matplotlib")
    panels = picture.draw({
        "pixels": {"image": [(10.0, 1.0), (100.0, 5.0)]},
        "events per second": {"cf": [(1e3, 2.0)], "kalman": [(1e3, 3.0), (1e6, 9.0)]},
    }).axes
    assert [axes.get_xlabel() for axes in panels] == ["pixels", "events per second"]
    time, proportional = panels[0].get_lines()
    np.testing.assert_allclose(time.get_ydata(), [1, 5])
    np.testing.assert_allclose(proportional.get_ydata(), [0.5, 5])
    assert [text.get_text() for text in panels[1].get_legend().get_texts()] == [
        "cf", "kalman"]


def test_a_case_without_its_package_is_skipped(monkeypatch, capsys):
    def check():
        raise ImportError("needs cv2")

    monkeypatch.setitem(CASES, "fake", case_of([], check=check))
    assert command.main(["fake"]) == 0
    assert "skipped: needs cv2" in capsys.readouterr().out


@pytest.mark.parametrize(("arguments", "message"), [
    (["nonsense"], "no case 'nonsense'; there are cf"),
    (["cf", "--pairs", "1"], "--pairs must be at least 2, got 1"),
])
def test_a_mistake_prints_one_line_and_returns_2(arguments, message, capsys):
    assert command.main(arguments) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1


@pytest.mark.parametrize("name", event_files.FORMATS)
def test_files_of_events_that_are_timed_hold_the_events(name, tmp_path):
    write, options = event_files.FORMATS[name]
    if name.startswith("ROS"):
        pytest.importorskip("rosbags")
    if "HDF5" in name:
        pytest.importorskip("h5py")
    events = event_input("uniform")[:50_000:17]
    write(tmp_path / "x", events)
    with open_recording(tmp_path / "x", **options) as recording:
        np.testing.assert_array_equal(recording.events(), events)


def test_streams_are_timed_by_packets_threads_and_pixels(monkeypatch, capsys):
    monkeypatch.setattr("lab.bench.streams.SIZES", ((16, 16),))
    monkeypatch.setattr("lab.bench.streams.STREAM_RATE", 1e5)
    monkeypatch.setattr("lab.bench.streams.MEMORY_PARTS", 2)
    assert command.main(
        ["image-pixels", "latency", "memory", "--pairs", "2", "--json"]) in (0, 1)
    report = json.loads(capsys.readouterr().out)
    assert [(r["case"], r["goal"], r["at"]) for r in report["results"]] == [
        ("image-pixels", 10, ["pixels", 256]), ("latency", 20, None),
        ("latency", 20, None), ("memory", 10, None)]
    assert all(r["candidate"] > r["floor"] > 0 for r in report["results"])


def test_a_second_behind_a_turning_analyser_is_timed(monkeypatch, capsys):
    monkeypatch.setattr("lab.bench.turning.SIZE", (32, 64))
    monkeypatch.setattr("lab.bench.turning.RATE", 100_000)
    command.main(["turning", "--pairs", "2", "--json"])
    [result] = json.loads(capsys.readouterr().out)["results"]
    assert (result["goal"], result["input"]) == (8, "0.1 Mev, 50 images")
    assert result["candidate"] > result["floor"] > 0


def test_images_of_a_recording_are_timed_method_by_method(monkeypatch, capsys):
    monkeypatch.delenv("PDAVIS_TEST_DATA", raising=False)
    assert command.main(["image-recording", "--pairs", "2", "--json"]) == 0
    results = json.loads(capsys.readouterr().out)["results"]
    assert [r["input"] for r in results] == [
        f"simulated_fan, {name}" for name in (
            "frames", "cf", "events", "redundancy", "kalman", "causal", "offline")]
    # Of the example, which is small, no goal is asked.
    assert all(r["reached"] is None and r["ratio"] > 0 for r in results)


def test_a_second_at_the_full_rate_is_compared_with_a_second(monkeypatch, capsys):
    monkeypatch.setattr("lab.bench.streams.FULL_RATE", 1e4)
    assert command.main(["full-rate", "--pairs", "2", "--json"]) in (0, 1)
    results = json.loads(capsys.readouterr().out)["results"]
    assert [(r["input"], r["floor"], r["unit"]) for r in results] == [
        ("1 thread", 1, "s"), ("2 threads", 1, "s")]
    assert all(r["candidate"] == r["ratio"] > 0 for r in results)


def test_images_of_two_threads_equal_those_of_one(monkeypatch):
    compared = next(CASES["threads"].comparisons())
    compared.check()
    assert compared.candidate() > 0
    assert compared.name == "kalman, 0.033 Mev/s"
