"""The angle of a turning analyser, stated or from pulses."""
import numpy as np
import pytest
from turning_pixels import pulses, turned

from pdavis_cv.turning import PulseClock, TurningAnalyser


@pytest.mark.parametrize("n", [1, 12])
@pytest.mark.parametrize(("drift", "ramp"), [(0, 0), (0.02, 0), (-0.02, 0), (0.02, 3)])
def test_pulses_tell_the_angle(n, drift, ramp):
    t, (at, turns) = pulses(20.0, 10, n, drift, ramp)
    times = np.linspace(2e6 if ramp else 0, 9.9e6, 5000)
    error = turned(TurningAnalyser(triggers=n).segments(t), times) - np.interp(
        times, at, turns)
    assert np.max(np.abs(error)) < (0.01 if ramp else 1e-4)


@pytest.mark.parametrize("n", [1, 12])
@pytest.mark.parametrize("fault", ["lost", "false", "late", "early", "both"])
def test_a_fault_of_a_pulse_stays_in_its_turn(n, fault):
    t, (at, turns) = pulses(20.0, 5, n, 0.02)
    k = 20 * n
    period = t[k + 1] - t[k]
    bad = np.delete(t, k) if fault in ("lost", "both") else t
    if fault != "lost":
        bad = np.sort(np.append(bad, t[3 * k] + period * {
            "late": 0.97, "early": 0.78}.get(fault, 0.4)))
    times = np.linspace(0, 5e6, 20_000)
    error = np.abs(turned(TurningAnalyser(triggers=n).segments(bad), times)
                   - np.interp(times, at, turns))
    near = np.zeros(len(times), bool)
    for one in t[k], t[3 * k]:
        near |= np.abs(times - one) < 55_000
    assert error[~near].max() < 1e-4
    assert error.max() < 0.05


@pytest.mark.parametrize("n", [1, 2, 12])
@pytest.mark.parametrize("k", range(5))
def test_a_fault_of_the_first_pulses_stays_in_them(n, k):
    t, (at, turns) = pulses(20.0, 2, n)
    times = np.linspace((1 + 6 / n) * 5e4, 1.9e6, 500)
    for bad in [np.delete(t, k), *(np.sort(np.append(t, t[k] + part * (t[1] - t[0])))
                                   for part in (0.15, 0.5, 0.85))]:
        error = turned(TurningAnalyser(triggers=n).segments(bad), times) - np.interp(
            times, at, turns) + np.interp(bad[0], at, turns)
        assert np.abs((error + 0.25) % 0.5 - 0.25).max() < 1e-4


@pytest.mark.parametrize("n", [1, 2, 12])
@pytest.mark.parametrize("hz", [5, 20, 60])
@pytest.mark.parametrize("k", [2, 3, 4, 7, 9])
def test_a_fault_stays_in_its_turn_while_a_motor_starts(n, hz, k):
    """The parabola of its neighbours tells it: a gap may be twice the next one."""
    t, (at, turns) = pulses(hz, 4, n, ramp=2)
    gap = t[k + 1] - t[k]
    for bad in [np.delete(t, k), *(np.sort(np.append(t, t[k] + part * gap))
                                   for part in (0.15, 0.5, 0.85))]:
        first = np.interp(np.interp(t[k], at, turns) + 1 + 5 / n, turns, at)
        times = np.linspace(first, 3.9e6, 500)
        found, sound = (turned(TurningAnalyser(triggers=n).segments(one), times)
                        for one in (bad, t))
        assert np.abs((found - sound + 0.25) % 0.5 - 0.25).max() < 0.005
        clock = PulseClock(TurningAnalyser(triggers=n))
        for part in np.array_split(bad, 17):
            clock.add(part)
        found = turned(clock.segments(), times) - np.interp(times, at, turns)
        assert np.abs((found + 0.25) % 0.5 - 0.25).max() < 0.08


