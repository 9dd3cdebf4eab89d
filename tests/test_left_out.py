"""Frames left out and predicted: the score, and the command that shows it."""
import csv
import json

import numpy as np
import pytest

import pdavis_cv
from pdavis_cv import ApsFrame, Layout, fuse, open_recording, recording_from_arrays
from pdavis_cv.analysis import CLASSES, HALVES, LeftOutFrames, observed, pooled
from pdavis_cv.events import EVENT_DTYPE
from pdavis_cv.reconstruct.base import Estimate
from pdavis_cv.tools import score

pytestmark = pytest.mark.accuracy

SHAPE = (20, 24)
EXPOSURE_MS = 10
FRAME_US = 40_000
ON, OFF = 0.25, 0.4


def frames(count, log, noise=0.0, seed=0):
    """Return frames of log(t_us) (H, W), each with so much noise of its log."""
    rng = np.random.default_rng(seed)
    out = []
    for k in range(count):
        mid = k * FRAME_US + 5000
        seen = log(mid) + noise * rng.normal(size=SHAPE)
        out.append(ApsFrame(np.exp(seen) * EXPOSURE_MS, mid - 5000, mid + 5000))
    return out


def ramp(t_us):
    """Return the left half at rest and the right half brightening, ln DN per ms."""
    log = np.full(SHAPE, np.log(30.0))
    log[:, 12:] += 2e-6 * t_us
    return log


def swing(t_us):
    """Return the left half at rest and the right half swinging, ln DN per ms."""
    log = np.full(SHAPE, np.log(30.0))
    log[:, 12:] += np.sin(2 * np.pi * t_us / 400_000)
    return log


def swing_events(stop_us):
    """Return what pixels of threshold ON for both signs fire of `swing`."""
    times = np.arange(0, stop_us, 1000)
    level = np.floor(np.sin(2 * np.pi * times / 400_000) / ON)
    step = np.flatnonzero(np.diff(level))
    events = np.zeros((len(step), SHAPE[0], 12), EVENT_DTYPE)
    events["t"] = times[step + 1, None, None]
    events["y"], events["x"] = np.arange(SHAPE[0])[:, None], np.arange(12, 24)
    events["p"] = (np.diff(level)[step] > 0)[:, None, None]
    return events.reshape(-1)


def still(count=9, noise=0.0):
    one = np.array([(1000, 0, 0, 1)], EVENT_DTYPE)
    return recording_from_arrays(
        one, frames(count, lambda t: np.log(np.linspace(2.0, 60, SHAPE[1])) +
                    np.zeros(SHAPE), noise),
        sensor_size=SHAPE, layout=Layout.PDAVIS)


def by_class(scores):
    assert [each.kind for each in scores] == list(CLASSES)
    return {each.kind: each for each in scores}


def test_every_second_frame_is_kept_and_nothing_else_is_lost():
    recording = still(9)
    left_out = LeftOutFrames(recording)
    mids = [frame.mid_us for p in recording.packets() for frame in p.frames]
    kept = [frame.mid_us for p in left_out.kept.packets() for frame in p.frames]
    assert left_out.times_us.tolist() == mids[1::2]
    assert kept == mids[::2]
    np.testing.assert_array_equal(left_out.kept.events(), recording.events())
    assert left_out.kept.info.frame_count == recording.info.frame_count - 4


def test_the_halves_leave_out_each_frame_between_others_once():
    recording = still(9)
    times = [LeftOutFrames(recording, half=half).times_us.tolist() for half in HALVES]
    mids = [frame.mid_us for p in recording.packets() for frame in p.frames]
    assert sorted([*times[0], *times[1]]) == mids[1:-1]
    with pytest.raises(ValueError, match="half must be one of"):
        LeftOutFrames(recording, half="both")


