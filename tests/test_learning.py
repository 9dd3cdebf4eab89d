"""What is learned of a camera: from a beginning, or while the stream passes."""
import pickle
import threading
import weakref

import numpy as np
import pytest
from truth_errors import errors_of

from pdavis_cv import Calibration, FusionOptions, fuse, recording_from_arrays
from pdavis_cv.fusion import Fusion, learning
from pdavis_cv.fusion.learning import Learned, Learning
from pdavis_cv.fusion.online_learning import FIRST_LOOK_S, OnlineLearning
from pdavis_cv.pixel.learn import LearnedPixels
from pdavis_cv.pixel.model import PixelModel
from pdavis_cv.reconstruct.kalman import KalmanFilter
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
    """Return the model at t_us, learned as the recording passes."""
    image, = fuse(recording, times_us=[t_us], **OPTIONS, **options)
    return image.provenance["parameters"]["model"]


def test_thresholds_are_learned_as_the_stream_passes(realistic):
    """Stated too low by half; after the first look they are right."""
    recording, _ = realistic
    options = {**OPTIONS, "nominal_thresholds": (0.08, 0.09)}
    start = Fusion(recording, **options).start_us
    images = fuse(recording, times_us=[start + 100_000, 1_500_000], **options)
    before, after = (image.provenance["parameters"]["model"] for image in images)
    np.testing.assert_allclose(before.theta, [0.09, 0.08])
    np.testing.assert_allclose(after.thresholds, [0.18, 0.16], rtol=0.15)
    assert np.all(np.sqrt(np.diag(after.theta_cov)) < 0.1 * after.theta)


@pytest.mark.gate
def test_a_calibration_s_bandwidth_is_kept(realistic):
    recording, _ = realistic
    known = Calibration(sensor_size=(8, 8), bandwidth_hz_per_dn=10.0)
    for t in (400_000, 1_500_000):
        assert in_force(recording, t, calibration=known).bandwidth == (0.0, 10.0)


def test_nothing_later_is_looked_at(realistic):
    recording, _ = realistic
    start = Fusion(recording, **OPTIONS).start_us
    for seconds in (FIRST_LOOK_S, 2 * FIRST_LOOK_S):
        t = start + int(seconds * 1e6)
        assert in_force(recording, t) == in_force(cut(recording, t), t)


def test_what_is_given_stays(realistic):
    recording, _ = realistic
    given = PixelModel(theta=np.array([0.2, 0.25]))
    assert in_force(recording, 1_700_000, model=given) is given


def test_without_frames_or_change_what_was_stated_stays():
    still, _ = Camera.preset("nominal", seed=3, size=(6, 6)).record(
        RotatingPolarizer(rpm=0.0), 1.2)
    np.testing.assert_allclose(in_force(still, 1_100_000).theta, NOMINAL[::-1])
    blind = recording_from_arrays(None, sensor_size=(4, 4),
                                  layout=still.info.layout)
    np.testing.assert_allclose(in_force(blind, 10**9).theta, NOMINAL[::-1])


@pytest.mark.gate
def test_the_state_goes_on_with_what_is_learned(realistic):
    """Images soon are what the model known from the beginning gives, and as right."""
    recording, truth = realistic
    options = {**OPTIONS, "nominal_thresholds": (0.1, 0.11)}
    times = np.arange(200_000, 1_700_000, 40_700)
    images = list(fuse(recording, times_us=times, **options))
    learned = images[-1].provenance["parameters"]["model"]
    known = list(fuse(recording, times_us=times, model=learned, **options))
    apart = np.array([np.sqrt(np.mean(np.angle(np.exp(2j * (a.aop - b.aop))) ** 2)) / 2
                      for a, b in zip(images, known, strict=True)])
    before, long_after = apart[times < 500_000], apart[times > 1_300_000]
    assert long_after.mean() < 0.5 * before.mean()
    assert np.degrees(long_after.mean()) < 1.0

    def error(**given):
        # What the look at .8 s tells holds from .9 s on, that at 1.13 s from 1.27 s.
        return errors_of(fuse(recording, times_us=np.arange(
            1_150_000, 1_700_000, 7_019), **options, **given), truth).aop

    assert error() < 1.6 * error(model=learned)
    assert error() < error(model=images[0].provenance["parameters"]["model"])


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
            assert image.provenance["parameters"]["model"] == (
                whole[k].provenance["parameters"]["model"])
    other.rewind()
    np.testing.assert_array_equal(next(other).quad, whole[0].quad)
    alone = next(Fusion(recording, times_us=times[-1:], **OPTIONS))
    np.testing.assert_array_equal(alone.quad, whole[-1].quad)


