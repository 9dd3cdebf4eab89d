import pickle

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from reference_lamp import RATES, fitted, triples
from streams import random_events
from truth_errors import errors_of

from pdavis_cv import EVENT_DTYPE, _kernels, fuse
from pdavis_cv.fusion import Fusion
from pdavis_cv.pixel.model import PixelModel
from pdavis_cv.reconstruct.lamp import BLOCK_US, Lamplight, LampTracker, Wave
from pdavis_cv.simulation import Camera, RotatingPlate, RotatingPolarizer

NOMINAL = (0.16, 0.18)
DEPTH = 0.1


def recorded(rpm, mains_hz=None, *, seed=1, seconds=1.6, size=(12, 12),
             scene=RotatingPolarizer, preset="nominal"):
    light = scene(rpm=rpm, start_angle=0.3)
    if mains_hz:
        light = light.flicker(mains_hz, DEPTH)
    return Camera.preset(preset, seed=seed, size=size).record(light, seconds)


def events_of(recording):
    return np.concatenate([packet.events for packet in recording.packets()])


@pytest.fixture(scope="module")
def lit():
    """A polarizer at 203 RPM under a lamp of 120 Hz: recording, truth."""
    return recorded(202.6, 60.0)


def waves_of(recording):
    tracker = LampTracker(recording.info.sensor_size, *NOMINAL)
    return list(tracker.push(events_of(recording)))


@settings(max_examples=25)
@given(st.integers(0, 99), st.sampled_from([0, 1]), st.integers(1, 4),
       st.sampled_from([0, -(10**9), 1_600_000_000_000_000]), st.integers(0, 1),
       st.sampled_from([0.0, 80.0]))
def test_sums_and_wave_equal_least_squares_over_all_triples(
        seed, rate, blocks, origin, shift, hz):
    shape, even_us = (5, 7), np.array([1000.0, 4000.0, 15000.0])
    start = origin // (2 * BLOCK_US) * 2 * BLOCK_US  # phase 0 of all frequencies
    stop = start + blocks * BLOCK_US
    events = random_events(3000, shape, start_us=start, stop_us=stop, seed=seed)
    stamps = np.full((8, 8, 2), 2 * -(2**62), np.int64)
    sums = np.zeros((blocks, 3, 4, 4, 7))
    i = 0
    for k in range(blocks):
        i += _kernels.lamp_push(
            events[i:], start + (k + 1) * BLOCK_US, (*shape, shift), (0.2, 0.25),
            even_us, np.full((8, 8), hz, np.float32), stamps, sums[k])
    assert i == len(events)
    rows = triples(events, 0.2, 0.25, shift)
    for span, even in enumerate(even_us):
        _, explained, weight = fitted(rows, RATES[rate], start, even, hz)
        total = sums[:, span, rate].sum((0, 1))
        np.testing.assert_allclose(total[5:], [
            weight @ rows[:, 3]**2, weight.sum()], rtol=1e-6)
        cc, cs, ss, c, s = total[:5]
        b = np.array([c, s])
        want = b @ np.linalg.solve([[cc + 1e-6, cs], [cs, ss + 1e-6]], b)
        np.testing.assert_allclose(want, explained, rtol=1e-5)
    out = np.empty(8)
    only = sums[-1:, 2].copy()
    _kernels.lamp_wave(only, stop, out)
    # The frequency of one block alone is that of the mains.
    mains = 120.0 if out[0] > 110e-6 else 100.0
    assert out[0] == pytest.approx(mains * 1e-6, abs=0.2e-6)
    last = rows[rows[:, 2] >= stop - BLOCK_US]
    (cosine, sine), explained, _ = fitted(last, 1e6 * out[0], stop, 15000.0, hz)
    np.testing.assert_allclose(out[1:3], [cosine, sine], atol=4e-3)
    assert out[3] == pytest.approx(explained, rel=0.1, abs=1e-3)


