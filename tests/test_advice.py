"""What a recording's user is told."""
import numpy as np
from streams import random_events

from pdavis_cv import ApsFrame, Layout, recording_from_arrays
from pdavis_cv.recording.advice import advise
from pdavis_cv.simulation import Camera, RotatingPolarizer

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


def frames_at(hz):
    return [ApsFrame(np.full(SIZE, 500), t, t + 1000)
            for t in range(0, 3_000_000, round(1e6 / hz))]


def test_harmonics_of_the_frame_clock_are_no_lamp():
    # Reading a frame disturbs pixels: a burst of events after each, at 25 Hz.
    rng, events = np.random.default_rng(0), steady(60_000)
    part = np.flatnonzero(rng.random(len(events)) < 0.2)
    events["t"][part] = events["t"][part] // 40_000 * 40_000 + rng.integers(
        500, 2500, len(part))
    events = events[np.argsort(events["t"], kind="stable")]
    assert set(topics(events, frames_at(25))) == set()
    assert "flicker" in topics(events), "without frames the clock is not known"


def test_a_lamp_is_found_beside_frames_that_its_frequency_is_a_multiple_of():
    events = steady(100_000)
    phase = np.sin(2 * np.pi * 100 * events["t"] / 1e6)
    keep = np.random.default_rng(0).random(len(events)) < 0.5 + 0.4 * phase
    assert set(topics(events[keep], frames_at(25))) == {"flicker"}


def test_events_that_come_in_steps_are_no_lamp():
    events = steady(60_000)
    events["t"] = events["t"] // 10_000 * 10_000
    assert "flicker" not in topics(events)


def exposed(moving, exposure_us=8_000):
    """Ten frames; a share of the pixels makes 4 events in each exposure."""
    pixels = round(moving * SIZE[0] * SIZE[1])
    events, frames = [], []
    for k in range(10):
        start = 5_000 + 40_000 * k
        part = np.zeros(4 * pixels, steady(0).dtype)
        place = np.tile(np.arange(pixels), 4)
        part["x"], part["y"] = place % SIZE[1], place // SIZE[1]
        part["t"] = start + np.repeat(np.arange(4), pixels) * exposure_us // 4
        events.append(part)
        frames.append(ApsFrame(np.full(SIZE, 500.0), start, start + exposure_us,
                               available_us=start + exposure_us + 5_000))
    return np.concatenate(events), frames


def test_an_exposure_during_which_light_moves_is_told():
    found = topics(*exposed(0.5))
    assert "exposure" in found
    assert "(8.0 ms)" in found["exposure"].finding
    assert "50% of the pixels" in found["exposure"].finding
    assert found["exposure"].action.startswith("expose for 2 ms or less")
    assert "exposure" not in topics(*exposed(0.03))


def test_light_that_moves_between_exposures_only_is_no_matter():
    events, frames = exposed(0.5)
    events["t"] += 20_000
    assert "exposure" not in topics(events, frames)


def test_a_fast_polarizer_blurs_and_a_slow_one_does_not():
    camera = Camera.preset("ideal", size=(12, 12), aps={"exposure_us": 8_000})
    for rpm, blurs in ((30.0, False), (1000.0, True)):
        recording = camera.stream(RotatingPolarizer(rpm=rpm), 0.3)
        assert ("exposure" in {a.topic for a in advise(recording)}) == blurs
