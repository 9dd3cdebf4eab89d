from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import reference
from hypothesis import given, strategies as st
from streams import random_events

from pdavis_cv import accumulate, slices, time_surface, voxel_grid

SHAPES = [(1, 1), (4, 6), (260, 346)]
IMAGES = {
    "accumulate": (accumulate, {}),
    "voxel_grid": (voxel_grid, {"bins": 4}),
    "time_surface": (time_surface, {"tau_us": 1e5}),
}
each_image = pytest.mark.parametrize(("image", "options"), IMAGES.values(), ids=IMAGES)


@pytest.mark.parametrize("n", [0, 1, 1000])
@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize(("start", "stop"), [(None, None), (100_000, 600_000)])
def test_accumulate_matches_reference(n, shape, start, stop):
    events = random_events(n, shape)
    want = reference.count(events, shape, start or 0, stop or 1_000_000)
    got = accumulate(events, shape, start_us=start, stop_us=stop)
    assert got.dtype == np.int32
    np.testing.assert_array_equal(got, want)


@pytest.mark.parametrize("n", [0, 1, 1000])
@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("bins", [1, 2, 5])
def test_voxel_grid_matches_reference(n, shape, bins):
    events = random_events(n, shape)
    for start, stop in ((0, 1_000_000), (250_000, 500_000)):
        got = voxel_grid(events, shape, bins, start_us=start, stop_us=stop)
        want = reference.voxel_grid(events, shape, bins, start, stop)
        assert got.dtype == np.float32
        np.testing.assert_allclose(got, want, rtol=1e-5, atol=1e-5)
    if n:
        first, last = int(events["t"][0]), int(events["t"][-1])
        np.testing.assert_array_equal(
            voxel_grid(events, shape, bins),
            voxel_grid(events, shape, bins, start_us=first, stop_us=last + 1))


@given(st.integers(0, 300), st.integers(1, 9), st.integers(1, 10**12))
def test_a_voxel_grid_keeps_the_sum_of_polarities(n, bins, span):
    events = random_events(n, (3, 3), start_us=-span, stop_us=span)
    grid = voxel_grid(events, (3, 3), bins, start_us=-span, stop_us=span)
    counts = accumulate(events, (3, 3)).astype(int)
    np.testing.assert_allclose(grid.sum(0), counts[1] - counts[0], atol=1e-4)


@pytest.mark.parametrize("n", [0, 1, 1000])
@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("t_us", [None, 400_000, 5_000_000])
def test_time_surface_matches_reference(n, shape, t_us):
    events = random_events(n, shape)
    at = int(events["t"][-1]) if n and t_us is None else t_us or 0
    want = reference.time_surface(events, shape, 1e5, at)
    got = time_surface(events, shape, tau_us=1e5, t_us=t_us)
    assert got.dtype == np.float32
    np.testing.assert_allclose(got, want, rtol=5e-6, atol=1e-30)


def test_exp_is_accurate_over_the_whole_range():
    events = random_events(20_000, (1, 20_000), stop_us=60_000_000, read_only=False)
    events["x"] = np.arange(20_000)
    got = time_surface(events, (1, 20_000), tau_us=1e6, t_us=60_000_000)
    age = np.float32(1e-6) * (60_000_000 - events["t"]).astype(np.float32)
    want = np.exp(-age.astype(float))
    np.testing.assert_allclose(got.max(axis=(0, 1)), want, rtol=3e-7)


@given(st.lists(st.integers(-50, 50), max_size=60), st.integers(1, 40),
       st.none() | st.integers(-60, 60), st.none() | st.integers(-60, 60))
