"""An analyser at another angle in each image: least squares, errors, files."""
import cv2
import numpy as np
import pytest

import pdavis_cv
from pdavis_cv import AnalyserSteps, RecordingError, TurningAnalyser, _kernels, fuse
from pdavis_cv.recording.base import ApsFrame
from pdavis_cv.tools.main import main

DEGREES = (0, 30, 60, 90, 120, 150, 10)


def light(shape=(60, 80)):
    """S0, DoLP and AoP of a scene."""
    y, x = np.indices(shape)
    return (1000 + 300 * np.sin(x / 20), 0.1 + 0.5 * x / shape[1],
            np.deg2rad(20 + 100 * y / shape[0]))


def images(degrees, shape=(60, 80), noise=0.0, contrast=1.0):
    """What a camera sees behind a polarizer at these angles (Malus)."""
    s0, dolp, aop = light(shape)
    twice = 2 * (np.deg2rad(np.array(degrees))[:, None, None] - aop)
    seen = s0 / 2 * (1 + contrast * dolp * np.cos(twice))
    return seen + noise * np.random.default_rng(0).standard_normal(seen.shape)


def turn(image, aop):
    """Errors of AoP in radians."""
    return np.angle(np.exp(2j * (image.aop - aop))) / 2


def steps(degrees, **more):
    return AnalyserSteps(tuple(np.deg2rad(degrees)), **more)


@pytest.mark.parametrize("degrees", [(0, 45, 90), (10, 50, 130, 170), DEGREES])
@pytest.mark.parametrize("dtype", [np.uint16, np.float32, np.float64])
def test_known_angles_give_the_light(degrees, dtype):
    seen = (40 * images(degrees)).astype(dtype)
    image = steps(degrees).polarization(seen)
    s0, dolp, aop = light()
    np.testing.assert_allclose(image.s0, 40 * s0, rtol=1e-4)
    np.testing.assert_allclose(image.dolp, dolp, atol=1e-4)
    assert np.abs(turn(image, aop)).max() < 1e-3
    assert (image.sigma_aop is None) == (len(degrees) == 3)


@pytest.mark.parametrize("missing", [0.0, 0.15])
def test_errors_cover_and_unusable_samples_do_not_count(missing):
    seen = images(DEGREES, noise=3.0)
    valid = np.random.default_rng(1).random(seen.shape) >= missing
    valid[:, 7, 9] = [True, True] + 5 * [False]
    seen[~valid] = 1e6
    image = steps(DEGREES).polarization(seen, valid)
    _, dolp, aop = light()
    assert not image.valid[7, 9]
    good = image.valid
    assert good.mean() > 0.99
    for off, sigma in ((turn(image, aop), image.sigma_aop),
                       (image.dolp - dolp, image.sigma_dolp)):
        assert np.mean((np.abs(off) < sigma)[good]) == pytest.approx(0.68, abs=0.05)
        assert np.median(np.abs(off)[good]) < 0.01


def test_angles_that_differ_by_half_turns_are_the_same():
    seen = images(DEGREES)
    one, other = (steps(np.array(DEGREES) + k).polarization(seen) for k in (0, 180))
    np.testing.assert_allclose(one.quad, other.quad, rtol=1e-5)


def test_the_turn_within_an_exposure_is_undone():
    sweep = 0.8
    seen = images(DEGREES, contrast=np.sin(sweep) / sweep)
    image = steps(DEGREES, sweep=sweep).polarization(seen)
    np.testing.assert_allclose(image.dolp, light()[1], atol=1e-4)


@pytest.mark.parametrize("noise", [0.0, 3.0])
def test_unknown_angles_are_found_up_to_zero_and_direction(noise):
    for sign in (1, -1):
        degrees = 25 + sign * np.array([0, 40, 75, 130, 10, 160])
        found = AnalyserSteps.found(images(degrees, noise=noise))
        off = np.array(found.angles) - np.deg2rad([0, 40, 75, 130, 10, 160])
        off = np.angle(np.exp(2j * off)) / 2
        assert np.rad2deg(np.abs(off)).max() < (0.05 if noise else 1e-4)


def test_what_cannot_be_found_is_said():
    with pytest.raises(ValueError, match=r"at least 5 .*, got 4"):
        AnalyserSteps.found(images(DEGREES[:4]))
    with pytest.raises(ValueError, match="different angles of polarization"):
        AnalyserSteps.found(np.random.default_rng(0).normal(9, 1, (6, 20, 20)))


def test_frames_at_a_turning_analyser():
    turning = TurningAnalyser(rpm=60, phase=0.2)
    found = turning.steps([0, 100_000, 250_000], 50_000)
    np.testing.assert_allclose(found.angles, 0.2 + 2 * np.pi * np.array([0, .1, .25]))
    assert found.sweep == pytest.approx(2 * np.pi * 0.05)
    pulsed = TurningAnalyser(triggers=1).steps(
        [500_000, 1_250_000, 1_300_000], 1000, 10**6 * np.arange(6))
    np.testing.assert_allclose(pulsed.angles, np.pi * np.array([1, 2.5, 2.6]))


