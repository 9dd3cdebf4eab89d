"""Check a recording for problems that make images or measurements wrong."""
from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pdavis_cv.recording.base import ApsFrame, Recording
from pdavis_cv.sensor import NOMINAL_THRESHOLDS

BUS_EVENTS_PER_S = 10e6
"""Largest event rate of the camera's read-out (paper, sensor section)."""
BUSY_SHARE = 0.5
"""Fraction of the bus's rate, in 1 ms, above which events are late; a convention."""
HOT_TIMES_MEDIAN, LEAST_HOT_EVENTS = 50, 100
"""A pixel is hot if its number of events exceeds both 50 times the median of all pixels
with events, and 100.  A convention: moving edges stay within 50 times the median."""
FLICKER_HZ = (100, 120)
"""Flicker of lamps on mains of 50 and 60 Hz."""
FLICKER_BIN_US, FLICKER_BINS = 1000, 1000
"""Bin of the event rate, us, and bins per interval of the averaged spectra: one second,
so that lines are 1 Hz wide."""
FLICKER_LONGEST_BINS = 1 << 17
"""Bound on the memory of the spectrum: 131 s."""
FLICKER_POWER = 10.0
"""Smallest ratio of a line in the spectrum of the event rate to the median of the lines
beside it.  White noise averaged over 4 s or more exceeds it with a probability below
1e-6 (exponential distribution)."""
CLIPPED_SHARE = 0.01
"""Fraction of saturated pixels that is reported; a convention."""
DARK_DN = 20.0
"""Median DN below which the usual offsets (Brandli et al. 2014: .5 % of the range) are
a fifth of the signal."""
BLUR_EVENTS = 3
"""Events of a pixel in one exposure that count as blur: at the usual threshold of 0.2,
the light changes by a factor of 1.8."""
BLURRED_SHARE = 0.05
"""Fraction of blurred pixels that is reported; a convention."""
MOST_KEPT_EVENTS = 2_000_000
"""Bound on the memory of an exposure's events: 26 MB."""
LEAST_FRAMES = 5
"""Smallest number of frames that determines the frame rate; a convention."""
MOST_EMPTY = 0.5
"""Largest fraction of empty bins of 1 ms: a camera with more than one event per bin
fills most of them."""
MOST_TIMES = 9999
"""Largest ratio to report; beyond it the noise beside the line is negligible."""
CLOCK_HZ = 1.5
"""Largest distance of a harmonic of the frame clock from a line that is 1 Hz wide."""


@dataclass(frozen=True, slots=True)
class Advice:
    """One finding and what to do about it.

    Parameters
    ----------
    topic : str
        ``"layout"``, ``"clipped frames"``, ``"event rate"``, ...
    finding : str
        Description of the finding, with its number.
    action : str
        Recommended action.
    """

    topic: str
    finding: str
    action: str


def advise(recording: Recording) -> list[Advice]:
    """Read a recording once and return findings that affect its results, if any."""
    facts = _Facts(recording.info.sensor_size)
    for packet in recording.packets():
        facts.add_events(packet.events)
        for frame in packet.frames:
            facts.add_frame(frame)
    found = [*_about_header(recording), *facts.about_frames(), *facts.about_events()]
    for problem in recording.problems:
        if problem.kind in ("backward time", "segment", "stale words", "damage"):
            found.append(Advice(
                "time" if problem.kind != "damage" else "damage",
                f"{problem.count:,} x {problem.kind}: {problem.message}",
                "treat intervals across it with care; record again if it matters"))
    return found


