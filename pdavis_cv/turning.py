"""An analyser that turns before a camera, and its angle at any time."""
from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pdavis_cv.steps import AnalyserSteps

_LEAST_RPM, _MOST_RPM = 0.1, 60_000.0
_MOST_PULSES = 4096
_LOOSE = 0.25
"""Deviation of a pulse from its time, in periods, that is accepted."""
_LOST = 3
"""Misfits in succession after which the period is measured anew.  So it is if most
gaps have several periods, which are then parts of the true one."""
_MEASURED, _ALIKE = 5, 1.8
"""Pulses that tell a period, and the most that their largest gap is of the smallest: a
false one, or one that is missing, makes it two at least."""
_RECENT = 4096
"""Pulses that a clock keeps beside those it is given: events may be older than they."""


@dataclass(frozen=True, kw_only=True)
class TurningAnalyser:
    """A linear polarizer that turns before a camera without polarizers of its own.

    Its speed is stated, or told by pulses on the camera's trigger input, or, without
    both, found from the events; the zero of its angle is then unknown.

    Parameters
    ----------
    rpm : float, optional
        Turns per minute, positive = counter-clockwise as displayed.  With `triggers`
        only its sign and, until the pulses tell the speed, its size are used.
    phase : float
        Angle of its transmission axis, radians as AoP, at time 0 of the recording's
        clock; with `triggers` at the first pulse; with a found speed at the first
        event, as far as that is known.
    triggers : int, optional
        Pulses of the recording's external trigger per turn: rising edges, or pulses.

    Raises
    ------
    ValueError
        If a value is out of range.

    Examples
    --------
    >>> analyser = TurningAnalyser(rpm=600)
    >>> angle = analyser.segments()[0]      # at 0 us; then 10 turns per second
    >>> round(float(angle[2]) * 1e6 / (4 * np.pi), 9)
    10.0
    """

    rpm: float | None = None
    phase: float = 0.0
    triggers: int | None = None

    def __post_init__(self) -> None:
        if self.rpm is not None and not _LEAST_RPM <= abs(self.rpm) <= _MOST_RPM:
            raise ValueError(
                f"rpm must lie in {_LEAST_RPM:g}..{_MOST_RPM:g} in either direction, "
                f"got {self.rpm}")
        if not math.isfinite(self.phase):
            raise ValueError(f"phase must be an angle in radians, got {self.phase}")
        if self.triggers is not None and not (
                isinstance(self.triggers, int | np.integer)
                and 1 <= self.triggers <= _MOST_PULSES):
            raise ValueError(
                f"triggers must be pulses per turn in 1..{_MOST_PULSES}, got "
                f"{self.triggers}")

    @property
    def found(self) -> bool:
        """Whether the speed has to be found from events."""
        return self.rpm is None and self.triggers is None

    def segments(self, pulses_us: ArrayLike | None = None) -> NDArray[np.float64]:
        """Return twice the angle as straight lines in time.

        Parameters
        ----------
        pulses_us : array_like of int, optional
            Times of all pulses, increasing; needed with `triggers`.

        Returns
        -------
        ndarray of float64, shape (M, 3)
            From a time in us on, twice the angle at it, and its rate in radians per us.
            The first one also holds before its time.

        Raises
        ------
        ValueError
            If the speed is told by pulses and there are fewer than two.
        """
        if self.triggers is None:
            if self.rpm is None:
                raise ValueError("rpm must be stated, or found from the events")
            return np.array([[0.0, 2 * self.phase, 4e-6 * math.pi * self.rpm / 60]])
        clock = PulseClock(self)
        clock.add([] if pulses_us is None else pulses_us)
        if len(clock.kept) == 1 and len(clock.recent) > 1:  # there are few
            clock.measure(math.inf)
        if len(clock.kept) < 2:
            raise ValueError("the recording must have two trigger pulses or more, got "
                             f"{len(clock.kept)}")
        t, a = np.array(clock.kept).T
        rate = np.diff(a) / np.diff(t)
        return np.stack([t, a, np.append(rate, rate[-1])], 1)

    def steps(
        self, mid_us: ArrayLike, exposure_us: float, pulses_us: ArrayLike | None = None
    ) -> AnalyserSteps:
        """Return the angle in each of a camera's exposures, and the turn within one.

        Parameters
        ----------
        mid_us : array_like of int, shape (N,)
            Middle of each exposure.
        exposure_us : float
            Its length, in which the polarizer turns at its mean speed.
        pulses_us : array_like of int, optional
            As for `segments`.
        """
        lines, middle = self.segments(pulses_us), np.asarray(mid_us, np.float64)
        turn = turned(lines, middle + exposure_us / 2) - turned(
            lines, middle - exposure_us / 2)
        return AnalyserSteps(tuple(turned(lines, middle) / 2), float(turn.mean()) / 2)