@pytest.mark.parametrize(("degrees", "said"), [
    ((0, 90), "at least three .* got 0, 90"), ((30, 30, 210), "got 30, 30, 210"),
    ((0, 90, 270), "got 0, 90, 270"), ((), "got none"),
    ((0, 45, float("nan")), "at least three")])
def test_angles_that_do_not_determine_the_light(degrees, said):
    with pytest.raises(ValueError, match=said):
        steps(degrees)


def test_mistakes_are_one_clear_line():
    three = steps((0, 60, 120))
    with pytest.raises(ValueError, match="one for each of 3 angles, got 7"):
        three.polarization(images(DEGREES))
    with pytest.raises(ValueError, match=r"shape \(N, H, W\), got float64 \(3, 4\)"):
        three.polarization(np.zeros((3, 4)))
    with pytest.raises(ValueError, match="valid must be bool of shape"):
        three.polarization(np.zeros((3, 4, 4)), np.ones((3, 4, 4)))
    with pytest.raises(ValueError, match="sweep must be less than pi, got 4"):
        steps((0, 60, 120), sweep=4)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32])
@pytest.mark.parametrize("pixels", [0, 1, 1024, 2500])
def test_the_kernel_equals_its_twin(dtype, pixels):
    rng = np.random.default_rng(5)
    seen = rng.integers(0, 250, (6, pixels)).astype(dtype)
    solution, back = (rng.normal(size=s).astype(np.float32) for s in ((4, 6), (6, 4)))
    out, rest = np.empty((4, pixels), np.float32), np.empty(pixels, np.float32)
    _kernels.least_squares(seen, solution, back, out, rest)
    want, left = np.zeros_like(out), np.zeros_like(rest)
    for j in range(6):
        want += solution[:, j, None] * seen[j].astype(np.float32)
    for j in range(6):
        a = back[j]
        off = seen[j] - (((a[0] * want[0] + a[1] * want[1]) + a[2] * want[2])
                         + a[3] * want[3])
        left += off * off
    np.testing.assert_array_equal(out, want)
    np.testing.assert_array_equal(rest, left.astype(np.float32))
    with pytest.raises(ValueError, match="least_squares: images must"):
        _kernels.least_squares(seen, solution[:3], back, out, rest)


# ---- files -----------------------------------------------------------------------


@pytest.fixture
def folder(tmp_path):
    """Return a folder with images behind a polarizer, angles in their names."""
    for degrees, image in zip(DEGREES, images(DEGREES), strict=True):
        cv2.imwrite(str(tmp_path / f"pol_{degrees:03d}.png"),
                    np.rint(4 * image).astype(np.uint16))
    (tmp_path / "angles.txt").write_text("".join(
        f"pol_{d:03d}.png, {d}\n" for d in DEGREES))
    return tmp_path


@pytest.mark.parametrize("stated", ["names", "0,10,30,60,90,120,150", "table", "found"])
def test_files_are_one_frame_of_four_planes(folder, stated):
    known = str(folder / "angles.txt") if stated == "table" else stated
    with pdavis_cv.open_recording(
            str(folder / "pol_*.png"), analyser_steps=known) as recording:
        assert recording.info.frame_count == 1
        assert recording.info.sensor_size == (120, 160)
        image, = fuse(recording)
    _, dolp, aop = light()
    np.testing.assert_allclose(image.dolp, dolp, atol=0.002)
    assert np.median(np.abs(turn(image, aop))) < 2e-3


def test_clipped_samples_do_not_count(tmp_path):
    seen = np.minimum(np.rint(0.32 * images(DEGREES)), 255).astype(np.uint8)
    assert 0.02 < (seen == 255).mean() < 0.3
    for k, image in enumerate(seen):
        cv2.imwrite(str(tmp_path / f"{k}.png"), image)
    with pdavis_cv.open_recording(
            str(tmp_path / "*.png"), analyser_steps=steps(DEGREES)) as recording:
        image, = fuse(recording)
    assert np.abs(image.dolp - light()[1])[image.valid].max() < 0.03


def test_the_command_line_takes_names_and_says_what_is_wrong(folder, capsys):
    files, out = str(folder / "pol_*.png"), str(folder / "x.png")
    assert main(["export", files, "--analyser-steps", "names", "-o", out]) == 0
    for stated, said in (("0,45,90", "one for each of 3 angles, got 7"),
                         ("5,5,5,5,5,5,5", "differ modulo 180 degrees, got 5, 5"),
                         ("0,x", "must be names, found, angles in degrees")):
        capsys.readouterr()
        assert main(["export", files, "--analyser-steps", stated, "-o", out]) == 2
        error = capsys.readouterr().err
        assert said in error
        assert error.count("\n") == 1
    (folder / "angles.txt").write_text("pol_000.png 0\n")
    with pytest.raises((ValueError, RecordingError), match=r"of 'pol_010\.png'"):
        pdavis_cv.open_recording(files, analyser_steps=str(folder / "angles.txt"))


def test_images_without_events_are_not_of_a_turning_analyser():
    recording = pdavis_cv.recording_from_arrays(np.zeros(0, pdavis_cv.EVENT_DTYPE), [
        ApsFrame(np.full((4, 4), 9, np.float32), 0, 10)], sensor_size=(4, 4))
    with pytest.raises(ValueError, match="has no events; of images"):
        fuse(recording, analyser=TurningAnalyser(rpm=600))
