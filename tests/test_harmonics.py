"""Periodic light by frames that blur it: amplitude, phase, errors, refusals."""
import re

import numpy as np
import pytest

from pdavis_cv.analysis import (
    HarmonicFit,
    PhaseLaw,
    Roi,
    event_hz,
    fit_harmonics,
    fit_periodic,
    loop_area,
    mosaic_errors,
    of_aop,
    of_dolp,
    specimen_errors,
)
from pdavis_cv.mosaic import demosaic
from pdavis_cv.sensor import Layout
from pdavis_cv.simulation import Camera, FlatLight, Tendon

EPOCH = 1_700_000_000_000_000
EXPOSURE = 20_000


def times(fps, seconds):
    return EPOCH + np.rint(np.arange(int(fps * seconds)) * 1e6 / fps).astype(np.int64)


def blurred(t, light, exposure=EXPOSURE):
    """Mean of light(seconds) over exposures around t."""
    nodes, weights = np.polynomial.legendre.leggauss(12)
    at = ((t - EPOCH)[:, None] + nodes * exposure / 2) / 1e6
    return light(at) @ weights / 2


def stokes(dolp, noise=0.0, seed=0):
    """S0, S1, S2 at 18.4 degrees, shape (1, T, 3)."""
    s = np.stack((np.ones_like(dolp), 0.8 * dolp, 0.6 * dolp), 1)
    return (s + np.random.default_rng(seed).normal(0, noise, s.shape))[None]


def fitted(light, hz, fps=25.0, seconds=20.0, noise=1e-3, exposure=EXPOSURE, seed=0):
    t = times(fps, seconds)
    return fit_periodic(t, stokes(blurred(t, light, exposure), noise, seed),
                        np.full(len(t), float(exposure)), hz, EPOCH)


def wave(hz, amplitude=0.05, phase=0.5):
    return lambda t: 0.3 + amplitude * np.cos(2 * np.pi * hz * t + phase)


def twin(law, t, values, exposure, harmonics, degree, span):
    """Least squares of one pixel, written down again: coefficients, noise, inverse."""
    turn = 2 * np.pi * law.hz * (t - law.reference_us) / 1e6
    basis = [np.ones(len(t))]
    for k in range(1, harmonics + 1):
        x = np.pi * k * law.hz * exposure / 1e6
        basis += [np.sin(x) / x * np.cos(k * turn), np.sin(x) / x * np.sin(k * turn)]
    x = 2 * (t - span[0]) / (span[1] - span[0]) - 1
    basis += [x, (3 * x ** 2 - 1) / 2][:degree]
    a = np.stack(basis, 1)
    found = np.linalg.lstsq(a, values, rcond=None)[0]
    rest = values - a @ found
    keep = 1 + 2 * harmonics
    return (found[:keep].T, rest.T @ rest / (len(t) - a.shape[1]),
            np.linalg.inv(a.T @ a)[:keep, :keep])


def test_the_fit_of_images_equals_that_of_each_pixel():
    rng = np.random.default_rng(1)
    t, law = times(30, 3), PhaseLaw.steady(3.1, EPOCH)
    span = int(t[0]), int(t[-1])
    images = 2 + rng.normal(size=(len(t), 3, 4, 5))
    valid = rng.uniform(size=(len(t), 4, 5)) > 0.2
    valid[:, 2:] = True
    valid[:, 0, 0] = False
    fit = HarmonicFit((4, 5), law, harmonics=2, degree=2, span_us=span)
    for now, image, usable in zip(t, images, valid, strict=True):
        fit.add(now, image, EXPOSURE, usable)
    found = fit.result()
    assert np.isnan(found.coefficients[:, :, 0, 0]).all()
    for y, x in ((0, 1), (1, 4), (3, 2)):
        some = valid[:, y, x]
        coefficients, noise, inverse = twin(
            law, t[some], images[some, :, y, x], EXPOSURE, 2, 2, span)
        np.testing.assert_allclose(found.coefficients[:, :, y, x], coefficients,
                                   rtol=1e-6, atol=1e-9)
        np.testing.assert_allclose(found.noise[:, :, y, x], noise, rtol=1e-6, atol=1e-9)
        np.testing.assert_allclose(found.shape_covariance[:, :, y, x], inverse,
                                   rtol=1e-6, atol=1e-12)
        assert found.count[y, x] == some.sum()
    with pytest.raises(ValueError, match="image must have shape"):
        fit.add(int(t[0]), np.zeros((3, 4, 6)))


