from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import reference
from streams import random_events

from pdavis_cv import accumulate

SHAPES = [(1, 1), (4, 6), (260, 346)]
IMAGES = {
    "accumulate": (accumulate, {}),
    "log change": (accumulate, {"theta": (0.2, 0.3)}),
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


@pytest.mark.parametrize("maps", [False, True])
def test_the_change_of_log_intensity_is_counts_times_thresholds(maps):
    shape = (4, 6)
    events = random_events(5000, shape)
    on, off = np.random.default_rng(0).uniform(0.1, 0.3, (2, *shape))
    if not maps:
        on, off = 0.2, 0.3
    want = np.zeros(shape)
    np.add.at(want, (events["y"], events["x"]), np.where(
        events["p"], np.broadcast_to(on, shape)[events["y"], events["x"]],
        -np.broadcast_to(off, shape)[events["y"], events["x"]]))
    got = accumulate(events, shape, theta=(on, off))
    assert got.dtype == np.float32
    np.testing.assert_allclose(got, want, rtol=1e-6, atol=1e-6)


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
    (lambda e: accumulate(e, (2, 0)), r"shape must lie in 1..65536, got \(2, 0\)"),
    (lambda e: accumulate(e, (2, 2), theta=(0.1, -0.1)), r"theta \(OFF\) must be pos"),
    (lambda e: accumulate(e, (2, 2), theta=(np.ones(3), 1)), r"theta \(ON\) must be a"),
])
def test_an_impossible_parameter_is_refused(call, message):
    with pytest.raises(ValueError, match=message):
        call(random_events(3, (2, 2)))
