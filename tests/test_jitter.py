"""Jitter of the events' time stamps: found from events alone, and what it changes."""
import numpy as np
import pytest

from pdavis_cv import EVENT_DTYPE, ApsFrame, KalmanFilter, fuse
from pdavis_cv.reconstruct.lamp import BLOCK_US, Wave
from pdavis_cv.selfcal import SelfCalibration
from pdavis_cv.simulation import Camera, FlatLight, RotatingPolarizer, Texture

SIZE = (12, 12)
STEADY = ApsFrame(np.full((1, 1), 100.0), 0, 1000)


def taken(jitter_us=0.0, scene=None, seconds=1.0, seed=7, preset="nominal", **dvs):
    camera = Camera.preset(preset, seed=seed, size=SIZE, dvs=dvs,
                           faults={"jitter_us": jitter_us})
    scene = scene or RotatingPolarizer(rpm=202.6, start_angle=0.3)
    return camera.record(scene, seconds)


def jitter_of(events, shape=SIZE):
    camera = SelfCalibration(shape, (0.16, 0.18), every_pixel=False)
    camera.add_events(events)
    return camera.estimate(wanted={"jitter_us"}).jitter


@pytest.mark.parametrize("rpm", [30.39, 202.6, 1013.0])
@pytest.mark.parametrize("jitter_us", [300.0, 1000.0])
def test_it_is_found_at_any_speed(jitter_us, rpm):
    recording, _ = taken(jitter_us, RotatingPolarizer(rpm=rpm, start_angle=0.3))
    found = jitter_of(recording.events())
    assert found.us == pytest.approx(jitter_us, rel=0.3)
    assert found.sigma_us < 0.2 * jitter_us or rpm > 1000   # stamps lose their order


@pytest.mark.parametrize("change", [
    {}, {"scene": Texture(velocity=(200, 60), seed=3)}, {"refractory_us": 1000.0},
    {"hot_fraction": 0.05, "hot_hz": 1000.0}, {"second_pole_hz": 250.0}])
def test_what_is_no_jitter_is_not_taken_for_it(change):
    recording, _ = taken(**change)
    assert jitter_of(recording.events()).us < 150


def test_few_events_or_noise_tell_nothing():
    recording, _ = taken(scene=FlatLight())
    assert jitter_of(recording.events()) is None
    assert jitter_of(recording.events()[:0]) is None
    rng = np.random.default_rng(4)
    noise = np.zeros(20_000, EVENT_DTYPE)
    noise["t"] = np.sort(rng.integers(0, 1_000_000, len(noise)))
    noise["x"], noise["p"] = rng.integers(0, 10, len(noise)), rng.integers(
        0, 2, len(noise))
    assert jitter_of(noise, (1, 10)) is None


@pytest.mark.parametrize(("lit", "found"), [(1, True), (2, True), (10, False)])
def test_a_false_alarm_of_flicker_hinders_no_estimate(lit, found):
    """A lamp that flickers triggers events, which hides the light's own timing."""
    recording, _ = taken(300.0)
    camera = SelfCalibration(SIZE, (0.16, 0.18), every_pixel=False)
    for k in range(10):
        camera.add_wave(Wave(k * BLOCK_US, *((120.0, 0.01, 0.02) if k < lit else ())))
    for packet in recording.packets():
        camera.add_events(packet.events)
        for frame in packet.frames:
            camera.add_frame(frame)
    told = camera.estimate(wanted={"jitter_us", "clock_offset", "refractory_us"})
    for one in (told.jitter, told.clock_offset, told.refractory):
        assert (one is not None) == found


def test_its_standard_error_covers_it():
    rng = np.random.default_rng(5)
    errors = []
    for _ in range(40):
        t = 4000 * np.arange(1, 41)[:, None] + rng.normal(0, 400.0, (40, 40))
        events = np.zeros(t.size, EVENT_DTYPE)
        events["t"], events["x"] = t.ravel(), np.tile(np.arange(40), 40)
        found = jitter_of(events[np.argsort(events["t"], kind="stable")], (1, 40))
        errors.append((found.us - 400.0) / found.sigma_us)
    assert abs(np.mean(errors)) < 1
    assert 0.4 < np.std(errors) < 2


@pytest.mark.parametrize("causal", [True, False])
def test_fuse_learns_it_and_errs_less(causal):
    recording, truth = taken(1000.0, RotatingPolarizer(rpm=1013.0, start_angle=0.3),
                             seconds=1.5, seed=8)

    def errors(**options):
        found = []
        for image in fuse(recording, times_us=range(1_000_000, 1_400_000, 5077),
                          causal=causal, demosaic="superpixel",
                          nominal_thresholds=(0.16, 0.18), **options):
            off = image.aop - truth.aop(image.t_us)
            off = (off + np.pi / 2) % np.pi - np.pi / 2
            found.append((np.abs(off).mean(), np.abs(image.dolp - 1).mean()))
            learned = image.provenance["parameters"]["jitter_us"]
        return np.mean(found, 0), learned

    (aop, dolp), learned = errors()
    assert learned == pytest.approx(1000.0, rel=0.3)
    (aop_without, dolp_without), stated = errors(jitter_us=0.0)
    assert stated == 0
    assert aop < 0.9 * aop_without
    assert dolp < 0.9 * dolp_without


def test_alone_it_is_not_worth_reading_ahead():
    recording, _ = taken()
    image = next(iter(fuse(
        recording, thresholds="nominal", bandwidth=(250.0, 0.0),
        noise=(0.01, 0.4, 0.0003), clock_offset_us=0.0, times_us=[500_000])))
    assert image.provenance["parameters"]["jitter_us"] == 0


def test_a_gap_shorter_than_its_error_tells_no_slope():
    """Live, a pixel whose last two events came close together is not taken to rush."""
    def shown(jitter_us):
        method = KalmanFilter((1, 1), theta_on=0.2, theta_off=0.2, mode="causal",
                              jitter_us=jitter_us)
        method.add_frame(STEADY)
        events = np.zeros(2, EVENT_DTYPE)
        events["t"], events["p"] = (50_000, 50_300), 1
        method.add_events(events)
        return method.read(50_450).log_intensity[0, 0]

    at_once, later = shown(0.0), shown(5000.0)
    level = np.log(100) + 0.4
    assert at_once > level + 0.04
    assert level <= later < level + 0.01


def test_it_must_be_a_time():
    for wrong in (-1.0, np.nan, np.inf):
        with pytest.raises(ValueError, match="jitter_us must be finite and not neg"):
            KalmanFilter((1, 1), theta_on=0.2, theta_off=0.2, jitter_us=wrong)
        with pytest.raises(ValueError, match="jitter_us must be finite and not neg"):
            KalmanFilter((1, 1), theta_on=0.2, theta_off=0.2).retune(jitter_us=wrong)
