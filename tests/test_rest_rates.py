"""Leak and noise events of pixels at rest, by intensity."""
import numpy as np
import pytest
from test_selfcal import looked_on

from pdavis_cv import EVENT_DTYPE, ApsFrame
from pdavis_cv.selfcal.rest_rates import fit_rest_rates
from pdavis_cv.selfcal.window import PixelWindow
from pdavis_cv.simulation import Camera, RotatingPolarizer, Texture

SHAPE, SECONDS, FRAMES = (40, 40), 8.0, 41


def window(leak, noise, *, move=None):
    """A window of pixels with 5 to 40 DN/ms that make Poisson events at these rates.

    leak and noise are functions of the intensity; move: intensity at time t, relative.
    """
    rng, kept = np.random.default_rng(1), PixelWindow(SHAPE)
    light = np.geomspace(5, 40, SHAPE[0] * SHAPE[1]).reshape(SHAPE)
    places = np.arange(light.size)
    events = []
    for sign, hz in ((1, leak(light) + noise(light) / 2), (0, noise(light) / 2)):
        where = np.repeat(places, rng.poisson(hz.ravel() * SECONDS))
        these = np.zeros(len(where), EVENT_DTYPE)
        these["y"], these["x"] = np.divmod(where, SHAPE[1])
        these["t"], these["p"] = rng.integers(0, int(SECONDS * 1e6), len(where)), sign
        events.append(these)
    events = np.concatenate(events)
    events = events[np.argsort(events["t"], kind="stable")]
    for mid in np.linspace(5000, SECONDS * 1e6 - 5000, FRAMES).astype(int):
        until = np.searchsorted(events["t"], mid)
        kept.add_events(events[:until])
        events = events[until:]
        dn = 10 * light * (1.0 if move is None else move(mid * 1e-6))
        dn = dn + rng.normal(0, 2, SHAPE)
        kept.add_frame(ApsFrame(dn.astype(np.float32), mid - 5000, mid + 5000))
    return kept


def test_rates_and_their_growth_with_light_are_found():
    """Poisson processes: the standard error of a mean rate is (rate / pixels T)^.5."""
    found = fit_rest_rates(window(lambda i: 0.1 + 0.02 * i, lambda i: 2 - 0.04 * i))
    assert len(found.light) == 3
    leak, noise = 0.1 + 0.02 * found.light, 2 - 0.04 * found.light
    for rate, sigma, true, spread in (
            (found.leak_hz, found.leak_sigma, leak, leak + noise),
            (found.noise_hz, found.noise_sigma, noise, 2 * noise)):
        assert np.all(np.abs(rate - true) < 3.5 * sigma)
        # A class is a third of the pixels, for 8 s.
        np.testing.assert_allclose(
            sigma, np.sqrt(spread / (SHAPE[0] * SHAPE[1] / 3 * SECONDS)), rtol=0.15)
    for value, sigma, true in zip(
            found.leak_law, found.leak_law_sigma, (0.1, 0.02), strict=True):
        assert abs(value - true) < 3.5 * sigma
    assert found.leak_law_sigma[1] < 0.003


@pytest.mark.parametrize("move", [
    lambda t: 1 + 0.3 * np.sin(7 * t), lambda t: 1.0 if t < 4 else 1.2])
def test_light_that_moves_tells_nothing(move):
    assert fit_rest_rates(window(lambda i: 0.2 + 0 * i, lambda i: 1 + 0 * i,
                                 move=move)) is None


def test_light_that_repeats_with_the_frames_is_not_at_rest():
    """Turned by half in 20 ms, a polarizer looks alike in every exposure of 20 ms."""
    camera = Camera.preset("nominal", seed=1, size=(8, 8))
    recording, _ = camera.record(RotatingPolarizer(rpm=1500.0), 1.0)
    found = looked_on(recording).estimate(wanted={"rest_rates"})
    assert found.rest_rates is None


def test_one_intensity_tells_no_growth():
    flat = fit_rest_rates(window(lambda i: 0.3 + 0 * i, lambda i: 1 + 0 * i))
    assert abs(flat.leak_law[1]) < 3.5 * flat.leak_law_sigma[1]
    kept = PixelWindow((8, 8))
    for k in range(10):
        kept.add_frame(ApsFrame(np.full((8, 8), 100, np.float32), 50_000 * k,
                                50_000 * k + 10_000))
    found = fit_rest_rates(kept)
    assert found.leak_law is None
    assert found.leak_hz[0] == 0
    assert found.leak_sigma[0] == pytest.approx(1 / (64 * 0.45))


def test_a_still_texture_shows_a_simulated_camera_s_leak():
    camera = Camera.preset("nominal", seed=2, size=(32, 32), dvs={
        "shot_noise_hz": 0.0, "leak_hz": 2.0})
    recording, _ = camera.record(Texture(velocity=(0.0, 0.0), seed=2), 8.0)
    rates = looked_on(recording).estimate(wanted={"rest_rates"}).rest_rates
    assert np.all(rates.noise_hz == 0)
    # All pixels begin alike, so counts may be off by an event in 8 s.
    np.testing.assert_allclose(rates.leak_hz, 2.0, atol=1 / 8)
