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
    np.testing.assert_allclose(segments[:, 1], 0.6 - 2 * np.pi * np.arange(10))
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
