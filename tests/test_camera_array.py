"""Images of several cameras laid over each other, and files of them."""
import cv2
import numpy as np
import pytest
from scipy import ndimage

import pdavis_cv
from pdavis_cv import AnalyserArray, PolarFrame, RecordingError, fuse
from pdavis_cv.data import example_recording
from pdavis_cv.tools.main import main

MOVES = ((0.0, 0.0, 0.0), (1.3, 0.0, 0.2), (-0.7, 1.3, -0.2), (9.4, -6.2, 0.1))
"""Pixels to the right and down, degrees counter-clockwise."""


def scene(shape=(160, 200), seed=0):
    """Channels (4, H, W) of a texture with its own AoP and DoLP."""
    rng = np.random.default_rng(seed)
    smooth = [ndimage.gaussian_filter(rng.normal(size=shape), one) * one
              for one in (1.5, 15, 15)]
    s0 = 3000 * np.exp(0.6 * smooth[0])
    dolp, aop = 0.3 + 0.15 * np.tanh(smooth[1] * 3), 0.6 + 1.5 * smooth[2]
    return np.stack([s0 / 2 * (1 + dolp * np.cos(2 * (aop - a)))
                     for a in np.deg2rad([0, 45, 90, 135])])


def moved(image, move):
    """What a camera sees that is moved so (of fifth order; the reader's is third)."""
    x, y, turn = move[0], move[1], np.deg2rad(move[2])
    matrix = np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
    middle = (np.array(image.shape) - 1) / 2
    return ndimage.affine_transform(
        image, matrix, middle - matrix @ (middle + np.array([y, x])), order=5,
        mode="nearest")


def cameras(channels, moves=MOVES):
    return np.stack([moved(one, move) for one, move in
                     zip(channels, moves, strict=True)])


def turn(image, channels):
    """Errors of AoP where all cameras see, degrees."""
    true = PolarFrame(channels)
    off = np.rad2deg(np.angle(np.exp(2j * (image.aop - true.aop))) / 2)
    return np.abs(off)[20:-20, 20:-20]


def test_a_shift_and_a_turn_are_undone():
    channels = scene()
    seen = cameras(channels) + np.random.default_rng(1).normal(0, 5, channels.shape)
    array = AnalyserArray.found(seen)
    for (x, y, angle), wanted in zip(array.moves, MOVES, strict=True):
        assert (x, y) == pytest.approx(wanted[:2], abs=0.01)
        assert np.rad2deg(angle) == pytest.approx(wanted[2], abs=0.005)
    image = PolarFrame(array.aligned(seen))
    assert np.median(turn(image, channels)) < 0.5
    assert np.median(turn(PolarFrame(seen), channels)) > 5
    assert not image.valid[:5, -8:].any()
    assert image.valid[20:-20, 20:-20].all()


def test_a_move_that_polarization_may_have_made_is_refused():
    rng = np.random.default_rng(1001)
    own, more = (2 * ndimage.gaussian_filter(rng.normal(size=(160, 200)), 2)
                 for _ in range(2))
    light, part = 3000 * np.exp(1.2 * own), 0.5 * np.tanh(2 * more)
    seen = [light * (1 + part), moved(light * (1 - part), MOVES[1])]
    with pytest.raises(ValueError, match=r"correlation of 0\.33"):    # .7 px wrong
        AnalyserArray.found(np.stack(seen))


@pytest.mark.parametrize("factor", [0.5, 2.0])
def test_other_exposures_do_not_move(factor):
    channels = scene()
    seen = cameras(channels)
    seen[1] *= factor
    assert np.array(AnalyserArray.found(seen).moves) == pytest.approx(
        np.array([(x, y, np.deg2rad(angle)) for x, y, angle in MOVES]), abs=0.05)


def test_images_in_place_stay_as_they_are():
    channels = scene().astype(np.float32)
    array = AnalyserArray(((0.0, 0.0, 0.0),) * 4, (0.0,) * 4)
    np.testing.assert_array_equal(array.aligned(channels), channels)


def test_large_images_are_binned_first(monkeypatch):
    monkeypatch.setattr("pdavis_cv.camera_array._PIXELS", 1 << 15)  # in pairs
    channels = scene((300, 450))
    found = AnalyserArray.found(cameras(channels[:2], MOVES[:2]))
    assert found.moves[1][:2] == pytest.approx((1.3, 0), abs=0.1)


def test_mistakes_are_one_clear_line():
    other = scene(seed=5)
    with pytest.raises(ValueError, match=r"image 1 cannot be aligned with image 0: "):
        AnalyserArray.found(np.stack([scene()[0], other[0]]))
    with pytest.raises(ValueError, match="image 1 cannot be aligned"):
        AnalyserArray.found(np.ones((2, 40, 40)))
    with pytest.raises(ValueError, match=r"at least 32, got float64 \(4, 8, 8\)"):
        AnalyserArray.found(np.ones((4, 8, 8)))
    with pytest.raises(ValueError, match="one for each of 4 moves, got 3"):
        AnalyserArray.found(scene()).aligned(scene()[:3])


@pytest.fixture
def files(tmp_path):
    """Return the names of four cameras' files."""
    names = []
    for degrees, image in zip((0, 45, 90, 135), cameras(scene()), strict=True):
        names.append(str(tmp_path / f"cam_I{degrees}.png"))
        cv2.imwrite(names[-1], np.rint(image).astype(np.uint16))
    return names


def test_four_files_are_aligned_and_it_is_stated(files, capsys):
    with pdavis_cv.open_recording(files, align_planes=True) as recording:
        image, = fuse(recording, extinction_ratio=None)
    assert np.median(turn(image, scene())) < 0.5
    assert main(["info", *files, "--align-planes"]) == 0
    assert "aligned with the first: image 1 by 1.3" in capsys.readouterr().out


def test_images_at_stepped_angles_are_aligned(files):
    with pdavis_cv.open_recording(
            files, align_planes=True, analyser_steps="names") as recording:
        image, = fuse(recording)
    assert np.median(turn(image, scene())) < 0.5


def test_a_mosaic_has_nothing_to_align(files, tmp_path, capsys):
    with pytest.raises(RecordingError, match="align_planes needs four planes"):
        pdavis_cv.open_recording(files[0], layout="sony", align_planes=True)
    assert main(["export", files[0], "--layout", "sony", "--align-planes", "-o",
                 str(tmp_path / "x.png")]) == 2
    assert capsys.readouterr().err.count("\n") == 1


def test_recordings_of_events_have_nothing_to_align():
    with pytest.raises(TypeError, match="align_planes= is no option of AEDAT-4"):
        pdavis_cv.open_recording(example_recording(), align_planes=True)
    pdavis_cv.open_recording(example_recording(), align_planes=False).close()
