"""Checks of a camera: orientation, layout, alignment, and the empty instrument."""
import os
from pathlib import Path

import numpy as np
import pytest

from pdavis_cv import (
    ApsFrame,
    Layout,
    PolarFrame,
    open_recording,
    recording_from_arrays as record,
)
from pdavis_cv.calibration.align import alignment
from pdavis_cv.calibration.check import check_recording
from pdavis_cv.calibration.instrument import background
from pdavis_cv.simulation.ideal import rotating_polarizer


@pytest.fixture(scope="module")
def real():
    """Frames and events of a real camera."""
    folder = os.environ.get("PDAVIS_TEST_DATA")
    if not folder:
        pytest.skip("PDAVIS_TEST_DATA is not set")
    with open_recording(Path(folder) / "davis346.aedat4") as recording:
        packets = list(recording.packets())
    return (np.concatenate([p.events for p in packets]),
            [f for p in packets for f in p.frames])


@pytest.mark.parametrize(("flip_x", "flip_y", "ok", "words"), [
    (False, False, True, "same orientation"),
    (True, False, False, "mirrored left-right"),
    (False, True, False, "upside down"), (True, True, False, "turned by 180")])
def test_a_flip_between_events_and_frames_is_found(real, flip_x, flip_y, ok, words):
    events, frames = real[0].copy(), real[1]
    if flip_x:
        events["x"] = 345 - events["x"]
    if flip_y:
        events["y"] = 259 - events["y"]
    finding, _ = check_recording(record(events, frames, sensor_size=(260, 346)))
    assert finding.ok is ok
    assert words in finding.message


def test_a_camera_without_polarizers_says_nothing_about_the_layout(real):
    _, finding = check_recording(record(*real, sensor_size=(260, 346)))
    assert finding.ok is None


@pytest.mark.parametrize(("layout", "ok"), [
    (Layout.PDAVIS, True), (Layout.SONY, True), (Layout((0, 90), (45, 135)), False),
    (Layout((0, 45), (90, 135)), False)])
def test_a_wrong_pairing_of_polarizers_is_found(layout, ok):
    recording, _ = rotating_polarizer(41.0, 1.0, size=(16, 16))
    assert check_recording(recording, layout)[1].ok is ok


def test_alignment_reports_the_extinction_ratio_between_neighbours():
    recording, _ = rotating_polarizer(
        7.5, 2.0, size=(12, 14), extinction_ratio=40, exposure_us=1_000)
    rows = list(alignment(recording, Layout.PDAVIS, roi=(1, 1, 11, 10)))
    best = np.max([row.ratio for row in rows], axis=0)
    np.testing.assert_allclose(best, 40, rtol=0.02)
    for row, frame in zip(rows, (f for p in recording.packets() for f in p.frames),
                          strict=True):
        assert row.t_us == frame.mid_us
        assert row.mean_dn[2] == pytest.approx(frame.dn[0::2, 1::2].mean(), rel=1e-6)
        assert row.sd_dn == pytest.approx((0, 0, 0, 0), abs=1e-3)


def test_the_background_is_the_mean_polarization_of_the_instrument():
    rng = np.random.default_rng(2)
    q, u, size = 0.03, -0.04, (8, 10)
    ideal = np.array([1 + q, 1 + u, 1 - q, 1 - u]) / 2
    images = [PolarFrame(ideal[:, None, None] * 100 + rng.normal(size=(4, *size)))
              for _ in range(50)]
    found = background(iter(images))
    assert found.frames == 50
    assert found.dolp == pytest.approx(0.05, abs=5 * 0.01 / np.sqrt(50 * 80))
    assert found.aop == pytest.approx(np.arctan2(u, q) / 2 % np.pi, abs=0.02)
    assert found.circular_purity == pytest.approx(np.sqrt(1 - 0.0025), abs=1e-4)
    assert found.stokes.shape == (8, 10, 3)
    np.testing.assert_allclose(found.stokes[..., 0], 1)
    np.testing.assert_allclose(found.stokes[..., 1], q, atol=0.01)
    with pytest.raises(ValueError, match="valid pixels, got 0 images"):
        background([])


def test_alignment_of_frames_with_dark_takes_it_out():
    dn = np.tile([[20.0, 60.0], [30.0, 30.0]], (2, 2))
    frame = ApsFrame(dn + 10, 0, 1)
    row, = alignment([frame], Layout.PDAVIS, dark=np.full((4, 4), 10, np.float32))
    assert row.mean_dn == (30, 30, 60, 20)
    assert row.ratio == (2.0, 1.5)
