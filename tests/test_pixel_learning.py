"""Learning of a camera from its own frames and events."""
from __future__ import annotations

import json
import math
from dataclasses import replace

import numpy as np
import pytest
from truth_errors import errors_of

from pdavis_cv import ApsFrame, Calibration, _kernels, fuse
from pdavis_cv.events import EVENT_DTYPE
from pdavis_cv.export.files import write_json
from pdavis_cv.pixel.frame_noise import learned_frame_noise
from pdavis_cv.pixel.learn import LearnedPixels, Priors, learn
from pdavis_cv.pixel.model import PixelModel
from pdavis_cv.pixel.sample import PAST_DTYPE, PixelSample, Sampled
from pdavis_cv.pixel.silences import turn_of
from pdavis_cv.simulation import Camera, FlatLight, RotatingPlate, RotatingPolarizer

pytestmark = pytest.mark.accuracy

SIZE = (8, 8)
TOLD = Priors(theta=(0.2, 0.2))


def sampled(camera, rpm, dolp, seconds=2.0, frames=None, light=None):
    """Return a sample of a recording of a rotating polarizer, or of other light."""
    recording, _ = camera.record(
        light or RotatingPolarizer(rpm=rpm, dolp=dolp), seconds)
    sample = PixelSample(recording.info.sensor_size)
    taken = 0
    for packet in recording.packets():
        if len(packet.events):
            sample.add_events(packet.events)
        for frame in packet.frames:
            if frames is None or taken < frames:
                sample.add_frame(frame)
                taken += 1
    return sample


def of(seed, **dvs):
    """Return a camera whose frames are stamped 3 ms late."""
    return Camera.preset(
        "nominal", seed=seed, size=SIZE, faults={"frame_offset_us": 3000},
        dvs={"theta_on": 0.23, "theta_off": 0.27, "cutoff_hz": 180.0, **dvs})


@pytest.mark.gate
@pytest.mark.parametrize(("rpm", "dolp"), [(200, 0.5), (500, 1.0), (1000, 0.3)])
def test_thresholds_and_clock_are_within_three_of_their_sigmas(rpm, dolp):
    camera = of(1300)
    found = learn(sampled(camera, rpm, dolp), TOLD, 50_000)
    for i, name in enumerate(("off", "on")):
        true = float(camera.maps[f"theta_{name}"].mean())
        step = found.model.theta[i] if not found.model.by_class.any() else None
        assert found.sigmas[name] < 0.3
        if step is not None:
            assert abs(math.log(step / true)) < 3 * found.sigmas[name]
    assert abs(found.clock_offset_us + 3000) < 3 * found.sigmas["shift"]
    assert found.sigmas["shift"] < 1000
    assert found.model.black == 0


def test_light_that_passes_in_the_dead_time_is_counted():
    camera = Camera.preset("nominal", seed=1306, size=SIZE, dvs={"refractory_us": 1e3})
    recording, truth = camera.record(RotatingPolarizer(rpm=1013.0), 1.5)
    images = fuse(recording, method="kalman", fps=211, demosaic="superpixel",
                  start_us=700_000, nominal_thresholds=(0.16, 0.18))
    error = errors_of(images, truth)
    assert error.dolp < 0.05
    assert error.aop < 1.3


def test_a_black_level_of_less_than_four_of_its_errors_is_none():
    # Here 3 DN/ms, 3.6 errors, lower -2 ln L by more than 25.
    light = RotatingPlate(rpm=202.6, s0=10, start_angle=0.4) + FlatLight(s0=10)
    camera = Camera.preset("typical", seed=1003, size=(12, 12))
    sample = sampled(camera, 0, 0, seconds=2.2, light=light)
    assert learn(sample, TOLD, 50_000).model.black == 0


def test_a_black_level_is_found_where_there_is_one():
    camera = Camera.preset(
        "nominal", seed=1301, size=SIZE, aps={"black_level_dn": 30.0})
    sample = sampled(camera, 200, 1.0)
    assert learn(sample, TOLD, 0).model.black == pytest.approx(30 / 20, rel=0.25)


@pytest.mark.parametrize("frames", [0, 1])
def test_without_two_frames_nothing_moves(frames):
    found = learn(sampled(of(1302), 200, 0.5, 0.5, frames), TOLD, 0)
    np.testing.assert_array_equal(found.model.theta, TOLD.theta)
    assert found.clock_offset_us == 0
    assert found.model.black == 0


