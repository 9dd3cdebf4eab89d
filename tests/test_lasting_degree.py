"""The degree of polarization that lasts, weighed in the images of the Kalman filter."""
import numpy as np
import pytest
from reference_degree import Reference, cells
from truth_errors import errors_of

from pdavis_cv import _kernels, fuse
from pdavis_cv._workers import Workers
from pdavis_cv.analyser import Analyser
from pdavis_cv.reconstruct.kalman import lasting_degree
from pdavis_cv.reconstruct.kalman.lasting_degree import LastingDegree
from pdavis_cv.simulation import Camera, RotatingPolarizer

ANGLES = np.deg2rad([[0.0, 45.0], [135.0, 90.0]])



def response_of(shape, seed=None):
    """Ideal polarizers, or such as differ from them."""
    angle = np.tile(ANGLES, [-(-side // 2) for side in shape])[:shape[0], :shape[1]]
    gain = purity = np.ones(shape)
    if seed is not None:
        rng = np.random.default_rng(seed)
        angle = angle + rng.normal(0, 0.05, shape)
        gain, purity = rng.uniform(0.9, 1.1, shape), rng.uniform(0.8, 1, shape)
    return np.stack([gain, gain * purity * np.cos(2 * angle),
                     gain * purity * np.sin(2 * angle)], -1) / 2


def light_of(response, angle=0.4, degree=0.6, total=80.0):
    stokes = total * np.stack(np.broadcast_arrays(
        1.0, degree * np.cos(2 * angle), degree * np.sin(2 * angle)), -1)
    return np.log((response * stokes).sum(-1))


def stokes_of(log, response):
    solution = np.linalg.pinv(cells(response))
    return np.einsum("yxjk,yxk->yxj", solution, np.exp(cells(log)))


def fed(method, response, frames=12, error=0.02, seed=1, **light):
    """Feed frames of light whose angle turns."""
    rng = np.random.default_rng(seed)
    for i in range(frames):
        log = light_of(response, angle=0.3 * i, **light)
        method.add_frame(
            (log + rng.normal(0, error, log.shape)).astype(np.float32))
    return method


def shown(shape, variance=0.01):
    return np.full(shape, variance, np.float32), np.ones(shape, np.uint8)


def weigh(method, log, variance, valid, workers=None):
    """Weigh the degree of an image of log intensities, in place."""
    light = np.exp(log)
    before = light.copy()
    method.weigh(light, variance, valid, workers or Workers(1))
    log[light != before] = np.log(light[light != before])


@pytest.mark.parametrize(("given", "shape"), [
    (None, (6, 8)), ("cell", (6, 8)), ("pixels", (6, 8)), ("pixels", (7, 131)),
    (None, (5, 139)), (None, (2, 2)), (None, (1, 5))])
def test_it_equals_its_twin(given, shape):
    response = response_of(shape, seed=3 if given == "pixels" else None)
    if given == "cell":
        response = np.tile(response_of((2, 2), seed=4), (3, 4, 1))
    method = LastingDegree(shape, {
        None: None, "cell": response[:2, :2], "pixels": response}[given])
    twin = Reference(
        response, lasting_degree.FRAMES, lasting_degree.LATE_FRAMES,
        lasting_degree.FIRST_ERROR, lasting_degree.SURE)
    rng = np.random.default_rng(5)
    for i in range(9):
        log = light_of(response, angle=0.3 * i) + rng.normal(0, 0.03, shape)
        log[rng.random(shape) < 0.02] = np.nan
        method.add_frame(log.astype(np.float32))
        twin.add_frame(log.astype(np.float32).astype(float))
    for found, expected in zip(method.state()["lasting"], twin.lasting(), strict=True):
        np.testing.assert_allclose(found, expected, rtol=2e-3, atol=2e-5)
    log = (light_of(response) + rng.normal(0, 0.1, shape)).astype(np.float32)
    variance = rng.uniform(0.001, 0.02, shape).astype(np.float32)
    valid = (rng.random(shape) < 0.97).astype(np.uint8)
    expected = twin.weigh(log.astype(float), variance.astype(float), valid)
    before = log.copy()
    weigh(method, log, variance, valid)
    np.testing.assert_allclose(log, expected, atol=2e-4)
    used = cells(valid).all(-1) & (method.state()["lasting"][2] > 0)
    np.testing.assert_array_equal(cells(log)[~used], cells(before)[~used])
    if min(shape) > 2:
        assert np.abs(log - before).max() > 0.01
    odd = [side // 2 * 2 for side in shape]
    np.testing.assert_array_equal(log[odd[0]:], before[odd[0]:])
    np.testing.assert_array_equal(log[:, odd[1]:], before[:, odd[1]:])


def test_the_angle_and_the_total_remain_and_the_degree_approaches_the_one_that_lasts():
    shape = 12, 16
    response = response_of(shape)
    method = fed(LastingDegree(shape, None), response)
    # A wrong degree, in light that is consistent: redundancy has nothing to correct.
    log = light_of(response, degree=0.5).astype(np.float32)
    before = stokes_of(log.astype(float), response)
    variance, valid = shown(shape)
    weigh(method, log, variance, valid)
    after = stokes_of(log.astype(float), response)
    np.testing.assert_allclose(after[..., 0], before[..., 0], rtol=1e-5)
    np.testing.assert_allclose(np.arctan2(after[..., 2], after[..., 1]),
                               np.arctan2(before[..., 2], before[..., 1]), atol=1e-5)
    degree = np.hypot(after[..., 1], after[..., 2]) / after[..., 0]
    assert np.all((degree > 0.55) & (degree < 0.61))


@pytest.mark.parametrize(
    "case", ["unpolarized", "changing", "few frames", "sure image"])
def test_images_stay_as_they_are(case):
    shape = 12, 16
    response = response_of(shape)
    method = LastingDegree(shape, None)
    if case == "changing":
        for i in range(12):
            method.add_frame(light_of(
                response, degree=0.3 + 0.4 * (i % 2)).astype(np.float32))
    else:
        fed(method, response, frames=1 if case == "few frames" else 12,
            degree=0.01 if case == "unpolarized" else 0.6)
    log = light_of(response, degree=0.5).astype(np.float32)
    variance, valid = shown(shape, 1e-9 if case == "sure image" else 0.01)
    before = log.copy()
    weigh(method, log, variance, valid)
    np.testing.assert_allclose(
        log, before, rtol=0, atol=1e-4 if case == "sure image" else 0)


def test_a_change_of_the_degree_counts_at_once_and_is_then_followed():
    shape = 12, 16
    response = response_of(shape)
    method = fed(LastingDegree(shape, None), response, degree=0.6)
    assert method.state()["lasting"][2].min() > 0.5
    log = light_of(response, degree=0.3).astype(np.float32)
    method.add_frame(log)
    assert method.state()["lasting"][2].max() == 0      # not used any more
    fed(method, response, frames=60, degree=0.3, error=0.01)
    degree, _, share = method.state()["lasting"]
    np.testing.assert_allclose(degree, 0.3, atol=0.03)
    assert share.min() > 0.4


def test_it_is_the_mean_weighted_by_the_inverse_variances():
    shape = 20, 20
    response = response_of(shape)
    rng = np.random.default_rng(7)
    method = fed(LastingDegree(shape, None), response, frames=40)
    spread = method.state()["lasting"][1].mean()
    # Malus' law: the scatter of the degree that an error of the logs causes.
    sigma = 0.02
    single, weighed = [], []
    for _ in range(40):
        log = (light_of(response) + rng.normal(0, sigma, shape)).astype(np.float32)
        variance, valid = shown(shape, sigma**2)
        single.append(stokes_of(log.astype(float), response))
        weigh(method, log, variance, valid)
        weighed.append(stokes_of(log.astype(float), response))
    own, mean = (np.hypot(s[..., 1], s[..., 2]) / s[..., 0] for s in (
        np.array(single), np.array(weighed)))
    # A tenth of the error with which a mean of 10 predicts one frame; more where the
    # last two frames happen to show a larger one.
    frames = lasting_degree.FRAMES
    least = (own.var(0).mean() * (1 + 1 / frames) + (
        lasting_degree.FIRST_ERROR**2 / (9 * frames + 1))) / frames
    assert least < spread < 1.8 * least
    # The mean with gain 1/10 errs by less: 1 / (2 10 - 1) of the frame's variance.
    error = np.mean((method.state()["lasting"][0] - 0.6)**2)
    assert error < spread
    # The error that an image makes itself shrinks by the weight of what lasts.
    weight = method.state()["lasting"][2].mean() * own.var(0).mean() / (
        spread + own.var(0).mean())
    assert mean.std(0).mean() / own.std(0).mean() == pytest.approx(1 - weight, abs=0.1)


def test_a_degree_that_drifts_is_as_uncertain_as_its_mean_lags_behind():
    shape = 20, 20
    response = response_of(shape)
    method, rng = LastingDegree(shape, None), np.random.default_rng(8)
    for degree in np.linspace(0.3, 0.8, 40):
        log = light_of(response, degree=degree)
        method.add_frame((log + rng.normal(0, 0.01, shape)).astype(np.float32))
    mean, variance, _ = method.state()["lasting"]
    lag = np.mean(0.8 - mean)
    assert 0.08 < lag < 0.15
    assert 0.8 * lag < np.sqrt(variance.mean()) < 1.3 * lag


@pytest.mark.parametrize("pixels", [False, True])
def test_threads_change_nothing(pixels, monkeypatch):
    monkeypatch.setattr("pdavis_cv._workers.LEAST_BAND_NS", 0)      # share all there is
    shape = 160, 140
    response = response_of(shape, 3 if pixels else None)
    images = []
    for threads in (1, 2, 5):
        log = light_of(response, degree=0.5).astype(np.float32)
        variance, valid = shown(shape)
        workers = Workers(threads)
        method = fed(LastingDegree(shape, response if pixels else None), response)
        weigh(method, log, variance, valid, workers)
        assert (workers._pool is not None) == (threads > 1)
        images.append(log)
    np.testing.assert_array_equal(images[0], images[1])
    np.testing.assert_array_equal(images[0], images[2])


def test_its_state_is_kept_and_restored():
    shape = 6, 8
    response = response_of(shape)
    method = fed(LastingDegree(shape, None), response)
    kept, other = method.state(), LastingDegree(shape, None)
    fed(method, response, degree=0.2)
    other.restore(kept)
    method.restore(other.state())
    for name, value in kept.items():
        np.testing.assert_array_equal(method.state()[name], value)


@pytest.mark.parametrize(("change", "message"), [
    ({"lasting": np.zeros((2, 3, 4), np.float32)}, "lasting must be"),
    ({"lasting": np.zeros((3, 4, 4), np.float32)}, r"hold \(2 h, 2 w\)"),
    ({"analyser": np.zeros((23, 1, 1), np.float32)}, "analyser must be"),
    ({"analyser": np.zeros((24, 3, 5), np.float32)}, "analyser must be"),
    ({"shown": (np.zeros((6, 7), np.float32), *shown((6, 7)))}, r"hold \(2 h, 2 w\)"),
    ({"shown": (np.zeros((6, 8), np.float32), *shown((6, 9)))}, r"hold \(2 h, 2 w\)"),
    ({"rows": (0, 4)}, "rows must lie"), ({"rows": (-1, 3)}, "rows must lie")])
def test_the_kernel_refuses_what_does_not_fit(change, message):
    given = {"lasting": np.zeros((3, 3, 4), np.float32),
             "analyser": np.zeros((24, 1, 1), np.float32),
             "shown": (np.zeros((6, 8), np.float32), *shown((6, 8))), "rows": (0, 3)}
    _kernels.lasting_degree(**given)
    with pytest.raises(ValueError, match=message):
        _kernels.lasting_degree(**given | change)


@pytest.mark.gate
def test_a_polarizer_before_a_camera_that_loses_events_has_the_degree_of_frames(
        monkeypatch):
    camera = Camera.preset("nominal", seed=31, size=(12, 12), faults={"lost": 0.1})
    recording, truth = camera.record(RotatingPolarizer(rpm=30.4, start_angle=0.5), 1.4)

    def error():
        images = fuse(recording, method="kalman", causal=True, fps=97,
                      demosaic="superpixel", nominal_thresholds=(0.16, 0.18))
        return errors_of(
            (image for image in images if image.t_us > 1_000_000), truth).dolp

    weighed = error()
    monkeypatch.setattr(LastingDegree, "weigh", lambda *_: None)
    assert weighed < 0.7 * error()


def test_the_ideal_analyser_is_that_of_orthogonal_polarizers_on_the_diagonals():
    ideal = LastingDegree((4, 4), None)
    cell = Analyser.ideal().response[[0, 1, 3, 2]].reshape(2, 2, 3)
    same = LastingDegree((4, 4), cell)
    response = response_of((4, 4))
    for method in (ideal, same):
        fed(method, response)
    np.testing.assert_array_equal(ideal.state()["lasting"], same.state()["lasting"])


@pytest.mark.parametrize("options", [{"causal": True}, {}])
def test_it_is_that_of_the_middle_of_exposures_in_which_the_angle_turns(options):
    """In 20 ms at 500 RPM the mean light has .83 of the light's degree."""
    recording, truth = Camera.preset("nominal", seed=1009, size=(12, 12)).record(
        RotatingPolarizer(rpm=500), 1.2)
    fusion = fuse(recording, method="kalman", demosaic="superpixel", **options,
                  times_us=np.arange(600_000, 1_100_000, 10_151))
    off = [image.dolp - truth.dolp(image.t_us, *np.mgrid[.5:12:2, .5:12:2][::-1])
           for image in fusion]
    assert abs(np.mean(off)) < 0.015
