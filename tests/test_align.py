"""Loads of a test frame, and the clock that they came with."""
import contextlib
import tracemalloc

import numpy as np
import pytest

from pdavis_cv import AnalysisWarning
from pdavis_cv.analysis import (
    Clock,
    LoadTrace,
    align_by_correlation,
    align_by_triggers,
    read_load,
)

OFFSET, SKEW = 1.7, 50e-6
EPOCH = 1_700_000_000_000_000


def force(t):
    """A ramp, then cycles that grow a little, as a tendon is loaded."""
    ramp = np.clip((t + 1) / 3, 0, 1)
    return 5 * ramp + 1.5 * ramp ** 2 * (1 + 0.01 * t) * np.sin(2 * np.pi * t)


def other_clock(rate=1000.0, seconds=34.0):
    """What a test frame writes whose zero lies at OFFSET and that runs slow."""
    own = np.arange(0, seconds, 1 / rate)
    return own, OFFSET + (1 + SKEW) * own  # its seconds, and the true ones


def errors_ms(clock, until=30.0):
    own = np.linspace(1, until, 50)
    true = OFFSET + (1 + SKEW) * own
    return (clock.to_us(own) - EPOCH) / 1e3 - true * 1e3


def test_correlation_finds_offset_and_skew_within_1_ms():
    rng = np.random.default_rng(1)
    own, true = other_clock()
    load = LoadTrace(own, force(true - 4) + rng.normal(0, 0.02, len(own)))
    t = np.arange(0, 30, 0.01)
    dolp = 0.3 + 0.02 * force(t - 4) + rng.normal(0, 0.002, len(t))
    clock = align_by_correlation(EPOCH + np.rint(t * 1e6).astype(np.int64), dolp, load)
    assert np.max(np.abs(errors_ms(clock, 27))) < 1
    assert clock.skew_ppm == pytest.approx(50, abs=5 * clock.skew_se_ppm)
    assert clock.correlation > 0.99
    back = clock.to_seconds(clock.to_us(own))
    np.testing.assert_allclose(back, own, atol=2e-6)


def test_the_sign_of_the_relation_is_found_or_enforced():
    own, true = other_clock()
    load = LoadTrace(own, force(true - 4))
    t = np.arange(0, 30, 0.01)
    clock = align_by_correlation(
        EPOCH + np.rint(t * 1e6).astype(np.int64), -force(t - 4), load)
    assert np.max(np.abs(errors_ms(clock, 27))) < 1
    assert clock.correlation < -0.99


def test_equal_cycles_are_called_ambiguous_and_an_expected_offset_helps():
    rng = np.random.default_rng(2)
    own, true = other_clock()
    load = LoadTrace(own, np.sin(2 * np.pi * true))
    t = np.arange(0, 30, 0.01)
    v = np.sin(2 * np.pi * t) + rng.normal(0, 0.05, len(t))
    times = EPOCH + np.rint(t * 1e6).astype(np.int64)
    with pytest.warns(AnalysisWarning, match="fits nearly as well"):
        align_by_correlation(times, v, load, sign=1)
    clock = align_by_correlation(
        times, v, load, sign=1, expected_s=1.8, within_s=0.4)
    assert np.max(np.abs(errors_ms(clock, 27))) < 2


@pytest.mark.parametrize("expected", [0.0, 1 / 3, -0.17])
def test_of_equal_cycles_the_nearest_of_the_stated_sign_is_taken(expected):
    rng = np.random.default_rng(5)
    own = np.arange(0, 6, 0.001)
    load = LoadTrace(own, np.sin(2 * np.pi * 3 * own))
    t = np.arange(0, 6, 0.04)
    v = np.sin(2 * np.pi * 3 * t) + rng.normal(0, 0.01, len(t))
    times = EPOCH + np.rint(t * 1e6).astype(np.int64)
    with pytest.warns(AnalysisWarning, match="fits nearly as well"):
        clock = align_by_correlation(
            times, v, load, sign=1, expected_s=expected, within_s=0.5)
    nearest = round(expected * 3) / 3
    assert clock.offset_s == pytest.approx(nearest, abs=2e-3)
    assert clock.offset_se_s > 0.3      # the next one is a period away


