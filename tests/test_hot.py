"""Hot pixels: found by what frames contradict, and without weight from then on."""
import numpy as np
import pytest
from streams import feed
from truth_errors import errors_of

from pdavis_cv import EVENT_DTYPE, ApsFrame, KalmanFilter, fuse
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
    return method._anchors["hot"] > HOT_PRIOR


@pytest.mark.parametrize("mode", ["buffered", "causal", "offline"])
def test_a_hot_pixel_shows_its_frames_and_is_found_again_when_it_calms_down(mode):
    events, frames = stream(frames=24, hot_until=24)
    method = KalmanFilter(SHAPE, theta_on=0.2, theta_off=0.25, mode=mode)
    feed(method, events, frames)
    method.settle(1_250_000)
    assert found(method).tolist() == [[True, False], [False, False]]
    log = method.read(1_250_000 - method.lookahead_us).log_intensity
    np.testing.assert_allclose(log, np.log(300 / 10), atol=0.05)
    # Then it falls and rises with the light, and frames agree.
    events = np.zeros(60, EVENT_DTYPE)
    rises = np.arange(60) // 4 % 2 == 0
    events["t"], events["p"] = 1_260_000 + 12_500 * np.arange(60), rises
    frames = []
    for k in range(15):
        dn = np.full(SHAPE, 300.0)
        dn[0, 0] *= 2.2 if k % 2 == 0 else 1.0
        frames.append(ApsFrame(dn, 1_302_000 + 50_000 * k, 1_304_000 + 50_000 * k))
    feed(method, events, frames)
    method.settle(3_000_000)
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


@pytest.mark.gate
def test_images_of_a_sensor_with_hot_pixels_have_polarization():
    """A channel whose events have no weight comes from the other three."""
    recording, truth = Camera.preset("nominal", seed=2, size=(12, 12), dvs={
        "hot_fraction": 0.05, "hot_hz": 1000.0}).record(
        RotatingPolarizer(rpm=202.6, start_angle=0.7), 1.5)
    error = errors_of(fuse(
        recording, method="kalman", causal=True, demosaic="superpixel",
        times_us=range(1_000_000, 1_450_000, 9_000), nominal_thresholds=(0.16, 0.18)),
        truth)
    assert np.degrees(error.aop) < 4
    assert error.dolp < 0.1     # where S0 vanishes it is beyond 1
    assert error.valid > 0.98