def test_a_prediction_is_averaged_over_the_exposure_before_it_is_compared():
    """Light that swings within an exposure is not an error of who predicts it."""
    def light(t_us):
        return 30 + 20 * np.sin(2 * np.pi * np.asarray(t_us) / 37_000)

    def blurred(k):
        within = k * FRAME_US + 20_000 * (np.arange(1000) + 0.5) / 1000
        return ApsFrame(np.full(SHAPE, 20 * light(within).mean(), np.float32),
                        k * FRAME_US, k * FRAME_US + 20_000)

    left_out = LeftOutFrames(recording_from_arrays(
        np.array([(1000, 0, 0, 1)], EVENT_DTYPE), [blurred(k) for k in range(9)],
        sensor_size=SHAPE, layout=Layout.PDAVIS))
    times = left_out.sample_times_us
    assert times.shape == (4, 5)
    np.testing.assert_array_equal(times.mean(axis=1), left_out.times_us)
    every = [Estimate(np.full(SHAPE, np.log(light(t)), np.float32),
                      np.full(SHAPE, 0.01, np.float32), np.ones(SHAPE, np.bool_))
             for t in times.ravel()]
    averaged = list(left_out.averaged(every))
    assert averaged[0].variance == pytest.approx(0.01)
    middle = [np.log(light(t)) + np.zeros(SHAPE) for t in left_out.times_us]
    assert by_class(left_out.score(averaged))["static, bright"].rmse < 0.02
    assert by_class(left_out.score(middle))["static, bright"].rmse > 0.1


def test_pooled_scores_are_those_of_all_pixels_together():
    left_out = LeftOutFrames(still(21, noise=0.03))
    exact = np.log(np.linspace(2.0, 60, SHAPE[1])) + np.zeros(SHAPE)
    guesses = [Estimate(exact.astype(np.float32), np.zeros(SHAPE, np.float32),
                        np.ones(SHAPE, np.bool_)) for _ in left_out.times_us]
    once = left_out.score(guesses)
    worse = left_out.score([exact + 0.1 for _ in guesses])
    for kind, one in by_class(pooled([once, once])).items():
        assert one.pixels == 2 * by_class(once)[kind].pixels
        assert one.rmse == pytest.approx(by_class(once)[kind].rmse, nan_ok=True)
        assert one.coverage == pytest.approx(by_class(once)[kind].coverage, nan_ok=True)
    both = by_class(pooled([once, worse]))["static, bright"]
    squares = [by_class(each)["static, bright"].rmse ** 2 for each in (once, worse)]
    assert both.rmse == pytest.approx(np.sqrt(np.mean(squares)))
    assert both.bias == pytest.approx(0.05, abs=0.005)


def test_a_straight_line_is_predicted_by_interpolation_and_missed_by_holding():
    left_out = LeftOutFrames(recording_from_arrays(
        np.array([(1000, 0, 0, 1)], EVENT_DTYPE), frames(7, ramp), sensor_size=SHAPE,
        layout=Layout.PDAVIS))
    guesses = left_out.simple()
    linear = by_class(left_out.score(guesses["linear"]))
    held = by_class(left_out.score(guesses["held"]))
    assert linear["static, bright"].rmse < 1e-6
    # Half of the pixels rose by 2e-6 per us over 40 ms.
    assert held["static, bright"].bias == pytest.approx(-0.04, rel=1e-4)
    assert held["static, bright"].rmse == pytest.approx(0.08 / np.sqrt(2), rel=1e-4)


def test_an_honest_sigma_covers_two_thirds_and_the_frames_own_noise_is_allowed_for():
    left_out = LeftOutFrames(still(21, noise=0.03))
    truth = np.log(np.linspace(2.0, 60, SHAPE[1])) + np.zeros(SHAPE)
    rng = np.random.default_rng(5)

    def coverage(claimed, actual):
        guesses = [Estimate(
            (truth + actual * rng.normal(size=SHAPE)).astype(np.float32),
            np.full(SHAPE, claimed**2, np.float32), np.ones(SHAPE, np.bool_))
            for _ in left_out.times_us]
        return by_class(left_out.score(guesses))["static, bright"].coverage

    assert coverage(0.0, 0.0) == pytest.approx(0.683, abs=0.04)
    assert coverage(0.05, 0.05) == pytest.approx(0.683, abs=0.04)
    assert coverage(0.05, 0.1) < 0.5
    assert coverage(0.2, 0.05) > 0.95