@pytest.mark.parametrize("rpm", [60.8, 202.6, 1013.0])
@pytest.mark.parametrize("mains_hz", [49.9, 60.0, 60.2])
def test_a_lamp_is_found_as_the_photoreceptors_pass_it_on(rpm, mains_hz):
    recording, _ = recorded(rpm, mains_hz)
    wave = waves_of(recording)[-1]
    hz = 2 * mains_hz
    assert wave.hz == pytest.approx(hz, abs=0.06)
    # ln(1 + d cos) through a low-pass of 250 Hz; the light is d cos(2 pi hz t).
    passed = DEPTH / (1 + 1j * hz / 250)
    phasor = passed * np.exp(2e-6j * np.pi * hz * wave.start_us)
    found = wave.cosine - 1j * wave.sine
    assert abs(found - phasor) < 0.25 * abs(phasor)


@pytest.mark.parametrize("scene", [RotatingPolarizer, RotatingPlate])
@pytest.mark.parametrize("rpm", [30.4, 202.6, 750.0, 900.0, 1013.0])
def test_what_turns_is_no_lamp(scene, rpm):
    # At 750 and 900 RPM the fourth harmonic of all four channels is that of a lamp.
    recording, _ = recorded(rpm, scene=scene)
    assert not any(wave.hz for wave in waves_of(recording)[6:])


def test_waves_come_in_order_of_time_a_block_each_and_from_the_past_alone(lit):
    events = events_of(lit[0])
    waves = waves_of(lit[0])
    starts = [wave.start_us for wave in waves]
    first = int(events["t"][0]) // BLOCK_US
    assert starts == [(first + k) * BLOCK_US for k in range(len(waves))]
    tracker = LampTracker((12, 12), *NOMINAL)
    early = list(tracker.push(events[events["t"] < waves[9].start_us]))
    early += tracker.advance(waves[9].start_us)
    assert early == waves[:10]


def test_packets_advances_and_snapshots_do_not_change_the_waves(lit):
    events, whole = events_of(lit[0]), waves_of(lit[0])
    tracker, waves = LampTracker((12, 12), *NOMINAL), []
    rng = np.random.default_rng(0)
    cuts = np.sort(rng.integers(0, len(events), 40))
    for part in np.split(events, cuts):
        waves += tracker.push(part)
        if len(part):
            now = int(part["t"][-1])
            waves += tracker.advance(now - 1)
            # What has been there is not counted again.
            waves += tracker.push(part[part["t"] < now])
        other = LampTracker((12, 12), *NOMINAL)
        other.restore(pickle.loads(pickle.dumps(tracker.state())))
        tracker = other
    assert waves == whole


