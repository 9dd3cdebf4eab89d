"""The simulator's kernels against their twins, and what they refuse."""
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import reference_simulate as reference
from streams import random_events

from pdavis_cv import _kernels
from pdavis_cv.events import EVENT_DTYPE
from pdavis_cv.simulation import Camera, DvsPixel, VideoScene, noise
from pdavis_cv.simulation.dvs import PixelArray


def shuffled(n, shape=(5, 7), seed=0):
    events = random_events(n, shape, read_only=False)
    return events[np.random.default_rng(seed).permutation(n)]


@pytest.mark.parametrize("n", [0, 1, 3000])
def test_sort_events_matches_reference(n):
    events = shuffled(n)
    start = int(events["t"].min()) if n else 0
    span = int(events["t"].max()) - start + 1 if n else 0
    events.flags.writeable = False
    out = np.empty_like(events)
    counts = np.empty(span, np.int32)
    assert _kernels.sort_events(events, start, counts, out) == n
    np.testing.assert_array_equal(out, reference.sort_events(events))


def test_sort_events_stops_at_a_time_outside():
    events = np.zeros(4, EVENT_DTYPE)
    events["t"] = (5, 6, 9, 7)
    out, counts = np.empty_like(events), np.empty(4, np.int32)
    assert _kernels.sort_events(events, 5, counts, out) == 2
    with pytest.raises(ValueError, match="sort_events: out must have as many"):
        _kernels.sort_events(events, 5, counts, out[:2])


def bus_memory(size):
    return (np.zeros(3), np.zeros(size[0], np.int32), np.zeros(size, np.uint16),
            np.zeros(size, np.uint8))


@pytest.mark.parametrize("event_us", [0.1, 5.0])
@pytest.mark.parametrize("n", [0, 1, 2000])
def test_read_out_matches_reference(n, event_us):
    size = (5, 7)
    events = random_events(n, size, read_only=False)
    events["t"] = np.sort(np.random.default_rng(1).integers(0, 5000, n))
    out = np.empty(n, EVENT_DTYPE)
    done, lost, taken = _kernels.read_out(
        events, 5001.0, event_us, 0.4, *bus_memory(size), out)
    want, want_lost = reference.read_out(events, 5001.0, event_us, 0.4, size)
    assert taken == n
    assert lost == want_lost
    assert (lost > 100) == (n == 2000 and event_us == 5.0)
    np.testing.assert_array_equal(out[:done], want)


def test_read_out_in_pieces_equals_read_out_at_once():
    size, n = (5, 7), 2000
    events = random_events(n, size, read_only=False)
    events["t"] = np.sort(np.random.default_rng(1).integers(0, 5000, n))
    whole, pieces, memory = np.empty(n, EVENT_DTYPE), [], bus_memory(size)
    done, lost, _ = _kernels.read_out(events, 5001.0, 4.0, 0.4, *bus_memory(size),
                                      whole)
    total = 0
    for stop in (1000, 2500, 5001):
        part = events[(events["t"] < stop)
                      & (events["t"] >= {1000: 0, 2500: 1000, 5001: 2500}[stop])]
        out = np.empty(len(part) + int(memory[0][2]), EVENT_DTYPE)
        passed, more, _ = _kernels.read_out(part, float(stop), 4.0, 0.4, *memory, out)
        pieces.append(out[:passed])
        total += more
    np.testing.assert_array_equal(np.concatenate(pieces), whole[:done])
    assert total == lost


def test_read_out_refuses_what_does_not_fit():
    size = (5, 7)
    events = random_events(9, size, read_only=False)
    events["x"][4] = 7
    events["t"] = np.arange(9)
    out = np.empty(9, EVENT_DTYPE)
    assert _kernels.read_out(events, 99.0, 0.1, 0.0, *bus_memory(size), out)[2] == 4
    with pytest.raises(ValueError, match="read_out: out must hold all requests"):
        _kernels.read_out(events, 99.0, 0.1, 0.0, *bus_memory(size), out[:3])
    clock, *rest = bus_memory(size)
    with pytest.raises(ValueError, match="read_out: clock is not one of this bus"):
        _kernels.read_out(events, 99.0, 0.1, 0.0, clock + 9, *rest, out)
    with pytest.raises(ValueError, match="read_out: shapes do not fit"):
        _kernels.read_out(events, 99.0, 0.1, 0.0, np.zeros(2), *rest, out)


