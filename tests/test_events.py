import numpy as np
import pytest

from pdavis_cv import EVENT_DTYPE, as_events
from pdavis_cv.events import check_order

NAMES = ("t", "x", "y", "p")
ROWS = [(10, 1, 2, 0), (20, 65_535, 0, 1), (-5, 0, 259, 1)]


def packed(names=NAMES, formats=("<i8", "<u2", "<u2", "u1"), rows=ROWS, **options):
    dtype = np.dtype(list(zip(names, formats, strict=True)), **options)
    return np.array(rows, dtype)


def test_the_dtype_is_13_bytes_in_the_order_of_the_contract():
    assert EVENT_DTYPE.itemsize == 13
    assert EVENT_DTYPE.names == NAMES


def test_events_of_the_dtype_are_returned_as_they_are():
    events = packed()
    events.flags.writeable = False
    assert np.shares_memory(as_events(events), events)


@pytest.mark.parametrize("names", [
    ("timestamp", "x", "y", "on"), ("ts", "x", "y", "polarity"), ("t", "x", "y", "p")])
@pytest.mark.parametrize("formats", [
    ("<i8", "<u2", "<u2", "?"), ("<u8", "<u2", "<u2", "u1"),
    ("<i8", "<u2", "<u2", "u1")])
def test_the_same_memory_under_other_names_is_a_view(names, formats):
    events = packed(names, formats, ROWS[:2])
    got = as_events(events)
    assert np.shares_memory(got, events)
    assert got.dtype == EVENT_DTYPE
    assert got.tolist() == ROWS[:2]


@pytest.mark.parametrize(("names", "formats", "options"), [
    (NAMES, ("<i8", "<u2", "<u2", "u1"), {"align": True}),
    (NAMES, ("<i8", "<i2", "<i2", "i1"), {}),
    (NAMES, (">i8", ">u2", ">u2", "u1"), {}),
    (("x", "y", "p", "t"), ("<u2", "<u2", "?", "<i8"), {}),
])
def test_another_layout_is_a_copy_with_the_same_values(names, formats, options):
    order = [NAMES.index(name) for name in names]
    events = packed(names, formats, [
        tuple(row[i] for i in order) for row in ((10, 1, 2, 0), (20, 345, 259, 1))],
        **options)
    got = as_events(events)
    assert not np.shares_memory(got, events)
    assert got.dtype == EVENT_DTYPE
    assert got.tolist() == [(10, 1, 2, 0), (20, 345, 259, 1)]


def test_columns_are_copied():
    columns = {"ts": [10, 20], "x": np.array([1, 2], np.int32), "y": [3, 4],
               "p": np.array([True, False])}
    assert as_events(columns).tolist() == [(10, 1, 3, 1), (20, 2, 4, 0)]


def test_a_strided_array_becomes_contiguous():
    events = packed()[::2]
    got = as_events(events)
    assert got.flags.c_contiguous
    assert got.tolist() == [ROWS[0], ROWS[2]]


def test_nothing_stays_nothing():
    assert len(as_events(np.empty(0, EVENT_DTYPE))) == 0
    assert len(as_events({name: np.empty(0, np.int64) for name in NAMES})) == 0


@pytest.mark.parametrize(("events", "error", "words"), [
    ([(1, 2, 3, 0)], TypeError, "structured array or a mapping of columns, got list"),
    (np.zeros((3, 4)), TypeError, "mapping of columns, .* got float64 of shape"),
    (packed(("t", "x", "y", "q")), TypeError, "no field p or on or polarity"),
    (packed(("time", "x", "y", "p")), TypeError, "no field t or timestamp or ts"),
    (packed(formats=("<f8", "<u2", "<u2", "u1")), TypeError,
     "field t must hold integers, got float64"),
    (packed().reshape(1, 3), ValueError, r"one-dimensional, got shape \(1, 3\)"),
    ({"t": [1], "x": [1], "y": [1, 2], "p": [0]}, ValueError, "equally long"),
    ({"t": [1], "x": [1.5], "y": [1], "p": [0]}, TypeError, "field x must hold int"),
    ({"t": [1, 2], "x": [1, -1], "y": [1, 1], "p": [0, 0]}, ValueError,
     r"field x must lie in 0\.\.65535, but event 1 has -1"),
    ({"t": [1], "x": [1], "y": [70_000], "p": [0]}, ValueError, "field y must lie in"),
    ({"t": [1], "x": [1], "y": [1], "polarity": [-1]}, ValueError,
     r"field polarity must lie in 0\.\.1, but event 0 has -1"),
])
def test_what_is_not_events_is_refused_by_field(events, error, words):
    with pytest.raises(error, match=words):
        as_events(events)


def test_check_order_names_the_first_event_before_its_predecessor():
    check_order(packed(rows=ROWS[:2] * 1))
    with pytest.raises(ValueError, match="event 2 at t=-5 comes after t=20"):
        check_order(packed())
