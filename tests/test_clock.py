"""One clock for all readers: outliers are dropped, segments need evidence."""
import struct

import numpy as np
import pytest
import reference_files as reference
from hypothesis import given, settings, strategies as st
from test_aedat4 import joined, without_index

import pdavis_cv
from pdavis_cv import EVENT_DTYPE, _kernels, open_recording, recording_from_arrays
from pdavis_cv.recording.aedat4.writer import write_aedat4
from pdavis_cv.recording.timeline import Clock, Timeline

SECOND = 1_000_000


def rows(times):
    """Return events of which x is the index."""
    events = np.zeros(len(times), EVENT_DTYPE)
    events["t"], events["x"] = times, np.arange(len(times))
    return events


def settled(times, pieces=1, timeline=True):
    """Return (index, time) of what a clock accepts, and the clock."""
    clock = Clock(Timeline() if timeline else None)
    samples = np.array_split(rows(times), pieces)
    found = [clock.order(piece) for piece in samples]
    found.append(clock.order(samples[0][:0], final=True))
    return [(int(x), int(t)) for t, x, _, _ in np.concatenate(found)], clock


some_times = st.lists(st.one_of(
    st.integers(0, 100), st.integers(0, 10**7), st.integers(-2**63, 2**63 - 1)),
    max_size=60)


@given(some_times, st.booleans())
@settings(deadline=None)
def test_any_times_are_settled_as_by_the_twin(times, timeline):
    got, clock = settled(times, timeline=timeline)
    expected, jumps = reference.settle(times, segments=timeline)
    assert got == expected
    assert clock.jumps == jumps
    assert [t for _, t in got] == sorted(t for _, t in got)


@given(st.lists(st.integers(0, 10**7), min_size=150, max_size=300), st.integers(1, 40),
       st.sampled_from([0, 4 * 3600 * SECOND]))
@settings(deadline=None, max_examples=30)
def test_pieces_change_nothing_of_a_stream(times, pieces, lonely):
    times = np.sort(times)
    times[::37] = np.roll(times, 11)[::37]
    times[0] -= lonely
    assert settled(times, pieces)[0] == settled(times)[0]


