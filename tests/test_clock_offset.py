"""Frames whose stamps are off: found, told from a lag, moved, said."""
import dataclasses
import os
from pathlib import Path

import numpy as np
import pytest

import pdavis_cv
from pdavis_cv import (
    Calibration,
    FusionOptions,
    fuse,
    open_recording,
    recording_from_arrays,
)
from pdavis_cv.analysis import Scorer
from pdavis_cv.fusion import Fusion, clock_offset_in_situ
from pdavis_cv.selfcal import ClockOffset, SelfCalibration
from pdavis_cv.selfcal.bandwidth import fit_bandwidth
from pdavis_cv.selfcal.clock_offset import fit_clock_offset
from pdavis_cv.selfcal.estimator import QUANTITIES
from pdavis_cv.selfcal.pixel_sample import select_busy_pixels
from pdavis_cv.simulation import Camera, FlatLight, RotatingPolarizer, Texture
from pdavis_cv.tools import info

NOMINAL = (0.16, 0.18)
LEAK_HZ = (0.2, 0.08)


def recorded(scene, preset="nominal", seed=3, seconds=2.0, size=(10, 10), **parts):
    camera = Camera.preset(preset, seed=seed, size=size, **parts)
    return camera.record(scene, seconds)


def sample_of(recording, nominal=NOMINAL):
    camera = SelfCalibration(recording.info.sensor_size, nominal, every_pixel=False)
    for packet in recording.packets():
        camera.add_events(packet.events)
        for frame in packet.frames:
            camera.add_frame(frame)
    return select_busy_pixels(camera._window, nominal, LEAK_HZ)


@pytest.fixture(scope="module")
def early():
    """A polarizer at 200 RPM, frames stamped 5 ms early; recording and truth."""
    return recorded(RotatingPolarizer(rpm=202.6, start_angle=0.4),
                    faults={"frame_offset_us": -5000})


SCENES = {
    "30 RPM": RotatingPolarizer(rpm=30.4, start_angle=0.4),
    "200 RPM": RotatingPolarizer(rpm=202.6, start_angle=0.4),
    "1000 RPM": RotatingPolarizer(rpm=1013.0, start_angle=0.4),
    "texture": Texture(velocity=(200.0, 60.0), seed=2),
}


@pytest.mark.parametrize("name", [
    name if name == "200 RPM" else pytest.param(name, marks=pytest.mark.gate)
    for name in SCENES])
def test_an_offset_is_found_whatever_it_is(name):
    sample = sample_of(recorded(SCENES[name], size=(14, 14))[0])
    for true in (0, 3000, -5000, 10_000):
        found = fit_clock_offset(sample.with_frames_moved(-true))
        assert found.us == pytest.approx(true, abs=300 if "RPM" in name else 500)
        assert abs(found.us - true) < 2 * found.sigma_us
        assert found.significant == (true != 0)


@pytest.mark.gate
@pytest.mark.parametrize("rpm", [30.4, 202.6, 1013.0])
def test_offsets_of_cameras_of_another_family_lie_within_their_sigma(rpm):
    """Nothing was chosen on these; thresholds are stated as .2."""
    for seed in (41, 42):
        recording, _ = recorded(RotatingPolarizer(rpm=rpm, start_angle=0.5), "davis346",
                                seed)
        true = -Camera.preset("davis346", seed=seed).faults.frame_offset_us
        found = clock_offset_in_situ(recording)
        assert found.significant
        # 3.2 sigma were seen at 1000 RPM: the common scale is off there too.
        assert abs(found.us - true) < 3.5 * found.sigma_us < 3100


@pytest.mark.gate
def test_thresholds_and_stamps_that_are_both_wrong_are_told_together():
    """With the stamps that suit thresholds of .2, the true ones are not likelier."""
    scene = RotatingPolarizer(rpm=1013.0, start_angle=np.deg2rad(59.4))
    recording, _ = recorded(scene, "davis346", 2, seconds=1.5, size=(12, 12))
    watch = SelfCalibration(recording.info.sensor_size, every_pixel=False)
    for packet in recording.packets():
        watch.add_events(packet.events)
        for frame in packet.frames:
            watch.add_frame(frame)
    found = watch.estimate(wanted=QUANTITIES - {"thresholds"})
    camera = Camera.preset("davis346", seed=2)
    offset_us = -camera.faults.frame_offset_us
    assert found.clock_offset.us == pytest.approx(offset_us, abs=1000)
    assert found.theta_on.mean() == pytest.approx(camera.dvs.theta_on, rel=0.2)


