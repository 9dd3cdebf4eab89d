"""The spread of threshold ratios over a chip, found from events alone."""
import numpy as np
import pytest
from reference_redundancy import Macropixel

from pdavis_cv import KalmanFilter, fuse, recording_from_arrays
from pdavis_cv.fusion.events_alone import LEAST_SPREAD, line_ratios, ratio_spread
from pdavis_cv.pixel.sample import PixelSample
from pdavis_cv.reconstruct.redundancy import RATIO_SIGMA
from pdavis_cv.simulation import Camera, FlatLight, RotatingPolarizer, Texture

NOMINAL = (0.16, 0.18)
REDUNDANCY = {"method": "events", "offsets": "redundancy", "demosaic": "superpixel",
              "nominal_thresholds": NOMINAL}


def taken(mismatch, rpm=121.56, seconds=2.0, scene=None, seed=5, **dvs):
    """Return a recording of a chip of this mismatch, and the spread of its ratios."""
    camera = Camera.preset("nominal", seed=seed, size=(12, 12),
                           dvs={"mismatch": mismatch, **dvs})
    recording, _ = camera.record(
        scene or RotatingPolarizer(rpm=rpm, start_angle=0.3, dolp=0.8), seconds)
    maps = camera.dvs.maps(seed, (12, 12), (0, 0))
    return recording, np.std(np.log(maps["theta_on"] / maps["theta_off"]))


def spread_of(events, shape=(12, 12), nominal=NOMINAL):
    sample = PixelSample(shape)
    sample.add_events(events)
    return ratio_spread(sample, nominal)


@pytest.mark.parametrize("rpm", [60.78, 202.6])
@pytest.mark.parametrize("mismatch", [0.03, 0.08, 0.15])
def test_the_spread_of_narrow_and_wide_chips_is_found(mismatch, rpm):
    recording, sigma = taken(mismatch, rpm)
    found = spread_of(recording.events())
    assert found.sigma == pytest.approx(sigma, rel=0.2)
    assert abs(found.sigma**2 - sigma**2) < 4 * found.error


def test_a_texture_s_own_trend_is_no_spread():
    recording, sigma = taken(0.035, scene=Texture(velocity=(200, 60), seed=3))
    assert spread_of(recording.events()).sigma < 1.7 * sigma


def test_hot_pixels_do_not_widen_it():
    recording, sigma = taken(0.05, hot_fraction=0.05, hot_hz=500.0)
    assert spread_of(recording.events()).sigma == pytest.approx(sigma, rel=0.35)


def test_few_events_leave_the_prior():
    still, _ = taken(0.035, scene=FlatLight(), seconds=0.5)
    assert spread_of(still.events()) is None
    assert spread_of(still.events()[:0]) is None
    recording, _ = taken(0.15)
    events = recording.events()
    assert spread_of(events[events["t"] < 50_000]) is None


def test_equal_pixels_give_the_least_published_spread():
    recording, _ = taken(0.0, 202.6, leak_hz=0.0)
    assert spread_of(recording.events()).sigma < 1.3 * LEAST_SPREAD


def test_lines_are_those_of_the_method():
    rng = np.random.default_rng(2)
    recording, _ = taken(0.1, seconds=0.6)
    events = recording.events()
    kept = events[(events["y"] == 0) & (events["x"] < 4)].copy()
    on, off = rng.uniform(0.1, 0.3, (2, 4))
    # A prior that is as wide leaves the ratio where its line has it.
    twin = Macropixel(np.ones(4), np.stack([on, off], 1), 1.0, 1e6, 0.0, 0.0)
    for one in kept:
        counts = np.zeros((2, 4))
        counts[1 - one["p"], one["x"]] = 1
        twin.sample(np.zeros(4), *counts)
    told = np.log(twin.theta[:, 0] / twin.theta[:, 1]) - np.log(on / off)
    order = np.argsort(kept["x"], kind="stable")
    np.testing.assert_allclose(line_ratios(
        kept["x"][order].astype(int), kept["p"][order] > 0, on, off), told, rtol=1e-6)


def test_light_that_changes_in_one_sense_tells_nothing():
    """A quarter of a turn of the polarizer: each half has events of one sign."""
    recording, _ = taken(0.1, 30.39, seconds=0.5)
    events = recording.events()
    for sign in (0, 1):
        alike = events[events["p"] == sign]
        assert len(alike) > 500
        assert spread_of(alike) is None


