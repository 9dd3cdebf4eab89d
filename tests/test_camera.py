"""The simulated camera against closed forms, statistics and itself."""
import numpy as np
import pytest
from ideal import rotating_polarizer

from pdavis_cv.simulation import (
    Camera,
    FlatLight,
    FunctionScene,
    RotatingPolarizer,
    Texture,
)


def drain(recording):
    packets = list(recording.packets())
    frames = [frame for packet in packets for frame in packet.frames]
    return np.concatenate([packet.events for packet in packets]), frames


@pytest.mark.parametrize("rpm", [-60.0, 1013.0])
def test_ideal_camera_equals_closed_form(rpm):
    exact, _ = rotating_polarizer(rpm, 0.4, start_angle=0.3, size=(4, 6))
    camera = Camera.preset("ideal", size=(4, 6))
    simulated, _ = camera.record(RotatingPolarizer(rpm=rpm, start_angle=0.3), 0.4)
    (want, frames), (got, simulated_frames) = drain(exact), drain(simulated)
    assert len(want) > 800
    order = [np.lexsort((e["t"], e["x"], e["y"])) for e in (want, got)]
    want, got = want[order[0]], got[order[1]]
    for name in ("x", "y", "p"):
        np.testing.assert_array_equal(got[name], want[name])
    assert np.max(np.abs(got["t"] - want["t"])) <= 1
    assert len(frames) == len(simulated_frames) == 8
    for a, b in zip(frames, simulated_frames, strict=True):
        np.testing.assert_allclose(a.dn, b.dn, rtol=1e-6)


@pytest.mark.parametrize("preset", ["nominal", "hard"])
def test_region_threads_and_repetition_do_not_change_a_pixel(preset):
    scene = RotatingPolarizer(rpm=300.0)
    whole = Camera.preset(preset, size=(40, 8), origin=(10, 20), seed=3, bus=None)
    part = Camera.preset(preset, size=(4, 6), origin=(30, 22), seed=3, bus=None)
    events, frames = drain(whole.record(scene, 0.2)[0])
    threaded, _ = drain(whole.record(scene, 0.2, threads=3)[0])
    np.testing.assert_array_equal(events, threaded)
    streamed, _ = drain(whole.stream(scene, 0.2))
    np.testing.assert_array_equal(events, streamed)
    cropped, cropped_frames = drain(part.record(scene, 0.2)[0])
    inside = events[(events["y"] >= 20) & (events["y"] < 24)
                    & (events["x"] >= 2) & (events["x"] < 8)]
    inside["y"] -= 20
    inside["x"] -= 2
    np.testing.assert_array_equal(
        inside[np.lexsort((inside["x"], inside["y"], inside["t"]))],
        cropped[np.lexsort((cropped["x"], cropped["y"], cropped["t"]))])
    np.testing.assert_array_equal(frames[1].reset[20:24, 2:8], cropped_frames[1].reset)
    np.testing.assert_array_equal(frames[1].dn[20:24, 2:8], cropped_frames[1].dn)


def test_uniform_light_is_the_same_when_it_is_simulated_pixel_by_pixel():
    scene = RotatingPolarizer(rpm=200)
    same = FunctionScene(scene.stokes, sampling_us=scene.step_us)
    camera = Camera.preset(
        "ideal", optics={"gain_sigma": 0.02, "angle_sigma": 0.01}, size=(8, 8))
    (events, frames), (others, again) = (
        drain(camera.record(light, 0.2)[0]) for light in (scene, same))
    np.testing.assert_allclose(
        [frame.dn for frame in frames], [frame.dn for frame in again], rtol=1e-6)
    assert len(frames) == 4
    assert len(events) == len(others) > 500


def test_a_pixel_before_a_texture_is_the_same_in_a_larger_region():
    optics = {"gain_sigma": 0.02, "angle_sigma": 0.01}
    large = Camera.preset("ideal", optics=optics, size=(20, 20), origin=(100, 100))
    small = Camera.preset("ideal", optics=optics, size=(8, 8), origin=(104, 106))
    (_, one), (_, other) = (drain(camera.record(Texture(), 0.06, threads=threads)[0])
                            for camera, threads in ((large, 2), (small, 1)))
    np.testing.assert_allclose(one[0].dn[4:12, 6:14], other[0].dn, rtol=1e-6)


def test_runs_differ_in_noise_and_specimens_in_maps():
    one, other = Camera.preset("nominal", seed=1), Camera.preset("nominal", seed=2)
    assert not np.array_equal(one.maps["theta_on"], other.maps["theta_on"])
    first, _ = drain(one.record(FlatLight(), 0.1, run=0)[0])
    second, frames = drain(one.record(FlatLight(), 0.1, run=1)[0])
    assert not np.array_equal(first, second)
    assert frames[0].reset.dtype == np.uint16


@pytest.mark.parametrize(("part", "name", "value"), [
    ("dvs", "theta_on", 0.0), ("dvs", "mismatch", 0.5), ("dvs", "cutoff_hz", -1),
    ("dvs", "second_pole_hz", 0.0),
    ("dvs", "burst_chance", 1.5), ("aps", "exposure_us", 60_000),
    ("aps", "adc_bits", 0), ("aps", "shutter", "focal"),
    ("optics", "extinction_ratio", 1.0), ("optics", "gain_sigma", 0.5),
    ("bus", "rate_hz", 0.0)])
def test_impossible_parameters_are_refused_by_name_and_value(part, name, value):
    with pytest.raises(ValueError, match=f"^{name} must .*{value}"):
        Camera.preset("realistic", **{part: {name: value}})