def test_slices_of_equal_duration_tile_the_interval(times, duration, start, stop):
    events = random_events(len(times), (2, 2), read_only=False)
    events["t"] = sorted(times)
    bins = list(slices(events, duration_us=duration, start_us=start, stop_us=stop))
    inside = events[(events["t"] >= (-99 if start is None else start))
                    & (events["t"] < (99 if stop is None else stop))]
    np.testing.assert_array_equal(
        np.concatenate([events[:0], *(b.events for b in bins)]), inside)
    for k, b in enumerate(bins):
        assert b.start_us == bins[0].start_us + k * duration
        assert ((b.events["t"] >= b.start_us) & (b.events["t"] < b.stop_us)).all()
        assert b.stop_us == b.start_us + duration or (
            b is bins[-1] and b.stop_us == stop)
    if start is not None and stop is not None:
        assert len(bins) == max(0, -(-(stop - start) // duration))


@given(st.integers(0, 50), st.integers(1, 60))
def test_slices_of_equal_number_divide_all_events(n, count):
    events = random_events(n, (2, 2), stop_us=30)  # many ties
    bins = list(slices(events, count=count))
    assert [len(b.events) for b in bins[:-1]] == [count] * (len(bins) - 1)
    np.testing.assert_array_equal(
        np.concatenate([events[:0], *(b.events for b in bins)]), events)
    for b in bins:
        assert len(b.events)
        assert b.start_us == b.events["t"][0]
        assert b.stop_us == b.events["t"][-1] + 1


def test_slices_are_views():
    events = random_events(10, (2, 2))
    assert all(np.shares_memory(b.events, events) for b in slices(events, count=3))
    assert all(np.shares_memory(b.events, events)
               for b in slices(events, duration_us=500_000) if len(b.events))


@pytest.mark.parametrize(("options", "message"), [
    ({}, "either duration_us or count, got duration_us=None, count=None"),
    ({"count": 1, "duration_us": 1}, "either duration_us or count"),
    ({"count": 0}, "count must be a whole number of 1..[0-9]+, got 0"),
    ({"duration_us": -5}, "duration_us must be a whole number of 1..[0-9]+, got -5"),
])
def test_slices_refuse_an_impossible_bin_at_once(options, message):
    with pytest.raises(ValueError, match=message):
        slices(random_events(3, (2, 2)), **options)


@pytest.mark.parametrize("cut", [
    lambda e: slices(e, count=2), lambda e: time_surface(e, (4, 4), tau_us=1.0)])
def test_time_that_runs_backward_is_named(cut):
    events = random_events(10, (4, 4), start_us=10, read_only=False)
    events["t"][7] = 3
    with pytest.raises(ValueError, match="event 7 at t=3 comes after"):
        cut(events)


@each_image
def test_the_first_event_outside_is_named(image, options):
    events = random_events(10, (4, 6), read_only=False)
    events["x"][8] = 6
    events["y"][7] = 4
    with pytest.raises(ValueError, match=r"event 7 at .*y=4, .* outside the 6x4"):
        image(events, (4, 6), **options)
    events["p"][2] = 9
    with pytest.raises(ValueError, match=r"event 2 at .*p=9\) lies outside"):
        image(events, (4, 6), **options)


@each_image
def test_strides_and_field_names_do_not_matter_and_inputs_stay(image, options):
    events = random_events(100, (4, 6), read_only=False)
    kept = events.copy()
    renamed = np.zeros(50, [("ts", "<i4"), ("on", "?"), ("x", "<i2"), ("y", "<i2")])
    for field, name in (("t", "ts"), ("p", "on"), ("x", "x"), ("y", "y")):
        renamed[name] = events[::2][field]
    want = image(events[::2].copy(), (4, 6), **options)
    np.testing.assert_array_equal(image(events[::2], (4, 6), **options), want)
    np.testing.assert_array_equal(image(renamed, (4, 6), **options), want)
    np.testing.assert_array_equal(events, kept)


@each_image
def test_out_is_overwritten_and_returned(image, options):
    events = random_events(100, (4, 6))
    want = image(events, (4, 6), **options)
    out = np.full_like(want, 77)
    assert image(events, (4, 6), out=out, **options) is out
    np.testing.assert_array_equal(out, want)
    out.fill(77)
    image(events[:0], (4, 6), out=out, **options)
    assert not out.any()
    with pytest.raises(TypeError, match=f"out must be {want.dtype}, got float64"):
        image(events, (4, 6), out=np.zeros(want.shape), **options)
    with pytest.raises(ValueError, match="out must have shape"):
        image(events, (4, 6), out=out[:1], **options)


@each_image
def test_eight_threads_give_the_same_bits(image, options):
    events = random_events(100_000, (64, 80))
    with ThreadPoolExecutor(8) as pool:
        results = list(pool.map(
            lambda _: image(events, (64, 80), **options), range(8)))
    for result in results[1:]:
        np.testing.assert_array_equal(result, results[0])


@pytest.mark.parametrize(("call", "message"), [
    (lambda e: voxel_grid(e, (2, 2), 0), "bins must be a whole number of 1..65536"),
    (lambda e: voxel_grid(e, (2, 2), 2, start_us=5, stop_us=5),
     r"stop_us must lie after start_us, got \[5, 5\)"),
    (lambda e: time_surface(e, (2, 2), tau_us=0), "tau_us must be positive"),
    (lambda e: accumulate(e, (2, 0)), r"shape must lie in 1..65536, got \(2, 0\)"),
])
def test_an_impossible_parameter_is_refused(call, message):
    with pytest.raises(ValueError, match=message):
        call(random_events(3, (2, 2)))