def test_still_light_moves_nothing():
    found = learn(sampled(of(1303), 0.01, 0.3), TOLD, 50_000)
    assert np.abs(np.log(found.model.theta / 0.2)).max() < 0.25
    assert found.model.black == 0
    assert found.clock_offset_us == 0


def test_learning_is_deterministic():
    one, other = (learn(sampled(of(1304), 200, 0.5, 0.5), TOLD, 50_000)
                  for _ in range(2))
    assert one.model == other.model
    assert one.clock_offset_us == other.clock_offset_us


def still_frames(read, shot, *, low=50.0, wave=0.0, seed=0):
    """Return a sample of 20 frames of 8x8 pixels, in light that goes to and fro."""
    rng = np.random.default_rng(seed)
    light = rng.uniform(low, 8 * low, SIZE)
    sample = PixelSample(SIZE)
    for k in range(20):
        dn = light * (1 + wave * np.sin(0.3 * k))
        sample.add_frame(ApsFrame(
            rng.normal(dn, np.sqrt(read + shot * dn)), 50_000 * k, 50_000 * k + 9000))
    return sample.sampled()


@pytest.mark.parametrize("wave", [0.0, 0.1])
def test_the_noise_of_frames_is_their_own(wave):
    found = learned_frame_noise(
        still_frames(8.0, 0.03, wave=wave), PixelModel(theta=np.array([0.2, 0.2])))
    for dn in (100, 200, 300):
        assert found.read_variance + found.shot * dn == pytest.approx(
            8 + 0.03 * dn, rel=0.15)


@pytest.mark.parametrize("frames", [
    {"read": 100.0, "shot": 0.1}, {"read": 8.0, "shot": 0.03, "low": 3.0}])
def test_more_noise_than_usual_is_light_and_in_dim_light_none_is_learned(frames):
    model = PixelModel(theta=np.array([0.2, 0.2]))
    assert learned_frame_noise(still_frames(**frames), model) == model


def twin(t, sign, at):
    """Return M-, M+ at a time between events that are all known: (2a, b)."""
    k = int(np.searchsorted(t, at, "right")) - 1
    out = np.zeros(2)
    if k < 0:
        return out
    for s in sign[:k + 1]:
        out[int(s > 0)] += s
    if k + 1 == len(t):
        return out
    gap = t[k + 1] - t[k]
    s, moves = (at - t[k]) / gap, 1 / (1 + (gap * 1e-6) ** 2)
    out[int(sign[k + 1] > 0)] += sign[k + 1] * s * moves
    if sign[k] != sign[k + 1]:
        q = 2 - math.sqrt(3)
        if k > 0 and sign[k - 1] == sign[k]:
            q = min(max((t[k] - t[k - 1]) / gap, 3 - 2 * 2**0.5), 1.0)
        out[int(sign[k] > 0)] += sign[k] * s * (1 - s) / q * moves
    return out


def a_pixel():
    """Return 60 events of a pixel, where they start, and a model."""
    rng = np.random.default_rng(5)
    past = np.zeros(60, PAST_DTYPE)
    past["t"] = np.sort(rng.choice(1_000_000, 60, replace=False))
    past["sign"] = rng.choice([-1, 1], 60)
    start, model = np.array([0, 60], np.int64), PixelModel(
        theta=np.array([0.2, 0.2]), rest_s=1.0)
    _kernels.learning_past(past, start, np.zeros(1, np.int64), model.numbers)
    return past, start, model


def test_counts_between_known_events_equal_their_twin():
    past, start, model = a_pixel()
    t, sign = past["t"], past["sign"]
    rng = np.random.default_rng(6)
    at = rng.integers(t[0] - 1000, t[-1], 200)
    then = rng.integers(t[0] - 1000, t[-1], 200)
    exposure = np.stack([[then, then], [at, at]])
    out, gains = np.empty((15, 200)), np.array([[0.1], [-0.2]])
    _kernels.learning_rows(
        past, start, np.zeros(200, np.int32), exposure, 1 << 40, np.zeros((2, 200)), 1,
        model.numbers, gains, out)
    counted = np.array([np.subtract(twin(t, sign, b), twin(t, sign, a))
                        for a, b in zip(then, at, strict=True)]).T
    np.testing.assert_allclose(out[:2], (1 + gains) * counted, atol=4e-5)
    np.testing.assert_allclose(out[13:], 0.2 * counted, atol=1e-5)
    np.testing.assert_allclose(out[12], 0.2 * out[:2].sum(0), atol=1e-5)
    for i, (polarity, first) in enumerate(((-1, 2), (1, 7))):
        own = t[sign == polarity]
        events = polarity * np.diff(np.searchsorted(own, [then, at], "right"), axis=0)
        np.testing.assert_allclose(
            out[first:first + 5].sum(0), (1 + gains[i]) * events[0], atol=1e-4)


