"""The speed of a turning analyser, found from the events of a recording."""
from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdavis_cv.fusion.events_alone import vertex
from pdavis_cv.recording.base import Recording
from pdavis_cv.turning import turned

_LOWEST_HZ, _HIGHEST_HZ = 8.0, 130.0
"""Of the modulation, which has two periods per turn."""
_BLOCK = 16
"""Side of the blocks of pixels whose events are counted together: polarization differs
little within one, so that its ON and OFF events alternate."""
_MOST_EVENTS, _MOST_BLOCKS = 4_000_000, 256
_WINDOW_S, _BIN_S = 1.0, 1e-3
_CLEAR = 6.0
"""Least height of the peak of a modulation above the median of the spectrum."""
_APART = 2.0
"""The same above the highest of its neighbours.  Motion alone, whose spectrum falls
with frequency, does not reach it: 1.2 in recordings by hand; 2.7 where an analyser
gains speed, over 30 where it turns steadily."""
_LOBE_HZ = 2.25
"""Half width of a line in the spectrum of a window of a second."""
_GAIN, _DAMPING, _SLOWING = 0.784, 0.384, 0.064
"""Parts of a phase error by which phase, rate, and its change in a period follow it:
those of a parabola through phases of which older ones fade by .6 (Morrison 1969)."""
_BESIDE, _MORE, _FEW, _MISFIT = 8, 11, 2, 8.0
"""Phases to either side on whose parabola one is moved, as motors gain speed steadily.
More are so at the ends, and where acceleration changes once, as a mean square error of
so many of those with few phases says; the few are where it says so again."""
_LINES = 8      # from one phase to the next, whose rate may change
_PLACES = 0.5, 0.75, 0.25, 0.9, 0.1     # of a recording: a motor's start has no line
_KEPT = 0.9
"""Part of the mean of past phases that remains when a new one is added to it."""


def found_hz(recording: Recording) -> float | None:
    """Return the frequency of a modulation of all the light, Hz, None if there is none.

    The first second with events is read.
    """
    t, block, sign = _events(recording, _WINDOW_S)
    return _strongest(t - t[:1], block, sign)


def found_segments(recording: Recording, phase: float = 0.0) -> NDArray[np.float64]:
    """Return twice the angle of an analyser, as `TurningAnalyser.segments` does.

    The frequency is that of the middle of the recording, or of where it is clear; from
    there the phase, which is the angle at the first event, radians, is followed to both
    ends.  If no modulation stands out, that is a ValueError.
    """
    t, block, sign = _events(recording)
    for part in _PLACES:
        middle = t[0] + part * (t[-1] - t[0]) if len(t) else 0.0
        near = np.abs(t - middle) < _WINDOW_S / 2
        hz = _strongest(t[near] - middle + _WINDOW_S / 2, block[near], sign[near])
        if hz is not None:
            break
    else:
        raise ValueError("recording must show a modulation of 8 to 130 Hz by a turning "
                         "analyser; state its rpm, or triggers")
    rate = 2 * math.pi * hz
    lines = np.array([[at, rate * at, rate] for at in (t[0] - middle, t[-1] - middle)])
    for _ in range(2):      # once more with waves of a speed that is even
        # The time at which an analyser that turns steadily would be there.
        even = np.maximum.accumulate(turned(lines, t - middle)) / rate
        later = _followed(even, block, sign, hz)
        earlier = _followed(-even[::-1], block[::-1], sign[::-1], hz)
        knots = np.array([(-at, -angle) for at, angle in earlier[:0:-1]] + later)
        knots[:, 0] = np.interp(
            rate * knots[:, 0], np.maximum.accumulate(lines[:, 1]), lines[:, 0])
        lines = _lines(knots[np.append(True, np.diff(knots[:, 0]) > 0.5 / _HIGHEST_HZ)])
    lines[:, 1] += 2 * phase - turned(lines, t[0] - middle)
    lines[:, 0] += middle
    return np.asarray(lines * [1e6, 1, 1e-6])


def _events(
    recording: Recording, seconds: float | None = None
) -> tuple[NDArray[np.float64], NDArray[np.intp], NDArray[np.float64]]:
    """Return times in s, block and sign of a bounded number of events."""
    width = recording.info.sensor_size[1]
    parts, kept, step, start = [np.empty((3, 0), np.int64)], 0, 1, None
    for packet in recording.packets():
        events = packet.events
        if not len(events):
            continue
        start = int(events["t"][0]) if start is None else start
        pixel = events["x"].astype(np.int64) + events["y"].astype(np.int64) * width
        parts.append(_of_some_pixels(
            np.stack([events["t"], pixel, 2 * events["p"].astype(np.int64) - 1]), step))
        kept += parts[-1].shape[1]
        if kept > _MOST_EVENTS:     # a block's phase is that of the same pixels always
            step *= 2
            parts = [_of_some_pixels(one, step) for one in parts]
            kept = sum(one.shape[1] for one in parts)
        if seconds is not None and int(events["t"][-1]) - start > seconds * 1e6:
            break
    t, pixel, sign = np.concatenate(parts, 1)
    block = pixel // width // _BLOCK * -(-width // _BLOCK) + pixel % width // _BLOCK
    # Between two events light changed by a threshold: the sign of the later is of both.
    order = np.argsort(pixel, kind="stable")
    later, same = sign[order[1:]], np.diff(pixel[order]) == 0
    sign[order[:-1]] += later * same
    return t / 1e6, block.astype(np.intp), sign.astype(np.float64)


def _of_some_pixels(events: NDArray[np.int64], step: int) -> NDArray[np.int64]:
    return events[:, events[1] * 7919 % 65_536 % step == 0]


