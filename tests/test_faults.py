"""Faults of stamps and streams, and the populations that specimens are drawn from."""
import numpy as np
import pytest

from pdavis_cv import Sensor
from pdavis_cv.recording.advice import advise
from pdavis_cv.simulation import (
    DEFAULT_CAMERA,
    PRESETS,
    Camera,
    Faults,
    FlatLight,
    RotatingPolarizer,
)
from pdavis_cv.simulation.populations import POPULATIONS, Range


def events_and_frames(scene, seconds=0.2, **faults):
    camera = Camera.preset("ideal", size=(4, 6), faults=faults)
    recording, _ = camera.record(scene, seconds)
    packets = list(recording.packets())
    return (np.concatenate([packet.events for packet in packets]),
            [frame for packet in packets for frame in packet.frames])


TURNING = RotatingPolarizer(rpm=300.0)


@pytest.mark.parametrize("offset", [-6000, 5000])
def test_offset_moves_what_frames_state_but_not_what_they_show_or_when(offset):
    events, frames = events_and_frames(TURNING)
    same, moved = events_and_frames(TURNING, frame_offset_us=offset)
    np.testing.assert_array_equal(events, same)
    assert len(frames) == len(moved) > 2
    for a, b in zip(frames, moved, strict=True):
        np.testing.assert_array_equal(a.dn, b.dn)
        assert b.mid_us - a.mid_us == offset
        assert b.exposure_ms == a.exposure_ms
        assert b.available_us == a.available_us


def test_jitter_has_its_spread_and_keeps_events_in_order():
    events, _ = events_and_frames(TURNING)
    late, _ = events_and_frames(TURNING, jitter_us=300.0)
    events, late = (e[e["t"] < 190_000] for e in (events, late))
    assert abs(len(late) - len(events)) < 10    # which cross the border
    assert np.all(np.diff(late["t"]) >= 0)
    moved = []
    for y, x, p in np.ndindex(4, 6, 2):
        a, b = (e["t"][(e["x"] == x) & (e["y"] == y) & (e["p"] == p)]
                for e in (events, late))
        n = min(len(a), len(b))
        moved.append(b[:n] - a[:n])
    # Of those sorted again within a pixel, the spread is less.
    assert 150 < np.std(np.concatenate(moved)) < 310


def test_lost_events_are_lost_at_their_rate_and_the_same_at_each_reading():
    events, _ = events_and_frames(TURNING, 1.0)
    first, _ = events_and_frames(TURNING, 1.0, lost=0.1)
    again, _ = events_and_frames(TURNING, 1.0, lost=0.1)
    np.testing.assert_array_equal(first, again)
    assert len(first) / len(events) == pytest.approx(0.9, abs=0.02)


