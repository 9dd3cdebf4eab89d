"""Intervals of events, and their phase."""
import numpy as np

from lab.paper.intervals import events_by_phase, pixel_intervals
from pdavis_cv.events import EVENT_DTYPE


def test_intervals_are_those_of_each_pixel():
    events = np.array([(0, 1, 0, 1), (5, 0, 1, 0), (7, 1, 0, 0), (9, 0, 1, 1),
                       (30, 1, 0, 1)], EVENT_DTYPE)
    assert pixel_intervals(events, 2).tolist() == [7, 23, 4]
    assert pixel_intervals(events[:0], 2).size == 0


def test_events_are_counted_by_phase_and_polarity():
    events = np.array([(0, 0, 0, 1), (104, 0, 0, 1), (60, 0, 0, 0), (199, 0, 0, 0)],
                      EVENT_DTYPE)
    assert events_by_phase(events, 100.0, 4).tolist() == [[0, 0, 1, 1], [2, 0, 0, 0]]
