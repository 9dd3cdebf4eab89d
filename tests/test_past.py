"""What causal images learn from the past, and that they learn from it alone."""
import pickle

import numpy as np
import pytest

from pdavis_cv import Calibration, fuse, recording_from_arrays
from pdavis_cv.analysis import Scorer
from pdavis_cv.calibration import bandwidth_in_situ
from pdavis_cv.calibration.past import LOOKS_S, Past
from pdavis_cv.fusion import Fusion
from pdavis_cv.reconstruct.kalman import NOISE
from pdavis_cv.selfcal import TYPICAL_BANDWIDTH
from pdavis_cv.simulation import Camera, RotatingPolarizer

NOMINAL = (0.16, 0.18)
OPTIONS = {"method": "kalman", "causal": True, "nominal_thresholds": NOMINAL,
           "demosaic": "superpixel"}


@pytest.fixture(scope="module")
def realistic():
    """A camera whose pixels are as fast as their light is bright, and the truth."""
    camera = Camera.preset("realistic", seed=4, size=(8, 8))
    return camera.record(RotatingPolarizer(rpm=202.6, start_angle=0.3), 1.8)


def cut(recording, stop_us):
    """What had arrived by stop_us."""
    events = recording.events()
    frames = [frame for packet in recording.packets() for frame in packet.frames]
    return recording_from_arrays(
        events[events["t"] <= stop_us],
        [frame for frame in frames if frame.available_us <= stop_us],
        sensor_size=recording.info.sensor_size, layout=recording.info.layout)


def past(recording, **parameters):
    return Past(recording, NOMINAL, None, {"bandwidth": "in-situ", **parameters})


def test_the_law_is_found_from_the_past(realistic):
    recording, _ = realistic
    learned = past(recording)
    assert learned.parameters_at(400_000)["bandwidth"] == TYPICAL_BANDWIDTH
    hz, slope, sigma = learned.parameters_at(1_500_000)["bandwidth"]
    assert (hz + slope * 20) == pytest.approx(0.42 * 20 * 20, rel=0.1)
    assert hz < 30
    assert sigma < 0.2


def test_a_calibration_s_bandwidth_holds_until_the_past_tells_more(realistic):
    recording, _ = realistic
    known = Calibration(sensor_size=(8, 8), bandwidth_hz_per_dn=10.0,
                        bandwidth_sigma=0.1)
    learned = Past(recording, NOMINAL, known, {"bandwidth": "in-situ"})
    assert learned.parameters_at(400_000)["bandwidth"] == (0.0, 10.0, 0.1)
    hz, slope, sigma = learned.parameters_at(1_500_000)["bandwidth"]
    alone = past(recording).parameters_at(1_500_000)["bandwidth"]
    assert (alone[0] + alone[1]) < hz + slope < 10.0
    assert sigma < min(0.1, alone[2])


def test_what_holds_does_not_depend_on_the_order_of_questions(realistic):
    recording, _ = realistic
    times = [1_700_000, 100_000, 900_000, 1_100_000, 530_000]
    one, other = past(recording), past(recording)
    late_first = {t: one.parameters_at(t) for t in times}
    assert late_first == {t: other.parameters_at(t) for t in sorted(times)}
    assert one.parameters_at(1_100_000) is one.parameters_at(1_900_000)


def test_nothing_later_is_looked_at(realistic):
    recording, _ = realistic
    start = Fusion(recording, **OPTIONS).start_us
    for seconds in LOOKS_S[:2]:
        t = start + int(seconds * 1e6)
        assert past(recording).parameters_at(t) == past(
            cut(recording, t)).parameters_at(t)


def test_what_is_given_stays(realistic):
    recording, _ = realistic
    noise = (0.03, 0.2, 0.001)
    given = past(recording, bandwidth=(200.0, 1.0), noise=noise)
    assert given.parameters_at(1_700_000) is given.parameters_at(0)
    assert given.parameters_at(0) == {"bandwidth": (200.0, 1.0), "noise": noise}
    unset = past(recording, bandwidth=None)
    assert unset.parameters_at(1_700_000)["bandwidth"] is None


