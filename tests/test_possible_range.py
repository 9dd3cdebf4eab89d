"""Which times a packet may have, from the packets around it, some of them damaged."""
import numpy as np
import pytest

from pdavis_cv.recording.timeline import NEVER, Timeline, possible_range

FIRST = [54, 330, 671, 818, 1503, 3501]
SECOND = [10_063, 10_208, 10_865, 11_084, 11_192]
THIRD, FOURTH = [17_144, 18_238, 18_692], [20_000, 20_010, 20_500]
ANY = NEVER, -NEVER


def limits(times, *following, before=NEVER):
    return possible_range(np.array(times, np.int64),
                          [np.array(one, np.int64) for one in following], before)


def test_whole_packets_end_where_the_next_begins():
    assert limits(FIRST, SECOND, THIRD, FOURTH) == (NEVER, SECOND[0])
    assert limits(SECOND, THIRD, before=FIRST[-1]) == (FIRST[-1], THIRD[0])
    assert limits(FOURTH, before=THIRD[-1]) == (THIRD[-1], -NEVER)


@pytest.mark.parametrize("damaged", [
    [10_063, 224, 0, 0, 0, 13_412, 2_251_799_813_700_545],     # of blocks of zeros
    [224, 10_208, 10_865, 11_084], [0, 0, 0, 0, 0, 0, 0], [2**60, 2**60 + 1], [7]])
def test_a_damaged_packet_that_follows_costs_a_whole_one_nothing(damaged):
    for before in (NEVER, 20):
        first, last = limits(FIRST, damaged, THIRD, FOURTH, before=before)
        assert first <= FIRST[0]
        assert last >= FIRST[-1]
    # the only one that follows, which has few events
    first, last = limits(SECOND, [7936], before=7881)
    assert first <= SECOND[0]
    assert last >= SECOND[-1]


@pytest.mark.parametrize("damaged", [
    [23_899, 84_480, 171_776, 2**57, 2**58], [1_688_851_258_299_973],
    [54, 330, 671, 818, 3501, 2**57], [54, 330, 671, 18_000, 18_500]])
def test_times_beyond_the_next_packets_are_not_taken(damaged):
    for before in (NEVER, 20):
        for following in ([SECOND, THIRD, FOURTH], [THIRD, FOURTH], [SECOND, THIRD]):
            _, last = limits(damaged, *following, before=before)
            assert sum(t < last for one in following for t in one) <= 1


def test_more_damaged_times_than_the_last_packet_has_are_not_taken():
    wild = [10_063, 10_208, 10_865, 11_084, *range(2**50, 2**50 + 4)]
    assert limits(wild, THIRD[:2], before=FIRST[-1])[1] < THIRD[0]


def test_a_clock_that_is_reset_is_not_damage():
    late = [9_000_000, 9_000_100]
    assert limits(late, FIRST, SECOND, THIRD, before=8_900_000) == ANY  # before it
    assert limits(FIRST, SECOND, THIRD, FOURTH, before=9_000_100) == ANY  # behind it
    assert limits(FIRST, before=9_000_100) == ANY
    assert limits(late, FIRST) == ANY
    assert limits([54, *late[::-1], 65_536], SECOND)[1] < SECOND[0]     # no clock's


def test_a_counter_of_32_bits_falls_by_its_period_once():
    assert Timeline().move(0, 2**32 - 30) == 2**32
    assert Timeline().move(0, 3 * 2**32 + 30) == 3 * 2**32 + 31
