"""Kernels of scenes with structure against their twins, and what they refuse."""
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import reference_simulate as reference

from pdavis_cv import _kernels
from pdavis_cv.simulation import Fan, Texture
from pdavis_cv.simulation.dvs import DvsPixel, PixelArray


def drawn(*shape, seed=0):
    array = np.random.default_rng(seed).normal(size=shape)
    array.flags.writeable = False
    return array


@pytest.mark.parametrize("shape", [(3, 4, 37), (1, 1, 1), (0, 2, 3), (2, 0, 3),
                                   (2, 3, 0)])
def test_plane_waves_match_reference(shape):
    waves, rows, columns = shape
    down, along = drawn(2, waves, rows), drawn(2, waves, columns, seed=1)
    out = np.full((rows, columns), 7.0)
    _kernels.plane_waves(*down, *along, out)
    np.testing.assert_array_equal(out, reference.plane_waves(*down, *along))


@pytest.mark.parametrize("n", [0, 1, 5, 1003])
def test_texture_stokes_match_reference(n):
    fields = 2.0 * drawn(3, n)
    fields[2] *= 100            # many turns
    about = (30.0, 0.5, 0.5, 0.4, 0.8, 0.6)
    want = reference.texture_stokes(fields.copy(), *about)
    _kernels.texture_stokes(*fields, *about)
    np.testing.assert_allclose(fields[0], want[0], rtol=1e-15)
    for got, expected in zip(fields[1:], want[1:], strict=True):
        np.testing.assert_allclose(got / want[0], expected / want[0], atol=4e-15)


def test_sine_and_cosine_are_right_where_they_are_small():
    near = np.outer(np.arange(-40, 41), [np.pi / 2]) + np.array([0, 1e-9, -1e-5])
    fields = np.zeros((3, near.size))
    fields[2] = near.ravel() / 2
    _kernels.texture_stokes(*fields, 1.0, 1.0, 1.0, 0.0, 0.0, 1.0)
    np.testing.assert_allclose(fields[1], np.cos(near.ravel()), rtol=1e-15, atol=1e-19)
    np.testing.assert_allclose(fields[2], np.sin(near.ravel()), rtol=1e-15, atol=1e-19)


def wheel(times, n):
    rng = np.random.default_rng(3)
    turns, rest = rng.uniform(0, 6, times), rng.uniform(-3, 3, n)
    steep, light = rng.uniform(0.01, 60, n), rng.uniform(0, 9, n)
    sectors = np.exp(1j * rng.uniform(0, 7, (times, 18)))
    return turns, sectors, rest, steep, light


@pytest.mark.parametrize(("times", "n"), [(0, 3), (2, 0), (1, 1), (7, 501)])
def test_fan_stokes_match_reference(times, n):
    turns, sectors, *still = wheel(times, n)
    s1, s2 = np.empty((2, times, n))
    _kernels.fan_stokes(turns, np.ascontiguousarray(sectors.real),
                        np.ascontiguousarray(sectors.imag), *still, s1, s2)
    want = reference.fan_stokes(turns, sectors, *still)
    np.testing.assert_array_equal(s1, want.real)
    np.testing.assert_array_equal(s2, want.imag)


@pytest.mark.parametrize("name", ["turns", "rest"])
@pytest.mark.parametrize("value", [np.nan, 6.5, -4.0])
def test_fan_stokes_refuse_places_outside_the_table(name, value):
    turns, sectors, rest, steep, light = wheel(2, 3)
    {"turns": turns, "rest": rest}[name][1] = value
    with pytest.raises(ValueError, match=f"fan_stokes: {name} must lie in"):
        _kernels.fan_stokes(turns, sectors.real.copy(), sectors.imag.copy(), rest,
                            steep, light, *np.empty((2, 2, 3)))


