"""Periodic signals and the optics of a retarder."""
import tracemalloc

import numpy as np
import pytest
from hypothesis import given, strategies as st
from scipy.signal import lombscargle

from pdavis_cv import AnalysisWarning
from pdavis_cv.analysis import (
    birefringence,
    dominant_tone,
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
    tones = [dominant_tone(t, wave(t, 3.0) + rng.normal(0, 0.5, len(t)), harmonics=1)
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


def test_what_lapack_cannot_solve_is_refused(capfd):
    t = times(50, 8)
    with pytest.raises(ValueError, match=r"values must lie within 1e\+100 of 0"):
        dominant_tone(t, 1e300 * wave(t, 1.0))
    assert np.isfinite(dominant_tone(t, 1e99 * wave(t, 1.0)).amplitude).all()
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