# ---- from a beginning ------------------------------------------------------------


def counted(monkeypatch):
    """Return a list that grows by one for each estimate that is made."""
    made = []
    estimate = Learning.estimate
    monkeypatch.setattr(Learning, "estimate", lambda self, *given: (
        made.append(1), estimate(self, *given))[1])
    return made


@pytest.mark.gate
def test_a_beginning_is_looked_at_once_per_recording_and_question(
        realistic, monkeypatch):
    recording = cut(realistic[0], 800_000)
    made = counted(monkeypatch)
    options = {"times_us": [400_000], "nominal_thresholds": NOMINAL}
    one, = fuse(recording, **options)
    two, = fuse(recording, method="kalman", **options)
    assert len(made) == 1
    assert one.provenance["parameters"]["model"] is (
        two.provenance["parameters"]["model"])
    list(fuse(recording, **{**options, "nominal_thresholds": (0.2, 0.2)}))
    list(fuse(recording, method="cf", thresholds="in-situ", **options))
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
def test_cf_learns_thresholds_as_the_stream_passes():
    """Stated too low by half."""
    made, _ = Camera.preset("nominal", seed=4, size=(8, 8)).record(
        RotatingPolarizer(rpm=202.6, start_angle=0.3), 1.2)
    fusion = Fusion(made, method="cf", causal=True, thresholds="in-situ",
                    nominal_thresholds=(0.08, 0.09), times_us=[1_150_000])
    next(fusion)
    found = fusion._state.method.parameters["theta_on"]
    assert np.mean(found) == pytest.approx(0.16, rel=0.1)


def test_what_was_learned_stays_where_frames_say_nothing(realistic):
    recording, _ = realistic
    learning = Learning(recording, FusionOptions(causal=True), {}, KalmanFilter.needs)

    def looked(us, theta, told=False):
        return Learned(pixels=LearnedPixels(
            model=PixelModel(theta=np.array(theta)), clock_offset_us=us, told=told,
            gains=np.zeros((2, 0))))

    early = learning.tuned(learning.prior, looked(3000.4, (0.2, 0.3)))
    assert (early.clock_us, *early.parameters["model"].theta) == (3000, 0.2, 0.3)
    still = learning.tuned(early, looked(0.0, (0.1, 0.1), told=True))
    assert (still.clock_us, *still.parameters["model"].theta) == (3000, 0.2, 0.3)
    late = learning.tuned(still, looked(2000.0, (0.25, 0.3)))
    assert (late.clock_us, *late.parameters["model"].theta) == (2000, 0.25, 0.3)


@pytest.mark.parametrize(("stated", "used"), [
    (None, (0, 0)), (0.1, (0.1, 0.1)), (0.98, (0.5, 0.98))])
def test_no_bandwidth_is_less_known_than_that_of_any_camera(realistic, stated, used):
    recording, _ = realistic
    learning = Learning(recording, FusionOptions(calibration=Calibration(
        sensor_size=recording.info.sensor_size, bandwidth_hz=250.0,
        bandwidth_sigma=stated)), {}, KalmanFilter.needs)
    assert learning._priors.bandwidth == (250, 0)
    assert learning._priors.bandwidth_sigma == used


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
    assert times == [1_100_000, 1_112_500, 1_141_421, 1_159_099, 1_200_000, 1_225_000,
                     1_282_843, 1_318_198]
    late = OnlineLearning(online._learning)
    late.begin(1_000_000, 1_700_000)         # it took long to arrive
    assert late.next_us == 1_800_000


def test_a_late_estimate_is_waited_for_or_asked_for_again(realistic, monkeypatch):
    recording, _ = realistic
    learning = Learning(
        recording, FusionOptions(causal=True), {}, KalmanFilter.needs)
    done, estimate = threading.Event(), learning.estimate

    def late(*given):
        assert done.wait(60)
        return estimate(*given)

    monkeypatch.setattr(learning, "estimate", late)
    live = OnlineLearning(learning, waits=False)
    live.begin(1_000_000, 1_010_000)
    assert live.look() == {}
    for number in range(30):
        assert live.next_us == 1_112_500 + 20_000 * number
        assert live.look() == {}
    waiting = OnlineLearning(learning)
    waiting.begin(1_000_000, 1_010_000)
    assert waiting.look() == {}
    threading.Timer(0.1, done.set).start()
    waiting.look()      # returns once the estimate is there
    assert done.is_set()
    assert waiting.next_us == 1_141_421
    assert live.next_us == 1_712_500
    live._pending.result(60)
    live.look()
    # What was to be looked at meanwhile, four times, is left to the next look.
    assert live.next_us == 1_800_000
    assert live._pending is None
