"""Hot pixels: found by what frames contradict, and without weight from then on."""
import numpy as np
import pytest
import reference_kalman
from streams import feed

from pdavis_cv import EVENT_DTYPE, ApsFrame, KalmanFilter, fuse
from pdavis_cv.analysis import Scorer
from pdavis_cv.selfcal import ClockOffset, SelfCalibration
from pdavis_cv.selfcal.pixel_sample import select_busy_pixels
from pdavis_cv.simulation import Camera, RotatingPolarizer

SHAPE = (2, 2)
HOT_PRIOR = 6.91


def stream(frames=12, hot_until=12, seed=0, light=300.0):
    """One pixel makes 40 ON events per frame until a frame; light is 300 DN, noisy."""
    rng = np.random.default_rng(seed)
    mids = 50_000 * np.arange(1, frames + 1)
    given = [ApsFrame((light + 3 * rng.normal(size=SHAPE)).astype(np.float32),
                      t - 5_000, t + 5_000, available_us=t + 7_000) for t in mids]
    events = np.zeros(40 * hot_until, EVENT_DTYPE)
    events["t"], events["p"] = 1_250 * np.arange(len(events)) + 600, 1
    return events, given


def found(method):
    return method._states["hot"] > HOT_PRIOR


@pytest.mark.parametrize(("mode", "hot_until"), [
    ("buffered", 5), ("offline", 5), ("buffered", 12), ("causal", 12), ("offline", 12)])
@pytest.mark.parametrize("t", [210_000, 400_000, 560_000])
def test_a_hot_pixel_equals_its_twin(mode, hot_until, t):
    events, frames = stream(hot_until=hot_until)
    method = KalmanFilter(SHAPE, theta_on=0.2, theta_off=0.25, mode=mode,
                          threshold_sigma=0.035)
    seen = t + method.lookahead_us
    feed(method, events[events["t"] <= seen],
         [frame for frame in frames if frame.available_us <= seen])
    method.settle(seen)
    estimate = reference_kalman.alone(method, t)
    log, variance, valid = reference_kalman.kalman(
        events[events["t"] <= seen], frames, SHAPE, 0.2, 0.25, t,
        lookahead_us=method.lookahead_us, offline=mode == "offline")
    np.testing.assert_allclose(estimate.log_intensity, log, atol=2e-3)
    np.testing.assert_allclose(estimate.variance, variance, rtol=5e-3, atol=1e-5)
    np.testing.assert_array_equal(estimate.valid, valid)


@pytest.mark.parametrize("mode", ["buffered", "causal", "offline"])
def test_a_hot_pixel_shows_its_frames_and_is_found_again_when_it_calms_down(mode):
    events, frames = stream(frames=28, hot_until=16)
    method = KalmanFilter(SHAPE, theta_on=0.2, theta_off=0.25, mode=mode)
    feed(method, events, frames[:16])
    method.settle(850_000)
    assert found(method).tolist() == [[True, False], [False, False]]
    log = method.read(850_000 - method.lookahead_us).log_intensity
    np.testing.assert_allclose(log, np.log(300 / 10), atol=0.05)
    if mode != "offline":   # its events are not worth a look
        assert method._reader.n == 0
    for frame in frames[16:]:
        method.add_frame(frame)
    method.settle(1_500_000)
    assert not found(method).any()


@pytest.mark.parametrize("factor", [0.4, 1.0, 3.0])
def test_light_that_moves_is_not_hot_whatever_thresholds_are_stated(factor):
    recording, _ = Camera.preset("nominal", seed=5, size=(6, 6)).record(
        RotatingPolarizer(rpm=101.3), 0.6)
    method = KalmanFilter((6, 6), theta_on=0.16 * factor, theta_off=0.18 * factor,
                          mode="causal")
    feed(method, recording.events(),
         [frame for packet in recording.packets() for frame in packet.frames])
    method.settle(600_000)
    assert not found(method).any()


def test_hot_pixels_are_no_busy_ones_however_many():
    camera = Camera.preset("nominal", seed=5, size=(10, 10), dvs={
        "hot_fraction": 0.1, "hot_hz": 1000.0})
    recording, _ = camera.record(RotatingPolarizer(rpm=101.3), 0.6)
    look = SelfCalibration((10, 10), (0.16, 0.18), every_pixel=False)
    for packet in recording.packets():
        look.add_events(packet.events)
        for frame in packet.frames:
            look.add_frame(frame)
    chosen = select_busy_pixels(look._window, (0.16, 0.18), (0.2, 0.08)).pixels
    events = recording.events()
    counts = np.bincount(events["y"] * 10 + events["x"].astype(int), minlength=100)
    assert np.count_nonzero(counts > 500) >= 5
    assert len(chosen) > 50
    assert counts[chosen].max() < 300


def test_an_offset_known_no_better_than_before_does_not_count():
    """Of a prior of 5 ms.  Found in hot pixels: 15 ms, beyond what clocks differ by."""
    assert not ClockOffset(11_300.0, 5_000.0).significant
    assert ClockOffset(11_300.0, 3_700.0).significant
    assert not ClockOffset(15_300.0, 4_000.0).significant


@pytest.mark.gate
def test_images_of_a_sensor_with_hot_pixels_have_polarization():
    """A channel whose events have no weight comes from the other three."""
    recording, truth = Camera.preset("nominal", seed=2, size=(12, 12), dvs={
        "hot_fraction": 0.05, "hot_hz": 1000.0}).record(
        RotatingPolarizer(rpm=202.6, start_angle=0.7), 1.5)
    scorer = Scorer(truth, (6, 6))
    for image in fuse(recording, method="kalman", causal=True, demosaic="superpixel",
                      times_us=range(1_000_000, 1_450_000, 9_000),
                      nominal_thresholds=(0.16, 0.18)):
        scorer.add(image)
    assert np.degrees(scorer.score.aop_error) < 4
    assert scorer.score.dolp_error < 0.1    # where S0 vanishes it is beyond 1
    assert scorer.score.valid > 0.98