@pytest.mark.parametrize("frames", [True, False])
@pytest.mark.parametrize("causal", [True, False])
def test_fuse_learns_it_from_events_alone(causal, frames):
    recording, sigma = taken(0.15, seconds=1.5)
    if not frames:
        recording = recording_from_arrays(
            recording.events(), sensor_size=(12, 12), layout=recording.info.layout)

    def in_force(t_us, **options):
        image, = fuse(recording, times_us=[t_us], causal=causal, **REDUNDANCY,
                      **options)
        return image.provenance["parameters"]["ratio_sigma"]

    assert in_force(1_400_000) == pytest.approx(sigma, rel=0.3)
    assert (in_force(100_000) == RATIO_SIGMA) == causal
    assert in_force(1_400_000, ratio_sigma=0.07) == 0.07


def test_frames_do_not_change_it():
    recording, _ = taken(0.1, seconds=1.2)
    blind = recording_from_arrays(
        recording.events(), sensor_size=(12, 12), layout=recording.info.layout)
    one, other = (next(iter(fuse(each, times_us=[1_000_000], **REDUNDANCY)))
                  for each in (recording, blind))
    assert (one.provenance["parameters"]["ratio_sigma"]
            == other.provenance["parameters"]["ratio_sigma"])
    np.testing.assert_array_equal(one.aop, other.aop)


def test_it_does_not_depend_on_how_events_are_cut():
    recording, _ = taken(0.1, seconds=1.2)
    events = recording.events()
    sample = PixelSample((12, 12))
    for part in np.array_split(events, 37):
        sample.add_events(part)
    assert ratio_spread(sample, NOMINAL) == spread_of(events)


def test_a_wide_chip_is_measured_better_than_with_the_prior():
    recording, _ = taken(0.15, 60.78, seconds=2.5)
    def error(**options):
        times = np.arange(1_000_000, 2_400_000, 20_011)
        found = [image.aop for image in fuse(
            recording, times_us=times, **REDUNDANCY, **options)]
        true = 0.3 + 2 * np.pi * 60.78 / 60e6 * times
        off = (np.array(found) - true[:, None, None] + np.pi / 2) % np.pi - np.pi / 2
        return np.sqrt(np.nanmean(off**2))

    assert error() < 0.9 * error(ratio_sigma=RATIO_SIGMA)


@pytest.mark.parametrize(("light", "sigma"), [(1e5, 0.05), (0.05, RATIO_SIGMA)])
def test_kalman_hands_it_on_where_frames_saturate(light, sigma):
    """In dim light noise events, not those of the light, decide how ratios differ."""
    recording, _ = Camera.preset("nominal", seed=1, size=(4, 4)).record(
        RotatingPolarizer(rpm=60.78, s0=light), 0.3)
    method = KalmanFilter((4, 4), theta_on=0.16, theta_off=0.18, ratio_sigma=0.07)
    frame, *_ = (frame for packet in recording.packets() for frame in packet.frames)
    method.add_frame(frame)
    method.settle(200_000)
    inner = method._saturated._method
    assert inner.parameters["ratio_sigma"] == max(0.07, sigma)
    method.retune(ratio_sigma=0.05)
    assert inner.parameters["ratio_sigma"] == sigma
    assert method.parameters["ratio_sigma"] == 0.05
    copy = KalmanFilter((4, 4), **method.parameters)
    copy.assign(method)
    assert copy._saturated._method.parameters["ratio_sigma"] == sigma
    copy = KalmanFilter((4, 4), **method.parameters)
    copy.restore(method.snapshot())
    assert copy._saturated._method.parameters["ratio_sigma"] == sigma


@pytest.mark.gate
@pytest.mark.parametrize("causal", [True, False])
def test_kalman_learns_it_unless_it_is_stated(causal):
    recording, sigma = taken(0.15, seconds=1.5)

    def in_force(**options):
        image, = fuse(recording, times_us=[1_400_000], causal=causal, method="kalman",
                      nominal_thresholds=NOMINAL, **options)
        return image.provenance["parameters"]["ratio_sigma"]

    assert in_force() == pytest.approx(sigma, rel=0.3)
    assert in_force(ratio_sigma=0.07) == 0.07