def turned(segments: NDArray[np.float64], t: ArrayLike) -> NDArray[np.float64]:
    """Return twice the angle at times, from `TurningAnalyser.segments`."""
    at, twice, rate = segments.T
    k = np.maximum(np.searchsorted(at, t, side="right") - 1, 0)
    return np.asarray(twice[k] + rate[k] * (np.asarray(t) - at[k]))


class PulseClock:
    """The angle of an analyser with `triggers` from its pulses as they come.

    A pulse that comes too early is left out, and one that is missing is counted, so
    that neither has an effect beyond its turn.  `kept` has the times of the last pulses
    that fit, us, and twice the angle then.
    """

    def __init__(self, analyser: TurningAnalyser) -> None:
        assert analyser.triggers is not None
        self._step = math.copysign(4 * math.pi / analyser.triggers, analyser.rpm or 1)
        self._phase = 2 * analyser.phase
        self._period = self._nominal = None if analyser.rpm is None else (
            60e6 / abs(analyser.rpm) / analyser.triggers)
        # Period before the last pulse that fits, and by how much that is off.
        self._before: tuple[float, float] | None = None
        self.recent: deque[float] = deque(maxlen=_MEASURED)
        self._misfits = 0.0     # three times those of late, less pulses that follow
        self.kept: list[tuple[float, float]] = []

    def add(self, pulses_us: ArrayLike) -> None:
        """Add the times of pulses, increasing, not before those added earlier."""
        del self.kept[:-_RECENT]
        for t in np.asarray(pulses_us, np.float64).ravel().tolist():
            self.recent.append(t)
            if not self.kept:
                self.kept.append((t, self._phase))
            elif self._period is not None:
                off = {0: 3, 1: -1}.get(self._fit(t, self._period), 0.5)
                self._misfits = max(self._misfits + off, 0)
            if self._misfits >= 3 * _LOST or (
                    self._period is None and len(self.recent) == _MEASURED):
                self.measure()

    def segments(self) -> NDArray[np.float64]:
        """Return lines as `TurningAnalyser.segments` does, each from earlier pulses.

        The speed after a pulse is that before it, as a later pulse is not known then.
        Of one whose speed is not known the rate is 0.
        """
        t, a = np.array(self.kept).reshape(-1, 2).T
        if len(t) < 2:
            first = self.kept[0] if self.kept else (0.0, self._phase)
            return np.array([[*first, self._step / (self._nominal or math.inf)]])
        rate = np.diff(a) / np.diff(t)
        return np.stack([t, a, np.append(rate[:1], rate)], 1)

    def _fit(self, t: float, period: float) -> int:
        """Keep a pulse about whole periods after the last one; return how many."""
        last, angle = self.kept[-1]
        if self._before is not None and t - last < self._before[0] / 2:
            # It may lie where the last one should have, which was then a false one.
            first, angle = self.kept[-2]
            before, off = self._before
            count = round((last - first) / before)
            if abs((t - first) / before - count) > off:
                return 0
            self.kept.pop()
            last, period = first, before
        count = round((t - last) / period)
        off = abs((t - last) / period - count)
        if count < 1 or off > _LOOSE:
            return 0
        self.kept.append((t, angle + count * self._step))
        self._before, self._period = (period, off), (t - last) / count
        return count

    def measure(self, most: float = _ALIKE) -> None:
        """Take the period of the last pulses, and those that fit it.

        The first ones tell it if no gap is `most` times another, or a motor starts.
        """
        gaps, zero = np.diff(self.recent), self.kept[0][0]
        starts = bool((gaps[1:] < 0.98 * gaps[:-1]).all())
        if self._period is None and not (starts or gaps.max() < most * gaps.min()):
            return
        self._before, self._misfits, self._period = None, 0, float(np.median(gaps))
        if len(self.kept) == 1 and starts:      # each gap is one period
            self.kept = [(t, self._phase + k * self._step)
                         for k, t in enumerate(self.recent)]
            self._period = float(gaps[-1])
        elif len(self.kept) == 1:   # pulses that have left may be false ones
            first = self.recent[int(self.recent[0] > zero)]
            turned = round((first - zero) / self._period) * self._step
            self.kept = [(first, self._phase + turned)]
        for t in self.recent:
            if t > self.kept[-1][0]:
                self._fit(t, self._period)