@pytest.mark.parametrize("hz", [1.0, 2.0, 4.3, 9.9, 19.7, 25.2, 33.0])
def test_amplitude_and_phase_are_those_of_the_light(hz):
    found = fitted(wave(hz), hz * 1.01)
    assert found.reasons == ("",)
    got = found.regions[0].wave(of_dolp)
    assert abs(found.law.hz - hz) < 5 * found.law.hz_se
    assert got.amplitude[0] == pytest.approx(0.05, abs=4 * got.amplitude_se)
    assert got.amplitude_se < 0.02 * 0.05
    error = np.hypot(got.phase_se, found.law.phase_se)
    assert got.phase[0] == pytest.approx(0.5, abs=4 * error)
    assert got.mean == pytest.approx(0.3, abs=4 * got.mean_se)
    assert found.regions[0].wave(of_aop).mean == pytest.approx(
        np.arctan2(0.6, 0.8) / 2, abs=1e-3)


def test_harmonics_of_the_light_return():
    found = fitted(lambda t: 0.3 + 0.05 * np.cos(2 * np.pi * 3.3 * t)
                   + 0.01 * np.cos(4 * np.pi * 3.3 * t + 1), 3.3)
    got = found.regions[0].wave(of_dolp)
    np.testing.assert_allclose(got.amplitude[:2], [0.05, 0.01], atol=1e-3)
    assert got.phase[1] == pytest.approx(1.0, abs=0.05)


@pytest.mark.gate
def test_the_stated_errors_are_those_of_many_trials():
    found = [fitted(wave(4.3), 4.3, noise=0.01, seconds=6.0, seed=seed)
             for seed in range(100)]
    waves = [one.regions[0].wave(of_dolp) for one in found]
    amplitude = np.array([one.amplitude[0] for one in waves])
    assert amplitude.std() == pytest.approx(
        np.mean([one.amplitude_se for one in waves]), rel=0.2)
    phase = np.array([one.phase[0] for one in waves])
    assert phase.std() == pytest.approx(np.mean(
        [np.hypot(a.phase_se, b.law.phase_se) for a, b in zip(
            waves, found, strict=True)]), rel=0.2)
    assert np.std([one.law.hz for one in found]) == pytest.approx(
        np.mean([one.law.hz_se for one in found]), rel=0.2)


def test_a_turning_polarizer_swings_in_s1_and_s2():
    t, turns = times(25, 6), 3.3        # AoP turns half as fast as the plate
    s1, s2 = (blurred(t, lambda now, of=of: 0.9 * of(2 * np.pi * turns * now + 0.4))
              for of in (np.cos, np.sin))
    light = np.stack((np.ones(len(t)), s1, s2), 1)[None]
    light += np.random.default_rng(1).normal(0, 0.003, light.shape)
    found = fit_periodic(t, light, np.full(len(t), 2e4), 3.3, EPOCH,
                         quantity=lambda s: s[1])
    assert found.reasons == ("",)
    got = found.regions[0].wave(lambda s: s[1])
    assert got.amplitude[0] == pytest.approx(0.9, abs=4 * got.amplitude_se)
    assert got.phase[0] == pytest.approx(0.4, abs=0.01)
    assert fit_periodic(t, light, np.full(len(t), 2e4), 3.3, EPOCH).reasons != ("",)