def test_in_a_cell_only_the_ratios_of_its_channels_count():
    left_out = LeftOutFrames(recording_from_arrays(
        swing_events(8 * FRAME_US), frames(9, swing), sensor_size=SHAPE,
        layout=Layout.PDAVIS))
    truth = [left_out.images(i)[0] for i in range(len(left_out.times_us))]
    levels = np.random.default_rng(1).normal(size=(10, 12)).repeat(2, 0).repeat(2, 1)
    found = by_class(left_out.score([log + levels for log in truth]))
    assert found["moving, in cell"].rmse < 1e-12
    assert found["moving, in cell"].pixels > 100
    assert found["moving"].rmse > 0.5
    # Independent errors of the four: sigmas of cells cover as those of pixels do.
    rng = np.random.default_rng(4)
    honest = [Estimate((log + 0.2 * rng.normal(size=SHAPE)).astype(np.float32),
                       np.full(SHAPE, 0.04, np.float32), np.ones(SHAPE, np.bool_))
              for log in truth]
    assert by_class(left_out.score(honest))["moving, in cell"].coverage == (
        pytest.approx(0.683, abs=0.05))
    # One pixel of four that is off by .4: .3 and three times .1 from the mean.
    off = np.zeros(SHAPE)
    off[::2, ::2] = 0.4
    found = by_class(left_out.score([log + off for log in truth], relative=True))
    assert found["moving, in cell"].rmse == pytest.approx(np.sqrt(0.03))
    assert all(np.isnan(score.rmse) for kind, score in found.items()
               if kind != "moving, in cell")


def test_light_that_is_known_takes_the_place_of_the_frames():
    left_out = LeftOutFrames(recording_from_arrays(
        swing_events(8 * FRAME_US), frames(9, swing, 0.05), sensor_size=SHAPE,
        layout=Layout.PDAVIS))
    light = [swing(t) for t in left_out.times_us]
    assert by_class(left_out.score(light))["moving"].rmse == pytest.approx(
        0.05, rel=0.1)
    assert by_class(left_out.score(light, truth=light))["moving"].rmse == 0


def test_what_is_observed_changes_no_image():
    recording = recording_from_arrays(
        swing_events(8 * FRAME_US), frames(9, swing), sensor_size=SHAPE,
        layout=Layout.PDAVIS)
    seen = []
    times = {"times_us": [50_000, 90_000, 200_000], "demosaic": "superpixel"}
    for plain, watched in zip(
            fuse(recording, method="cf", **times),
            fuse(recording, method=observed("cf", seen), **times), strict=True):
        np.testing.assert_array_equal(plain.quad, watched.quad)
        # I0 of PDAVIS lies at (1, 0) of the cell.
        np.testing.assert_allclose(
            np.exp(seen[0].log_intensity[1::2, ::2]), plain.quad[0], rtol=1e-6)


def test_too_little_is_refused():
    with pytest.raises(ValueError, match="at least 5 frames, got 4"):
        LeftOutFrames(still(4))
    nothing = recording_from_arrays(
        None, frames(9, ramp), sensor_size=SHAPE, layout=Layout.PDAVIS)
    with pytest.raises(ValueError, match="events between its frames"):
        LeftOutFrames(nothing)


# Where pixels move, and at rest where it is bright; what was measured, and 5 %.
REAL = {
    "held": (0.809, 0.038), "linear": (0.594, 0.029), "cf": (0.377, 0.034),
    "kalman": (0.233, 0.027), "kalman causal": (0.287, 0.032),
    "kalman offline": (0.206, 0.026)}
# The same of methods that are told nothing.
UNTOLD = {"kalman": (0.226, 0.027), "kalman causal": (0.291, 0.032),
          "kalman offline": (0.202, 0.026)}


