"""An analyser that turns before a camera, and its angle at any time."""
from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

__all__ = ["PulseClock", "TurningAnalyser"]

_LEAST_RPM, _MOST_RPM = 0.1, 60_000.0
_MOST_PULSES = 4096
_STEADY, _LOOSE = 0.03, 0.25
"""Deviation of a pulse, in periods, that is accepted at a steady speed and at most."""
_LOST = 4
"""Pulses in succession that do not fit, after which the period is measured anew."""


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

    @property
    def sign(self) -> int:
        """1 if it turns counter-clockwise as displayed, -1 if clockwise."""
        return -1 if self.rpm is not None and self.rpm < 0 else 1

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
        t, a = np.array(clock.kept).reshape(-1, 2).T
        if len(t) < 2:
            raise ValueError(
                f"the recording must have two trigger pulses or more, got {len(t)}")
        rate = np.diff(a) / np.diff(t)
        return np.stack([t, a, np.append(rate, rate[-1])], 1)


class PulseClock:
    """The angle of an analyser from its pulses as they come.

    A pulse that comes too early is left out, and one that is missing is counted, so
    that neither has an effect beyond its turn.

    Parameters
    ----------
    analyser : TurningAnalyser
        With `triggers`.

    Attributes
    ----------
    kept : list of (float, float)
        Time of each pulse that fits, us, and twice the angle then.
    """

    def __init__(self, analyser: TurningAnalyser) -> None:
        assert analyser.triggers is not None
        self._step = 4 * math.pi / analyser.triggers * analyser.sign
        self._nominal = None if analyser.rpm is None else (
            60e6 / abs(analyser.rpm) / analyser.triggers)
        self._phase = 2 * analyser.phase
        self._period = self._nominal
        self._spread = _LOOSE
        # Deviation of the last pulse, and period and spread before it.
        self._before: tuple[float, float | None, float] = 0.0, None, _LOOSE
        self._waiting: list[float] = []
        self._crowded = 0       # pulses in succession before which others were left out
        self.kept: list[tuple[float, float]] = []

    def add(self, pulses_us: ArrayLike) -> None:
        """Add the times of pulses, increasing, not before those added earlier."""
        for t in np.asarray(pulses_us, np.float64).ravel().tolist():
            self._take(t)

    def segments(self) -> NDArray[np.float64]:
        """Return lines as `TurningAnalyser.segments` does, each from earlier pulses.

        The speed after a pulse is that before it, as a later pulse is not known then.
        """
        t, a = np.array(self.kept).reshape(-1, 2).T
        if len(t) < 2:
            period = self._nominal or 100_000.0
            first = self.kept[0] if self.kept else (0.0, self._phase)
            return np.array([[*first, self._step / period]])
        rate = np.diff(a) / np.diff(t)
        return np.stack([t, a, np.append(rate[:1], rate)], 1)

    def _take(self, t: float) -> None:
        if not self.kept:
            self.kept.append((t, self._phase))
            return
        last, _ = self.kept[-1]
        if self._period is None:
            self._waiting.append(t)
            if len(self._waiting) >= _LOST:
                self._measure()
            return
        if self._fits_better(t):
            self.kept.pop()
            self._period, self._spread = self._before[1:]
            last, _ = self.kept[-1]
            assert self._period is not None
        count = round((t - last) / self._period)
        off = abs((t - last) / self._period - count)
        if count < 1 or off > min(max(4 * self._spread, _STEADY), _LOOSE) * math.sqrt(
                max(count, 1)):
            self._waiting.append(t)
            if len(self._waiting) >= _LOST and t - last > _LOST * self._period:
                self._measure()
            return
        crowd = len(self._waiting)
        self._crowded = self._crowded + 1 if crowd else 0
        if crowd >= _LOST - 1 or self._crowded >= _LOST:   # pulses come faster
            self._waiting.append(t)
            self._measure()
            return
        self._waiting.clear()
        self._before = off, self._period, self._spread
        self.kept.append((t, self.kept[-1][1] + count * self._step))
        self._period = (t - last) / count
        self._spread += 0.3 * (off - self._spread)

    def _fits_better(self, t: float) -> bool:
        """Return whether a pulse lies where the last one that was kept should have."""
        off, period, _ = self._before
        if len(self.kept) < 2 or period is None:
            return False
        last, before = self.kept[-1][0], self.kept[-2][0]
        count = round((last - before) / period)
        return abs((t - before) / period - count) < off

    def _measure(self) -> None:
        """Take the period of pulses that wait, and those that fit it."""
        waiting, self._waiting, self._crowded = self._waiting, [], 0
        gaps = np.diff([self.kept[-1][0], *waiting])
        self._period, self._spread = float(np.median(gaps[gaps > 0])), _LOOSE
        self._before = 0.0, None, _LOOSE
        for t in waiting:
            self._take(t)