def test_of_equal_cycles_the_widest_overlap_is_taken():
    rng = np.random.default_rng(2)
    own = np.arange(0, 6, 0.001)
    load = LoadTrace(own, np.sin(2 * np.pi * 5 * own))
    t = np.arange(0, 6, 0.01)
    v = np.sin(2 * np.pi * 5 * (t - 0.03)) + rng.normal(0, 0.05, len(t))
    times = EPOCH + np.rint(t * 1e6).astype(np.int64)
    with pytest.warns(AnalysisWarning, match="fits nearly as well"):
        clock = align_by_correlation(times, v, load, sign=1)
    middle = float(clock.to_us(3.0)) - EPOCH
    assert abs(middle / 1e6 - 3.03) < 0.002


@pytest.mark.gate
def test_a_load_in_another_unit_of_time_is_refused():
    own = np.arange(0, 6, 0.001)
    load = LoadTrace(own * 1000, np.sin(2 * np.pi * 5 * own))
    t = np.arange(0, 6, 0.01)
    times = EPOCH + np.rint(t * 1e6).astype(np.int64)
    with pytest.raises(ValueError, match="is the time of one of them in another unit"):
        align_by_correlation(times, np.sin(2 * np.pi * 5 * t), load)


def test_samples_locked_to_the_load_leave_the_offset_open():
    rng = np.random.default_rng(4)
    own = np.arange(0, 6, 0.001)
    load = LoadTrace(own, np.sin(2 * np.pi * 10 * own))

    def aligned(hz):
        t = 0.02 + np.arange(0, 5.9, 1 / hz)
        v = np.sin(2 * np.pi * 10 * t) + rng.normal(0, 0.01, len(t))
        return align_by_correlation(
            EPOCH + np.rint(t * 1e6).astype(np.int64), v, load, expected_s=-0.02,
            within_s=0.03)

    for hz in (20.7, 50.0):   # that it aliases at 20.7 Hz does not matter
        clock = aligned(hz)
        assert clock.offset_se_s < 5e-4
        assert clock.offset_s == pytest.approx(-0.02, abs=1e-3)
    with contextlib.suppress(ValueError):   # which says so as well
        assert aligned(20.0).offset_se_s > 0.02


def test_a_gap_in_the_load_is_left_out():
    rng = np.random.default_rng(3)
    own, true = other_clock()
    keep = (own < 9) | (own > 12.5)
    load = LoadTrace(own[keep], force(true - 4)[keep], gaps=((9.0, 12.5),))
    t = np.arange(0, 30, 0.01)
    dolp = force(t - 4) + rng.normal(0, 0.05, len(t))
    clock = align_by_correlation(EPOCH + np.rint(t * 1e6).astype(np.int64), dolp, load)
    assert np.max(np.abs(errors_ms(clock, 27))) < 1


def test_triggers_give_offset_and_skew_with_pulses_missing_at_the_ends():
    rng = np.random.default_rng(4)
    pulses = np.cumsum(rng.uniform(0.5, 2.0, 20))
    theirs = pulses[3:]
    ours = EPOCH + np.rint((OFFSET + (1 + SKEW) * pulses[:-2]) * 1e6).astype(np.int64)
    clock = align_by_triggers(ours, theirs)
    assert np.max(np.abs(errors_ms(clock))) < 0.01
    coarse = align_by_triggers(ours, theirs, resolution_s=0.01)
    assert coarse.offset_se_s == pytest.approx(0.01 / np.sqrt(12), rel=1e-3)
    single = align_by_triggers(ours[3:4], theirs[:1])
    assert single.skew_ppm == 0
    assert float(single.to_us(theirs[0])) == pytest.approx(ours[3], abs=1)


def test_triggers_that_do_not_match_are_refused():
    with pytest.raises(ValueError, match="trigger_s must match trigger_us within"):
        align_by_triggers([0, 1_000_000, 3_000_000], [0.0, 2.0, 2.1])
    with pytest.raises(ValueError, match="trigger_us must hold at least one pulse"):
        align_by_triggers([], [0.0])


def test_evenly_spaced_triggers_of_which_some_are_missing_are_called_ambiguous():
    pulses = np.arange(20) * 0.5
    ours = np.rint(1e6 * pulses).astype(np.int64)
    assert align_by_triggers(ours, pulses).offset_s == 0
    with pytest.warns(AnalysisWarning, match="also match with an offset of"):
        clock = align_by_triggers(ours, pulses[:-2])
    assert clock.offset_se_s >= 0.5
    assert abs(clock.offset_s) <= 2 * clock.offset_se_s