def swinging(dolp):
    """Return events of 40 pixels behind a polarizer at 2 turns/s, and their phases."""
    rng, turns = np.random.default_rng(3), np.arange(0, 20, 1e-3)
    phase, events, start = rng.uniform(0, 2 * np.pi, 40), [], [0]
    for one in phase:
        light = np.log(1 + dolp * np.cos(2 * np.pi * turns + one))
        theta = 0.25 * rng.lognormal(0, 0.1)
        level = light[0] + theta * rng.uniform(-0.5, 0.5)
        for t, value in enumerate(light):
            if abs(value - level) >= theta:
                sign = math.copysign(1, value - level)
                level += sign * theta
                events.append((500 * t, sign))
        start.append(len(events))
    past = np.zeros(len(events), PAST_DTYPE)
    past["t"], past["sign"] = np.array(events).T
    none = np.zeros(0, np.int64)
    return Sampled([], past, np.array(start, np.int64), none, none, none), phase


@pytest.mark.parametrize(("dolp", "better"), [
    (0.18, 0.7), (0.2, 0.6), (0.22, 0.5), (0.3, None), (0.6, None)])
def test_counts_of_a_weak_wave_follow_it_later_without_its_own_turn(dolp, better):
    data, phase = swinging(dolp)
    model = PixelModel(theta=np.array([0.25, 0.25]), rest_s=10.0)
    data = data.with_past(model.numbers)
    pixel = np.repeat(np.flatnonzero(np.diff(data.start) > 8), 300).astype(np.int32)
    at = np.tile(np.linspace(1_000_000, 9_000_000, 300), len(pixel) // 300).astype(int)
    before = at - 125_000
    z = 4e-6 * np.pi * np.stack([before, at]) + phase[pixel]
    light = np.log(1 + dolp * np.cos(z))
    slope = -dolp * np.sin(z) / (1 + dolp * np.cos(z)) * 4 * np.pi
    gap_s = 10 / (np.diff(data.start)[np.unique(pixel)].mean())
    lags, out = [], np.empty((15, len(at)))
    for turn in (model.turn, turn_of(data)):
        _kernels.learning_rows(
            data.events, data.start, pixel, np.stack([[before, before], [at, at]]),
            1 << 40, np.zeros((2, len(at))), 1, model.replace(turn=turn).numbers,
            np.zeros((2, 40)), out)
        x = np.stack([out[:2].sum(0), np.diff(slope, axis=0)[0]], 1)
        found = np.linalg.lstsq(x, np.diff(light, axis=0)[0], rcond=None)[0]
        lags.append(found[1] / gap_s)
    if better is None:
        assert turn_of(data) == pytest.approx(model.turn)
        assert abs(lags[0]) < 0.03
    else:
        assert lags[0] > 0.04
        assert abs(lags[1]) < better * lags[0]


def test_the_mean_of_an_exposure_is_that_of_its_samples():
    past, start, model = a_pixel()
    begin, end = 100_000, 170_000
    exposure = np.array([[[-1], [-1]], [[begin], [end]]])   # and before all events
    out = np.empty((15, 1))
    _kernels.learning_rows(
        past, start, np.zeros(1, np.int32), exposure, 1 << 40, np.zeros((2, 1)), 7,
        model.numbers, np.zeros((2, 1)), out)
    t, sign = past["t"], past["sign"]
    j = np.array([0.2 * twin(t, sign, begin + int(70_000 * (i + 0.5) / 7)).sum()
                  for i in range(7)])
    h = np.log(np.exp(j).mean())
    np.testing.assert_allclose(out[12, 0], h, atol=1e-4)


def test_a_scale_from_events_replaces_what_was_told():
    found = LearnedPixels(model=PixelModel(theta=np.array([0.2, 0.3])),
                          gains=np.zeros((2, 4)), told=True).scaled(1.5, 0.05)
    np.testing.assert_allclose(found.model.theta, [0.3, 0.45])
    np.testing.assert_allclose(found.model.thresholds, [0.3, 0.45])
    sigma = np.sqrt(np.diag(found.model.theta_cov)) / found.model.theta
    assert not found.told
    assert (np.abs(sigma - 0.05) < 0.01).all()


def test_a_black_level_is_missing_in_frames_not_in_light():
    model = PixelModel(theta=np.array([0.2, 0.2]), black=4.0)
    light = np.array([[1.0, 3.0, 4.001, 5.0, 12.0]], np.float32)
    shown, of_shown = model.in_frames(np.log(light), np.full_like(light, 0.01))
    for mean, got, variance in zip(
            light[0], np.exp(shown[0]), of_shown[0], strict=True):
        # What is left of a normal distribution above the black level.
        x = 1e-5 * (np.arange(2_000_000) + 0.5)
        weight = np.exp(-((x + 4 - mean) ** 2) / (2 * (0.1 * mean) ** 2))
        weight /= weight.sum()
        right = float(x @ weight)
        assert got == pytest.approx(right, rel=1e-3)
        assert variance == pytest.approx(
            float((x - right) ** 2 @ weight) / right**2, rel=0.01)
    log = np.log(light)
    assert model.replace(black=0.0).in_frames(log, log) == (log, log)


def test_a_black_level_found_before_stays_without_evidence_against_it():
    sample = sampled(Camera.preset(
        "typical", seed=1303, size=SIZE, aps={"black_level_dn": 30.0}), 60, 0.5, 0.4)
    alone = learn(sample, TOLD, 0)
    before = replace(alone, model=alone.model.replace(black=1.5))
    assert alone.model.black == 0
    assert learn(sample, TOLD, 0, before).model.black > 0.3
    # None is there: it goes again.
    sample = sampled(of(1304), 200, 1.0)
    assert learn(sample, TOLD, 0, before).model.black < 0.1


@pytest.mark.parametrize("seed", [1303, 1309])
def test_an_unsure_clock_offset_is_the_mean_with_none(seed, monkeypatch):
    sample = sampled(Camera.preset("typical", seed=seed, size=SIZE), 60, 0.3, 0.5)
    found = learn(sample, TOLD, 0)
    assert -3000 < found.clock_offset_us < 0
    assert found.clock_offset_us + 2 * found.sigmas["shift"] > -3000
    assert found.clock_offset_us - 2 * found.sigmas["shift"] < -3000
    monkeypatch.setattr("pdavis_cv.pixel.learn.SURE", 0.5)
    likelier = learn(sample, TOLD, 0)
    assert likelier.clock_offset_us == 0 or (
        likelier.clock_offset_us < found.clock_offset_us)
    # None is there, and that is sure.
    sample = sampled(Camera.preset("nominal", seed=1304, size=SIZE), 200, 1.0)
    before = replace(found, clock_offset_us=-3000.0)
    assert learn(sample, TOLD, 0, before).clock_offset_us == 0


def test_a_known_clock_offset_is_used_and_not_learned():
    sample = sampled(of(1005), 200, 0.5)
    found = [learn(sample, Priors(theta=(0.2, 0.2), clock_us=(us, 0.0)), 50_000)
             for us in (-3000.0, 0.0)]
    assert [one.clock_offset_us for one in found] == [-3000, 0]
    assert all("shift" not in one.sigmas for one in found)
    told, wrong = (np.abs(one.model.thresholds / (0.27, 0.23) - 1).max()
                   for one in found)
    assert told < 0.1
    assert told < wrong


@pytest.mark.gate
def test_what_was_learned_does_not_depend_on_what_was_fused_before():
    """Each look-ahead has its own weights, though both read the same recording."""
    recording, _ = of(1006).record(RotatingPolarizer(rpm=200), 1.5)

    def learned(**options):
        image = next(iter(fuse(recording, method="kalman", **options)))
        return image.provenance["parameters"]["model"]

    first = learned(mode="offline")
    assert learned() != first
    assert learned(mode="offline") == first


def test_a_stated_clock_offset_is_that_of_the_images():
    recording, _ = of(1007).record(RotatingPolarizer(rpm=200), 1.0)
    image = next(iter(fuse(recording, method="kalman", clock_offset_us=-3000)))
    assert image.provenance["clock_offset_us"] == -3000


def test_what_was_learned_of_a_camera_is_where_the_next_recording_starts(tmp_path):
    """Images of half a second of slower and weaker light."""
    first, _ = of(1008).record(RotatingPolarizer(rpm=200), 2.0)
    images = fuse(first, method="kalman")
    clip = Calibration(sensor_size=SIZE, clip_dn=1000.0)
    assert fuse(first, method="kalman", calibration=clip).camera.clip_dn == 1000
    camera = Calibration.load(images.camera.save(tmp_path / "camera.npz"))
    sigma_us = camera.learned["clock_offset_sigma_us"]
    assert abs(camera.clock_offset_us + 3000) < 3 * sigma_us
    assert float(camera.theta_off.mean()) == pytest.approx(0.27, rel=0.06)
    other, truth = of(1008).record(RotatingPolarizer(rpm=60, dolp=0.5), 0.6)
    times = 150_000 + 10_000 * np.arange(35)
    errors = []
    for calibration in (None, camera):
        fusion = fuse(other, method="kalman", times_us=times,
                      calibration=calibration, demosaic="superpixel")
        errors.append(errors_of(fusion, truth))
    assert fusion.camera.clock_offset_us == pytest.approx(-3000, abs=1500)
    assert errors[1].aop < 0.95 * errors[0].aop


def test_a_black_level_is_kept_in_dn_whatever_the_exposure():
    sample = sampled(of(1011), 200, 1.0)
    told = Priors(theta=(0.27, 0.23), theta_sigma=0.05, black=(30.0, 0.0))
    found = learn(sample, told, 50_000)
    assert found.exposure_ms == pytest.approx(20, rel=0.5)
    assert found.model.black * found.exposure_ms == pytest.approx(30)


def test_no_camera_is_learned_of_still_light():
    still, _ = of(1009).record(FlatLight(), 1.0)
    camera = fuse(still, method="kalman").camera
    assert camera.parts == ()
    assert camera.sensor_size == SIZE


def test_a_learned_camera_is_written_as_numbers(tmp_path):
    model = PixelModel(theta=np.array([0.25, 0.2]), black=1.5)
    write_json(tmp_path / "a.json", {"model": model})
    found = json.loads((tmp_path / "a.json").read_text())["model"]
    assert found["theta"] == [0.25, 0.2]
    assert found["black"] == 1.5
    assert PixelModel.of_lists(found) == model
    assert found.pop("turn") == model.turn
    assert PixelModel.of_lists(found) == model      # as older files have it
    del found["black"]
    with pytest.raises(KeyError):
        PixelModel.of_lists(found)


def test_a_busy_sensor_is_sampled_by_fewer_pixels_for_longer():
    rng = np.random.default_rng(7)
    sample, shape = PixelSample((64, 64)), (64, 64)
    for part in range(6):
        events, begin = np.zeros(400_000, EVENT_DTYPE), part * 100_000
        events["t"] = np.sort(rng.integers(begin, begin + 100_000, 400_000))
        events["x"], events["y"] = rng.integers(0, 64, (2, 400_000))
        sample.add_frame(ApsFrame(np.full(shape, 100.0), begin, begin))
        sample.add_events(events)
    data = sample.sampled()
    assert 256 <= len(sample.pixels) < 64 * 64
    assert len(data.t) <= 1_000_000
    assert data.t[0] < 1000     # all of the time
    assert data.t[-1] > 599_000
    assert len(data.frames) == 6
    assert {len(frame.dn) for frame in data.frames} == {len(sample.pixels)}
    counts = np.diff(data.start)
    assert counts.min() > 0.7 * counts.mean()           # all events of those pixels
    other = PixelSample(shape)
    other.restore(sample.state())
    np.testing.assert_array_equal(other.sampled().events, data.events)
    np.testing.assert_array_equal(other.pixels, sample.pixels)


def test_intervals_without_events_are_not_learned_from():
    camera = Camera.preset("typical", seed=1305, size=SIZE)
    recording, _ = camera.record(RotatingPolarizer(rpm=61), 2.0)
    packets = list(recording.packets())
    frames = [frame for packet in packets for frame in packet.frames]
    events = recording.events()
    for one, following in zip(frames[::2], frames[1::2], strict=False):
        t = events["t"] + camera.faults.frame_offset_us
        events = events[(t < one.exposure_end_us) | (t > following.exposure_start_us)]
    sample = PixelSample(SIZE)
    sample.add_events(events)
    for frame in frames:
        sample.add_frame(frame)
    found = learn(sample, TOLD, 0)
    truth = [camera.maps[name].mean() for name in ("theta_off", "theta_on")]
    np.testing.assert_allclose(found.model.thresholds, truth, rtol=0.15)
    assert found.clock_offset_us == pytest.approx(-3000, abs=2000)
    # Where they are missing, light moves on.
    assert found.model.missing > 1 > 5 * found.model.noise[0]
