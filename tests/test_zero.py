"""The zero of the angle from light of a known direction."""
import math

import numpy as np
import pytest

import pdavis_cv
from pdavis_cv import PolarFrame, TurningAnalyser, fuse
from pdavis_cv.analysis import found_zero
from pdavis_cv.simulation import Camera, FunctionScene
from pdavis_cv.tools.main import main


def image(aop_deg, dolp=0.8, shape=(6, 7), noise_deg=0.0):
    aop = np.deg2rad(aop_deg + noise_deg * np.random.default_rng(0).normal(size=shape))
    quad = [1 + dolp * np.cos(2 * (aop - a)) for a in np.deg2rad([0, 45, 90, 135])]
    return PolarFrame(np.stack(quad))


@pytest.mark.parametrize(("aop", "known", "zero"), [
    (30, 40, 10), (170, 10, 20), (10, 170, -20), (0, 90, 90), (90, 0, 90)])
def test_the_zero_is_known_less_measured_modulo_half_a_turn(aop, known, zero):
    found, sigma = found_zero([image(aop)] * 3, math.radians(known))
    assert math.degrees(found) == pytest.approx(zero, abs=1e-4)
    assert sigma == pytest.approx(0, abs=1e-6)


def test_its_error_is_that_of_the_mean():
    _, sigma = found_zero([image(20, noise_deg=2, shape=(50, 50))], 0)
    assert math.degrees(sigma) == pytest.approx(2 / 50, rel=0.1)


def test_light_that_is_not_polarized_tells_no_zero():
    with pytest.raises(ValueError, match=r"a DoLP of 0.1 or more, got none"):
        found_zero([image(20, dolp=0.05)], 0)


@pytest.fixture(scope="module")
def film(tmp_path_factory):
    """A film at 20 degrees before a camera, whose analyser begins at 50 degrees."""
    def light(t_us, x, y):
        angle = 2 * np.pi * 5 * t_us * 1e-6 + np.deg2rad(50)
        wave = 1 + 0.7 * np.cos(2 * (angle - np.deg2rad(20))) + 0 * x
        return 20 * wave, 0 * wave, 0 * wave

    camera = Camera.preset("ideal", size=(8, 12), origin=(0, 0), aps=None)
    recording, _ = camera.record(FunctionScene(light, sampling_us=500.0), 1.5)
    path = tmp_path_factory.mktemp("zero") / "film.aedat4"
    pdavis_cv.write_aedat4(path, pdavis_cv.recording_from_arrays(
        recording.events(), sensor_size=(8, 12)))
    return path


def test_the_command_finds_the_phase_of_a_turning_analyser(film, capsys):
    command = ["calibrate", "zero", str(film), "--analyser-rpm", "300", "--start", ".5"]
    assert main([*command, "--known-deg", "20"]) == 0
    said = capsys.readouterr().out
    phase = float(said.split("--analyser-phase ")[1])
    assert phase == pytest.approx(50, abs=1.5)
    with pdavis_cv.open_recording(film) as recording:
        one, = fuse(recording, times_us=[1_000_000], analyser=TurningAnalyser(
            rpm=300, phase=math.radians(phase)))
    assert np.rad2deg(np.median(one.aop[one.valid])) == pytest.approx(20, abs=1)
    assert main([*command, "--known-deg", "20", "--analyser-phase", str(phase)]) == 0
    assert "zero: add 0.000" in capsys.readouterr().out.replace("-0.000", "0.000")


def test_a_direction_is_needed(film, capsys):
    assert main(["calibrate", "zero", str(film)]) == 2
    assert "--known-deg" in capsys.readouterr().err
