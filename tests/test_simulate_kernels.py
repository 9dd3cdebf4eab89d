"""The simulator's kernels against their twins, and what they refuse."""
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import reference_simulate as reference
from streams import random_events

from pdavis_cv import _kernels
from pdavis_cv.events import EVENT_DTYPE
from pdavis_cv.simulation import Camera, FunctionScene, noise


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
        "light": light, "slope": np.full((intervals + 1, n), -20.0 / intervals),
        "analyser": None,
        "pixels": np.tile([0.1, 0.1, 0.0], (n, 1)), "keys": np.arange(n, dtype="u8"),
        "edges": np.empty(0), "first_edge": 0, "settings": settings,
        "places": np.stack((np.arange(n), np.zeros(n)), 1).astype("u2"),
        "state": state, "counters": np.zeros(n, "u8"), "start": 0, "stop": n,
        "out": np.empty(500, EVENT_DTYPE)}


def test_pixel_events_of_falling_light_are_where_light_passes_the_levels():
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
            "light": np.ones((4, 3)), "slope": np.ones((4, 3)),
            "analyser": np.ones((6, 2))}).values())


def waves(seed=0):
    """Return light of its own on each pixel, a sum of waves of 30 to 300 Hz."""
    rng = np.random.default_rng(seed)
    rate, phase = rng.uniform(2e-4, 2e-3, (3, 5)), rng.uniform(0, 6, (3, 5))

    def light(t_us, x, y):
        s0, s1, s2 = (sum(np.sin(k * t_us + p + 1.7 * (i + 1) * x + (2 - i) * y)
                          for i, (k, p) in enumerate(zip(*each, strict=True))) / 5
                      for each in zip(rate, phase, strict=True))
        s0 = np.exp(3 + 1.5 * s0)
        return s0, 0.6 * s0 * s1, 0.6 * s0 * s2

    return FunctionScene(light, sampling_us=50.0)


@pytest.mark.parametrize(("cutoff_hz", "leak_hz"), [(100.0, 0.0), (400.0, 20.0)])
def test_events_of_waves_match_reference(cutoff_hz, leak_hz):
    camera = Camera.preset("ideal", size=(4, 6), origin=(0, 0), aps=None, dvs={
        "cutoff_hz": cutoff_hz, "leak_hz": leak_hz, "theta_off": 0.12})
    scene = waves()
    events = np.concatenate([
        packet.events for packet in camera.stream(scene, 0.021).packets()])
    t = np.arange(21_001.0)
    found = 0
    for y in range(4):
        for x in range(6):
            mine = events[(events["y"] == y) & (events["x"] == x)]
            light = camera.maps["analyser"][y, x] @ np.array(scene.stokes(t, x, y))
            want = reference.filtered_pixel(light, cutoff_hz, 0.15, 0.12, leak_hz)
            np.testing.assert_array_equal(mine["p"], [p for _, p in want])
            # The twin sees a crossing up to 1 us late.
            assert np.all(np.abs(mine["t"] - [t for t, _ in want]) <= 1.5)
            found += len(want)
    assert found > 30


@pytest.mark.parametrize("dvs", [
    {"cutoff_hz": 250.0}, {"cutoff_hz_per_dn_ms": 8.0}, {"cutoff_hz": None},
    {"cutoff_hz": 250.0, "second_pole_hz": 2000.0}])
def test_light_that_turns_black_and_back_passes_each_level_once(dvs):
    def light(t_us, x, y):
        s0 = 15 * (1 + np.cos(2 * np.pi * np.minimum(t_us / 1e6, 1))) + 0 * (x + y)
        return s0, 0 * s0, 0 * s0

    camera = Camera.preset("ideal", size=(2, 2), origin=(0, 0), aps=None, dvs=dvs)
    recording, _ = camera.record(FunctionScene(light, sampling_us=2000.0), 2.0)
    levels = np.log(30.0 / 2 / 1e-9) // 0.15    # 1e-9 is the least light
    off, on = np.bincount(recording.events()["p"], minlength=2) / 4
    assert abs(on - off) <= 1
    assert 20 < off <= levels


def test_threads_leave_the_events_of_waves_and_their_order():
    camera = Camera.preset("nominal", size=(52, 18), origin=(0, 0), seed=1)
    found = [np.concatenate([piece.events for piece in camera.stream(
        waves(9), 0.02, threads=threads).pieces()]) for threads in (1, 2, 3)]
    assert len(found[0]) > 1000
    for events in found[1:]:
        np.testing.assert_array_equal(events, found[0])


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