@pytest.mark.parametrize("seconds", [20.0, 60.0])
def test_a_frequency_that_drifts_by_a_percent_is_followed(seconds):
    def turns(t):
        return 4.3 * t * (1 + 0.01 * t / (2 * seconds))

    found = fitted(lambda t: 0.3 + 0.05 * np.cos(2 * np.pi * turns(t) + 0.5), 4.3,
                   seconds=seconds)
    t = times(25, seconds)
    np.testing.assert_allclose(found.law.rate(t[[0, -1]]), [4.3, 4.343], rtol=2e-4)
    np.testing.assert_allclose(found.law.cycles(t), turns((t - EPOCH) / 1e6), atol=0.01)
    got = found.regions[0].wave(of_dolp)
    assert got.amplitude[0] == pytest.approx(0.05, rel=0.01)
    assert got.phase[0] == pytest.approx(0.5, abs=0.03)


@pytest.mark.parametrize("beside", [
    lambda t: 0.01 * t, lambda t: 0.1 * np.exp(-t / 4)])
def test_a_ramp_and_relaxation_do_no_harm(beside):
    found = fitted(lambda t: wave(4.3)(t) + beside(t), 4.3)
    assert found.regions[0].wave(of_dolp).amplitude[0] == pytest.approx(0.05, rel=0.01)


@pytest.mark.parametrize(("light", "hz", "reason"), [
    (wave(50.0), 50.0, "exposures of 20 ms blur 50 Hz to 0% of its amplitude"),
    (wave(25.0), 25.0, "25 frames per second see 25 Hz always at the same phases"),
    (wave(12.5), 12.5, "see 12.5 Hz always at the same phases"),
    (lambda t: 0.3 + 0 * t, 4.3, "no periodic light stands out"),
    (lambda t: 0.3 + 0.1 * (t > 9), 0.15, "no (steady|periodic)|but not with a period"),
    (lambda t: 0.3 + 0.1 * (t > 9), 4.3, "no (steady|periodic)"),
    (wave(0.05), 0.05, "1.0 cycles of 0.05 Hz, 2 are needed")])
def test_what_frames_cannot_tell_is_refused_with_the_reason(light, hz, reason):
    assert re.search(reason, fitted(light, hz).reasons[0])


def test_a_frequency_that_no_clock_resolves_is_refused():
    # In float16 the largest frequency is infinite, so a comparison there lets it pass.
    for hz in (0, -1.0, np.float16("inf")):
        with pytest.raises(ValueError, match="hz must be positive and at most 500000"):
            fitted(wave(1.0), hz)


@pytest.mark.parametrize("hz", [
    5.065, 20.26, pytest.param(33.0, marks=pytest.mark.gate)])
def test_events_tell_the_frequency_where_frames_alias(hz):
    camera = Camera.preset("davis346", seed=1001, size=(28, 36))
    recording, _ = camera.record(Tendon(hz=hz), 3.0)
    region = Roi.from_rectangle(4, 4, 28, 20)
    found = event_hz(recording, [region], recording.info.layout, 0, 3_000_000)
    assert found == pytest.approx(hz, abs=0.1)


def test_events_of_still_light_have_no_frequency():
    camera = Camera.preset("davis346", seed=1001, size=(28, 36))
    region = Roi.from_rectangle(4, 4, 28, 20)
    still, _ = camera.record(FlatLight(dolp=0.3), 1.0)
    assert event_hz(still, [region], still.info.layout, 0, 1_000_000) is None
    assert event_hz(still, [region], still.info.layout, 0, 10_000) is None
    with pytest.raises(ValueError, match="rois must be one or more, got none"):
        event_hz(still, [], still.info.layout, 0, 1_000_000)


def test_columns_that_are_exposed_later_are_brought_to_one_time():
    t, hz = times(30, 4), 3.1
    delay = np.linspace(0, 0.01, 8)
    fit = HarmonicFit((1, 8), PhaseLaw.steady(hz, EPOCH), harmonics=1, degree=0,
                      span_us=(int(t[0]), int(t[-1])), signals=1)
    for now in t:
        seconds = (now - EPOCH) / 1e6 + delay
        fit.add(now, np.cos(2 * np.pi * hz * seconds + 0.3)[None, None])
    late = fit.result()
    np.testing.assert_allclose(late.delayed(delay).wave().phase[0, 0], 0.3, atol=1e-9)
    assert late.wave().phase[0, 0, -1] == pytest.approx(0.3 + 2 * np.pi * hz * 0.01)


