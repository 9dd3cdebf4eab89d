"""Periodic signals and the optics of a retarder."""
import tracemalloc

import numpy as np
import pytest
from hypothesis import given, strategies as st
from scipy.signal import lombscargle

from pdavis_cv import AnalysisWarning
from pdavis_cv.analysis import (
    LockIn,
    LockInMaps,
    alias_warning,
    birefringence,
    cycle_average,
    cycle_drift,
    dominant_tone,
    fit_tone,
    phase_locked,
    retardance,
    spectrum,
    subtract_background,
)
from pdavis_cv.analysis.periodogram import highest_peak

EPOCH = 1_700_000_000_000_000  # Unix time in us, as DV writes it


def times(fps, seconds, start=EPOCH):
    return start + np.rint(np.arange(int(fps * seconds)) * 1e6 / fps).astype(np.int64)


def wave(t, hz, phase=0.0):
    return np.cos(2 * np.pi * hz * (t - t[0]) / 1e6 + phase)


@pytest.mark.parametrize("hz", [1.0, 5.0, 10.0, 17.3])
def test_frequency_amplitude_and_phase_return_within_their_errors(hz):
    rng = np.random.default_rng(3)
    t = times(100, 10)
    v = 0.4 + 0.05 * wave(t, hz, 0.7) + rng.normal(0, 0.02, len(t))
    tone = dominant_tone(t, v)
    assert abs(tone.hz - hz) < 5 * tone.hz_se
    assert abs(tone.hz / hz - 1) < 0.005
    assert abs(tone.amplitude[0] - 0.05) < 5 * tone.amplitude_se[0]
    assert abs(tone.phase[0] - 0.7) < 5 * tone.phase_se[0]
    assert tone.false_alarm < 1e-6
    assert tone.residual_sd == pytest.approx(0.02, rel=0.1)


def test_the_stated_errors_are_those_of_many_trials():
    rng = np.random.default_rng(4)
    t = times(50, 6)
    tones = [fit_tone(t, wave(t, 3.0) + rng.normal(0, 0.5, len(t)), 3.0, harmonics=1)
             for _ in range(200)]
    for name in ("hz", "amplitude", "phase"):
        got = np.array([np.ravel(getattr(tone, name))[0] for tone in tones])
        said = np.mean([np.ravel(getattr(tone, name + "_se"))[0] for tone in tones])
        assert got.std() == pytest.approx(said, rel=0.2)


def test_harmonics_and_distortion_of_a_known_wave():
    t = times(200, 5)
    v = wave(t, 4.0) + 0.3 * wave(t, 8.0, 1.0) + 0.1 * wave(t, 12.0, -2.0)
    tone = dominant_tone(t, v, harmonics=3)
    np.testing.assert_allclose(tone.amplitude, [1, 0.3, 0.1], rtol=1e-4)
    np.testing.assert_allclose(tone.phase, [0, 1, -2], atol=1e-3)
    assert tone.distortion == pytest.approx(np.hypot(0.3, 0.1), rel=1e-3)


def test_irregular_times_and_missing_values_do_no_harm():
    rng = np.random.default_rng(5)
    t = np.sort(rng.choice(10_000_000, 900, replace=False)).astype(np.int64)
    v = np.cos(2 * np.pi * 7.25 * t / 1e6)
    v[::7] = np.nan
    assert dominant_tone(t, v).hz == pytest.approx(7.25, abs=1e-4)


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize("spacing", ["even", "random", "with gaps"])
def test_the_highest_peak_is_that_of_the_whole_periodogram(seed, spacing):
    rng = np.random.default_rng(seed)
    t = np.arange(300) / 50.0
    if spacing == "random":
        t = np.sort(rng.uniform(0, 6, 300))
    elif spacing == "with gaps":
        t = t[(t % 2 < 0.5) | (t % 2 > 1.2)]
    v = 0.3 * np.cos(2 * np.pi * rng.uniform(1, 20) * t) + rng.normal(size=len(t))
    hz = np.linspace(0.4, 25, 4000)
    power = lombscargle(t, v, 2 * np.pi * hz)
    found, height = highest_peak(t, v, 0.4, 25)
    # An eighth of a peak's width away, cos(pi / 16)^2 of its height is left.
    assert height >= 0.96 * power.max()
    assert height == pytest.approx(
        float(lombscargle(t, v, 2 * np.pi * np.array([found]))))