def _strongest(
    t: NDArray[np.float64], block: NDArray[np.intp], sign: NDArray[np.float64]
) -> float | None:
    """Return the modulation frequency of most power, summed over blocks."""
    bins = int(_WINDOW_S / _BIN_S)
    at = (t / _BIN_S).astype(np.intp)
    inside = (at >= 0) & (at < bins)
    block, at, sign = block[inside], at[inside], sign[inside]
    count = np.bincount(block)
    rates = np.bincount(block * bins + at, sign, len(count) * bins).reshape(-1, bins)
    rates = rates[np.argsort(-count)[:_MOST_BLOCKS]]
    power = (np.abs(np.fft.rfft(rates * np.hanning(bins), 4 * bins)) ** 2).sum(0)
    hz = np.fft.rfftfreq(4 * bins, _BIN_S)
    wanted = (hz >= _LOWEST_HZ) & (hz <= _HIGHEST_HZ)
    best = int(np.argmax(np.where(wanted, power, 0)))
    around = (hz > hz[best] / 1.6) & (hz < hz[best] * 1.6) & (
        np.abs(hz - hz[best]) > _LOBE_HZ)
    # That of a slower modulation has a second harmonic.
    if not power[best] > max(
            _CLEAR * np.median(power[wanted]), power[best // 2],
            _APART * np.max(power[around], initial=0.0)):
        return None
    near = slice(best - 1, best + 2)
    return vertex(hz[near].astype(np.float64), -power[near])


def _lines(knots: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return phases at times, (N, 2), smoothed, as lines from one to the next."""
    at, angle = knots.T
    more, n = np.concatenate((2 * at[:1] - at[1], at, 2 * at[-1:] - at[-2])), len(at)
    fine = np.interp(np.arange(-_LINES, _LINES * (n + 2) + 1) / _LINES,
                     np.arange(n + 2), more)

    def fit(k: int, beside: int, bends: bool = False) -> tuple[Any, float]:
        """Return a parabola from the phase before to that behind, and its misfit."""
        first = max(min(k - 1 - beside, n - 2 * beside - 1), 0)
        near = slice(first, first + 2 * beside + 1)
        t, y, when = at[near] - more[k], angle[near], math.inf
        if bends:   # to another one from some time on, whose slope is the same there
            whens = np.linspace(t[1], t[-2], _LINES * (len(t) - 3) + 1)
            basis = np.linalg.qr(np.vander(t, 3))[0]
            rest = np.column_stack((y, np.maximum(t[:, None] - whens, 0) ** 2))
            rest -= basis @ (basis.T @ rest)
            told = (rest[:, 0] @ rest[:, 1:]) ** 2 / (rest[:, 1:] ** 2).sum(0)
            when = vertex(whens, -told)
        here, around = (np.column_stack((np.vander(x, 3), np.maximum(x - when, 0) ** 2))
                        for x in (t, fine[_LINES * k:_LINES * (k + 2) + 1] - more[k]))
        curve = np.linalg.lstsq(here, y, rcond=None)[0]
        left = np.sum((here @ curve - y) ** 2)
        return around @ curve, left / max(len(t) - 3 - 2 * bends, 1)

    least = [fit(k, _FEW) for k in range(n + 2)]
    most = _MISFIT * np.median([misfit for _, misfit in least])
    smooth, share = np.zeros_like(fine), 1 - np.abs(np.linspace(-1, 1, 2 * _LINES + 1))
    for k in range(n + 2):
        one = fit(k, _BESIDE if _BESIDE < k <= n - _BESIDE else _MORE)
        if one[1] > most and n > 2 * _FEW:
            one = fit(k, _MORE, bends=True)
        smooth[_LINES * k:_LINES * (k + 2) + 1] += share * (
            one if one[1] <= most else least[k])[0]
    fine, smooth = fine[_LINES:-_LINES], smooth[_LINES:-_LINES]
    rate = np.diff(smooth) / np.diff(fine)
    return np.stack([fine, smooth, np.append(rate, rate[-1])], 1)


def _followed(
    t: NDArray[np.float64], block: NDArray[np.intp], sign: NDArray[np.float64],
    hz: float,
) -> list[tuple[float, float]]:
    """Follow the phase of the modulation from time 0 on; return times and phases."""
    rate, phase, at, gain = 2 * math.pi * hz, 0.0, 0.0, 0.0
    knots, count, span = [(0.0, 0.0)], int(block.max()) + 1, 1 / hz

    def ahead(span: Any) -> Any:
        return (rate + gain * span / 2) * span

    def wave() -> NDArray[np.complex128]:
        """Return the wave of each block in two cycles, faded in and out."""
        few = slice(*np.searchsorted(t, (at - span, at + span)))
        angle = ahead(t[few] - at)
        fade = np.cos(np.clip(angle / 4, -math.pi / 2, math.pi / 2)) ** 2
        out = np.zeros(count, np.complex128)
        np.add.at(out, block[few], sign[few] * fade * np.exp(-1j * (phase + angle)))
        return out

    template = wave()   # which both directions share
    while True:
        span = 4 * math.pi / (rate + math.sqrt(max(rate**2 + 4 * math.pi * gain, 0)))
        at, phase, rate = at + span, phase + ahead(span), rate + gain * span
        if at + span > t[-1] and len(knots) > 1:
            return knots
        found = wave()
        error = float(np.angle(np.vdot(template, found)))
        template = _KEPT * template + found * np.exp(-1j * error)
        knots.append((at, phase + error))
        phase += _GAIN * error
        rate = max(rate + _DAMPING * error / span, math.pi * _LOWEST_HZ / 4)
        gain += _SLOWING * error / span**2
