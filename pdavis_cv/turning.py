"""An analyser that turns before a camera, and its angle at any time."""
from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pdavis_cv.steps import AnalyserSteps

_LEAST_RPM, _MOST_RPM = 0.1, 60_000.0
_MOST_PULSES = 4096
_MEASURED, _COUNTED, _UNSURE = 5, 10, 3
"""Pulses that tell a speed that is not stated; those that are counted together; and the
last of them, whose faults do not show yet."""
_EVEN, _ALIKE = 0.25, 1.8
"""Change of a gap from one to the next, in parts of it, that no fault makes; and the
most that the largest of gaps is of the smallest unless there is one or a motor starts.
"""
_FAULT, _FAULTS = 0.5, 3
"""Parts of a pulse by which a fault, and gaps that are not alike, must come closer; and
the most of them together."""
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
            clock.count()
        if len(clock.kept) < 2:
            raise ValueError("the recording must have two trigger pulses or more, got "
                             f"{len(clock.kept)}")
        lines = clock.segments()
        lines[:-1, 2] = lines[1:, 2]
        return lines

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

    The last ones are counted together, so that one that is false, or missing, has no
    effect beyond its turn, also while a motor starts.  `kept` has the times of pulses,
    us, and twice the angle then.
    """

    def __init__(self, analyser: TurningAnalyser) -> None:
        assert analyser.triggers is not None
        self._step = math.copysign(4 * math.pi / analyser.triggers, analyser.rpm or 1)
        self._phase = 2 * analyser.phase
        self._nominal = None if analyser.rpm is None else (
            60e6 / abs(analyser.rpm) / analyser.triggers)
        self.kept: list[tuple[float, float]] = []
        # Pulses that are counted together, and how many of `kept` they are.
        self.recent: list[float] = []
        self._open = 4 if self._nominal else 1

    def add(self, pulses_us: ArrayLike) -> None:
        """Add the times of pulses, increasing, not before those added earlier."""
        del self.kept[:-_RECENT]
        pulses, last = np.ravel(pulses_us).astype(np.float64), self.recent[-1:]
        for t in pulses[np.diff(pulses, prepend=last or -math.inf) > 0].tolist():
            self.recent.append(t)
            if not self.kept:   # behind some that a stated speed tells
                period, angle = self._nominal or 0, self._phase
                self.kept = [(t + k * period, angle + k * self._step)
                             for k in range(1 - self._open, 1)]
                self.recent = [one for one, _ in self.kept]
            elif 2 < self._open == len(self.recent) - 1 and abs(
                    (t - self.recent[-2]) / (self.recent[-2] - self.recent[-3]) - 1
            ) < _EVEN:
                self.kept.append((t, self.kept[-1][1] + self._step))
                self._open += 1
            elif self._nominal or len(self.recent) >= _MEASURED:
                self.count()
            while len(self.recent) > _COUNTED:  # the first is decided, faults soon
                self._open -= 1
                (first, _), *rest = self.kept[-self._open:]
                last = self.recent[-_UNSURE:]
                self.recent = [first, *(one for one, _ in rest if one < last[0]),
                               *(one for one in last if one > first)]

    def count(self) -> None:
        """Count the recent pulses together."""
        t, n = _counted(np.array(self.recent))
        if len(n) <= n[-1] < 2 * len(n):    # missing ones, as if speed changed evenly
            from scipy.interpolate import PchipInterpolator
            t, n = PchipInterpolator(n, t)(np.arange(n[-1] + 1)), np.arange(n[-1] + 1)
        angle = self.kept[-self._open][1] + n * self._step
        self.kept[-self._open:] = zip(t.tolist(), angle.tolist(), strict=True)
        self._open = len(t)

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


def _counted(t: Any) -> tuple[Any, Any]:
    """Return pulses without those that are false, and numbers, but those that are lost.

    They are alike, or come closest, each up to a pulse, to the parabola through the
    three behind it.
    """
    def off(t: Any, n: Any) -> Any:
        gaps = np.diff(t)
        period, two = gaps / np.diff(n), gaps[..., :-1] + gaps[..., 1:]
        change = np.diff(1 / period) / two
        left = gaps[..., :-2] * two[..., :-1] * np.diff(change)
        return np.minimum(np.abs(left), 1).sum(-1) + _FAULT * (
            period.max(-1) > _ALIKE * period.min(-1))

    n = np.arange(len(t))
    for _ in range(_FAULTS):
        period, k = np.diff(t) / np.diff(n), np.arange(len(t))
        if len(t) < 4 or period.max() <= _ALIKE * period.min():
            break
        many = np.rint(np.diff(t) / np.median(period)).astype(np.int64) - 1
        behind, other = k > k[:-1, None], k != k[1:, None]
        lost = np.concatenate((n + behind, n + np.maximum(many, 1)[:, None] * behind))
        rest = [np.broadcast_to(one, other.shape)[other].reshape(len(t) - 1, -1)
                for one in (t, n - (k > k[1:, None]))]
        left = np.concatenate((off(t, lost), off(*rest)))
        best = int(np.argmin(left))
        if left[best] + _FAULT >= off(t, n):
            break
        t, n = (t, lost[best]) if best < len(lost) else (
            one[best - len(lost)] for one in rest)
    return t, n