@pytest.mark.parametrize("rpm", [30.4, 202.6])
def test_a_lag_that_depends_on_the_light_is_no_offset(rpm):
    recording, _ = recorded(RotatingPolarizer(rpm=rpm, start_angle=0.5), "realistic")
    found = fit_clock_offset(sample_of(recording))
    assert not found.significant
    assert abs(found.us) < 2000


@pytest.mark.parametrize("law", [(15.0, 4.0), (30.0, 3.0)])
def test_a_lag_that_depends_on_the_light_in_part_is_no_offset_either(law):
    """105 Hz in bright light, 25 and 37 Hz at a tenth of it: events trail by ms."""
    sample = sample_of(recorded(
        RotatingPolarizer(rpm=202.6, start_angle=0.5, dolp=0.8), "nominal",
        dvs=dict(zip(("cutoff_hz", "cutoff_hz_per_dn_ms"), law, strict=True)))[0])
    assert not fit_clock_offset(sample).significant
    found = fit_bandwidth(sample)
    for light in (sample.bright, 0.1 * sample.bright):
        assert found.hz + found.hz_per_intensity * light == pytest.approx(
            law[0] + law[1] * light, rel=0.2)


@pytest.mark.parametrize(("hz", "significant"), [(90.0, False), (40.0, True)])
def test_a_delay_that_a_usual_lag_makes_is_no_offset(hz, significant):
    """90 Hz delay by 1.8 ms, 2.4 sigmas of ln 300 Hz; 40 Hz by 4.0 ms, 4.0 sigmas."""
    sample = sample_of(recorded(RotatingPolarizer(rpm=202.6, start_angle=0.5),
                                "nominal", dvs={"cutoff_hz": hz})[0])
    found = fit_clock_offset(sample)
    assert found.us == pytest.approx(1e6 / (2 * np.pi) * (1 / hz - 1 / 300), rel=0.25)
    assert found.significant == significant
    assert not found.ambiguous


def test_at_rest_nothing_is_told():
    found = clock_offset_in_situ(recorded(FlatLight())[0], nominal=NOMINAL)
    assert found is None or (not found.significant and found.sigma_us > 1000)


def test_a_bandwidth_that_is_known_takes_its_part_exactly(early):
    sample = sample_of(early[0])
    found = fit_clock_offset(sample, (250.0, 0.0, 0.01))
    assert found.us == pytest.approx(5000, abs=100)
    assert found.sigma_us < 250


def test_frames_move_with_their_arrival_where_they_must():
    frame = pdavis_cv.ApsFrame(np.ones((2, 2)), 1000, 2000, available_us=2500)
    later, earlier = frame.moved(800), frame.moved(-300)
    assert (later.exposure_start_us, later.mid_us, later.available_us) == (
        1800, 2300, 2800)
    assert (earlier.mid_us, earlier.available_us) == (1200, 2500)
    assert frame.moved(0) is frame


def aop_error(recording, truth, **options):
    return scored(recording, truth, 1_000_000, stop_us=1_900_000, **options)


def scored(recording, truth, start_us, **options):
    """Return the AoP error from start_us on, and the offset that was applied last."""
    scorer = Scorer(truth, (5, 5))
    images = fuse(recording, method="kalman", fps=200, demosaic="superpixel",
                  start_us=start_us, nominal_thresholds=NOMINAL, **options)
    for image in images:
        scorer.add(image)
        last = image
    return np.rad2deg(scorer.score.aop_error), last.provenance["clock_offset_us"]


@pytest.mark.gate
@pytest.mark.parametrize("causal", [False, True])
def test_stamps_that_are_off_no_longer_turn_the_angle(early, causal):
    found, us = aop_error(*early, causal=causal)
    stated, as_stated = aop_error(*early, causal=causal, clock_offset_us=5000)
    without, none = aop_error(*early, causal=causal, clock_offset_us=None)
    assert us == pytest.approx(5000, abs=300)
    assert (as_stated, none) == (5000, 0)
    assert found < 1.3 * stated + 0.2
    assert without > 1.5 * found


