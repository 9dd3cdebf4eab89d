"""Periodic signals and the optics of a retarder."""
import numpy as np
import pytest
from hypothesis import given, strategies as st

from pdavis_cv import AnalysisWarning
from pdavis_cv.analysis import birefringence, retardance, subtract_background, trace_hz

EPOCH = 1_700_000_000_000_000  # Unix time in us, as DV writes it


def times(fps, seconds, start=EPOCH):
    return start + np.rint(np.arange(int(fps * seconds)) * 1e6 / fps).astype(np.int64)


def wave(t, hz, phase=0.0):
    return np.cos(2 * np.pi * hz * (t - t[0]) / 1e6 + phase)


@pytest.mark.parametrize("hz", [0.31, 1.0, 5.0, 10.0, 17.3])
def test_the_frequency_of_a_trace_is_found(hz):
    rng = np.random.default_rng(3)
    t = times(100, 10)
    v = 0.4 + 1e-9 * (t - t[0]) + 0.05 * wave(t, hz, 0.7) + rng.normal(0, 0.02, len(t))
    found, part = trace_hz(t, v)
    assert abs(found / hz - 1) < 0.005
    assert part == pytest.approx(0.05**2 / (0.05**2 + 2 * 0.02**2), abs=0.05)


def test_harmonics_do_not_pull_the_frequency():
    t = times(200, 1)       # two and a half cycles
    v = wave(t, 2.5) + 0.3 * wave(t, 5.0, 1.0) + 0.1 * wave(t, 7.5, -2.0)
    assert trace_hz(t, v)[0] == pytest.approx(2.5, rel=1e-3)


def test_missing_values_do_no_harm():
    t = times(100, 9)
    v = wave(t, 7.25)
    v[::7] = np.nan
    v[300:400] = np.nan
    assert trace_hz(t, v)[0] == pytest.approx(7.25, abs=1e-4)


def test_of_two_traces_the_steady_one_is_explained_better():
    t, noise = times(50, 8), np.random.default_rng(6).normal(size=400)
    parts = [trace_hz(t, size * wave(t, 3.0) + noise)[1] for size in (0, 0.5, 2)]
    assert parts == sorted(parts)
    assert parts[0] < 0.15


@pytest.mark.parametrize(("values", "message"), [
    (np.zeros(100), "values must vary"),
    (np.full(100, np.nan), "8 finite samples, got 0")])
def test_traces_without_an_answer_are_refused(values, message):
    with pytest.raises(ValueError, match=message):
        trace_hz(times(10, 10), values)


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