def test_a_wheel_is_the_same_by_the_kernel_and_without():
    fan = Fan(rpm=-3000.0, start_angle=0.7)
    x, y = np.arange(100.0, 240)[None, :], np.arange(60.0, 200)[:, None]
    t = np.array([0.0, 1234.0, 7e6])
    together = fan.stokes(t[:, None, None], x, y)
    for k, one in enumerate(t):
        for got, want in zip(together, fan.stokes(one, x, y), strict=True):
            np.testing.assert_allclose(got[k], want, rtol=1e-12, atol=1e-12)


def test_a_texture_is_the_same_at_one_place_and_at_many():
    texture = Texture(seed=5)
    x, y = np.arange(40.0)[None, :], np.arange(30.0)[:, None]
    together = texture.stokes(np.array([0.0, 5e5])[:, None, None], x, y)
    alone = texture.stokes(5e5, 17.0, 11.0)
    for got, want in zip(together, alone, strict=True):
        np.testing.assert_allclose(got[1, 11, 17], want, rtol=1e-12)


@pytest.mark.parametrize("constant", [True, False])
@pytest.mark.parametrize(("times", "n"), [(0, 3), (2, 0), (1, 1), (5, 77)])
def test_analysed_light_matches_reference(times, n, constant):
    analyser, (s1, s2) = drawn(3, n), drawn(2, times, n, seed=1)
    s0 = drawn(1 if constant else times, n, seed=2)
    out = np.empty((times, n))
    _kernels.analysed(analyser, s0, s1, s2, out)
    np.testing.assert_array_equal(
        out, analyser[0] * s0 + analyser[1] * s1 + analyser[2] * s2)


def test_shapes_that_do_not_fit_are_refused():
    a, b = np.zeros((2, 3)), np.zeros((3, 2))
    row = np.zeros(3)
    for call in (lambda: _kernels.plane_waves(a, a, a, b, np.zeros((3, 3))),
                 lambda: _kernels.plane_waves(a, a, a, a, a),
                 lambda: _kernels.texture_stokes(row, row[:2], row, *[1.0] * 6),
                 lambda: _kernels.fan_stokes(row, a, a, row, row, row, a, a),
                 lambda: _kernels.analysed(a, a, a, a, a)):
        with pytest.raises(ValueError, match=": shapes do not fit"):
            call()


def test_eight_threads_compute_the_same_light():
    texture = Texture(seed=2)
    x, y = np.arange(64.0)[None, :], np.arange(16.0)[:, None]
    t = 500.0 * np.arange(20)[:, None, None]
    with ThreadPoolExecutor(8) as pool:
        found = list(pool.map(lambda _: texture.stokes(t, x, y), range(16)))
    for each in found[1:]:
        for got, want in zip(each, found[0], strict=True):
            np.testing.assert_array_equal(got, want)


@pytest.mark.parametrize("more", [{}, {"cutoff_hz": None}, {"cutoff_hz_per_dn_ms": 9.0},
                                  {"dark_dn_ms": 0.5}])
def test_many_intervals_at_once_make_the_events_of_few_at_a_time(more):
    """Logs of few intervals are computed for several pixels at once."""
    pixel = DvsPixel(**{"cutoff_hz": 250.0, "leak_hz": 5.0, "shot_noise_hz": 20.0,
                        "refractory_us": 30.0, **more})
    size, intervals, step = (3, 15), 80, 128.0
    rng = np.random.default_rng(4)
    light = np.exp(np.cumsum(rng.normal(0, 0.2, (intervals + 1, 45)), 0))
    light[20:30, 3] = -1.0
    slope = 0.1 * rng.normal(size=light.shape)

    def events(every):
        pixels = PixelArray(pixel, pixel.maps(1, size, (0, 0)), 7)
        pixels.settle(light[0].reshape(size))
        parts = []
        for k in range(0, intervals, every):
            nodes = slice(k, k + every + 1)
            parts += [part.copy() for part in pixels.advance(
                k * step, step, light[nodes], slope[nodes])]
        return np.sort(np.concatenate(parts), order=["y", "x", "t", "p"])

    whole = events(intervals)
    assert len(whole) > 400
    for every in (1, 16, 40):
        np.testing.assert_array_equal(events(every), whole)