@pytest.fixture(scope="module")
def davis(data_dir):
    with open_recording(data_dir / "davis346.aedat4", layout=Layout.PDAVIS) as made:
        yield LeftOutFrames(made)


@pytest.mark.parametrize("method", [
    "held", "linear", "cf", "kalman",
    pytest.param("kalman causal", marks=pytest.mark.gate),
    pytest.param("kalman offline", marks=pytest.mark.gate)])
def test_a_real_recording_is_predicted_as_well_as_before(davis, method):
    stated = 0.309, 0.368       # regression of the frames' changes on counts
    guesses = (score.predicted(
        davis, **score.trials()[method].options, thresholds=stated)
        if method in score.trials() else davis.simple()[method])
    found = by_class(davis.score(guesses))
    moving, static = REAL[method]
    assert found["moving"].pixels == 5744
    assert found["moving"].rmse < 1.05 * moving
    assert found["static, bright"].rmse < 1.05 * static
    if method in ("kalman", "kalman offline"):
        assert 0.55 < found["moving"].coverage < 0.8
        for kind in ("static, bright", "static, dark"):
            assert found[kind].coverage > 0.55
    if method in ("held", "linear"):
        assert found["moving"].rmse > 0.99 * moving


@pytest.mark.gate
@pytest.mark.parametrize("method", ["kalman causal", "kalman", "kalman offline"])
def test_without_a_hint_it_is_predicted_as_well_as_before(davis, method):
    found = by_class(davis.score(score.predicted(
        davis, **score.trials()[method].options)))
    moving, static = UNTOLD[method]
    assert found["moving"].rmse < 1.05 * moving
    assert found["static, bright"].rmse < 1.05 * static
    assert 0.55 < found["moving"].coverage < 0.8
    # At rest it is at least as good as what uses the same frames.
    frames = davis.simple()["held" if "causal" in method else "linear"]
    plain = by_class(davis.score(frames))
    for kind in ("static, bright", "static, dark"):
        assert found[kind].rmse < plain[kind].rmse


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "swing.aedat4"
    pdavis_cv.write_aedat4(path, recording_from_arrays(
        swing_events(20 * FRAME_US), frames(19, swing, 0.01),
        sensor_size=SHAPE, layout=Layout.PDAVIS))
    return path


@pytest.mark.gate
def test_the_command_writes_a_table_and_json(file, tmp_path, capsys):
    stem = tmp_path / "out"
    assert score.main([
        str(file), "-o", str(stem), "--layout", "pdavis", "--methods", "cf", "kalman",
        "--thresholds", "nominal", f"{ON},{ON}"]) == 0
    text = capsys.readouterr().out
    found = json.loads((tmp_path / "out.json").read_text())
    rows = {(row["method"], row["thresholds_from"]): row for row in found["rows"]}
    assert ("kalman", "given") in rows
    assert ("linear", "") in rows
    best = rows["kalman", "given"]["scores"]["moving"]
    assert f"{best['rmse']:.3f}" in text
    with open(tmp_path / "out.csv") as table:
        lines = list(csv.DictReader(table))
    mine = [line for line in lines if line["method"] == "kalman"
            and line["thresholds_from"] == "given" and line["class"] == "moving"]
    assert float(mine[0]["rmse_ln"]) == best["rmse"]
    assert (float(mine[0]["on"]), float(mine[0]["off"])) == (ON, ON)


