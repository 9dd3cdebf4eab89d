"""The common scale of thresholds from events alone, and methods that are told of it."""
import math

import numpy as np
import pytest

from pdavis_cv import FusionOptions, fuse, recording_from_arrays
from pdavis_cv.events import EVENT_DTYPE
from pdavis_cv.fusion import events_alone
from pdavis_cv.fusion.events_alone import event_scale
from pdavis_cv.pixel.sample import PixelSample
from pdavis_cv.reconstruct.redundancy import EventRedundancy
from pdavis_cv.simulation import Camera, RotatingPolarizer

pytestmark = pytest.mark.accuracy

SIZE, NOMINAL = (12, 12), (0.16, 0.18)


def scene(rpm=202.6, **more):
    return RotatingPolarizer(rpm=rpm, start_angle=0.7, **more)


@pytest.fixture(scope="module")
def right():
    """Events of a camera whose thresholds are `NOMINAL`."""
    return Camera.preset("nominal", seed=51, size=SIZE).record(scene(), 1.2)[0]


@pytest.fixture(scope="module")
def real():
    """A camera like real ones, whose thresholds are stated as .2; its true ones."""
    camera = Camera.preset("davis346", seed=52, size=SIZE)
    return camera.record(scene(), 1.5)[0], (
        camera.maps["theta_on"].mean(), camera.maps["theta_off"].mean())


def kept(events, shape=SIZE):
    sample = PixelSample(shape)
    sample.add_events(events)
    return sample


def test_thresholds_stated_right_are_kept(right):
    found = event_scale(kept(right.events()), NOMINAL)
    assert abs(found.ln) < 0.08
    assert found.fall < 0.1
    assert not found.significant


@pytest.mark.parametrize("factor", [0.4, 0.5, 0.7, 1.5])
def test_a_factor_on_the_stated_thresholds_is_found(right, factor):
    """Sums of events scale with the thresholds, so that only the factor changes.

    What is stated too large is not corrected: a lag looks the same.
    """
    cells = kept(right.events())
    found = event_scale(cells, [theta * factor for theta in NOMINAL])
    assert found.significant == (factor < 1)
    assert found.ln == pytest.approx(-math.log(factor), abs=3 * found.sigma)
    assert found.factor == math.exp(found.ln)
    assert 0.05 < found.sigma < 0.1


def test_the_scale_of_a_camera_like_real_ones_is_found(real):
    recording, true = real
    found = event_scale(kept(recording.events()), (0.2, 0.2))
    assert found.significant
    assert found.ln == pytest.approx(
        0.5 * math.log(true[0] * true[1] / 0.04), abs=3 * found.sigma)


def test_the_misfit_is_the_quality_of_the_method_on_these_macropixels(right):
    """On a small sensor all macropixels are kept; here they are chosen by hand."""
    events = right.events()
    misfit = events_alone._misfit_of(kept(events), NOMINAL)
    n = len(misfit._on[0]) // 2
    assert n > events_alone._LEAST_CELLS
    method = EventRedundancy(SIZE, theta_on=0.16, theta_off=0.18)
    total, parts = np.zeros(36), 0
    last = events["t"][-1]
    first = int(misfit._parts[0]["t"][0])
    for part in np.split(events, np.searchsorted(
            events["t"], np.arange(first, last, 150_000)))[1:]:
        method.add_events(part)
        if parts:
            total += np.log(method.quality[::2, ::2].ravel())
        parts += 1
    found = misfit(0.0)
    assert len(found) == n
    for one in found:       # all of them see their events from the first one used on
        assert np.abs(total / (parts - 1) - one).min() < 0.05


def test_macropixels_that_leak_do_not_count(right):
    events = right.events()
    rng = np.random.default_rng(3)
    leaked = np.zeros(20_000, EVENT_DTYPE)
    leaked["t"] = np.sort(rng.integers(0, events["t"][-1], len(leaked)))
    leaked["x"], leaked["y"] = rng.integers(0, 12, len(leaked)), 2
    leaked["p"] = 1
    both = np.concatenate([events, leaked])
    both = both[np.argsort(both["t"], kind="stable")]
    others = events[(events["y"] != 2) & (events["y"] != 3)]
    assert event_scale(kept(both), NOMINAL) == event_scale(
        kept(others), NOMINAL)


def test_too_few_events_tell_nothing(right):
    events = right.events()
    assert event_scale(PixelSample(SIZE), NOMINAL) is None
    assert event_scale(kept(events[:2000]), NOMINAL) is None
    assert event_scale(kept(events[events["p"] == 1]), NOMINAL) is None
    assert event_scale(kept(events[events["x"] % 2 == 0]), NOMINAL) is None


