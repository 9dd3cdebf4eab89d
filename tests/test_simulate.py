"""pdavis simulate: a recording and its truth in files."""
import numpy as np
import pytest

import pdavis_cv
from pdavis_cv.data import example_recording
from pdavis_cv.simulation import SCENES, Camera, RotatingPolarizer, example_truth
from pdavis_cv.tools.main import main


def drain(recording):
    packets = list(recording.packets())
    frames = [frame for packet in packets for frame in packet.frames]
    return np.concatenate([packet.events for packet in packets]), frames


def test_files_hold_what_the_camera_records_and_the_truth(tmp_path, capsys):
    path = tmp_path / "polarizer.aedat4"
    assert main(["simulate", "polarizer", "--camera", "nominal", "--rpm", "1000",
                 "--seconds", "0.3", "--seed", "1", "--start-deg", "20",
                 "-o", str(path)]) == 0
    assert "polarizer.aedat4.truth.npz" in capsys.readouterr().out
    scene = RotatingPolarizer(rpm=1000.0, start_angle=np.deg2rad(20))
    want, frames = drain(Camera.preset("nominal", seed=1).record(scene, 0.3)[0])
    with pdavis_cv.open_recording(path) as recording:
        assert recording.info.layout == pdavis_cv.Layout.PDAVIS
        got, read = drain(recording)
    np.testing.assert_array_equal(got, want)
    assert len(read) == len(frames) == 6
    np.testing.assert_array_equal(read[2].dn, np.maximum(frames[2].dn, 0))
    assert read[2].mid_us == frames[2].mid_us
    with np.load(f"{path}.truth.npz") as truth:
        t = truth["t_us"]
        turned = np.deg2rad(20) + 2 * np.pi * 1000 / 60e6 * t
        assert np.max(np.abs(np.sin(truth["aop"] - turned))) < 1e-9
        np.testing.assert_allclose(truth["dolp"], 1)
        np.testing.assert_allclose(truth["s0"], 30.75)
        np.testing.assert_array_equal(truth["roi"], (0, 0, 12, 12))
        assert truth["lit"].all()
        assert len(truth["bus_load"]) == 0
    assert sorted(p.name for p in tmp_path.iterdir()) == [
        "polarizer.aedat4", "polarizer.aedat4.truth.npz"]


def test_a_short_recording_of_a_slow_polarizer_is_exported(tmp_path):
    """A tenth of a turn gives few events, and in some pixels none."""
    path, out = tmp_path / "b.aedat4", tmp_path / "b.npy"
    assert main(["simulate", "polarizer", "--rpm", "10", "--start-deg", "45",
                 "--seconds", "0.6", "-o", str(path)]) == 0
    assert main(["export", str(path), "-o", str(out), "--fps", "100",
                 "--clock-offset", "none"]) == 0
    images = np.load(out)
    assert len(images) == 59
    assert np.isfinite(images[5:]).all()
    assert np.isfinite(images[0]).mean() > 0.8   # nothing is known of the rest yet


@pytest.mark.parametrize("scene", sorted(SCENES))
def test_every_scene_is_simulated_with_its_bus(scene, tmp_path):
    path = tmp_path / f"{scene}.aedat4"
    assert main(["simulate", scene, "--camera", "realistic", "--seconds", "0.05",
                 "--size", "8x6", "-o", str(path)]) == 0
    with pdavis_cv.open_recording(path, layout=pdavis_cv.Layout.PDAVIS) as recording:
        assert recording.info.sensor_size == (6, 8)
        assert recording.scan().frame_count == 1
    with np.load(f"{path}.truth.npz") as truth:
        assert truth["lit"].shape == (6, 8)
        np.testing.assert_array_equal(truth["bus_t_us"], np.arange(1, 6) * 10_000)
        assert np.all(truth["bus_load"] >= 0)


def test_aedat2_holds_the_events(tmp_path):
    path = tmp_path / "polarizer.aedat"
    assert main(["simulate", "polarizer", "--camera", "ideal", "--seconds", "0.1",
                 "--size", "346x260", "--rpm", "20", "-o", str(path)]) == 0
    want, _ = drain(Camera.preset("ideal", size=(260, 346)).record(
        RotatingPolarizer(rpm=20.0), 0.1)[0])
    with pdavis_cv.open_recording(path) as recording:
        got, _ = drain(recording)
    assert len(got) == len(want) > 1000


def test_background_and_flicker_reach_the_recording(tmp_path):
    counts = []
    for extra in ([], ["--background", "30"], ["--flicker", "50"]):
        path = tmp_path / f"{len(counts)}.aedat4"
        assert main(["simulate", "polarizer", "--camera", "ideal", "--rpm", "100",
                     "--seconds", "0.2", "-o", str(path), *extra]) == 0
        with pdavis_cv.open_recording(path) as recording:
            counts.append(recording.scan().event_count)
    assert counts[1] < counts[0] < counts[2]


@pytest.mark.parametrize(("arguments", "said"), [
    (["polarizer", "-o", "x.bin"], "the name must end in .aedat4, .aedat"),
    (["polarizer", "-o", "x.aedat4", "--size", "400x300"], "--size must lie within"),
    (["dr", "-o", "x.aedat4", "--light", "3"], "sets its own light"),
    (["polarizer", "-o", "x.aedat4", "--background", "-1"], "must not be negative"),
    (["flat", "-o", "x.aedat", "--camera", "sony"], "AEDAT-2.0 is for event cameras"),
    (["polarizer", "-o", "x.aedat4", "--seed", "-1"], "--seed: must lie in 0..")])
def test_mistakes_are_one_line_and_leave_no_file(arguments, said, tmp_path,
                                                 monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["simulate", *arguments, "--seconds", "0.02"]) == 2
    error = capsys.readouterr().err
    assert said in error
    assert error.count("\n") == 1
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", ["fan", "tendon"])
def test_a_shipped_recording_is_of_the_scene_of_its_truth(name):
    truth = example_truth(name)
    with pdavis_cv.open_recording(example_recording(name)) as recording:
        assert recording.info.sensor_size == truth.size
        assert recording.info.layout == pdavis_cv.Layout.PDAVIS
        images = [image for image in pdavis_cv.fuse(recording, method="cf", fps=20)
                  if image.t_us > 300_000]
    difference = []
    for image in images:
        s0, s1, s2 = truth.image(image.t_us)
        there = image.valid & truth.lit() & (s1**2 + s2**2 > 0.01 * s0**2)
        error = image.aop - np.arctan2(s2, s1) / 2
        difference.append(np.abs((error + np.pi / 2) % np.pi - np.pi / 2)[there])
    assert np.rad2deg(np.median(np.concatenate(difference))) < 5


def test_recordings_that_do_not_ship_are_refused_by_name():
    with pytest.raises(ValueError, match="name must be one of davis346, fan, tendon"):
        example_recording("wheel")
    with pytest.raises(ValueError, match="name must be one of fan, tendon"):
        example_truth("davis346")