def pixel_arguments(n=6, intervals=3):
    """Arguments of pixel_events by name, n pixels of one row in falling light."""
    light = np.linspace(30, 10, intervals + 1)[:, None] * np.ones(n)
    state = np.zeros((n, 6))
    state[:, :2] = np.log(30.0)
    state[:, 2] = -np.inf
    settings = np.array([1000.0, 0, 1, 0, 0, 0, 0.25, 51, 0, 200, 0, 0, 0])
    return {
        "light": light, "slope": np.empty((0, n)), "analyser": None,
        "pixels": np.tile([0.1, 0.1, 0.0], (n, 1)), "keys": np.arange(n, dtype="u8"),
        "edges": np.empty(0), "first_edge": 0, "settings": settings,
        "places": np.stack((np.arange(n), np.zeros(n)), 1).astype("u2"),
        "state": state, "counters": np.zeros(n, "u8"), "start": 0, "stop": n,
        "out": np.empty(500, EVENT_DTYPE)}


def test_pixel_events_of_linear_light_are_where_light_passes_the_levels():
    arguments = pixel_arguments()
    done, made = _kernels.pixel_events(*arguments.values())
    assert done == 6
    levels = 30 * np.exp(-0.1 * np.arange(1, 11))
    want = np.rint((30 - levels) / 20 * 3000)
    out = arguments["out"][:made]
    assert made == 6 * 10
    np.testing.assert_array_equal(out["t"].reshape(6, 10), np.tile(want, (6, 1)))
    assert not out["p"].any()


def test_pixel_events_continue_where_room_ran_out():
    whole, small = pixel_arguments(), pixel_arguments()
    _, made = _kernels.pixel_events(*whole.values())
    small["out"] = np.empty(25, EVENT_DTYPE)
    parts, done = [], 0
    while done < 6:
        small["start"] = done
        done, n = _kernels.pixel_events(*small.values())
        assert n == 10 * (done - small["start"])
        parts.append(small["out"][:n].copy())
    np.testing.assert_array_equal(np.concatenate(parts), whole["out"][:made])
    np.testing.assert_array_equal(small["state"], whole["state"])


@pytest.mark.parametrize(("name", "value"), [
    ("light", np.ones((4, 5))), ("slope", np.ones((2, 6))), ("stop", 7),
    ("pixels", np.ones((6, 2))), ("state", np.ones((6, 4))),
    ("settings", np.ones(3)), ("keys", np.zeros(5, "u8"))])
def test_pixel_events_refuse_shapes_that_do_not_fit(name, value):
    arguments = pixel_arguments() | {name: value}
    with pytest.raises(ValueError, match="pixel_events: shapes do not fit"):
        _kernels.pixel_events(*arguments.values())


def test_pixel_events_refuse_an_interval_of_no_time():
    arguments = pixel_arguments()
    arguments["settings"][0] = 0
    with pytest.raises(ValueError, match="the interval must be positive"):
        _kernels.pixel_events(*arguments.values())
    with pytest.raises(ValueError, match="analyser must be"):
        _kernels.pixel_events(*(pixel_arguments() | {
            "light": np.ones((4, 3)), "analyser": np.ones((6, 2))}).values())


def film(seed=0, n=12, size=(4, 6)):
    rng = np.random.default_rng(seed)
    steps = np.cumsum(rng.normal(0, 0.15, (n, 4, *size)), 0)
    return np.exp(2 + steps)


@pytest.mark.parametrize(("cutoff_hz", "leak_hz"), [(100.0, 0.0), (400.0, 20.0)])
def test_video_events_match_reference(cutoff_hz, leak_hz):
    quad = film()
    camera = Camera.preset("ideal", size=(4, 6), origin=(0, 0), aps=None, dvs={
        "cutoff_hz": cutoff_hz, "leak_hz": leak_hz, "theta_off": 0.12})
    stream = camera.stream(VideoScene(quad, fps=1000.0), 0.011)
    events = np.concatenate([packet.events for packet in stream.packets()])
    s0 = quad.sum(1) / 2
    stokes = np.stack((s0, quad[:, 0] - quad[:, 2], quad[:, 1] - quad[:, 3]), -1)
    v = np.log(np.einsum("nhwc,hwc->nhw", stokes, camera.maps["analyser"]))
    found = 0
    for y in range(4):
        for x in range(6):
            mine = events[(events["y"] == y) & (events["x"] == x)]
            want = reference.film_pixel(v[:, y, x], 1000, cutoff_hz, 0.15, 0.12,
                                        leak_hz)
            np.testing.assert_array_equal(mine["p"], [p for _, p in want])
            # The twin sees a crossing up to 1 us late; logs are float32.
            assert np.all(np.abs(mine["t"] - [t for t, _ in want]) <= 1.5)
            found += len(want)
    assert found > 30