def test_a_stated_offset_is_taken_as_it_is():
    clock = Clock(EPOCH, OFFSET, skew_ppm=50)
    moved = clock.counted_from(EPOCH - 3_000_000)
    assert moved.offset_s == pytest.approx(OFFSET + 3)
    np.testing.assert_allclose(moved.to_us([0, 9.5]), clock.to_us([0, 9.5]), rtol=1e-15)
    assert np.max(np.abs(errors_ms(clock))) < 1e-3


@pytest.mark.parametrize("text", [
    "Time (ms),Load (kN),Position (um)\n0,0.001,5\n10,0.002,6\n20,0.003,7\n",
    "# a comment\nTime;Force;Extension\n(s);(N);(mm)\n0;1;0,005\n0,01;2;0,006\n"
    "0,02;3;0,007\n",
    "time_s\tforce_N\tdisplacement_mm\n0\t1\t.005\n.01\t2\t.006\n.02\t3\t.007\n",
    "Elapsed [s],Force [N],Displacement [mm],Note\n0,1,.005,\n.01,2,.006,x\n"
    ".02,3,.007,\n",
    "Zeit [s];Kraft [N];Weg [mm]\n0;1;0,005\n0,01;2;0,006\n0,02;3;0,007\n",
    "t_ms,F_N,x (mm)\n0,1,.005\n10,2,.006\n20,3,.007\n",
])
def test_dialects_and_units_are_understood(tmp_path, text):
    path = tmp_path / "load.csv"
    path.write_text(text)
    load = read_load(path)
    np.testing.assert_allclose(load.t_s, [0, 0.01, 0.02])
    np.testing.assert_allclose(load.force_n, [1, 2, 3])
    np.testing.assert_allclose(load.displacement_mm, [0.005, 0.006, 0.007])
    assert (load.gaps, load.dropped) == ((), 0)


def test_gaps_and_rows_without_numbers_are_reported(tmp_path):
    rows = [f"{i / 100},{i}" for i in range(100) if not 40 <= i < 60]
    rows[10] = "0.1,"
    path = tmp_path / "load.csv"
    path.write_text("time (s),force (N)\n" + "\n".join(rows))
    load = read_load(path)
    assert load.dropped == 1
    assert load.gaps == ((0.39, 0.6),)
    assert load.inside_gap(np.array([0.2, 0.5, 2.0])).tolist() == [False, True, True]


def test_many_rows_take_the_memory_of_their_numbers(tmp_path):
    path = tmp_path / "load.csv"
    path.write_text("t_s,F_N\n" + "".join(f"{i},2\n" for i in range(100_000)))
    assert len(read_load(path).t_s) == 100_000      # and imports what that takes
    tracemalloc.start()
    try:
        read_load(path)
        assert tracemalloc.get_traced_memory()[1] < 100_000 * 120
    finally:
        tracemalloc.stop()


def test_triggers_of_a_file_are_where_the_level_rises(tmp_path):
    path = tmp_path / "load.csv"
    path.write_text("time (s),force (N),trigger (V)\n" + "\n".join(
        f"{i / 10},1,{5 if i % 10 in (3, 4) else 0}" for i in range(30)))
    np.testing.assert_allclose(read_load(path).trigger_times(), [0.25, 1.25, 2.25])


@pytest.mark.parametrize(("text", "message"), [
    ("time (s),force (furlong)\n0,1\n1,2\n",
     "column 'force [(]furlong[)]': the unit must be one of N, mN, kN, gf, lbf, got "
     "'furlong'"),
    ("time (s),force\n0,1\n1,2\n", "column 'force': .* the header names none"),
    ("time (h),force (N)\n0,1\n1,2\n", "the unit must be one of s, ms, us, min"),
    ("\n".join(["1,2"] * 2_000 + ["t_s,F_N", "0,1", "1,2"]), "no header line"),
    (",".join(["a"] * 2_000 + ["t_s", "F_N"]) + "\n0,1\n", "no header line"),
    ("a,b\n0,1\n", "no header line with a time column"),
    ("temp,fluff,xy\n0,1,2\n", "time: time, elapsed, timestamp, zeit, t [(]s, ms, us"),
    ("", "no header line"),
    ("time (s),force (N)\n0,1\n2,2\n1,3\n", "line 4: time must increase, got 1 s"),
    ("time (s),force (N)\nx,y\n0,1\n", "fewer than two rows"),
])
def test_load_files_that_cannot_be_trusted_are_refused(tmp_path, text, message):
    path = tmp_path / "load.csv"
    path.write_text(text)
    with pytest.raises(ValueError, match=f"load.csv: .*{message}"):
        read_load(path)
