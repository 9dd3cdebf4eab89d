"""Temperature of the chip: dark signal, leak and thresholds follow their laws."""
import math

import numpy as np
import pytest

import pdavis_cv
from pdavis_cv.simulation import (
    Camera,
    FlatLight,
    RotatingPolarizer,
    Temperature,
    VideoScene,
)
from pdavis_cv.tools import simulate


def recorded(scene, seconds, **parts):
    camera = Camera.preset("ideal", size=(4, 4), **parts)
    recording, _ = camera.record(scene, seconds)
    packets = list(recording.packets())
    return (np.concatenate([packet.events for packet in packets]),
            [frame.dn for packet in packets for frame in packet.frames])


def test_currents_double_every_ten_kelvin_or_so():
    assert Temperature().current(0.0) == 1
    assert Temperature(start_c=34.8).current(0.0) == pytest.approx(2, rel=0.01)
    # Its log is linear in 1 / T: the slope is the activation energy.
    t = [Temperature(start_c=c, activation_ev=0.6) for c in (0, 20, 60)]
    inverse = [1 / (at.start_c + 273.15) for at in t]
    slope = np.diff(np.log([at.current(0) for at in t])) / np.diff(inverse)
    np.testing.assert_allclose(slope, -0.6 / 8.617333e-5)


def test_a_chip_warms_towards_its_end():
    warm = Temperature(start_c=20, end_c=50, rise_s=100)
    assert warm.at(0) == 20
    assert warm.at(100e6) == pytest.approx(50 - 30 / math.e)
    assert warm.at(1e10) == pytest.approx(50)
    assert Temperature(start_c=31).at(1e9) == 31


def test_the_dark_signal_of_frames_follows_it():
    warm = {"start_c": 25, "end_c": 65, "rise_s": 0.2}
    _, frames = recorded(FlatLight(s0=0.0), 0.5, temperature=warm, dvs=None,
                         aps={"dark_dn_s": 100.0})
    law = Temperature(**warm)
    want = [2.0 * law.current(50_000 * k) for k in range(len(frames))]
    assert len(frames) == 10
    np.testing.assert_allclose([dn.mean() for dn in frames], want, rtol=1e-5)


@pytest.mark.parametrize("scene", [
    FlatLight(), VideoScene(np.ones((2, 4, 4, 4)), 10.0, origin=(128, 170))])
def test_leak_events_follow_it(scene):
    rates = {}
    for celsius in (25.0, 45.0):
        camera = Camera.preset("ideal", size=(4, 4), aps=None, dvs={"leak_hz": 5.0},
                               temperature={"start_c": celsius, "threshold_per_k": 0.0},
                               origin=(128, 170))
        events = np.concatenate(
            [packet.events for packet in camera.record(scene, 4.0)[0].packets()])
        assert np.all(events["p"] == 1)
        rates[celsius] = len(events) / 16 / 4
    assert rates[25.0] == pytest.approx(5, abs=0.3)
    assert rates[45.0] / rates[25.0] == pytest.approx(
        Temperature(start_c=45).current(0), rel=0.06)


def test_thresholds_follow_it():
    def events(per_k):
        return len(recorded(RotatingPolarizer(rpm=300), 2.0, aps=None, dvs={
            "theta_on": 0.01, "theta_off": 0.01}, temperature={
            "start_c": 65.0, "threshold_per_k": per_k})[0])

    assert events(0.002) / events(0.0) == pytest.approx(1 / 1.08, rel=0.004)


def test_at_the_reference_nothing_changes():
    scene = RotatingPolarizer(rpm=300)
    dvs = {"leak_hz": 1.0, "mismatch": 0.03}
    one, frames = recorded(scene, 0.2, dvs=dvs)
    other, again = recorded(scene, 0.2, dvs=dvs, temperature={
        "start_c": 25.0, "end_c": 25.0})
    np.testing.assert_array_equal(one, other)
    np.testing.assert_array_equal(frames, again)


@pytest.mark.parametrize(("name", "value"), [
    ("start_c", 200.0), ("end_c", -60.0), ("rise_s", 0.0), ("activation_ev", -0.1),
    ("threshold_per_k", 0.1)])
def test_impossible_temperatures_are_refused(name, value):
    with pytest.raises(ValueError, match=f"^{name} must .*{value}"):
        Temperature(**{name: value})


def test_the_command_warms_the_camera(tmp_path, capsys):
    levels = []
    for given in ([], ["--temperature", "25,85"], ["--temperature=85"]):
        path = tmp_path / f"{len(levels)}.aedat4"
        assert simulate.main(["dark", "--seconds", "0.1", *given, "-o", str(path)]) == 0
        with pdavis_cv.open_recording(path) as recording:
            levels.append(np.mean([frame.dn.mean() for packet in recording.packets()
                                   for frame in packet.frames]))
    assert levels[1] == pytest.approx(levels[0], abs=0.1)  # it has only begun
    assert levels[2] > levels[0] + 5  # .3 DN, times some 40
    assert simulate.main(["dark", "--temperature", "300", "-o", "x.aedat4"]) == 2
    assert "start_c must" in capsys.readouterr().err