def test_json_is_all_that_is_printed(file, capsys):
    assert score.main([str(file), "--json", "--layout", "pdavis", "--methods", "cf",
                       "--thresholds", "nominal"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["camera"].keys() >= {"theta_on", "thresholds_sigma"} or (
        not found["camera"])
    assert any("suits it best" in line for line in found["advice"])


def test_frames_and_redundancy_are_scored_where_they_mean_something(file, capsys):
    assert score.main([str(file), "--json", "--layout", "pdavis", "--thresholds",
                       "nominal", "default", "--methods", "frames", "cf",
                       "events, redundancy"]) == 0
    found = json.loads(capsys.readouterr().out)
    rows = {(row["method"], row["thresholds_from"]): row["scores"]
            for row in found["rows"]}
    for kind in CLASSES:  # once, as it has no thresholds
        assert rows["frames", ""][kind]["rmse"] == pytest.approx(
            rows["held", ""][kind]["rmse"], rel=1e-5)
    told = rows["events, redundancy", "nominal"]
    assert told["moving"]["rmse"] is None
    assert told["moving, in cell"]["rmse"] > 0
    assert any("recorded, for polarization" in line for line in found["advice"])


def test_redundancy_without_polarizers_is_refused_or_left_out(tmp_path, capsys):
    plain = recording_from_arrays(
        swing_events(8 * FRAME_US), frames(9, swing), sensor_size=SHAPE)
    path = tmp_path / "plain.aedat4"
    pdavis_cv.write_aedat4(path, plain)
    assert score.main([str(path), "--methods", "events, redundancy"]) == 2
    assert "'events, redundancy' needs polarizers" in capsys.readouterr().err
    assert score._possible(score.trials(), None, plain) == [
        "frames", "cf", "cf causal", "kalman", "kalman causal", "kalman offline"]


def test_every_method_can_be_scored_and_networks_only_if_asked_for(file):
    known = score.trials()
    assert list(known) == [
        "frames", "events, redundancy", "events, redundancy causal", "cf", "cf causal",
        "kalman", "kalman causal", "kalman offline", "firenet", "firenet causal",
        "joint", "joint causal"]
    assert [name for name, one in known.items() if one.relative] == [
        "events, redundancy", "events, redundancy causal", "firenet", "firenet causal",
        "joint", "joint causal"]
    with open_recording(file) as recording:
        assert score._possible(known, None, recording) == list(known)[:8]


def row(method, moving, static, pixels=1000, cell=0.5):
    def each(kind):
        rmse = cell if kind == "moving, in cell" else (
            moving if kind.startswith("moving") else static)
        return pdavis_cv.analysis.PredictionScore(
            kind, pixels if kind.startswith("moving") else 10_000, rmse, 0.0, 0.5)
    return score.Row(method, "nominal", (0.2, 0.2), tuple(map(each, CLASSES)),
                     score.trials().get(method))


def test_the_method_that_suits_is_good_where_pixels_move_and_not_bad_at_rest():
    rows = [row("linear", 0.5, 0.03), row("kalman", 0.3, 0.033),
            row("cf", 0.2, 0.06), row("kalman causal", 0.4, 0.031)]
    assert score.suited(rows).method == "kalman"
    assert score.suited(rows, causal=True).method == "kalman causal"
    assert score.suited([row("linear", 0.5, 0.03, 5), row("kalman", 0.3, 0.033, 5)]
                        ).method == "linear"


def test_for_polarization_the_ratios_of_a_cell_decide():
    rows = [row("kalman", 0.3, 0.03, cell=0.2), row("cf", 0.2, 0.06, cell=0.3),
            row("events, redundancy causal", np.nan, np.nan, cell=0.1)]
    assert score.suited(rows).method == "kalman"
    assert score.suited_for_polarization(rows).method == "events, redundancy causal"
    advice = score._advice(rows, "a.aedat4", polarized=True)
    assert "  pdavis export a.aedat4 -o fused.mp4 --method events " \
        "--set offsets=redundancy --causal --thresholds nominal" in advice
    assert not any("polarization" in line
                   for line in score._advice(rows, "a.aedat4", polarized=False))


@pytest.mark.parametrize(("arguments", "said"), [
    (["--methods", "magic"], "invalid choice"),
    (["--thresholds", "0.2"], "numbers with commas"),
    (["--seconds", "0.1"], "at least 5 frames"),
    (["--thresholds", "0.2,-1"], "thresholds")])
def test_a_mistake_is_one_line(file, arguments, said, capsys):
    assert score.main([str(file), "--layout", "pdavis", *arguments]) == 2
    text = capsys.readouterr().err
    assert len(text.splitlines()) == 1
    assert said in text
