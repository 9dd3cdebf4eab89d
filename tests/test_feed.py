"""Events and frames of packets, in the order in which a method takes them."""
import numpy as np
import pytest

from pdavis_cv import EVENT_DTYPE, ApsFrame, Packet
from pdavis_cv.fusion import feed
from pdavis_cv.fusion.feed import Feed


def events(*times):
    out = np.zeros(len(times), EVENT_DTYPE)
    out["t"] = times
    return out


def fed(packets, t_us):
    """Return what a Feed gives up to t_us, which it has read: times, or a frame's end.
    """
    whole = Feed(iter(packets), by_arrival=True)
    assert whole.reaches(t_us + 1)
    return [each["t"].tolist() if isinstance(each, np.ndarray) else each.available_us
            for each in whole.until(t_us)]


def test_events_of_small_packets_come_together_up_to_a_frame():
    frame = ApsFrame(np.zeros((2, 2)), 1, 2, available_us=5)
    packets = [Packet(events(1, 2)), Packet(events(3)), Packet(events(4, 6), (frame,)),
               Packet(events(7, 8)), Packet(events(9))]
    assert fed(packets, 8) == [[1, 2, 3, 4], 5, [6, 7, 8]]
    assert fed(packets, 7) == [[1, 2, 3, 4], 5, [6, 7]]


def test_no_more_events_than_those_of_the_largest_packet_come_together(monkeypatch):
    monkeypatch.setattr(feed, "_TOGETHER", 4)
    packets = [Packet(events(*range(t, t + n)))
               for t, n in ((0, 2), (2, 2), (4, 3), (7, 5), (12, 1), (13, 1))]
    assert fed(packets, 12) == [[0, 1, 2, 3], [4, 5, 6], [7, 8, 9, 10, 11], [12]]


@pytest.mark.parametrize("step", [1, 2])
def test_events_of_one_packet_are_not_copied(step):
    packet = Packet(events(1, 2, 3)[::step])
    got = next(Feed(iter([packet]), by_arrival=True).until(None))
    assert np.shares_memory(got, packet.events)


def test_events_that_are_no_plain_array_are_passed_on_one_by_one():
    packets = [Packet(events(1, 2, 3)[::2]), Packet(events(4)), Packet(events(5))]
    assert fed(packets, 4) == [[1, 3], [4]]


def test_what_is_not_taken_yet_is_not_lost(monkeypatch):
    monkeypatch.setattr(feed, "_TOGETHER", 2)
    whole = Feed(iter([Packet(events(t, t + 1)) for t in range(0, 10, 2)]),
                 by_arrival=True)
    assert whole.reaches(9)
    got = [next(whole.until(20)) for _ in range(3)] + list(whole.until(20))
    assert np.concatenate(got)["t"].tolist() == list(range(10))
