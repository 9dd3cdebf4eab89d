"""What is learned of a camera: from a beginning, or while the stream passes."""
import pickle
import threading
import weakref

import numpy as np
import pytest

from pdavis_cv import (
    Calibration,
    FusionOptions,
    bandwidth_in_situ,
    fuse,
    recording_from_arrays,
)
from pdavis_cv.analysis import Scorer
from pdavis_cv.fusion import Fusion, learning
from pdavis_cv.fusion.learning import Learning
from pdavis_cv.fusion.online_learning import FIRST_LOOK_S, OnlineLearning
from pdavis_cv.reconstruct.kalman import NOISE, KalmanFilter
from pdavis_cv.selfcal import TYPICAL_BANDWIDTH, CameraEstimate
from pdavis_cv.selfcal.priors import THRESHOLD_SIGMA
from pdavis_cv.selfcal.refractory import Refractory
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


def in_force(recording, t_us, **options):
    """Return the method's parameters at t_us, learned as the recording passes."""
    image, = fuse(recording, times_us=[t_us], **OPTIONS, **options)
    return image.provenance["parameters"]


def test_the_law_is_found_as_the_stream_passes(realistic):
    recording, _ = realistic
    assert in_force(recording, 400_000)["bandwidth"] == TYPICAL_BANDWIDTH
    hz, slope, sigma = in_force(recording, 1_500_000)["bandwidth"]
    assert (hz + slope * 20) == pytest.approx(0.42 * 20 * 20, rel=0.1)
    assert hz < 30
    assert sigma < 0.2


@pytest.mark.gate
def test_a_calibration_s_bandwidth_holds_until_the_stream_tells_more(realistic):
    recording, _ = realistic
    known = Calibration(sensor_size=(8, 8), bandwidth_hz_per_dn=10.0,
                        bandwidth_sigma=0.1)
    assert in_force(recording, 400_000, calibration=known)["bandwidth"] == (
        0.0, 10.0, 0.1)
    hz, slope, sigma = in_force(recording, 1_500_000, calibration=known)["bandwidth"]
    alone = in_force(recording, 1_500_000)["bandwidth"]
    assert min(alone[1], 10.0) < hz + slope < max(alone[1], 10.0)
    assert sigma < min(0.1, alone[2])


def test_nothing_later_is_looked_at(realistic):
    recording, _ = realistic
    start = Fusion(recording, **OPTIONS).start_us
    for seconds in (FIRST_LOOK_S, 2 * FIRST_LOOK_S):
        t = start + int(seconds * 1e6)
        whole, past = in_force(recording, t), in_force(cut(recording, t), t)
        assert whole["bandwidth"] == past["bandwidth"]
        assert whole["noise"] == past["noise"]


def test_what_is_given_stays(realistic):
    recording, _ = realistic
    noise = (0.03, 0.2, 0.001)
    given = in_force(recording, 1_700_000, bandwidth=(200.0, 1.0), noise=noise)
    assert given["bandwidth"][:2] == (200.0, 1.0)
    assert given["noise"][:3] == noise
    assert in_force(recording, 1_700_000, bandwidth=None)["bandwidth"][:2] == (0, 0)


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
    sigma, per_s, per_event, _ = in_force(noisy, 1_700_000)["noise"]
    assert (sigma, per_event) == (NOISE[0], NOISE[2])
    assert per_s > 10 * NOISE[1]


def test_without_frames_or_change_the_usual_bandwidth_stays():
    still, _ = Camera.preset("nominal", seed=3, size=(6, 6)).record(
        RotatingPolarizer(rpm=0.0), 1.2)
    assert in_force(still, 1_100_000)["bandwidth"] == TYPICAL_BANDWIDTH
    blind = recording_from_arrays(None, sensor_size=(4, 4),
                                  layout=still.info.layout)
    assert in_force(blind, 10**9)["bandwidth"] == TYPICAL_BANDWIDTH