def test_a_band_narrower_than_a_step_is_searched_at_its_ends():
    t = np.arange(100) / 10.0
    found, _ = highest_peak(t, np.cos(2 * np.pi * 3 * t), 2.9999, 3.0)
    assert found == 3.0


def test_a_long_trace_takes_little_memory():
    t = times(1000, 20)
    v = wave(t, 3.3) + np.random.default_rng(0).normal(size=len(t))
    tracemalloc.start()
    assert dominant_tone(t, v).hz == pytest.approx(3.3, abs=1e-3)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 100e6     # an array of samples by frequencies would be 6400 MB


def test_a_frequency_of_less_than_a_cycle_has_an_answer(capfd):
    t = times(10, 10)
    v = np.random.default_rng(1).normal(size=len(t))
    assert np.isfinite(fit_tone(t, v, 1e-130, harmonics=20).amplitude).all()
    assert capfd.readouterr() == ("", "")      # LAPACK says so where numbers are none


def test_what_lapack_cannot_solve_is_refused(capfd):
    t = times(50, 8)
    # In float16 the largest frequency is infinite, so a comparison there lets it pass.
    with pytest.raises(ValueError, match="hz must be positive and at most 500000"):
        fit_tone(t, wave(t, 1.0), np.float16("inf"))
    for ask in (lambda v: fit_tone(t, v, 1.0), lambda v: dominant_tone(t, v)):
        with pytest.raises(ValueError, match=r"values must lie within 1e\+100 of 0"):
            ask(1e300 * wave(t, 1.0))
        assert np.isfinite(ask(1e99 * wave(t, 1.0)).amplitude).all()
    assert capfd.readouterr() == ("", "")


def test_the_search_leaves_what_least_squares_leave():
    rng = np.random.default_rng(3)
    for count, harmonics, hz in ((9, 1, 0.5), (40, 3, 0.7), (400, 20, 1.3)):
        t = np.sort(rng.uniform(0, 4, count))
        v, basis = rng.normal(size=count) + 3, spectrum._basis(t, hz, harmonics)
        solution = np.linalg.lstsq(basis, v, rcond=None)[0]
        assert spectrum._residual(basis, v) == pytest.approx(
            np.sum((v - basis @ solution) ** 2), rel=1e-9)
    # Dependent columns count once.
    assert spectrum._residual(np.hstack([basis, basis]), v) == pytest.approx(
        spectrum._residual(basis, v), rel=1e-9)


@pytest.mark.gate
def test_noise_has_no_dominant_frequency():
    rng = np.random.default_rng(6)
    alarms = [dominant_tone(times(50, 8), rng.normal(size=400)).false_alarm
              for _ in range(60)]
    assert np.mean(np.array(alarms) < 0.05) < 0.2
    assert np.median(alarms) > 0.1


@pytest.mark.parametrize(("values", "message"), [
    (np.zeros(100), "values must vary"),
    (np.full(100, np.nan), "8 finite samples, got 0"),
    (np.zeros(99), "one per time")])
def test_traces_without_an_answer_are_refused(values, message):
    with pytest.raises(ValueError, match=message):
        dominant_tone(times(10, 10), values)


def test_a_20_fps_source_aliases_at_10_hz_and_not_at_1_hz():
    with pytest.warns(AnalysisWarning, match="frames: a load of 10 Hz aliases at 20"):
        assert alias_warning(10.0, 20.0, "frames") is not None
    assert alias_warning(1.0, 20.0, "frames") is None
    assert alias_warning(10.0, 100.0) is None


@given(st.floats(0.5, 40), st.floats(5, 60))
def test_the_apparent_frequency_is_what_sampling_shows(load, rate):
    if rate >= 2.5 * load:
        return
    with pytest.warns(AnalysisWarning) as found:
        alias_warning(load, rate)
    apparent = float(str(found[0].message).split("appears at ")[1].split(" Hz")[0])
    k = np.arange(50) / rate
    np.testing.assert_allclose(
        np.cos(2 * np.pi * load * k),
        np.cos(2 * np.pi * abs(load - rate * round(load / rate)) * k), atol=1e-6)
    assert apparent == pytest.approx(
        abs(load - rate * round(load / rate)), rel=0.01, abs=1e-3)