@pytest.mark.gate
@pytest.mark.parametrize(("rpm", "us"), [
    (202.6, -10_000), pytest.param(1013.0, 5_000, marks=pytest.mark.gate)])
def test_a_stream_recovers_from_what_wrong_stamps_taught(rpm, us):
    """Before the first look, at .5 s, thresholds were learned from frames elsewhere."""
    made = recorded(RotatingPolarizer(rpm=rpm, start_angle=0.4), seconds=1.2,
                    faults={"frame_offset_us": us})
    found, stated = (scored(*made, 700_000, causal=True, clock_offset_us=one)[0]
                     for one in ("learned", -us))
    assert found < stated + 0.9     # two sigmas of the offset: 6 degrees per ms


def test_right_stamps_stay(early):
    right, _ = recorded(RotatingPolarizer(rpm=202.6, start_angle=0.4))
    fusion = Fusion(right, method="kalman", nominal_thresholds=NOMINAL)
    assert fusion.clock_offset_us == 0
    assert Fusion(early[0], method="cf").clock_offset_us == 0
    assert Fusion(early[0], method="cf", clock_offset_us=4000).clock_offset_us == 4000


def test_frames_act_at_their_moved_time(early):
    recording, _ = early
    first = next(frame for packet in recording.packets() for frame in packet.frames)
    for method in ("cf", "kalman"):
        images = fuse(recording, method=method, clock_offset_us=2500)
        image = next(images)
        assert image.t_us == image.frame_us == first.mid_us + 2500
        assert image.valid.any()


def test_a_calibration_keeps_it(early, tmp_path):
    recording, _ = early
    known = Calibration(sensor_size=(10, 10), clock_offset_us=4321.0)
    path = known.save(tmp_path / "camera.npz")
    again = Calibration.load(path)
    assert again.clock_offset_us == 4321.0
    assert "clock_offset_us" in again.parts
    assert Fusion(recording, calibration=again).clock_offset_us == 4321
    assert Fusion(recording, calibration=again,
                  clock_offset_us=None).clock_offset_us == 0
    with pytest.raises(ValueError, match="clock_offset_us must be finite"):
        known.replace(clock_offset_us=np.nan)


@pytest.mark.parametrize("causal", [False, True])
def test_the_camera_is_learned_with_the_stated_offset(early, causal):
    """Otherwise frames that are early look like pixels that are slow, 30 Hz."""
    told = {}
    for us in (5000, None):
        image, = fuse(early[0], method="kalman", causal=causal, times_us=[1_500_000],
                      nominal_thresholds=NOMINAL, clock_offset_us=us)
        told[us] = image.provenance["parameters"]["bandwidth"]
    assert 150 < told[5000][0] + told[5000][1] * 15 < 450
    assert told[None][0] + told[None][1] * 15 < 100


def test_a_stated_offset_is_that_of_frames_that_were_moved(early):
    found = []
    for moved_us, stated_us in ((5000, 0), (0, 5000)):
        camera = SelfCalibration((10, 10), NOMINAL)
        for packet in early[0].packets(None, 1_400_000):
            camera.add_events(packet.events)
            for frame in packet.frames:
                camera.add_frame(frame.moved(moved_us))
        found.append(camera.estimate(
            wanted=QUANTITIES - {"clock_offset"}, clock_offset_us=stated_us))
    one, other = found
    assert one.bandwidth == other.bandwidth
    np.testing.assert_array_equal(one.theta_on, other.theta_on)


@pytest.mark.parametrize("value", ["best", 2e6, float("nan")])
def test_impossible_offsets_are_refused(value):
    with pytest.raises(ValueError, match="clock_offset_us must be 'learned'"):
        FusionOptions(clock_offset_us=value)


def test_an_offset_counts_beyond_three_sigmas_and_a_millisecond():
    assert ClockOffset(3100.0, 1000.0).applied_us == 3100
    assert ClockOffset(2900.0, 1000.0).applied_us == 0
    assert ClockOffset(-900.0, 10.0).applied_us == 0
    assert ClockOffset(300.0, 0.0).applied_us == 300    # stated


