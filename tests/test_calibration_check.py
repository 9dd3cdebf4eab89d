"""Checks of a camera: orientation and layout."""
import os
from pathlib import Path

import numpy as np
import pytest
from ideal import rotating_polarizer

from pdavis_cv import Layout, open_recording, recording_from_arrays as record
from pdavis_cv.calibration.check import check_recording


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