@given(st.data())
@settings(deadline=None)
def test_damaged_times_change_only_themselves(data):
    n = data.draw(st.integers(30, 400))
    times = 1_700_000_000_000_000 + np.cumsum(data.draw(st.lists(
        st.integers(1, 3000), min_size=n, max_size=n)))
    # Of the values near one another, most are good.
    places = sorted(data.draw(st.sets(st.integers(0, n // 10 - 1), max_size=12)))
    damaged = times.copy()
    touched = set()
    for place in places:
        for k in range(data.draw(st.integers(1, 2))):
            at = 10 * place + k
            damaged[at] = data.draw(st.integers(-2**62, 2**62))
            touched.add(at)
    got, clock = settled(damaged)
    whole = {i: t for i, t in got if i not in touched}
    assert whole == {i: int(t) for i, t in enumerate(times) if i not in touched}
    assert clock.jumps == 0
    assert n - len(got) == sum(damaged[i] != times[i] for i in touched) - len(
        touched & {i for i, _ in got if damaged[i] != times[i]})


def test_a_segment_needs_the_agreement_of_several_times():
    one = list(range(10 * SECOND, 10 * SECOND + 3000, 10))
    got, clock = settled([*one, *range(0, 3000, 10)])
    assert clock.jumps == 1
    assert [t for _, t in got] == [*one, *range(one[-1] + 1, one[-1] + 3001, 10)]
    got, clock = settled([*one, *range(3), *range(one[-1], one[-1] + 300, 10)])
    assert clock.jumps == 0
    assert len(got) == len(one) + 30
    got, clock = settled([*one, 2**50, *range(0, 3000, 10)])     # beside a damaged one
    assert [t for _, t in got] == [*one, *range(one[-1] + 1, one[-1] + 3001, 10)]


@pytest.mark.parametrize("early", [-2**61 + 5, -2**56])
def test_times_before_any_clock_are_damage(early):
    good = list(range(1000, 2000, 10))
    assert [t for _, t in settled([early, early + 1, early + 2, *good])[0]] == good
    assert not settled(range(early, early + 20))[0]


def test_streams_share_the_shift_of_a_segment():
    timeline = Timeline()
    fast, slow = Clock(timeline), Clock(timeline)
    times = [*range(5 * SECOND, 6 * SECOND, 1000), *range(0, SECOND, 1000)]
    fast.order(rows(times), final=True)
    found = slow.order(rows(times[7::10]), final=True)
    assert fast.state[2] == slow.state[2]
    assert len(found) == 200


def test_a_clock_of_which_none_is_held_back_looks_ahead():
    clock = Clock(Timeline(), held=0)
    t = [clock.among(rows([t]), [t + 40, t + 80])["t"].tolist() for t in (0, 40, 80)]
    assert t == [[0], [40], [80]]
    assert not len(clock.among(rows([2**40]), [120, 160]))
    assert clock.among(rows([120]), [])["t"].tolist() == [120]


def test_the_kernel_refuses_what_lies_outside_an_array():
    for accepted, n, reach, size in ((-1, 2, 8, 7), (3, 2, 8, 7), (0, 9, 8, 7),
                                     (0, 2, 0, 7), (0, 2, 9, 7), (0, 2, 8, 6)):
        with pytest.raises(ValueError, match="settle"):
            _kernels.settle(rows(range(5)), accepted, n, reach, 64, True, None,
                            np.zeros(size, np.int64))


def written(path, damaged, index):
    """Write AEDAT-4 of three streams; some times are replaced in each."""
    t = 10_000_000 + 100 * np.arange(8000)
    events = rows(t)
    events["x"] %= 16
    imu, triggers = (np.zeros(len(t) // step, dtype) for step, dtype in (
        (10, pdavis_cv.IMU_DTYPE), (200, pdavis_cv.TRIGGER_DTYPE)))
    imu["t"], triggers["t"] = t[::10] + 3, t[::200] + 7
    frames = [pdavis_cv.ApsFrame(np.zeros((12, 16)), int(s), int(s) + 900,
                                 available_us=int(s) + 2000) for s in t[::300] + 11]
    write_aedat4(path, recording_from_arrays(
        events, frames, sensor_size=(12, 16), imu=imu, triggers=triggers),
        compression="none")
    data = path.read_bytes()
    data = bytearray(data if index else without_index(data))
    for place, value in damaged:
        at = data.index(struct.pack("<q", place))
        data[at:at + 8] = struct.pack("<q", value)
    path.write_bytes(data)
    return events, imu, triggers, frames


WILD = [  # of events, IMU samples, triggers; the start of exposure of a frame
    [], [(10_005_000, 2**40)], [(10_005_000, 0), (10_005_100, 5)],
    [(10_000_000, 3)], [(10_799_900, 2**45)], [(10_005_003, 2**40), (10_300_003, 0)],
    [(10_040_007, 2**41)], [(10_300_011, 2**50)], [(10_020_000 + 100 * k, 7 * k)
                                                   for k in range(0, 900, 40)],
]


@pytest.mark.filterwarnings("ignore::pdavis_cv.PdavisWarning")
@pytest.mark.parametrize("index", [True, False])
@pytest.mark.parametrize("damaged", WILD)
def test_windows_of_damaged_files_are_parts_of_the_whole(tmp_path, damaged, index):
    events, imu, triggers, frames = written(tmp_path / "x.aedat4", damaged, index)
    gone = [place for place, _ in damaged]
    with open_recording(tmp_path / "x.aedat4") as recording:
        whole = joined(recording.packets())
        assert "segment" not in {p.kind for p in recording.problems}
        np.testing.assert_array_equal(recording.events(), whole[0])
    for got, good in zip((whole[0], *whole[2:]), (events, imu, triggers), strict=True):
        assert set(good["t"]) - set(got["t"]) <= set(gone)
        assert len(got) >= len(good) - len(gone)
    assert len(whole[1]) >= len(frames) - 1
    rng = np.random.default_rng(0)
    with open_recording(tmp_path / "x.aedat4") as used:
        for _ in range(5):
            a, b = np.sort(rng.integers(9_990_000, 10_830_000, 2)).tolist()
            for recording in (used, open_recording(tmp_path / "x.aedat4")):
                found = joined(recording.packets(a, b))
                for got, all_ in zip((found[0], *found[2:]), (whole[0], *whole[2:]),
                                     strict=True):
                    inside = (all_["t"] >= a) & (all_["t"] < b)
                    np.testing.assert_array_equal(got, all_[inside])
                assert [f.available_us for f in found[1]] == [
                    f.available_us for f in whole[1] if a <= f.available_us < b]
                np.testing.assert_array_equal(recording.events(a, b), found[0])
                if recording is not used:
                    recording.close()
