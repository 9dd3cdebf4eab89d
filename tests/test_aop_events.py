import numpy as np
import pytest
import reference
from hypothesis import given, settings, strategies as st
from streams import random_events

from pdavis_cv import AOP_EVENT_DTYPE, AopEvents, Layout, fuse
from pdavis_cv.simulation import Camera, RotatingPolarizer

SHAPE = (6, 8)
MAPS = np.random.default_rng(9).uniform(0.1, 0.3, (2, *SHAPE))


def make(shape=SHAPE, on=0.2, off=0.25, layout=Layout.PDAVIS, **options):
    return AopEvents(shape, theta_on=on, theta_off=off, layout=layout, **options)


def apart(a, b):
    return np.abs((a - b + np.pi / 2) % np.pi - np.pi / 2)


@settings(max_examples=60)
@given(st.integers(0, 150), st.integers(0, 99), st.integers(0, 3), st.booleans(),
       st.sampled_from([SHAPE, (2, 2), (1, 1), (3, 9)]),
       st.sampled_from([0, 1_600_000_000_000_000]), st.sampled_from([0.5, 8.0]))
def test_it_equals_spreading_every_event_in_float64(
        n, seed, radius, correct, shape, start, cutoff_hz):
    events = random_events(n, shape, seed=seed, start_us=start, stop_us=start + 10**6)
    on, off = MAPS if shape == SHAPE else (0.2, 0.25)
    stream = make(shape, on, off, radius=radius, correct_phase=correct,
                  cutoff_hz=cutoff_hz)
    twin = reference.AopEvents(shape, on, off, Layout.PDAVIS.angles_deg, cutoff_hz,
                               radius, correct)
    got = stream.add(events)
    assert got.dtype == AOP_EVENT_DTYPE
    want = np.array([twin.add(e) for e in events], complex)
    for name in ("t", "x", "y"):
        np.testing.assert_array_equal(got[name], events[name])
    sure = np.abs(want) > 1e-3      # an angle of nothing is noise
    angle = np.angle(want[sure]) / 2
    assert np.all(apart(got["aop"][sure], angle) < 2e-3)
    assert np.all((got["aop"] >= 0) & (got["aop"] < np.pi))


def test_packets_do_not_change_the_stream():
    events = random_events(20_000, SHAPE, stop_us=60_000_000)
    whole, cut = make(correct_phase=True), make(correct_phase=True)
    rng = np.random.default_rng(2)
    want, got = whole.add(events), []
    while len(events):
        n = rng.integers(1, 900)
        got.append(cut.add(events[:n]))
        events = events[n:]
    np.testing.assert_array_equal(np.concatenate(got), want)


def test_the_stream_says_what_the_image_at_that_time_says():
    recording, _ = Camera.preset("nominal", seed=1, aps=None).record(
        RotatingPolarizer(rpm=203), 1.0)
    events = np.concatenate([packet.events for packet in recording.packets()])
    stream = make(recording.info.sensor_size, 0.16, 0.18, recording.info.layout).add(
        events)
    at = np.flatnonzero(np.diff(stream["t"]) > 0)[-50:]
    images = fuse(recording, times_us=stream["t"][at], demosaic="superpixel",
                  thresholds=(0.16, 0.18), hold=False)
    for event, image in zip(stream[at], images, strict=True):
        assert apart(image.aop[event["y"] // 2, event["x"] // 2], event["aop"]) < 1e-3


@pytest.mark.parametrize("rpm", [30, -30, 60])
def test_the_phase_is_corrected_for_either_sense_of_rotation(rpm):
    recording, truth = Camera.preset("nominal", seed=1, aps=None).record(
        RotatingPolarizer(rpm=rpm * 1.013), 2.5)
    events = np.concatenate([packet.events for packet in recording.packets()])
    error = {}
    for correct in (False, True):
        stream = make(recording.info.sensor_size, 0.16, 0.18, recording.info.layout,
                      correct_phase=correct).add(events)
        stream = stream[stream["t"] > 10**6]
        turn = stream["aop"] - truth.aop(stream["t"])
        error[correct] = np.rad2deg(np.angle(np.exp(2j * turn).mean()) / 2)
    # atan(0.5 Hz / 1.013 Hz) / 2 is 13 degrees, less half a threshold's lag.
    assert abs(error[False] - np.sign(rpm) * {30: 12, 60: 5}[abs(rpm)]) < 1.5
    assert abs(error[True]) < 4


@pytest.mark.parametrize(("options", "message"), [
    ({"radius": -1}, "radius must be a whole number of 0..32, got -1"),
    ({"cutoff_hz": 0}, "cutoff_hz must be positive"),
    ({"on": -1}, "theta_on must be positive"),
])
def test_an_impossible_parameter_is_refused(options, message):
    with pytest.raises(ValueError, match=message):
        make(**options)


def test_a_layout_is_asked_for():
    with pytest.raises(TypeError, match="layout must be a Layout or its name, got int"):
        make(layout=3201)


def test_events_outside_or_late_are_refused_by_name():
    events = random_events(10, SHAPE).copy()
    events["x"][7] = 9
    stream = make()
    with pytest.raises(ValueError, match=r"event 7 at \(x=9"):
        stream.add(events)
    with pytest.raises(ValueError, match="event 0 at t="):
        stream.add(events[:2])
    assert len(stream.add(events[:0])) == 0