def test_smoothing_averages_known_pixels():
    rng = np.random.default_rng(8)
    t = times(20, 2)
    fit = HarmonicFit((7, 9), PhaseLaw.steady(3.0, EPOCH), harmonics=1, degree=0,
                      span_us=(int(t[0]), int(t[-1])), signals=1)
    usable = np.ones((7, 9), bool)
    usable[2, 3] = False
    for now in t:
        fit.add(now, rng.normal(size=(1, 7, 9)), valid=usable)
    raw = fit.result()
    smooth = raw.smoothed(3)
    for y, x in ((0, 0), (2, 4), (5, 5), (6, 8)):
        part = (..., slice(max(y - 1, 0), y + 2), slice(max(x - 1, 0), x + 2))
        np.testing.assert_allclose(smooth.coefficients[0, :, y, x], np.nanmean(
            raw.coefficients[0][part], (1, 2)), atol=1e-12)
        n = max(np.count_nonzero(usable[part]) / 4, 1)
        assert smooth.noise[0, 0, y, x] == pytest.approx(
            np.nanmean(raw.noise[0, 0][part]) / n)
    assert np.isnan(smooth.coefficients[:, :, 2, 3]).all()
    assert raw.smoothed(1) is raw
    with pytest.raises(ValueError, match="size must be odd and positive, got 2"):
        raw.smoothed(2)


def test_the_loop_of_an_ellipse_has_its_area_and_its_sense():
    t, law = times(100, 5), PhaseLaw.steady(1.0, EPOCH)

    def of(amplitude, phase, noise=0.0):
        v = amplitude * np.cos(2 * np.pi * (t - EPOCH) / 1e6 + phase)
        v += np.random.default_rng(int(100 * phase)).normal(0, noise, len(t))
        return fit_harmonics(law, t, v[:, None], harmonics=1, degree=1).wave()

    # A material that loses energy: force ahead of displacement.
    assert loop_area(of(1, 0), of(3, 0.2))[0] == pytest.approx(3 * np.pi * np.sin(0.2))
    assert loop_area(of(1, 0.2), of(3, 0))[0] < 0
    area, error = loop_area(of(1, 0, 0.1), of(3, 0.2, 0.1))
    assert abs(area - 3 * np.pi * np.sin(0.2)) < 4 * error < 0.5
    assert loop_area(of(1, 0), of(3, 0.2), 0.3)[1] == pytest.approx(
        3 * np.pi * np.cos(0.2) * 0.3, rel=1e-3)


def test_errors_of_the_polarizers_are_those_of_many_cameras():
    rng = np.random.default_rng(3)
    t = times(25, 6)
    s = stokes(blurred(t, wave(4.3)))[0]
    law, samples = PhaseLaw.steady(4.3, EPOCH), 100
    angles = np.deg2rad((0, 45, 90, 135))
    spread = (0.02, 0.012, 0.004, 0.01)

    def seen():
        gain, turn, contrast, offset = (
            sigma * rng.normal(size=4) / np.sqrt(samples) for sigma in spread)
        a = angles + turn
        quad = (1 + gain) / 2 * (
            s[:, :1] + (1 + contrast) * (np.cos(2 * a) * s[:, 1:2]
                                         + np.sin(2 * a) * s[:, 2:])) + offset
        i0, i45, i90, i135 = quad.T
        return np.stack((quad.sum(1) / 2, i0 - i90, i45 - i135), 1)

    waves = [fit_harmonics(law, t, seen(), harmonics=1, degree=0,
                           exposure_us=EXPOSURE).wave(of_dolp) for _ in range(300)]
    fit = fit_harmonics(law, t, s, harmonics=1, degree=0, exposure_us=EXPOSURE)
    stated = fit.wave(of_dolp, specimen_errors(fit, *spread, samples=samples))
    assert np.std([one.amplitude[0] for one in waves]) == pytest.approx(
        float(stated.amplitude_se), rel=0.2)
    assert np.std([one.mean for one in waves]) == pytest.approx(
        float(stated.mean_se), rel=0.2)