@pytest.mark.gate
def test_the_state_goes_on_with_what_is_learned(realistic):
    """Images soon are what the law known from the beginning gives, and as right."""
    recording, truth = realistic
    times = np.arange(200_000, 1_700_000, 40_700)
    images = list(fuse(recording, times_us=times, **OPTIONS))
    learned = images[-1].provenance["parameters"]
    assert images[0].provenance["parameters"]["bandwidth"] == TYPICAL_BANDWIDTH
    assert learned["bandwidth"][1] > 3
    given = {key: learned[key] for key in ("bandwidth", "noise")}
    known = list(fuse(recording, times_us=times, **given, **OPTIONS))
    apart = np.array([np.sqrt(np.mean(np.angle(np.exp(2j * (a.aop - b.aop))) ** 2)) / 2
                      for a, b in zip(images, known, strict=True)])
    before, long_after = apart[times < 500_000], apart[times > 1_300_000]
    assert long_after.mean() < 0.3 * before.mean()
    assert np.degrees(long_after.mean()) < 0.8

    def error(bandwidth=None):
        scorer = Scorer(truth, (4, 4))
        options = {**OPTIONS, **({"bandwidth": bandwidth} if bandwidth else {})}
        # What the second look tells holds an eighth after 1 s.
        for image in fuse(recording, times_us=np.arange(
                1_150_000, 1_700_000, 7_019), **options):
            scorer.add(image)
        return np.degrees(scorer.score.aop_error), scorer.score.aop_coverage

    aop, coverage = error()
    assert aop < 0.5 * error(TYPICAL_BANDWIDTH)[0]
    assert aop < 1.1 * error(learned["bandwidth"])[0]
    assert 0.5 < coverage < 0.85
    assert bandwidth_in_situ(recording, nominal=NOMINAL).hz_per_intensity == (
        pytest.approx(learned["bandwidth"][1], rel=0.15))


@pytest.mark.gate
def test_seeks_and_snapshots_across_a_look_give_the_same_images(realistic):
    recording, _ = realistic
    times = np.arange(200_000, 1_700_000, 61_003)
    fusion = Fusion(recording, times_us=times, **OPTIONS)
    whole, marks = [], []
    for image in fusion:
        marks.append(pickle.loads(pickle.dumps(fusion.snapshot())))
        whole.append(image)
    other = Fusion(recording, times_us=times, **OPTIONS)
    for i in np.random.default_rng(2).integers(0, len(marks) - 6, 4):
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


# ---- from a beginning ------------------------------------------------------------


def counted(monkeypatch):
    """Return a list that grows by one for each estimate that is made."""
    made = []
    estimate = Learning.estimate
    monkeypatch.setattr(Learning, "estimate", lambda self, camera: (
        made.append(1), estimate(self, camera))[1])
    return made


def test_a_beginning_is_looked_at_once_per_recording_and_question(
        realistic, monkeypatch):
    recording = cut(realistic[0], 800_000)
    made = counted(monkeypatch)
    options = {"times_us": [400_000], "nominal_thresholds": NOMINAL}
    one, = fuse(recording, **options)
    two, = fuse(recording, method="kalman", mode="offline", **options)
    assert len(made) == 1
    assert one.provenance["parameters"]["bandwidth"] == (
        two.provenance["parameters"]["bandwidth"])
    list(fuse(recording, **{**options, "nominal_thresholds": (0.2, 0.2)}))
    list(fuse(recording, thresholds="in-situ", **options))
    list(fuse(recording, calibration=Calibration(sensor_size=(8, 8)), **options))
    assert len(made) == 4


def test_what_is_kept_of_a_recording_goes_with_it(realistic):
    recording = cut(realistic[0], 700_000)
    list(fuse(recording, times_us=[300_000]))
    assert recording in learning._kept
    gone = weakref.ref(recording)
    del recording
    assert gone() is None


def test_nothing_is_read_or_learned_before_the_first_image(realistic, monkeypatch):
    recording = cut(realistic[0], 800_000)
    made = counted(monkeypatch)
    read = []
    packets = type(recording).packets
    monkeypatch.setattr(type(recording), "packets", lambda self, *a, **k: (
        read.append(1), packets(self, *a, **k))[1])
    images = fuse(recording, fps=100)
    assert (made, read) == ([], [])
    next(images)
    assert (len(made), len(read)) == (1, 2)


@pytest.mark.gate
def test_each_pixel_s_uncertainty_reaches_the_filter(realistic):
    recording, _ = realistic
    image, = fuse(recording, times_us=[900_000], thresholds="in-situ",
                  nominal_thresholds=NOMINAL)
    sigma = image.provenance["parameters"]["threshold_sigma"]
    assert sigma.shape == (2, 8, 8)
    assert np.ptp(sigma) > 0
    plane = np.full((8, 8), 0.17, np.float32)
    spread = np.linspace(0.001, 0.01, 64, dtype=np.float32).reshape(8, 8)
    known = Calibration(sensor_size=(8, 8), theta_on=plane, theta_off=plane,
                        theta_on_sigma=spread, theta_off_sigma=2 * spread)
    image, = fuse(recording, times_us=[900_000], calibration=known, roi=(2, 4, 2, 2),
                  demosaic="superpixel")
    sigma = image.provenance["parameters"]["threshold_sigma"]
    np.testing.assert_allclose(sigma[1], np.sqrt(8) * spread, rtol=1e-6)