@pytest.mark.parametrize(("load", "rate", "locked"), [
    (10.0, 20.003, True), (20.0, 20.003, True), (10.0, 10.0, True), (5.0, 20.0, False),
    (1.0, 20.0, False), (9.7, 20.0, False), (10.0, 15.0, False)])
def test_samples_at_one_phase_or_at_opposite_ones_are_locked(load, rate, locked):
    t = np.rint(7_000 + np.arange(80) * 1e6 / rate).astype(np.int64)
    assert phase_locked(t, load) is locked
    assert phase_locked(t[:2], load)


def test_lock_in_equals_the_fit_of_each_pixel():
    rng = np.random.default_rng(7)
    t = times(60, 4)
    amplitude, phase = rng.uniform(0, 1, (5, 6)), rng.uniform(-3, 3, (5, 6))
    lock = LockIn((5, 6), 3.0, EPOCH)
    stack = []
    for now in t:
        u = 2 * np.pi * 3.0 * (now - EPOCH) / 1e6
        image = 2 + amplitude * np.cos(u + phase) + rng.normal(0, 0.1, (5, 6))
        valid = rng.uniform(size=(5, 6)) > 0.3
        valid[0, 0] = False
        stack.append(np.where(valid, image, np.nan))
        lock.add(now, image.astype(np.float32), valid)
    maps = lock.maps()
    assert np.isnan(maps.amplitude[0, 0])
    assert not maps.significant[0, 0]
    stack = np.array(stack)
    u = 2 * np.pi * 3.0 * (t - EPOCH) / 1e6
    basis = np.stack((np.ones_like(u), np.cos(u), np.sin(u)), axis=1)
    for y, x in ((1, 1), (2, 5), (4, 0)):
        usable = np.isfinite(stack[:, y, x])
        a, v = basis[usable], stack[usable, y, x]
        (mean, c, s), (rest,), _, _ = np.linalg.lstsq(a, v, rcond=None)
        spread = np.linalg.inv(a.T @ a)
        se = np.sqrt(rest / (len(v) - 3) * (spread[1, 1] + spread[2, 2]) / 2)
        for name, value in (("mean", mean), ("amplitude", np.hypot(c, s)),
                            ("phase", np.arctan2(-s, c)), ("count", len(v)),
                            ("amplitude_se", se)):
            assert getattr(maps, name)[y, x] == pytest.approx(value, rel=1e-5)
    known = np.isfinite(maps.amplitude)
    assert np.all(np.abs(maps.amplitude - amplitude)[known]
                  < 5 * maps.amplitude_se[known])
    assert maps.significant[known & (amplitude > 0.1)].all()


def test_smoothed_maps_average_the_phasors_of_known_pixels():
    rng = np.random.default_rng(8)
    phasor = rng.normal(size=(7, 9)) + 1j * rng.normal(size=(7, 9))
    se = rng.uniform(0.1, 0.2, (7, 9))
    phasor[2, 3] = se[2, 3] = np.nan
    maps = LockInMaps(3.0, 0, np.ones((7, 9)), np.abs(phasor), se, np.angle(phasor),
                      np.full((7, 9), 50.0))
    smooth = maps.smoothed(3)
    got = smooth.amplitude * np.exp(1j * smooth.phase)
    for y, x in ((0, 0), (2, 4), (5, 5), (6, 8)):
        part = (slice(max(y - 1, 0), y + 2), slice(max(x - 1, 0), x + 2))
        assert got[y, x] == pytest.approx(np.nanmean(phasor[part]))
        n = max(np.count_nonzero(np.isfinite(se[part])) / 4, 1)
        assert smooth.amplitude_se[y, x] == pytest.approx(
            np.sqrt(np.nanmean(se[part] ** 2) / n))
    assert np.isnan(smooth.amplitude[2, 3])
    np.testing.assert_allclose(smooth.mean[np.isfinite(phasor)], 1)
    assert maps.smoothed(1) is maps
    with pytest.raises(ValueError, match="size must be odd and positive, got 2"):
        maps.smoothed(2)


