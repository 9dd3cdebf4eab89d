"""What a recording's user is told."""
import numpy as np
from streams import random_events

from pdavis_cv import ApsFrame, Layout, recording_from_arrays
from pdavis_cv.recording.advice import advise

SIZE = (40, 60)


def topics(events=None, frames=(), layout=Layout.PDAVIS):
    found = advise(recording_from_arrays(
        events, frames, sensor_size=SIZE, layout=layout))
    return {one.topic: one for one in found}


def steady(n=20_000):
    return random_events(n, SIZE, seed=1, stop_us=3_000_000).copy()


def frame(level, share=0.0):
    valid = np.ones(SIZE, np.bool_)
    valid.flat[:round(share * valid.size)] = False
    return ApsFrame(np.full(SIZE, level), 0, 1000, valid=valid)


def test_a_good_recording_needs_no_advice():
    assert topics(steady(), [frame(500)]) == {}


def test_an_unknown_layout_is_told():
    assert set(topics(steady(), layout=None)) == {"layout"}


def test_clipped_and_dark_frames_are_told():
    assert set(topics(None, [frame(500, 0.05)])) == {"clipped frames"}
    assert "5.0%" in topics(None, [frame(500, 0.05)])["clipped frames"].finding
    assert set(topics(None, [frame(5)])) == {"dark frames"}


def test_hot_pixels_are_counted():
    events = steady()
    events["x"][::10], events["y"][::10] = 7, 9
    found = topics(events)
    assert set(found) == {"hot pixels"}
    assert found["hot pixels"].finding.startswith("1 pixels give 10.")


def test_a_rate_near_the_bus_is_told():
    events = random_events(8000, SIZE, stop_us=1000)
    assert set(topics(events)) == {"event rate"}


def test_mains_flicker_is_found_and_nothing_else():
    events = steady(100_000)
    for hz in (100, 120):
        phase = np.sin(2 * np.pi * hz * events["t"] / 1e6)
        keep = np.random.default_rng(0).random(len(events)) < 0.5 + 0.4 * phase
        found = topics(events[keep])
        assert set(found) == {"flicker"}
        assert f"at {hz} Hz" in found["flicker"].finding
