"""The speed of a turning analyser, found from events."""

import numpy as np
import pytest
from turning_pixels import Still, as_recording, pulses, rms, turned

import pdavis_cv
from pdavis_cv.events import EVENT_DTYPE
from pdavis_cv.fusion import turning_speed
from pdavis_cv.fusion.turning_speed import found_hz, found_segments


@pytest.fixture(scope="module")
def few():
    return Still(40, seconds=1.5, degree=(0.35, 0.95))


def test_an_event_alone_has_no_speed():
    events = np.zeros(1, EVENT_DTYPE)
    assert found_hz(pdavis_cv.recording_from_arrays(events, sensor_size=(4, 4))) is None


def test_light_that_is_not_modulated_has_no_speed():
    rng = np.random.default_rng(0)
    events = np.zeros(20_000, EVENT_DTYPE)
    events["t"] = np.sort(rng.integers(0, 1_500_000, len(events)))
    events["x"], events["p"] = rng.integers(0, (320, 2), (len(events), 2)).T
    recording = pdavis_cv.recording_from_arrays(events, sensor_size=(1, 320))
    assert found_hz(recording) is None
    with pytest.raises(ValueError, match="must show a modulation"):
        found_segments(recording)


def test_a_camera_that_is_moved_by_hand_shows_no_turning_analyser(data_dir):
    with pdavis_cv.open_recording(data_dir / "davis346.aedat4") as recording:
        assert found_hz(recording) is None
        with pytest.raises(ValueError, match="must show a modulation"):
            found_segments(recording)


@pytest.mark.parametrize(("hz", "drift", "ramp"), [
    pytest.param(5, 0.02, 0, marks=pytest.mark.gate), (60, 0.02, 0),
    pytest.param(20, -0.02, 0, marks=pytest.mark.gate), (20, 0.02, 3), (5, 0, 3),
    pytest.param(60, 0, 6, marks=pytest.mark.gate)])
def test_a_speed_is_found_and_followed(hz, drift, ramp):
    """Also where the middle of the recording is in the start, whose line is wide."""
    seconds = 6 + ramp // 2
    _, (at, turns) = pulses(hz, seconds, 1, drift, ramp)

    class Drifting(Still):
        def light(self, t):
            angle = 2 * np.pi * np.interp(t * 1e6, at, turns)
            return 1 + self.dolp * np.cos(2 * (angle - self.aop))

    scene = Drifting(24, hz=hz, seconds=seconds, step=2e-4)
    segments = found_segments(as_recording(scene))
    times = np.linspace((0.6 * ramp) * 1e6, seconds * 1e6, 2000)
    error = turned(segments, times) - np.interp(times, at, turns)
    assert np.abs(error - np.median(error)).max() < 0.003
    halves = np.arange(seconds, 0.5 * ramp - 0.1, -0.5)[::-1] * 1e6
    found, true = turned(segments, halves), np.interp(halves, at, turns)
    assert np.abs(np.diff(found) / np.diff(true) - 1).max() < 1e-4
    times = np.linspace((ramp + 0.5) * 1e6, (seconds - 0.5) * 1e6, 500)
    found, true = turned(segments, times), np.interp(times, at, turns)
    assert rms(np.gradient(found) / np.gradient(true) - 1) < 1e-4


@pytest.mark.parametrize("speeds", [(0.05, 0.3, 0.8, 1, 1), (1, 1, 0.9, 0.9, 1)])
def test_a_speed_is_followed_where_acceleration_changes_often(speeds):
    t = np.linspace(0, 6, 100_001)
    speed = 20 * np.interp(t, [0, 1, 2, 3, 6], speeds)
    turns = np.append(0, np.cumsum((speed[1:] + speed[:-1]) / 2 * np.diff(t)))

    class Changing(Still):
        def light(self, at):
            return 1 + self.dolp * np.cos(2 * (
                2 * np.pi * np.interp(at, t, turns) - self.aop))

    segments = found_segments(as_recording(Changing(24, hz=20, seconds=6, step=2e-4)))
    halves = np.arange(1, 6.1, 0.5)
    found, true = turned(segments, halves * 1e6), np.interp(halves, t, turns)
    assert np.abs(np.diff(found) / np.diff(true) - 1).max() < 1e-4


def test_the_second_harmonic_of_slow_turns_is_none():
    scene = Still(24, hz=3, seconds=2, step=2e-4)
    assert found_hz(as_recording(scene)) is None


def test_a_bound_on_events_keeps_all_events_of_some_pixels(few, monkeypatch):
    """With other events of a block its phase is another, which looks like a turn."""
    monkeypatch.setattr(turning_speed, "_MOST_EVENTS", 2 * len(few.events) // 3)
    t, block, _ = turning_speed._events(as_recording(few))
    assert 0.2 < len(t) / len(few.events) < 0.8
    kept = np.isin(few.events["x"], block)
    np.testing.assert_array_equal(t, few.events["t"][kept] / 1e6)
