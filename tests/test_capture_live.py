"""VideoCapture on live sources: cv2's manners of a camera."""
import pickle

import numpy as np
import pytest
from link_faults import FaultySource

import pdavis_cv
from pdavis_cv import CAP_PDAVIS, Layout, VideoCapture, fuse
from pdavis_cv.capture import constants as c
from pdavis_cv.capture.video import CaptureStatus
from pdavis_cv.live.base import LiveSource
from pdavis_cv.live.replay import ReplaySource
from pdavis_cv.simulation import Camera, RotatingPolarizer

POS_MSEC, POS_FRAMES, FRAME_COUNT = 0, 1, 7
OPTIONS = {"layout": Layout.PDAVIS, "nominal_thresholds": (0.16, 0.18), "method": "cf",
           "fps": 60}
ADDRESS = "simulate:polarizer?size=4x4&rpm=600&seconds=0.5&speed=0"


@pytest.fixture(scope="module")
def recording():
    camera = Camera.preset("realistic", seed=4, size=(8, 8))
    return camera.record(RotatingPolarizer(rpm=202.6, start_angle=0.3), 0.5)[0]


def device(recording, **faults):
    source = ReplaySource(recording, "test", speed=0)
    return FaultySource(source, **faults) if faults else source


class Silent(LiveSource):
    """A device that sends nothing."""

    def _arrivals(self):
        self._closed.wait()
        yield from ()


def test_pictures_are_those_of_the_recording(recording):
    with VideoCapture(device(recording), **OPTIONS) as live, VideoCapture(
            recording, causal=True, **OPTIONS) as file:
        count = 0
        while live.grab():
            assert file.grab()
            count += 1
            for flag in range(c.CAP_PDAVIS_BGR, c.CAP_PDAVIS_EVENTS_BGR + 1):
                (ok, one), (_, other) = (v.retrieve(None, flag) for v in (live, file))
                assert ok
                np.testing.assert_array_equal(one, other)
            assert live.get(POS_FRAMES) == file.get(POS_FRAMES) == count
            assert live.get(POS_MSEC) == file.get(POS_MSEC)
        assert count > 20
        assert not file.grab()
        assert live.status is CaptureStatus.EOF
        assert live.isOpened()
        assert live.read() == (False, None)


def test_a_live_source_has_neither_a_length_nor_positions(recording):
    with VideoCapture(device(recording), **OPTIONS) as capture:
        assert capture.read()[0]
        assert capture.get(FRAME_COUNT) == -1
        assert not capture.set(POS_FRAMES, 0)
        assert "no positions" in capture.last_error
        assert not capture.set(POS_MSEC, 100.0)
        assert capture.get(5) == 60
        with pytest.raises(TypeError, match="cannot pickle a capture of a live source"):
            pickle.dumps(capture)
        assert capture.read()[0]


@pytest.mark.parametrize("backend", [0, CAP_PDAVIS])
def test_an_address_is_opened_here(backend, threads_ended):
    with VideoCapture(ADDRESS, backend, **OPTIONS) as capture:
        assert capture.getBackendName() == "PDAVIS"
        ok, picture = capture.read()
        assert (ok, picture.shape) == (True, (4, 4, 3))
    assert threads_ended()


def test_a_device_that_is_gone_gives_false_and_says_why(recording):
    with VideoCapture(device(recording, unplug=0.3), **OPTIONS) as capture:
        count = 0
        while capture.read()[0]:
            count += 1
        assert count > 5
        assert capture.read() == (False, None)
        assert capture.status is CaptureStatus.ERROR
        assert "the device is gone" in capture.last_error


def test_no_device_is_a_failed_open():
    capture = VideoCapture("simulate:nothing")
    assert not capture.isOpened()
    assert "scene must be one of" in capture.last_error


def test_timeouts_are_failures_that_pass(recording):
    info = recording.info
    capture = VideoCapture(
        Silent(info, "silent"), 0, (c.CAP_PROP_OPEN_TIMEOUT_MSEC, 1), **OPTIONS)
    assert not capture.isOpened()
    assert "nothing arrived for 0.001 s" in capture.last_error
    slow = ReplaySource(recording, "slow", speed=1e-3)
    with VideoCapture(slow, **OPTIONS) as capture:
        assert capture.get(c.CAP_PROP_READ_TIMEOUT_MSEC) == 30_000
        assert capture.set(c.CAP_PROP_READ_TIMEOUT_MSEC, 1)
        assert capture.read() == (False, None)
        assert "no image for 0.001 s" in capture.last_error
        assert capture.read() == (False, None)
        assert capture.isOpened()


def test_the_rate_can_be_changed(recording):
    with VideoCapture(device(recording), **OPTIONS) as capture:
        assert capture.read()[0]
        assert capture.set(c.CAP_PROP_PDAVIS_FPS, 20)
        while capture.read()[0]:
            pass
        assert capture.get(c.CAP_PROP_PDAVIS_FPS) == 20


def test_a_source_of_ones_own_is_a_live_source(recording):
    source = pdavis_cv.source_from_packets(recording.info, recording.packets())
    expected = [image.dolp for image in fuse(recording, causal=True, **OPTIONS)]
    with VideoCapture(source, output=c.CAP_PDAVIS_DOLP, **OPTIONS) as capture:
        images = list(capture)
    assert len(images) == len(expected)
    np.testing.assert_array_equal(images, expected)