@pytest.mark.parametrize("us", [4000, -4000])
@pytest.mark.parametrize("causal", [False, True])
def test_images_do_not_depend_on_how_one_got_there(early, us, causal):
    """Moved frames, on seeking and as the stream passes."""
    options = {"method": "kalman", "causal": causal, "clock_offset_us": us, "fps": 40,
               "bandwidth": (250.0, 0.0), "noise": (0.02, 0.1, 0.0003)}
    whole = Fusion(early[0], **options)
    kept = []
    for _ in range(30):
        image = next(whole)
        kept.append((whole.snapshot(), image))
    for i in (3, 17, 25):
        other = Fusion(early[0], **options)
        other.restore(kept[i][0])
        for _, expected in kept[i + 1:i + 4]:
            image = next(other)
            assert image.t_us == expected.t_us
            np.testing.assert_array_equal(image.quad, expected.quad)


@pytest.mark.gate
def test_info_warns(early, tmp_path, capsys):
    path = tmp_path / "early.aedat4"
    pdavis_cv.write_aedat4(path, early[0])
    assert info.main([str(path), "--scan"]) == 0
    assert "ms early by the clock of the events" in capsys.readouterr().out
    right, _ = recorded(RotatingPolarizer(rpm=202.6, start_angle=0.4), seconds=1.5)
    pdavis_cv.write_aedat4(path, right)
    assert info.main([str(path), "--scan"]) == 0
    assert "clock of the events" not in capsys.readouterr().out


def test_events_of_one_sign_in_a_row_are_chosen():
    events = np.zeros(6, pdavis_cv.EVENT_DTYPE)
    events["t"], events["p"] = [10, 20, 30, 40, 50, 60], [1, 1, 1, 0, 0, 0]
    frames = [pdavis_cv.ApsFrame(np.full((1, 1), 100.0), t, t + 2)
              for t in (0, 14, 24, 34, 54, 64)]
    camera = SelfCalibration((1, 1), NOMINAL, every_pixel=False)
    made = recording_from_arrays(events, frames, sensor_size=(1, 1))
    for packet in made.packets():
        camera.add_events(packet.events)
        for frame in packet.frames:
            camera.add_frame(frame)
    camera._window.last_us = 10**6
    sample = select_busy_pixels(camera._window, NOMINAL, LEAK_HZ)
    steady = sample.between_like_events(0.0)
    assert (steady._frames["variance"][:, 0] > 0).tolist() == [
        False, False, True, False, True, False]
    moved = sample.with_frames_moved(-10).between_like_events(10.0)
    np.testing.assert_array_equal(
        moved._frames["variance"], steady._frames["variance"])


def test_frames_with_several_events_are_chosen():
    events = np.zeros(6, pdavis_cv.EVENT_DTYPE)
    events["t"], events["p"] = [10, 20, 30, 40, 50, 60], [1, 0, 1, 0, 1, 0]
    frames = [pdavis_cv.ApsFrame(np.full((1, 1), 100.0), *span)
              for span in ((0, 4), (9, 31), (32, 44), (45, 51), (52, 58), (62, 66))]
    camera = SelfCalibration((1, 1), NOMINAL, every_pixel=False)
    made = recording_from_arrays(events, frames, sensor_size=(1, 1))
    for packet in made.packets():
        camera.add_events(packet.events)
        for frame in packet.frames:
            camera.add_frame(frame)
    camera._window.last_us = 10**6
    sample = select_busy_pixels(camera._window, NOMINAL, LEAK_HZ)
    for delay_us in (0, 10):
        steady = sample.with_frames_moved(-delay_us).between_like_events(
            float(delay_us), 3)
        assert (steady._frames["variance"][:, 0] > 0).tolist() == [
            False, True, False, False, False, False]


def test_the_real_camera_s_offset():
    """Frames left out are predicted best with 3 to 4 ms."""
    data = os.environ.get("PDAVIS_TEST_DATA")
    if not data:
        pytest.skip("PDAVIS_TEST_DATA is not set")
    with open_recording(Path(data) / "davis346.aedat4") as made:
        found = clock_offset_in_situ(made)
    assert found.significant
    assert found.us == pytest.approx(3300, abs=800)
    assert dataclasses.replace(found, us=0.0).applied_us == 0