def test_a_harmonic_that_frames_cannot_resolve_is_no_noise():
    # Four frames a cycle show the second harmonic at two phases only.
    t = times(20, 6)
    law = PhaseLaw.steady(5.0, EPOCH)

    def stated(second):
        turn = 2 * np.pi * law.cycles(t)
        v = np.cos(turn) + second * np.cos(2 * turn)
        v += np.random.default_rng(4).normal(0, 1e-3, len(t))
        return fit_harmonics(law, t, v[:, None], harmonics=1, degree=1).wave()

    assert stated(0.1).amplitude_se == pytest.approx(stated(0.0).amplitude_se, rel=1e-6)
    assert stated(0.1).amplitude_se == pytest.approx(1e-3 * np.sqrt(2 / 120), rel=0.2)


def test_a_second_harmonic_that_falls_on_the_fundamental_is_said():
    def light(t):
        return wave(10)(t) + 0.004 * np.cos(40 * np.pi * t + 2)

    locked = fitted(light, 10.0, fps=30.0)
    assert locked.regions[0].wave(of_dolp).amplitude[0] != pytest.approx(0.05, rel=0.01)
    assert "cannot tell the second harmonic of 10 Hz" in locked.doubt
    assert "cannot tell the third harmonic" in fitted(light, 10.0, fps=40.0).doubt
    free = fitted(light, 10.0, fps=31.0)
    assert not free.doubt
    assert free.regions[0].wave(of_dolp).amplitude[0] == pytest.approx(0.05, rel=0.01)


def demosaiced(stokes, layout):
    """S0, S1, S2 of images (M, 3, H, W) seen through a mosaic of ideal polarizers."""
    out = np.empty_like(stokes)
    for seen, (s0, s1, s2) in zip(out, stokes, strict=True):
        mosaic = np.empty(s0.shape, np.float32)
        for y, x in np.ndindex(2, 2):
            a = 2 * np.deg2rad(layout.angles_deg[y][x])
            behind = (s0 + np.cos(a) * s1 + np.sin(a) * s2) / 2
            mosaic[y::2, x::2] = behind[y::2, x::2]
        i0, i45, i90, i135 = demosaic(mosaic, layout, "guided")
        seen[:] = (i0 + i45 + i90 + i135) / 2, i0 - i90, i45 - i135
    return out


@pytest.mark.parametrize("layout", [Layout.PDAVIS, Layout.SONY])
def test_errors_of_demosaicing_are_those_that_structure_makes(layout):
    rng = np.random.default_rng(8)
    y, x = np.mgrid[:44, :52].astype(float)
    law, t = PhaseLaw.steady(1.0, 0), np.arange(16) * 62_500

    def maps(images):
        fit = HarmonicFit((44, 52), law, harmonics=3, degree=0, span_us=(0, 10**6))
        for now, image in zip(t, images, strict=True):
            fit.add(int(now), image)
        return fit.result()

    ratios = []
    for _ in range(24):
        scene = Tendon(hz=1.0, fibre_angle=rng.uniform(-1.5, 1.5),
                       fibre_width=rng.uniform(5, 16))
        light = np.array([np.stack(scene.stokes(now, x, y)) for now in t])
        mask = np.zeros((44, 52), bool)
        mask[12:32, 10:10 + rng.integers(12, 32)] = True
        seen = demosaiced(light, layout)
        errors = mosaic_errors(maps(seen), [mask], layout, "guided")[0]

        def region(images, mask=mask):
            return fit_harmonics(
                law, t, images[:, :, mask].mean(2), harmonics=3, degree=0)

        true, found = region(light).wave(of_dolp), region(seen).wave(of_dolp, errors)
        ratios.append((found.amplitude[0] - true.amplitude[0]) / found.amplitude_se)
    assert 0.3 < np.mean(np.abs(ratios) < 1) < 0.85
    assert np.median(np.abs(ratios)) > 0.3

    flat = np.broadcast_to(np.reshape((1, 0.2, 0.1), (3, 1, 1)), (16, 3, 44, 52))
    assert np.abs(mosaic_errors(maps(flat), [mask], layout, "guided")[0]).max() < 1e-6
