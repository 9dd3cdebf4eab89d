import pickle

import numpy as np
import pytest
import reference_denoise
from hypothesis import given, settings, strategies as st
from streams import random_events

from pdavis_cv import _kernels, fuse
from pdavis_cv.reconstruct.denoise import EventDenoiser
from pdavis_cv.simulation import Camera, Fan, FlatLight, RotatingPolarizer

SIZE = (16, 20)


def recorded(scene, seconds=2.0, **pixel):
    camera = Camera.preset("nominal", seed=1, size=SIZE, aps=None, dvs=pixel)
    recording, _ = camera.record(scene, seconds)
    return np.concatenate([packet.events for packet in recording.packets()])


@settings(max_examples=40)
@given(st.integers(0, 400), st.integers(0, 99), st.integers(1, 4),
       st.sampled_from([10_000, 60_000]), st.integers(0, 60),
       st.sampled_from([(7, 9), (6, 6), (1, 1), (2, 5)]),
       st.sampled_from([0, 1_600_000_000_000_000]))
def test_it_equals_comparing_every_event_with_all_before(
        n, seed, support, window_us, of_one, shape, start):
    events = random_events(n, shape, seed=seed, start_us=start,
                           stop_us=start + 3 * 10**6, read_only=False)
    # One pixel has many, and there is a gap.
    events["y"][:of_one], events["x"][:of_one] = shape[0] // 2, shape[1] // 2
    events["t"][n // 2:] += 900_000
    denoiser = EventDenoiser(shape, window_us=window_us, support=support)
    want, hot = reference_denoise.kept(events, shape, window_us, support)
    np.testing.assert_array_equal(denoiser.keep(events), want)
    np.testing.assert_array_equal(denoiser.hot, hot)


def test_packets_do_not_change_what_is_kept():
    events = random_events(20_000, SIZE, stop_us=5_000_000)
    whole, cut = EventDenoiser(SIZE), EventDenoiser(SIZE)
    want, got = whole.filter(events), []
    rng = np.random.default_rng(1)
    while len(events):
        n = rng.integers(1, 900)
        got.append(cut.filter(events[:n]))
        other = EventDenoiser(SIZE)
        other.restore(pickle.loads(pickle.dumps(cut.state())))
        cut, events = other, events[n:]
    assert 0 < len(want) < 20_000
    np.testing.assert_array_equal(np.concatenate(got), want)


def test_noise_and_hot_pixels_go_and_true_events_stay():
    noise = {"hot_fraction": 0.01, "hot_hz": 100.0}
    dark = recorded(FlatLight(s0=0.01), 3.0, **noise)
    assert len(dark) > 2 * 3 * SIZE[0] * SIZE[1]
    left = EventDenoiser(SIZE).filter(dark)
    assert np.sum(left["t"] > 10**6) / 2 / (SIZE[0] * SIZE[1]) < 0.1
    for rpm in (30, 1000):
        true = recorded(RotatingPolarizer(rpm=rpm * 1.013), 3.0 if rpm == 30 else 1.0,
                        shot_noise_hz=0, leak_hz=0)
        both = np.concatenate([true, dark[dark["t"] < true["t"][-1]]])
        order = np.argsort(both["t"], kind="stable")
        kept = EventDenoiser(SIZE).keep(both[order])
        assert kept[order < len(true)].mean() > 0.95


@pytest.mark.gate
@pytest.mark.parametrize("options", [
    {"method": "events"}, {"method": "events", "offsets": "redundancy"},
    {"method": "cf"},
    {"method": "kalman", "mode": "offline"},
    {"method": "kalman", "causal": True}])
def test_every_method_takes_it_and_regions_and_seeks_stay_exact(options):
    camera = Camera.preset("nominal", seed=2, size=(24, 26),
                           origin=(54, 190), dvs={"hot_fraction": 0.02})
    recording, _ = camera.record(Fan(rpm=203), 0.6)
    options = {"thresholds": (0.16, 0.18), "fps": 25, "denoise": True, **options}
    images = list(fuse(recording, **options))
    plain = list(fuse(recording, **{**options, "denoise": False}))
    assert any(not np.array_equal(a.aop, b.aop)
               for a, b in zip(images, plain, strict=True))
    for image, part in zip(images, fuse(recording, roi=(9, 11, 4, 3), **options),
                           strict=True):
        np.testing.assert_array_equal(part.aop, image.aop[11:14, 9:13])
    cursor = fuse(recording, **options)
    for _ in range(6):
        next(cursor)
    snapshot = pickle.loads(pickle.dumps(cursor.snapshot()))
    cursor.rewind()
    cursor.restore(snapshot)
    for image, again in zip(images[6:], cursor, strict=True):
        np.testing.assert_array_equal(again.aop, image.aop)
    assert images[0].provenance["parameters"]["denoise"] == {
        "window_us": 50_000, "support": 2}


def test_parameters_are_passed_on_and_checked():
    recording, _ = Camera.preset("ideal", size=(4, 4), aps=None).record(
        RotatingPolarizer(rpm=60), 0.1)
    fused = fuse(recording, denoise={"support": 1})
    assert fused.provenance["parameters"]["denoise"]["support"] == 1
    with pytest.raises(ValueError, match="support must be 1 to 8, got 9"):
        fuse(recording, denoise={"support": 9})
    with pytest.raises(ValueError, match="window_us must be a whole number"):
        EventDenoiser(SIZE, window_us=0)
    with pytest.raises(TypeError, match="denoise must be a bool or a mapping"):
        fuse(recording, denoise="yes")


def test_events_outside_or_late_are_refused_by_name():
    events = random_events(10, SIZE).copy()
    events["x"][7] = 99
    denoiser = EventDenoiser(SIZE)
    with pytest.raises(ValueError, match=r"event 7 at \(x=99"):
        denoiser.keep(events)
    with pytest.raises(ValueError, match="event 0 at t="):
        denoiser.keep(events[:2])
    assert len(denoiser.keep(events[:0])) == 0


def test_kernels_refuse_arrays_that_do_not_fit():
    u8, i32 = np.zeros(SIZE, np.uint8), np.zeros(SIZE, np.int32)
    times = np.zeros((*SIZE, 2), np.int64)
    events, keep = random_events(3, SIZE), np.zeros(3, np.uint8)
    with pytest.raises(ValueError, match="denoise_events: an array"):
        _kernels.denoise_events(events, 0, 0, 9, 9, 1, u8[1:], times, i32, keep)
    with pytest.raises(ValueError, match="start must not be negative"):
        _kernels.denoise_events(events, -1, 0, 9, 9, 1, u8, times, i32, keep)
    with pytest.raises(ValueError, match="denoise_rates: all images"):
        _kernels.denoise_rates(
            i32, np.zeros((2, 2), np.float32), u8, 0.1, 1.0, 1.0, 1.0)
