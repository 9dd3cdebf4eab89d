"""The frequency of periodic polarization by events, which do not alias as frames do."""
from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from pdavis_cv.analysis.roi import Roi
from pdavis_cv.recording.base import Recording
from pdavis_cv.sensor import Layout

__all__ = ["event_hz"]

_BIN_US = 2000
"""Events are counted in bins of this length: frequencies up to 250 Hz."""
_MOST_BINS = 10_000
_TILE, _MOST_TILES = 16, 512
"""Least side of the tiles, pixels, in which angles of polarization count as alike, and
how many there may be, as all their bins are held in memory."""
_FINE = 8
"""Frequencies per 1 / span."""
_STANDS_OUT = 15.0
"""Power over its median from which a line is believed.  A choice: the sum over tiles of
the power of white noise reaches twice its median."""


def event_hz(
    recording: Recording, rois: Sequence[Roi], layout: Layout, start_us: int,
    stop_us: int,
) -> float | None:
    """Return the strongest frequency of S1 and S2 in regions, by signed events.

    Parameters
    ----------
    recording : Recording
    rois : sequence of Roi
        In sensor pixels.
    layout : Layout
        Polarizers, by whose angle events count.
    start_us, stop_us : int
        Interval; of one longer than 20 s the first 20 s.

    Returns
    -------
    float or None
        None if no line stands out.
    """
    if recording.info.event_count == 0:
        return None
    height, width = recording.info.sensor_size
    stop_us = min(stop_us, start_us + _MOST_BINS * _BIN_US)
    bins = (stop_us - start_us) // _BIN_US
    side = max(_TILE, math.ceil(math.sqrt(height * width / _MOST_TILES)))
    columns = -(-width // side)
    tiles = -(-height // side) * columns
    angle = 2 * np.deg2rad(np.tile(
        layout.angles_deg, (-(-height // 2), -(-width // 2))))
    inside = np.any([roi.mask((height, width)) for roi in rois], axis=0)
    total = np.zeros((2, tiles * bins))
    for packet in recording.packets(start_us, start_us + bins * _BIN_US):
        events = packet.events
        x, y = events["x"], events["y"]
        seen = inside[y, x]
        events, x, y = events[seen], x[seen].astype(np.int64), y[seen].astype(np.int64)
        place = (y // side * columns + x // side) * bins + (
            events["t"] - start_us) // _BIN_US
        sign = 2.0 * events["p"] - 1
        for one, weight in zip(total, (np.cos(angle), np.sin(angle)), strict=True):
            np.add.at(one, place, sign * weight[y, x])
    counts = total.reshape(-1, bins)
    counts = counts[np.any(counts, axis=1)]
    if bins < 16 or not len(counts):
        return None
    counts = counts - counts.mean(1, keepdims=True)
    power = np.zeros(_FINE * bins // 2 + 1)
    for row in counts:
        power += np.abs(np.fft.rfft(row, _FINE * bins)) ** 2
    hz = np.arange(len(power)) * 1e6 / (_FINE * bins * _BIN_US)
    power[:2 * _FINE] = 0.0     # less than two cycles
    best = int(np.argmax(power))
    if power[best] < _STANDS_OUT * np.median(power):
        return None
    return float(hz[best])
