"""The speed of a turning analyser, found from the events of a recording."""
from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdavis_cv.recording.base import Recording

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
_BESIDE = 6
"""Phases to either side on whose parabola one is moved: motors gain speed steadily."""
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

    The frequency is that of the middle of the recording; from there the phase, which is
    the angle at the first event, radians, is followed to both ends.  If no modulation
    stands out, that is a ValueError.
    """
    t, block, sign = _events(recording)
    middle = (t[0] + t[-1]) / 2 if len(t) else 0.0
    near = np.abs(t - middle) < _WINDOW_S / 2
    hz = _strongest(t[near] - middle + _WINDOW_S / 2, block[near], sign[near])
    if hz is None:
        raise ValueError("recording must show a modulation of 8 to 130 Hz by a turning "
                         "analyser; state its rpm, or triggers")
    later = _followed(t - middle, block, sign, hz)
    earlier = _followed(middle - t[::-1], block[::-1], sign[::-1], hz)
    knots = np.array([(-at, -angle) for at, angle in earlier[:0:-1]] + later)
    smooth = [np.polyfit(knots[near, 0] - knots[k, 0], knots[near, 1], 2)[-1]
              for k in range(len(knots))
              for near in [slice(max(k - _BESIDE, 0), k + _BESIDE + 1)]]
    at, angle = (knots[:, 0] + middle) * 1e6, np.array(smooth)
    rate = np.diff(angle) / np.diff(at)
    begin = angle[0] + rate[0] * (t[0] * 1e6 - at[0])
    return np.stack([at, angle - begin + 2 * phase, np.append(rate, rate[-1])], 1)


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
    if not power[best] > max(_CLEAR * np.median(power[wanted]),
                             _APART * np.max(power[around], initial=0.0)):
        return None
    left, top, right = power[best - 1:best + 2]
    bend = left - 2 * top + right
    shift = (left - right) / (2 * bend) if bend else 0.0
    return float(hz[best] + shift * (hz[1] - hz[0]))


def _followed(
    t: NDArray[np.float64], block: NDArray[np.intp], sign: NDArray[np.float64],
    hz: float,
) -> list[tuple[float, float]]:
    """Follow the phase of the modulation from time 0 on; return times and phases."""
    rate, phase, at, gain = 2 * math.pi * hz, 0.0, 0.0, 0.0
    knots, count = [(0.0, 0.0)], int(block.max()) + 1

    def turned(span: Any) -> Any:
        return phase + (rate + gain * span / 2) * span

    def wave(start: float, stop: float) -> NDArray[np.complex128]:
        few = slice(*np.searchsorted(t, (start, stop)))
        out = np.zeros(count, np.complex128)
        np.add.at(out, block[few], sign[few] * np.exp(-1j * turned(t[few] - at)))
        return out

    # The cycle around time 0, which both directions share.
    template = wave(-0.5 / hz, 0.5 / hz)
    # A part of a cycle has another phase than the template.
    while at + (span := 4 * math.pi / (rate + math.sqrt(max(
            rate**2 + 4 * math.pi * gain, 0)))) <= t[-1] or len(knots) < 2:
        found = wave(at, at + span)
        error = float(np.angle(np.vdot(template, found)))
        template = _KEPT * template + found * np.exp(-1j * error)
        knots.append((at + span / 2, turned(span / 2) + error))
        at, phase = at + span, turned(span) + _GAIN * error
        rate += gain * span + _DAMPING * error / span
        rate = max(rate, math.pi * _LOWEST_HZ / 4)
        gain += _SLOWING * error / span**2
    return knots