def test_smoothing_takes_out_what_neighbours_do_not_share():
    x = np.arange(40) + np.zeros((40, 1))
    truth = 0.2 + 0.03 * np.sin(x / 5)
    rng = np.random.default_rng(9)
    maps = LockInMaps(3.0, 0, truth, truth * (1 + 0.05 * rng.normal(size=truth.shape)),
                      np.full_like(truth, 0.001), np.zeros_like(truth), truth)
    error = [np.std(m.amplitude - truth) for m in (maps, maps.smoothed(3))]
    assert error[1] < 0.5 * error[0]


def test_lock_in_refuses_another_shape():
    with pytest.raises(ValueError, match="image must have shape"):
        LockIn((4, 4), 1.0, 0).add(0, np.zeros((4, 5)))


def test_cycle_average_returns_the_waveform_and_its_spread():
    rng = np.random.default_rng(8)
    t = times(100, 40)
    phase = np.mod((t - EPOCH) / 1e6 * 2.0, 1)
    cycle = cycle_average(t, phase ** 2 + rng.normal(0, 0.1, len(t)), 2.0, bins=20)
    assert cycle.count.sum() == len(t)
    some = cycle.count > 0
    expected = cycle.phase[some] ** 2
    assert np.all(np.abs(cycle.mean[some] - expected)
                  < 5 * cycle.se[some] + 0.06)  # the bin is 0.05 wide
    assert np.nanmean(cycle.sd) == pytest.approx(0.1, rel=0.1)


def test_drift_per_cycle_is_found():
    t = times(100, 20)
    n = (t - EPOCH) / 1e6 * 2.0
    v = 0.3 + 0.002 * n + (0.1 - 0.001 * n) * np.cos(2 * np.pi * n)
    drift = cycle_drift(t, v, 2.0)
    assert len(drift.cycle) == 40
    assert drift.mean_per_cycle == pytest.approx(0.002, rel=0.02)
    assert drift.amplitude_per_cycle == pytest.approx(-0.001, rel=0.02)
    assert drift.mean_per_cycle_se < 1e-4


@given(st.floats(0.01, 1.2), st.floats(1, 500), st.floats(300, 900))
def test_birefringence_returns_from_malus_and_the_retarder(delta, thickness, colour):
    dolp = np.sin(delta)
    got, se = retardance(dolp, 1e-4)
    assert got == pytest.approx(delta, rel=1e-9)
    assert se == pytest.approx(1e-4 / np.cos(delta), rel=1e-6)
    dn = birefringence(got, thickness_um=thickness, wavelength_nm=colour)
    assert 2 * np.pi * dn * thickness * 1000 / colour == pytest.approx(delta)


def test_retardance_warns_where_it_folds_back_and_knows_no_dolp_above_one():
    with pytest.warns(AnalysisWarning, match="2 of 3 DoLP values exceed"):
        delta, se = retardance([0.5, 0.97, 1.01])
    assert np.isnan(delta[2])
    assert se is None
    with pytest.raises(ValueError, match="thickness_um must be positive"):
        birefringence(1.0, thickness_um=0, wavelength_nm=500)


def test_background_is_removed_and_a_clean_one_changes_nothing():
    rng = np.random.default_rng(9)
    sample = np.stack((rng.uniform(5, 9, (4, 5)), *rng.uniform(-1, 1, (2, 4, 5))))
    clean = np.stack((np.ones((4, 5)), np.zeros((4, 5)), np.zeros((4, 5))))
    np.testing.assert_array_equal(subtract_background(sample, clean), sample)
    tilted = clean.copy()
    tilted[1], tilted[2] = 0.03, -0.02
    mixed = sample.copy()
    mixed[1:] += sample[0] * tilted[1:]
    np.testing.assert_allclose(subtract_background(mixed, tilted), sample, atol=1e-12)
    with pytest.raises(ValueError, match=r"background must be \(3, ...\)"):
        subtract_background(sample, np.ones((4, 5)))