@pytest.mark.parametrize("cutoff_hz", [None, 150.0])
def test_the_light_of_a_video_equals_its_twin_bit_for_bit(cutoff_hz):
    # 1015 pixels: neither whole vectors nor whole rows of the kernel's.
    size, n = (35, 29), 35 * 29
    quad = film(n=5, size=size).astype("f4")
    quad[2, :, 3:5] = 0  # no light has a log too
    weights = np.random.default_rng(1).uniform(-0.2, 0.5, (3, n)).astype("f4")
    weights[0] += 0.5
    pixel = DvsPixel(cutoff_hz=cutoff_hz, dark_dn_ms=0.3)
    pixels = PixelArray(pixel, pixel.maps(0, size, (0, 0)), 0)
    pixels.settle_film(np.full(n, 7.0, "f4"))
    phi = None if cutoff_hz is None else 2e-3 * np.pi * cutoff_hz
    level, v = pixels._watch[0].copy(), pixels._watch[1].copy()
    for k in range(5):
        seen = np.empty((1, n), "f4")
        pixels.advance_film((1000.0 * k, 1000.0 * k + 1000), quad[k:k + 1], weights,
                            seen)
        light, level, v = reference.film_step(quad[k], weights, level, v, phi, 0.3)
        np.testing.assert_array_equal(seen[0], light)
        np.testing.assert_array_equal(pixels._watch[1], v)
        np.testing.assert_array_equal(pixels._watch[0], level)


@pytest.mark.parametrize("dvs", [
    {"cutoff_hz": 60.0, "leak_hz": 20.0, "shot_noise_hz": 30.0, "refractory_us": 2500},
    {"cutoff_hz": None, "leak_hz": 5.0, "refractory_us": 300.0},
    {"cutoff_hz": 300.0, "leak_hz": 0.0, "burst_chance": 0.3, "burst_us": 100.0}])