def test_noise_tells_nothing():
    rng = np.random.default_rng(5)
    events = np.zeros(20_000, EVENT_DTYPE)
    events["t"] = np.sort(rng.integers(0, 10**6, len(events)))
    events["y"], events["x"] = rng.integers(0, 12, (2, len(events)))
    events["p"] = rng.integers(0, 2, len(events))
    assert event_scale(kept(events), NOMINAL) is None


@pytest.mark.parametrize("shape", [(1, 1), (1, 40), (3, 2), (7, 9)])
def test_sensors_too_small_tell_nothing(shape):
    rng = np.random.default_rng(0)
    events = np.zeros(3000, EVENT_DTYPE)
    events["t"] = np.sort(rng.integers(0, 10**6, len(events)))
    events["y"], events["x"] = (rng.integers(0, side, len(events)) for side in shape)
    events["p"] = rng.integers(0, 2, len(events))
    assert event_scale(kept(events, shape), NOMINAL) is None


def test_packets_do_not_matter(right):
    events = right.events()
    cut = PixelSample(SIZE)
    for part in np.array_split(events, 300):
        cut.add_events(part)
    assert event_scale(cut, NOMINAL) == event_scale(kept(events), NOMINAL)


def test_kalman_asks_events_where_frames_do_not_tell(real):
    """Of frames that are always the same, as those of light beyond full scale."""
    recording, true = real
    frames = [frame.replace(valid=np.zeros(SIZE, bool))
              for packet in recording.packets() for frame in packet.frames]
    blind = recording_from_arrays(recording.events(), frames, sensor_size=SIZE,
                                  layout=recording.info.layout)
    image, = fuse(blind, method="kalman", times_us=[1_000_000])
    off, on = image.provenance["parameters"]["model"].thresholds
    assert on == pytest.approx(true[0], rel=0.2)
    assert off == pytest.approx(true[1], rel=0.25)


@pytest.mark.parametrize("causal", [False, True])
def test_redundancy_finds_the_degree_of_a_camera_like_real_ones(real, causal):
    recording, true = real
    errors = []
    for stated in (None, (0.2, 0.2), true):
        image, = fuse(recording, FusionOptions(
            method="events", thresholds=stated, causal=causal, demosaic="superpixel",
            times_us=[1_400_000]), offsets="redundancy")
        errors.append(np.abs(image.dolp - 1).mean())
        used = float(np.mean(image.provenance["parameters"]["theta_on"]))
        if stated is None:
            assert used == pytest.approx(true[0], rel=0.2)
    learned, nominal, exact = errors
    assert learned < 0.5 * nominal
    assert learned < exact + 0.1


def test_a_method_continues_with_other_thresholds(right):
    events = right.events()
    half = len(events) // 2
    method = EventRedundancy(SIZE, theta_on=0.1, theta_off=0.12)
    method.add_events(events[:half])
    before = method._states.copy()
    method.retune(theta_on=0.2)
    assert method.parameters["theta_on"] == 0.2
    assert method.parameters["theta_off"] == 0.12
    np.testing.assert_array_equal(method._states["theta_on"], 2 * before["theta_on"])
    for name in ("base", "theta_off", "prior_off"):
        np.testing.assert_array_equal(method._states[name], before[name])
    other = EventRedundancy(SIZE, **method.parameters)
    other.restore(method.snapshot())
    third = EventRedundancy(SIZE, theta_on=0.3, theta_off=0.3)
    third.assign(method)
    for one in (method, other, third):
        one.add_events(events[half:])
        one.settle(1_300_000)
    expected = method.read(1_250_000)
    for one in (other, third):
        got = one.read(1_250_000)
        np.testing.assert_array_equal(got.log_intensity, expected.log_intensity)
    with pytest.raises(ValueError, match="theta_off must"):
        method.retune(theta_off=-1.0)
    with pytest.raises(TypeError, match=r"retune takes theta_on.*got noise"):
        method.retune(noise=1.0)


@pytest.mark.gate
@pytest.mark.parametrize("causal", [False, True])
def test_saturated_light_before_a_camera_like_real_ones(causal):
    """Frames say nothing of thresholds that are half as large again as stated."""
    camera = Camera.preset("davis346", seed=54, size=SIZE)
    recording, _ = camera.record(scene(rpm=60.8, s0=27 * 41.0), 1.6)
    errors = [np.mean([np.abs(image.dolp - 1).mean() for image in fuse(
        recording, FusionOptions(
            method="kalman", causal=causal, thresholds=stated, demosaic="superpixel",
            times_us=np.arange(1_250_000, 1_550_000, 50_000).tolist()))])
        for stated in (None, (0.2, 0.2))]
    assert errors[0] < 0.6 * errors[1]
    assert errors[0] < 0.15