def test_after_a_long_silence_the_lamp_is_unknown(lit):
    events = events_of(lit[0])
    later = events.copy()
    later["t"] += 60_000_000
    tracker = LampTracker((12, 12), *NOMINAL)
    before, after = list(tracker.push(events)), list(tracker.push(later))
    assert before[-1].hz > 0
    assert after[0] == Wave(int(later["t"][0]) // BLOCK_US * BLOCK_US)
    assert after[-1].hz > 0


def test_a_large_sensor_is_looked_at_in_part():
    small, large = (LampTracker(shape, 0.2, 0.2) for shape in ((12, 12), (260, 346)))
    assert small._shift == 0
    assert large._stamps[..., 0].size <= 4096 + 2 * (260 + 346)


def test_lamplight_forgets_and_begins_anew():
    light = Lamplight()
    for k in range(5):
        light.add(Wave(k * BLOCK_US))
    assert light.waves.shape == (0,)
    light.add(Wave(5 * BLOCK_US, 120.0, 0.1, 0.2))
    assert light.waves.shape == (6,)
    light.forget(4 * BLOCK_US + 1)
    assert light.waves["start_us"].tolist() == [4 * BLOCK_US, 5 * BLOCK_US]
    np.testing.assert_allclose(
        light.waves[1].tolist(), (5 * BLOCK_US, 120e-6, 0.1, 0.2, 0))
    state = light.state()
    light.add(Wave(99 * BLOCK_US))
    assert len(light.waves) == 0
    light.restore(state)
    assert light.waves["start_us"].tolist() == [4 * BLOCK_US, 5 * BLOCK_US]


def error(recording, truth, **options):
    found = errors_of(fuse(
        recording, times_us=np.arange(800_000, 1_500_000, 3037), demosaic="superpixel",
        nominal_thresholds=NOMINAL, **options), truth)
    return np.array([np.degrees(found.aop), found.dolp])


@pytest.mark.gate
@pytest.mark.parametrize(("options", "times"), [
    ({}, (1.7, 2.2)), ({"mode": "offline"}, (1.7, 2.2)),
    ({"causal": True}, (5.0, 2.2))])
def test_flicker_costs_little_accuracy(lit, options, times):
    # Of AoP and DoLP; the degree in steady light is known to .007 or better.
    steady = np.maximum(error(*recorded(202.6), **options), (0, 0.007))
    assert np.all(error(*lit, **options) < np.multiply(times, steady))


@pytest.mark.gate
def test_in_dim_light_slow_pixels_pass_on_less_of_a_lamp():
    steady = error(*recorded(30.4, preset="realistic"))
    flickering = error(*recorded(30.4, 60.0, preset="realistic"))
    # Taken to be alike in all pixels the ripple makes that of DoLP 2.7 times as large.
    assert np.all(flickering < 1.3 * steady)


@pytest.mark.parametrize("causal", [False, True])
def test_under_a_lamp_a_region_is_the_crop_and_a_snapshot_goes_on(lit, causal):
    recording, _ = lit
    options = {"causal": causal, "nominal_thresholds": NOMINAL,
               "model": PixelModel(theta=np.array([0.18, 0.16]), bandwidth=(20.0, 8.0)),
               "times_us": np.arange(900_000, 1_400_000, 50_301)}
    whole = list(fuse(recording, **options))
    part = list(fuse(recording, roi=(4, 2, 6, 8), **options))
    for a, b in zip(whole, part, strict=True):
        np.testing.assert_array_equal(a.quad[:, 2:10, 4:10], b.quad)
    fusion = Fusion(recording, **options)
    for _ in range(3):
        next(fusion)
    other = Fusion(recording, **options)
    other.restore(pickle.loads(pickle.dumps(fusion.snapshot())))
    for a, b in zip(whole[3:], other, strict=True):
        np.testing.assert_array_equal(a.quad, b.quad)


@pytest.mark.parametrize(("changes", "message"), [
    ({"sensor": (4, 4, -1)}, "shift must"), ({"sensor": (4, 4, 20)}, "shift must"),
    ({"sensor": (9, 4, 0)}, "hz must have room"),
    ({"hz": np.zeros((4, 2), np.float32)}, "hz must have room"),
    ({"sums": np.zeros((3, 4, 4, 6))}, "sums must"),
    ({"even_us": np.ones(2)}, "sums must")])
def test_lamp_push_checks_sizes(changes, message):
    arguments = {
        "events": np.zeros(1, EVENT_DTYPE), "until": 1, "sensor": (4, 4, 0),
        "thresholds": (0.2, 0.2), "even_us": np.ones(3),
        "hz": np.zeros((4, 4), np.float32),
        "stamps": np.zeros((4, 4, 2), np.int64), "sums": np.zeros((3, 4, 4, 7))}
    assert _kernels.lamp_push(*arguments.values()) == 1
    with pytest.raises(ValueError, match=message):
        _kernels.lamp_push(*{**arguments, **changes}.values())


@pytest.mark.parametrize(("sums", "out", "message"), [
    (np.zeros((0, 4, 4, 7)), 8, "sums must"), (np.zeros((1, 2, 4, 7)), 8, "sums must"),
    (np.zeros((1, 4, 4, 7)), 7, "out must")])
def test_lamp_wave_checks_sizes(sums, out, message):
    with pytest.raises(ValueError, match=message):
        _kernels.lamp_wave(sums, 0, np.empty(out))


def test_events_beside_the_sensor_do_not_count():
    events = np.zeros(50, EVENT_DTYPE)
    events["t"], events["x"], events["y"] = np.arange(50) * 500, 60_000, 60_000
    tracker = LampTracker((12, 12), 0.2, 0.2)
    assert len(list(tracker.push(events))) == 1
    assert not tracker.state()["now"].any()