def test_drift_of_a_threshold_shows_in_the_number_of_its_events():
    def on_events(scene, **faults):
        events, _ = events_and_frames(scene, 2.0, **faults)
        return [np.count_nonzero(events["p"][(events["t"] // 200_000) == k])
                for k in (0, 9)]

    before, after = on_events(TURNING, drift_on=0.4)
    steady, still = on_events(TURNING)
    assert before == pytest.approx(steady, rel=0.05)
    # ON events of a swing are those that the threshold divides it into.
    assert after / still == pytest.approx(1 / 1.38, rel=0.12)


def test_leak_grows_with_the_light():
    counts = []
    for s0 in (0.0, 10.0, 40.0):
        camera = Camera.preset("ideal", size=(20, 20), aps=None, dvs={
            "leak_hz": 1.0, "leak_hz_per_dn_ms": 0.1, "dark_dn_ms": 1e-3})
        recording, _ = camera.record(FlatLight(s0=s0), 10.0)
        counts.append(sum(len(packet.events) for packet in recording.packets()) / 400)
    # Half of the light passes a polarizer; a fraction of an event is cut off.
    assert counts == pytest.approx([10, 15, 30], abs=1.0)


@pytest.mark.parametrize(("name", "value"), [
    ("jitter_us", -1.0), ("lost", 1.0), ("drift_on", 0.6), ("frame_offset_us", 0.5)])
def test_impossible_faults_are_refused(name, value):
    with pytest.raises(ValueError, match=f"^{name} must .*{value}"):
        Faults(**{name: value})


def test_an_offset_beyond_the_readout_is_refused():
    with pytest.raises(ValueError, match="frame_offset_us must be at most"):
        Camera.preset("nominal", faults={"frame_offset_us": 12_001})


@pytest.mark.parametrize("name", ["drawn", "davis346"])
def test_a_seed_names_a_specimen_and_seeds_differ(name):
    one, same, other = (Camera.preset(name, seed=seed) for seed in (1, 1, 2))
    assert one.dvs == same.dvs
    assert one.optics == same.optics
    assert one.dvs != other.dvs
    assert one.aps != other.aps


@pytest.mark.parametrize("name", list(POPULATIONS))
def test_what_the_maker_states_is_not_what_a_specimen_has(name):
    stated, camera = PRESETS[name]["dvs"], Camera.preset(name, seed=1)
    assert stated.theta_on == stated.theta_off == 0.2
    assert camera.dvs.theta_on != 0.2 != camera.dvs.theta_off


def test_a_typical_camera_is_off_as_cameras_are_measured():
    assert DEFAULT_CAMERA == "typical"
    camera = Camera.preset("typical", size=(100, 100))
    mean = (camera.dvs.theta_on + camera.dvs.theta_off) / 2
    assert mean == pytest.approx(1.2 * PRESETS["typical"]["dvs"].theta_on)
    for name in ("theta_on", "theta_off"):
        assert camera.maps[name].std() == pytest.approx(0.045, rel=0.05)
    recording, _ = camera.record(TURNING, 0.06)
    (frame,) = [frame for packet in recording.packets() for frame in packet.frames]
    assert frame.mid_us == 10_000 + 3_000


def test_a_preset_without_a_population_is_one_camera():
    one, other = (Camera.preset("nominal", seed=seed) for seed in (1, 2))
    assert (one.dvs, one.aps, one.optics) == (other.dvs, other.aps, other.optics)


def test_given_parameters_win_over_drawn_ones():
    camera = Camera.preset("drawn", seed=3, dvs={"theta_on": 0.19})
    assert camera.dvs.theta_on == 0.19


def priors():
    """Return what methods assume, by part and parameter of `drawn`."""
    gain, angle_deg, ratio = Sensor.PDAVIS.mismatch
    return {("optics", "gain_sigma"): gain,
            ("optics", "angle_sigma"): np.deg2rad(angle_deg),
            ("optics", "extinction_ratio_sigma"): ratio,
            ("optics", "extinction_ratio"): Sensor.PDAVIS.extinction_ratio,
            ("aps", "offset_fpn_dn"): Sensor.PDAVIS.offset_dn,
            ("dvs", "theta_on"): 0.2, ("dvs", "mismatch"): 0.035}


def test_what_is_drawn_is_wider_than_what_is_assumed_and_centred_off_it():
    for (part, name), assumed in priors().items():
        limits = POPULATIONS["drawn"][part][name]
        assert limits.low < assumed < limits.high, name
        assert limits.high / limits.low > 2, name
        assert abs(np.log(limits.at(0.5) / assumed)) > 0.04, name


def test_ranges_are_uniform_in_the_log_or_in_themselves():
    assert Range(1.0, 100.0).at(0.5) == pytest.approx(10)
    assert Range(-8.0, -4.0, log=False).at(0.25) == -7


def test_davis346_of_any_seed_can_be_recorded_and_looks_like_a_camera():
    for seed in range(3):
        camera = Camera.preset("davis346", seed=seed, size=(8, 8))
        assert -7400 <= camera.faults.frame_offset_us <= -4000
        recording, _ = camera.record(TURNING, 0.5)
        assert recording.info.event_count > 100
        assert recording.info.frame_count == 10
        assert all("hot" not in found.topic for found in advise(recording))