def test_cf_learns_thresholds_as_the_stream_passes():
    """Stated too low by half.  cf has no bandwidth, which is learned with them."""
    made, _ = Camera.preset("nominal", seed=4, size=(8, 8)).record(
        RotatingPolarizer(rpm=202.6, start_angle=0.3), 1.2)
    fusion = Fusion(made, method="cf", causal=True, thresholds="in-situ",
                    nominal_thresholds=(0.08, 0.09), times_us=[1_150_000])
    next(fusion)
    found = fusion._state.method.parameters["theta_on"]
    assert found.mean() == pytest.approx(0.16, rel=0.1)


@pytest.mark.parametrize("told", [
    {"nominal_sigma": 0.05}, {"refractory": Refractory(1000.0, 30.0)}, {}])
def test_thresholds_that_a_later_look_denies_are_given_back(realistic, told):
    """With a refractory period that was not known, a scale was of another camera."""
    recording, _ = realistic
    learning = Learning(recording, FusionOptions(
        method="kalman", causal=True, nominal_thresholds=NOMINAL), {},
        KalmanFilter.needs)
    on, off = (np.full((8, 8), theta) for theta in NOMINAL)
    early = learning.tuned(learning.prior, CameraEstimate(
        theta_on=0.5 * on, theta_off=0.6 * off, common_scale_sigma=0.04))
    assert np.all(early.theta_on == np.float32(0.08))
    late = learning.tuned(early, CameraEstimate(theta_on=on, theta_off=off, **told))
    assert late.has_thresholds_of(learning.prior if told else early)
    changes = late.changes(early)
    assert ("theta_on" in changes) == ("threshold_sigma" in changes) == bool(told)
    if "nominal_sigma" in told:     # with the prior of the pixels' spread, .1
        np.testing.assert_allclose(changes["threshold_sigma"], np.sqrt(
            0.1**2 + 2 * 0.05**2) * np.stack([on, off]))
    elif told:
        assert changes["threshold_sigma"] == THRESHOLD_SIGMA
    if told:
        again = learning.tuned(late, CameraEstimate(theta_on=on, theta_off=off, **told))
        assert not again.changes(late)


def test_the_stream_is_looked_at_ever_more_rarely(realistic):
    recording, _ = realistic
    online = OnlineLearning(Learning(
        recording, FusionOptions(causal=True), {}, KalmanFilter.needs))
    online.begin(1_000_000, 1_010_000)
    times = []
    for _ in range(8):
        times.append(online.next_us)
        again = OnlineLearning(online._learning)
        again.restore(online.state())
        assert again.look() == online.look()
        assert again.next_us == online.next_us
    # Each estimate is gone on with after an eighth of the time more.
    assert times == [1_500_000, 1_562_500, 2_000_000, 2_125_000, 3_000_000, 3_250_000,
                     5_000_000, 5_500_000]
    late = OnlineLearning(online._learning)
    late.begin(1_000_000, 1_700_000)         # it took long to arrive
    assert late.next_us == 2_000_000


def test_a_late_estimate_is_waited_for_or_asked_for_again(realistic, monkeypatch):
    recording, _ = realistic
    learning = Learning(
        recording, FusionOptions(causal=True), {}, KalmanFilter.needs)
    done, estimate = threading.Event(), learning.estimate

    def late(camera):
        assert done.wait(60)
        return estimate(camera)

    monkeypatch.setattr(learning, "estimate", late)
    live = OnlineLearning(learning, waits=False)
    live.begin(1_000_000, 1_010_000)
    assert live.look() == {}
    for number in range(30):
        assert live.next_us == 1_562_500 + 20_000 * number
        assert live.look() == {}
    waiting = OnlineLearning(learning)
    waiting.begin(1_000_000, 1_010_000)
    assert waiting.look() == {}
    threading.Timer(0.1, done.set).start()
    waiting.look()      # returns once the estimate is there
    assert done.is_set()
    assert waiting.next_us == 2_000_000
    assert live.next_us == 2_162_500
    live._pending.result(60)
    live.look()
    # What was to be looked at meanwhile, at 2 s, is left to the look after it.
    assert live.next_us == 3_000_000
    assert live._pending is None
