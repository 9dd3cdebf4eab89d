from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import reference
from streams import random_events

from pdavis_cv import accumulate

SHAPES = [(1, 1), (4, 6), (260, 346)]


@pytest.mark.parametrize("n", [0, 1, 1000])
@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize(("start", "stop"), [(None, None), (100_000, 600_000)])
def test_accumulate_matches_reference(n, shape, start, stop):
    events = random_events(n, shape)
    want = reference.count(events, shape, start or 0, stop or 1_000_000)
    got = accumulate(events, shape, start_us=start, stop_us=stop)
    assert got.dtype == np.int32
    np.testing.assert_array_equal(got, want)


def test_the_first_event_outside_is_named():
    events = random_events(10, (4, 6), read_only=False)
    events["x"][8] = 6
    events["y"][7] = 4
    with pytest.raises(ValueError, match=r"event 7 at .*y=4, .* outside the 6x4"):
        accumulate(events, (4, 6))
    events["p"][2] = 9
    with pytest.raises(ValueError, match=r"event 2 at .*p=9\) lies outside"):
        accumulate(events, (4, 6))


def test_strides_and_field_names_do_not_matter_and_inputs_stay():
    events = random_events(100, (4, 6), read_only=False)
    kept = events.copy()
    renamed = np.zeros(50, [("ts", "<i4"), ("on", "?"), ("x", "<i2"), ("y", "<i2")])
    for field, name in (("t", "ts"), ("p", "on"), ("x", "x"), ("y", "y")):
        renamed[name] = events[::2][field]
    want = accumulate(events[::2].copy(), (4, 6))
    np.testing.assert_array_equal(accumulate(events[::2], (4, 6)), want)
    np.testing.assert_array_equal(accumulate(renamed, (4, 6)), want)
    np.testing.assert_array_equal(events, kept)


def test_out_is_overwritten_and_returned():
    events = random_events(100, (4, 6))
    want = accumulate(events, (4, 6))
    out = np.full_like(want, 77)
    assert accumulate(events, (4, 6), out=out) is out
    np.testing.assert_array_equal(out, want)
    out.fill(77)
    accumulate(events[:0], (4, 6), out=out)
    assert not out.any()
    with pytest.raises(TypeError, match=f"out must be {want.dtype}, got float64"):
        accumulate(events, (4, 6), out=np.zeros(want.shape))
    with pytest.raises(ValueError, match="out must have shape"):
        accumulate(events, (4, 6), out=out[:1])


def test_eight_threads_give_the_same_bits():
    events = random_events(100_000, (64, 80))
    with ThreadPoolExecutor(8) as pool:
        results = list(pool.map(
            lambda _: accumulate(events, (64, 80)), range(8)))
    for result in results[1:]:
        np.testing.assert_array_equal(result, results[0])


@pytest.mark.parametrize(("call", "message"), [
    (lambda e: accumulate(e, (2, 0)), r"shape must lie in 1..65536, got \(2, 0\)"),
])
def test_an_impossible_parameter_is_refused(call, message):
    with pytest.raises(ValueError, match=message):
        call(random_events(3, (2, 2)))