def test_pixels_that_are_left_in_peace_would_have_made_no_event(dvs):
    size, n = (16, 40), 640
    quad = np.exp(2 + np.cumsum(np.random.default_rng(2).normal(
        0, 0.03, (40, 4, *size)), 0)).astype("f4")
    weights = np.tile([[0.5], [0.3], [0.2]], n).astype("f4")
    pixel = DvsPixel(theta_on=0.1, theta_off=0.12, **dvs)
    found = []
    for look in (False, True):
        pixels = PixelArray(pixel, pixel.maps(3, size, (0, 0)), 3)
        events, left = [], 0
        pixels.settle_film(np.full(n, 7.0, "f4"))
        for k, frame in enumerate(quad):
            if look:
                pixels._watch[4] = -1
            left += np.count_nonzero(pixels._watch[4] > 1000 * (k + 1))
            edges = np.array([1000.0 * k + 200] if k % 5 == 2 else [])
            events += [part.copy() for part in pixels.advance_film(
                (1000.0 * k, 1000.0 * k + 1000), [frame], weights, edges=edges,
                first_edge=k // 5)]
        found.append(np.concatenate(events))
        assert bool(left) != look
    assert len(found[0]) > 500
    np.testing.assert_array_equal(*found)


def noisy_film(dvs, quad, run):
    """Return what run(pixels, weights) makes of a film by a specimen with noise."""
    size = quad.shape[2:]
    n = size[0] * size[1]
    weights = np.tile([[0.5], [0.3], [0.2]], n).astype("f4")
    pixel = DvsPixel(theta_on=0.1, theta_off=0.12, mismatch=0.05, leak_hz=3.0, **dvs)
    pixels = PixelArray(pixel, pixel.maps(3, size, (0, 0)), 3)
    pixels.settle_film(np.full(n, 7.0, "f4"))
    return np.concatenate([part.copy() for part in run(pixels, weights)])


@pytest.mark.parametrize("cutoff_hz", [3.0, 40.0, 300.0, 4000.0])
def test_crossings_found_many_at_once_are_those_found_one_by_one(cutoff_hz):
    quad = film(7, 30, (24, 31)).astype("f4")
    # A burst that has next to no chance still sends every pixel the general way.
    dvs = {"cutoff_hz": cutoff_hz, "shot_noise_hz": 5.0, "burst_chance": 1e-300}
    quick, thorough = (
        noisy_film(dvs, quad, lambda pixels, weights, edges=edges: pixels.advance_film(
            1000.0 * np.arange(31), quad, weights, edges=edges))
        for edges in (np.empty(0), np.zeros(1)))
    assert len(quick) > 500
    np.testing.assert_array_equal(quick[["x", "y", "p"]], thorough[["x", "y", "p"]])
    # Found to .001 us, then rounded.
    assert np.abs(quick["t"] - thorough["t"]).max() <= 1
    assert np.count_nonzero(quick["t"] != thorough["t"]) < 0.005 * len(quick)


def test_intervals_of_a_film_may_come_together_or_one_by_one_and_in_little_room():
    quad = film(8, 20, (40, 23)).astype("f4")
    times = 500.0 * np.arange(21)
    dvs = {"cutoff_hz": 200.0, "shot_noise_hz": 5.0}

    def together(pixels, weights):
        return pixels.advance_film(times, quad, weights)

    def one_by_one(pixels, weights):
        for k in range(20):
            for rows in (slice(0, 16), slice(16, 40)):
                yield from pixels.advance_film(times[k:k + 2], quad[k:k + 1], weights,
                                               rows=rows)

    def cramped(pixels, weights):
        pixels._buffers |= {(0, k): np.empty(7, EVENT_DTYPE) for k in (0, 16)}
        return pixels.advance_film(times, quad, weights)

    whole, parts, small = (noisy_film(dvs, quad, run)
                           for run in (together, one_by_one, cramped))
    assert len(whole) > 1000
    np.testing.assert_array_equal(small, whole)
    for events in (whole, parts):
        events.sort(order=["y", "x", "t", "p"])
    np.testing.assert_array_equal(parts, whole)


def test_threads_leave_the_events_of_a_film_and_their_order():
    scene = VideoScene(film(9, 21, (52, 18)), fps=1000.0)
    camera = Camera.preset("nominal", size=(52, 18), origin=(0, 0), seed=1)
    found = [np.concatenate([piece.events for piece in camera.stream(
        scene, 0.02, threads=threads).pieces()]) for threads in (1, 2, 3)]
    assert len(found[0]) > 1000
    for events in found[1:]:
        np.testing.assert_array_equal(events, found[0])


def test_video_events_refuse_what_does_not_fit():
    size, n = (2, 3), 6
    base = pixel_arguments(n)
    pixels = PixelArray(DvsPixel(), DvsPixel().maps(0, size, (0, 0)), 0)
    pixels.settle_film(np.full(n, 30.0, "f4"))
    quad = np.ones((4, *size), "f4")
    arguments = {
        "quads": (quad, quad), "weights": np.ones((3, n), "f4"),
        "light": np.empty((2, n), "f4"),
        **{k: base[k] for k in ("keys", "edges", "first_edge")},
        "settings": np.stack(2 * [base["settings"]]),
        "watch": pixels._watch, "cells": pixels._cells, "start": 0, "stop": n,
        "band": 4, "done": 0, "out": base["out"]}
    assert _kernels.video_events(*arguments.values())[0] == 2 * n
    assert _kernels.video_events(*(arguments | {"done": 2 * n}).values()) == (2 * n, 0)
    for name, value in (("quads", (quad, quad[:3])), ("quads", ()), ("stop", 7),
                        ("quads", (quad, quad[:, :1].copy())), ("quads", 17 * (quad,)),
                        ("light", np.empty((1, n), "f4")), ("band", 0),
                        ("light", np.empty((2, 5), "f4")), ("done", 13), ("done", -1),
                        ("settings", arguments["settings"][:1]),
                        ("weights", np.ones((4, n), "f4")),
                        ("watch", np.zeros((4, n), "f4")),
                        ("cells", pixels._cells[1:])):
        with pytest.raises(ValueError, match="video_events: shapes do not fit"):
            _kernels.video_events(*(arguments | {name: value}).values())
    for column, value in ((4, 1.0), (0, 0.0), (12, 1e-6)):
        settings = arguments["settings"].copy()
        settings[1, column] = value
        with pytest.raises(ValueError, match="the interval, the cutoff or the leak"):
            _kernels.video_events(*(arguments | {"settings": settings}).values())


def test_eight_threads_with_eight_states_give_the_same_events():
    def run(_):
        arguments = pixel_arguments(200, 20)
        arguments["settings"][10] = 1e-3
        arguments["out"] = np.empty(9000, EVENT_DTYPE)
        done, made = _kernels.pixel_events(*arguments.values())
        assert done == 200
        return arguments["out"][:made].tobytes()

    with ThreadPoolExecutor(8) as pool:
        assert len(set(pool.map(run, range(8)))) == 1


def test_random_numbers_are_uniform_normal_and_of_their_pixel():
    index = noise.pixel_index((200, 200))
    uniform, normal = (f(5, "test", index) for f in (noise.uniform, noise.normal))
    assert uniform.mean() == pytest.approx(0.5, abs=4 * 0.2887 / 200)
    assert normal.std() == pytest.approx(1, abs=4 / (200 * 2**0.5))
    beside = np.corrcoef(uniform[:, 1:].ravel(), uniform[:, :-1].ravel())
    assert abs(beside[0, 1]) < 0.02
    part = noise.uniform(5, "test", noise.pixel_index((3, 4), (7, 9)))
    np.testing.assert_array_equal(part, uniform[7:10, 9:13])
    assert not np.any(uniform == noise.uniform(5, "other", index))
    assert not np.any(uniform == noise.uniform(6, "test", index))
    assert not np.any(uniform == noise.uniform(5, "test", index, counter=1))
