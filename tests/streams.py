"""Random event streams and frames for the tests."""
import numpy as np

import pdavis_cv
import pdavis_cv.live.address
import pdavis_cv.recording.open
import pdavis_cv.tools.fan
from pdavis_cv import live, recording, tools
from pdavis_cv.simulation import Camera, RotatingPolarizer

METHODS = [{"method": name} for name in pdavis_cv.METHODS] + [
    {"method": "events", "offsets": "redundancy"}]
"""Options of every method."""


def turning_polarizer():
    """Return a second of a polarizer that turns, with frames, of 8x8 pixels."""
    camera = Camera.preset("realistic", seed=4, size=(8, 8))
    return camera.record(RotatingPolarizer(rpm=202.6, start_angle=0.3), 1.0)[0]


def assert_same(images, others):
    """Assert that two sequences of images are equal to the bit."""
    assert len(images) == len(others) > 5
    for one, two in zip(images, others, strict=True):
        assert (one.t_us, one.frame_us) == (two.t_us, two.frame_us)
        np.testing.assert_array_equal(one.quad, two.quad)
        np.testing.assert_array_equal(one.valid, two.valid)


def random_events(n, shape, *, seed=0, start_us=0, stop_us=1_000_000, read_only=True):
    """Return n time-ordered events, uniform over the sensor and the interval."""
    rng = np.random.default_rng(seed)
    out = np.zeros(n, pdavis_cv.EVENT_DTYPE)
    out["t"] = np.sort(rng.integers(start_us, stop_us, n))
    out["x"] = rng.integers(0, shape[1], n)
    out["y"] = rng.integers(0, shape[0], n)
    out["p"] = rng.integers(0, 2, n)
    out.flags.writeable = not read_only
    return out


def random_frame(shape, mid_us, *, seed=0, exposure_us=10_000, low=-20, high=1100):
    """Return a frame of uniform noise; a tenth of its samples is marked unusable."""
    rng = np.random.default_rng(seed)
    start = mid_us - exposure_us // 2
    return pdavis_cv.ApsFrame(
        rng.uniform(low, high, shape), start, start + exposure_us,
        valid=rng.random(shape) > 0.1, available_us=start + exposure_us + 2_000)


def opens_by(monkeypatch, opened):
    """Let the commands open recordings by a function; fan opens its second itself."""
    for module in (recording.open, live.address, tools.fan):
        monkeypatch.setattr(module, "open_recording", opened)


def feed(method, events, frames):
    """Feed a Reconstructor in time order, a frame before events of its time."""
    at = 0
    for frame in frames:
        end = int(np.searchsorted(events["t"], frame.mid_us))
        method.add_events(events[at:end])
        method.add_frame(frame)
        at = end
    method.add_events(events[at:])