class _Facts:
    """Statistics that are collected in one pass over the samples."""

    def __init__(self, size: tuple[int, int]) -> None:
        self._counts = np.zeros(size, np.int64)
        self._bins: dict[int, int] = {}
        self._clipped: list[float] = []
        self._levels: list[float] = []
        self._recent: deque[NDArray[np.void]] = deque()
        self._kept = 0
        self._blurred: list[tuple[float, float, float]] = []
        self._mids: list[int] = []

    def add_events(self, events: NDArray[np.void]) -> None:
        if not len(events):
            return
        self._counts += self._per_pixel(events)
        bins, counts = np.unique(events["t"] // FLICKER_BIN_US, return_counts=True)
        for i, n in zip(bins.tolist(), counts.tolist(), strict=True):
            self._bins[i] = self._bins.get(i, 0) + n

        self._recent.append(events)
        self._kept += len(events)
        while self._kept > MOST_KEPT_EVENTS:
            self._kept -= len(self._recent.popleft())

    def _per_pixel(self, events: NDArray[np.void]) -> NDArray[np.int64]:
        width = self._counts.shape[1]
        places = events["y"].astype(np.int64) * width + events["x"]
        return np.bincount(
            places, minlength=self._counts.size).reshape(self._counts.shape)

    def add_frame(self, frame: ApsFrame) -> None:
        self._clipped.append(
            0.0 if frame.valid is None else float(np.mean(~frame.valid)))
        self._levels.append(float(np.median(frame.dn)))
        self._mids.append(frame.mid_us)
        # Count the events of each pixel during the exposure of the frame.
        half = round(1000 * frame.exposure_ms / 2)
        start, stop = frame.mid_us - half, frame.mid_us + half
        counts = np.zeros(self._counts.shape, np.int64)
        for events in self._recent:
            t = events["t"]
            if t[-1] >= start and t[0] < stop:
                counts += self._per_pixel(events[(t >= start) & (t < stop)])
        moving = counts >= BLUR_EVENTS
        self._blurred.append((
            float(np.mean(moving)), frame.exposure_ms,
            float(np.median(counts[moving])) if moving.any() else 0.0))
        self._recent.clear()
        self._kept = 0

    def about_frames(self) -> list[Advice]:
        found: list[Advice] = []
        if not self._levels:
            return found
        clipped = float(np.mean(self._clipped))
        if clipped > CLIPPED_SHARE:
            found.append(Advice(
                "clipped frames", f"{clipped:.1%} of the pixels are saturated",
                "shorten the exposure: a clipped channel makes AoP and DoLP wrong"))
        level = float(np.median(self._levels))
        if level < DARK_DN:
            found.append(Advice(
                "dark frames", f"the median pixel has {level:.0f} DN",
                "lengthen the exposure or add light; subtract a dark frame"))
        share, exposure_ms, events = np.mean(self._blurred, axis=0).tolist()
        if share > BLURRED_SHARE:
            factor = math.exp(NOMINAL_THRESHOLDS[0] * BLUR_EVENTS)
            found.append(Advice(
                "exposure", f"while a frame is exposed ({exposure_ms:.1f} ms), light "
                f"changes by a factor of {factor:.1f} or more on {share:.0%} of the "
                "pixels: the frames blur, their DoLP reads low",
                f"expose for {exposure_ms / events:.2g} ms or less, or slow the scene; "
                "method kalman accounts for the exposure, the others do not"))
        return found

    def about_events(self) -> list[Advice]:
        found: list[Advice] = []
        if not self._bins:
            return found
        peak = max(self._bins.values()) * 1e6 / FLICKER_BIN_US
        if peak > BUSY_SHARE * BUS_EVENTS_PER_S:
            found.append(Advice(
                "event rate", f"up to {peak / 1e6:.1f} M events per second in 1 ms; "
                "the bus carries 10 M",
                "raise the thresholds or lower the light: events are late or lost"))
        busy = self._counts[self._counts > 0]
        limit = max(LEAST_HOT_EVENTS, HOT_TIMES_MEDIAN * float(np.median(busy)))
        hot = int(np.count_nonzero(self._counts > limit))
        if hot:
            share = float(self._counts[self._counts > limit].sum() / busy.sum())
            found.append(Advice(
                "hot pixels", f"{hot} pixels give {share:.1%} of all events",
                "mask them before measuring rates or thresholds"))
        found += self._about_flicker()
        return found

    def _about_flicker(self) -> list[Advice]:
        first, last = min(self._bins), max(self._bins)
        n = min(last - first + 1, FLICKER_LONGEST_BINS)
        if n < FLICKER_BINS:
            return []
        rate = np.zeros(n)
        for i, count in self._bins.items():
            if i - first < n:
                rate[i - first] = count
        if np.mean(rate == 0) > MOST_EMPTY and rate.mean() > 1:
            return []  # simulated from images: events come in bursts
        pieces = rate[:n // FLICKER_BINS * FLICKER_BINS].reshape(-1, FLICKER_BINS)
        window = np.hanning(FLICKER_BINS)
        power = np.mean(np.abs(np.fft.rfft(
            (pieces - pieces.mean(1, keepdims=True)) * window)) ** 2, axis=0)
        found = []
        for hz in FLICKER_HZ:
            line = float(power[hz - 1:hz + 2].max())
            around = np.r_[power[hz - 15:hz - 4], power[hz + 5:hz + 16]]
            if line > 0 and line > FLICKER_POWER * max(
                    float(np.median(around)), self._frame_clock(power, hz)):
                found.append(Advice(
                    "flicker", f"the event rate swings at {hz} Hz: "
                    f"{min(line / float(np.median(around) or 1), MOST_TIMES):.0f} "
                    "times its surroundings",
                    "use direct-current light; mains light makes events of its own"))
        return found


    def _frame_clock(self, power: NDArray[np.float64], hz: int) -> float:
        """Return the power that the frame clock causes near a frequency.

        Reading a frame disturbs events, which gives lines at all harmonics of the frame
        rate, where a lamp has a single line.  0 if the frequency is not a harmonic.
        """
        if len(self._mids) < LEAST_FRAMES:
            return 0.0
        rate = 1e6 / float(np.median(np.diff(self._mids)))
        order = round(hz / rate)
        if order < 1 or abs(order * rate - hz) > CLOCK_HZ:
            return 0.0
        beside = [round(k * rate) for k in range(max(order - 2, 1), order + 3)
                  if k != order and k * rate < len(power) - 2]
        return max((float(power[f - 1:f + 2].max()) for f in beside), default=0.0)


def _about_header(recording: Recording) -> list[Advice]:
    info = recording.info
    found: list[Advice] = []
    if info.layout is None:
        found.append(Advice(
            "layout", "the file does not give the polarizer layout",
            "pass layout=; check it with a polarizer at a known angle"))
    if info.format == "AEDAT-4" and info.writer not in ("jAER", "pdavis_cv", None) and (
            info.sensor is not None):
        found.append(Advice(
            "layout", "a DV recording of a DAVIS346 may come from a camera without "
            "polarizers", "measure DoLP of polarized light first"))
    if "aedat4to2" in str(dict(info.header)).lower():
        found.append(Advice(
            "orientation", "aedat4to2 writes its files mirrored left to right",
            "use layout.flip_x(), or convert the original"))
    return found