def test_noise_of_events_is_learned_too(realistic):
    recording, _ = realistic
    rng = np.random.default_rng(1)
    events = recording.events()
    more = np.zeros(10 * 64 * 2, events.dtype)
    more["t"] = rng.integers(0, 1_800_000, len(more))
    more["y"], more["x"] = rng.integers(0, 8, (2, len(more)))
    more["p"] = rng.integers(0, 2, len(more))
    events = np.concatenate([events, more])
    noisy = recording_from_arrays(
        events[np.argsort(events["t"], kind="stable")],
        [frame for packet in recording.packets() for frame in packet.frames],
        sensor_size=(8, 8), layout=recording.info.layout)
    sigma, per_s, per_event = past(noisy).parameters_at(1_700_000)["noise"]
    assert (sigma, per_event) == (NOISE[0], NOISE[2])
    assert per_s > 10 * NOISE[1]


def test_without_frames_or_change_the_usual_bandwidth_stays():
    still, _ = Camera.preset("nominal", seed=3, size=(6, 6)).record(
        RotatingPolarizer(rpm=0.0), 1.2)
    assert past(still).parameters_at(1_100_000)["bandwidth"] == TYPICAL_BANDWIDTH
    blind = recording_from_arrays(None, sensor_size=(4, 4))
    assert past(blind).parameters_at(10**12)["bandwidth"] == TYPICAL_BANDWIDTH


def test_images_are_those_of_the_law_known_from_the_beginning(realistic):
    recording, truth = realistic
    times = np.arange(200_000, 1_700_000, 40_700)
    images = list(fuse(recording, times_us=times, **OPTIONS))
    last = images[-1].provenance["parameters"]["bandwidth"]
    assert images[0].provenance["parameters"]["bandwidth"] == TYPICAL_BANDWIDTH
    assert last[1] > 3
    given = {key: images[-1].provenance["parameters"][key]
             for key in ("bandwidth", "noise")}
    known = list(fuse(recording, times_us=times, **given, **OPTIONS))
    np.testing.assert_array_equal(images[-1].quad, known[-1].quad)

    def error(bandwidth=None):
        scorer = Scorer(truth, (4, 4))
        options = {**OPTIONS, **({"bandwidth": bandwidth} if bandwidth else {})}
        for image in fuse(recording, times_us=np.arange(
                1_000_000, 1_700_000, 7_019), **options):
            scorer.add(image)
        return np.degrees(scorer.score.aop_error), scorer.score.aop_coverage

    aop, coverage = error()
    assert aop < 0.5 * error(TYPICAL_BANDWIDTH)[0]
    assert 0.5 < coverage < 0.85
    assert bandwidth_in_situ(recording, nominal=NOMINAL).hz_per_intensity == (
        pytest.approx(last[1], rel=0.15))


def test_seeks_and_snapshots_across_a_look_give_the_same_images(realistic):
    recording, _ = realistic
    times = np.arange(200_000, 1_700_000, 61_003)
    fusion = Fusion(recording, times_us=times, **OPTIONS)
    whole, marks = [], []
    for image in fusion:
        marks.append(pickle.loads(pickle.dumps(fusion.snapshot())))
        whole.append(image)
    other = Fusion(recording, times_us=times, **OPTIONS)
    for i in np.random.default_rng(2).integers(0, len(marks) - 6, 8):
        other.restore(marks[i])
        np.testing.assert_array_equal(other.image().quad, whole[i].quad)
        for k in range(i + 1, i + 5):
            image = next(other)
            np.testing.assert_array_equal(image.quad, whole[k].quad)
            assert image.provenance["parameters"]["bandwidth"] == (
                whole[k].provenance["parameters"]["bandwidth"])
    other.rewind()
    np.testing.assert_array_equal(next(other).quad, whole[0].quad)
    alone = next(Fusion(recording, times_us=times[-1:], **OPTIONS))
    np.testing.assert_array_equal(alone.quad, whole[-1].quad)