@pytest.mark.parametrize("speeds", [(0.02, 0.02, 1, 1), (1, 0.3, 0.3, 0.3)])
def test_a_motor_that_starts_late_or_slows_down_is_counted(speeds):
    t = np.linspace(0, 4, 200_001)
    speed = 20 * np.interp(t, [0, 1, 2, 4], speeds)
    turns = np.append(0, np.cumsum((speed[1:] + speed[:-1]) / 2 * np.diff(t)))
    which = np.arange(1, int(turns[-1] * 12)) / 12
    segments = TurningAnalyser(triggers=12).segments(np.interp(which, turns, t) * 1e6)
    times = np.linspace(2, 3.9, 500)
    error = turned(segments, times * 1e6) - np.interp(times, t, turns) + which[0]
    assert np.abs(error).max() < 2e-3


@pytest.mark.parametrize("hz", [5, 20, 60])
@pytest.mark.parametrize("ramp", [0.5, 2, 6])
def test_a_stated_speed_may_be_that_after_a_start(hz, ramp):
    t, (at, turns) = pulses(hz, ramp + 2, 12, ramp=ramp)
    times = np.linspace(ramp + 0.3, ramp + 1.8, 100) * 1e6
    error = turned(TurningAnalyser(triggers=12, rpm=60 * hz).segments(t), times
                   ) - np.interp(times, at, turns)
    assert np.abs(error).max() < 1e-3


def test_a_pulse_that_comes_twice_counts_once():
    t = 5e4 * np.arange(40)
    analyser = TurningAnalyser(triggers=12)
    np.testing.assert_array_equal(analyser.segments(np.repeat(t, 3)),
                                  analyser.segments(t))


@pytest.mark.parametrize("k", range(4))
def test_a_stated_speed_tells_a_false_pulse_among_the_first(k):
    t = 5e4 * np.arange(k + 3)
    false = np.sort(np.append(t, 5e4 * (k + 0.4)))
    segments = TurningAnalyser(triggers=4, rpm=300).segments(false)
    np.testing.assert_allclose(turned(segments, t), np.arange(k + 3) / 4, atol=1e-9)


def test_few_pulses_tell_the_angle_too():
    for count in 2, 3, 4:
        segments = TurningAnalyser(triggers=1).segments(5e4 * np.arange(count))
        assert turned(segments, 2e5) == pytest.approx(4)


def test_a_stated_speed_three_times_too_large_is_corrected():
    """Its pulses are not all preceded by two that were lost."""
    t, (at, turns) = pulses(20.0, 3, 12)
    times = np.linspace(1e6, 2.9e6, 1000)
    error = turned(TurningAnalyser(triggers=12, rpm=3600).segments(t), times
                   ) - np.interp(times, at, turns)
    assert np.ptp(error) < 1e-4


def test_pulses_as_they_come_give_the_angle_from_those_before():
    t, (at, turns) = pulses(20.0, 5, 1, 0.02)
    clock = PulseClock(TurningAnalyser(triggers=1, rpm=1300))
    for part in np.array_split(t, 23):
        clock.add(part)
    times = np.linspace(1e6, 4.9e6, 2000)
    error = turned(clock.segments(), times) - np.interp(times, at, turns)
    assert np.max(np.abs(error)) < 5e-4


def test_phase_and_direction_of_pulses():
    t = np.arange(10) * 50_000
    segments = TurningAnalyser(triggers=2, rpm=-600, phase=0.3).segments(t)
    np.testing.assert_allclose(
        turned(segments, t), 0.3 / (2 * np.pi) - np.arange(10) / 2)
    assert (segments[:, 2] < 0).all()


def test_a_stated_speed_is_one_line():
    (t, angle, rate), = TurningAnalyser(rpm=-600, phase=0.2).segments()
    assert (t, angle, rate * 1e6) == (0, 0.4, pytest.approx(-40 * np.pi))
    assert TurningAnalyser().found
    assert not TurningAnalyser(triggers=1).found


@pytest.mark.parametrize(("values", "match"), [
    ({"rpm": 0}, "rpm must"), ({"rpm": np.nan}, "rpm must"),
    ({"phase": np.inf}, "phase must"), ({"triggers": 0}, "triggers must"),
    ({"triggers": 1.5}, "triggers must")])
def test_bad_analysers_are_refused(values, match):
    with pytest.raises(ValueError, match=match):
        TurningAnalyser(**values)


def test_too_few_pulses_are_an_error():
    with pytest.raises(ValueError, match="two trigger pulses or more, got 1"):
        TurningAnalyser(triggers=1).segments([5])
