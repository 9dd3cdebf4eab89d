"""Find the polarizer layout from a recording of a rotating polarizer.

A polarizer that turns at an unknown rate, in an unknown direction, from an unknown
angle only shows which places of the 2x2 cell are orthogonal, as I(theta, a) =
I(-theta, -a) = I(theta + c, a + c).  The direction of rotation as displayed determines
the cyclic order, and one known angle determines the zero.
"""
from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from itertools import permutations

import numpy as np
from numpy.typing import NDArray

from pdavis_cv.recording.base import Packet, Recording
from pdavis_cv.sensor import CHANNELS, Layout

_BIN_US = 1_000         # 50 of them in the period of 600 RPM
_MOST_CORRELATION, _LEAST_LEAD, _LEAST_CYCLES = -0.4, 0.2, 0.45
"""Mean correlation of the pairs and its lead over other pairings from which a layout is
told, where wrong ones reached -.3 and .14; and periods of the light: half of one less
what the first and last bin may lack."""
_PAIRINGS = (((0, 1), (2, 3)), ((0, 2), (1, 3)), ((0, 3), (1, 2)))

ALL_LAYOUTS = tuple(Layout((a, b), (c, d)) for a, b, c, d in permutations(CHANNELS))
"""All 24 arrangements of four polarizers."""


@dataclass(frozen=True)
class Candidates:
    """Layouts that are compatible with a recording.

    Parameters
    ----------
    layouts : tuple of Layout
        One if direction and zero are known; if families differ, the most likely first.
    pairs : ((int, int), (int, int))
        Places of orthogonal polarizers.
    pair_correlation : float
        Mean correlation of the two pairs; -1 for ideal intensities.
    rival_correlation : float
        The same for the next best pairing.
    cycles : float
        Number of periods of the polarization in the recording.
    direction : int
        Direction of rotation, given or inferred: 1 counter-clockwise as displayed, -1
        clockwise, 0 unknown.
    source : str
        ``"frames"`` or ``"events"``.
    """

    layouts: tuple[Layout, ...]
    pairs: tuple[tuple[int, int], tuple[int, int]]
    pair_correlation: float
    rival_correlation: float
    cycles: float
    direction: int
    source: str


def _place_signals(
    recording: Recording, source: str, roi: tuple[int, int, int, int] | None
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return times and mean log intensity of each place, without offset and drift.

    place = 2 * (row % 2) + col % 2; frames at mid-exposure, or sums of events in bins
    of 1 ms.
    """
    if source not in _COLLECTORS:
        raise ValueError(f"source must be one of {sorted(_COLLECTORS)}, got {source!r}")
    height, width = recording.info.sensor_size
    x, y, w, h = roi or (0, 0, width, height)
    times, signal = _COLLECTORS[source](recording.packets(), (x, y, x + w, y + h))
    if len(times) < 8:      # two numbers of each place are fitted
        raise ValueError(
            f"a layout needs at least eight samples of {source}, got {len(times)}")
    # The constant is the gain; the slope comes from unequal ON and OFF thresholds.
    trend = np.stack([np.ones(len(times)), np.linspace(-1, 1, len(times))], 1)
    return times, signal - trend @ np.linalg.lstsq(trend, signal, rcond=None)[0]


Box = tuple[int, int, int, int]


def _from_frames(
    packets: Iterable[Packet], box: Box
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    times, rows = [], []
    x0, y0, x1, y1 = box
    for packet in packets:
        for frame in packet.frames:
            # Log intensities of one frame: a varying exposure is common to the places.
            row = np.empty(4)
            for place in range(4):
                top, left = y0 + (place // 2 - y0) % 2, x0 + (place % 2 - x0) % 2
                row[place] = frame.dn[top:y1:2, left:x1:2].mean(dtype=np.float64)
            times.append(frame.mid_us)
            rows.append(row / max(frame.exposure_ms, 1e-3))
    levels = np.maximum(np.array(rows).reshape(-1, 4), 1e-6)
    return np.array(times, np.int64), levels / levels.mean(0)


def _from_events(
    packets: Iterable[Packet], box: Box
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    x0, y0, x1, y1 = box
    pixels = max((x1 - x0) * (y1 - y0) / 4, 1)
    origin: int | None = None
    sums = np.zeros((0, 4))
    for packet in packets:
        events = packet.events
        x, y = events["x"], events["y"]
        events = events[(x >= x0) & (x < x1) & (y >= y0) & (y < y1)]
        if not len(events):
            continue
        origin = int(events["t"][0]) if origin is None else origin
        bins = (events["t"] - origin) // _BIN_US
        if bins[-1] >= len(sums):
            sums = np.concatenate([sums, np.zeros((int(bins[-1]) + 1024, 4))])
        place = (2 * (events["y"] & 1) + (events["x"] & 1)).astype(np.int64)
        np.add.at(sums, (bins, place), events["p"] * 2.0 - 1)
        last = int(bins[-1])
    if origin is None:
        return np.zeros(0, np.int64), np.zeros((0, 4))
    times = origin + _BIN_US * np.arange(1, last + 2)
    return times, np.cumsum(sums[:last + 1], axis=0) / pixels


_COLLECTORS = {"frames": _from_frames, "events": _from_events}
"""By source what returns times, and the mean log intensity of each place."""


def detect_layout(
    recording: Recording,
    *,
    direction: int = 0,
    known_angle: tuple[int, float] | None = None,
    family: Layout | None = None,
    source: str | None = None,
    roi: tuple[int, int, int, int] | None = None,
) -> Candidates:
    """Find the polarizer layout from a recording of a rotating polarizer.

    Parameters
    ----------
    recording : Recording
        Uniform light through a steadily turning polarizer, for at least half a turn.
    direction : {1, -1, 0}
        Direction of rotation as displayed: 1 counter-clockwise, -1 clockwise, 0 if
        unknown.
    known_angle : (int, float), optional
        A time in microseconds and the polarizer's angle at that time, radians.
    family : Layout, optional
        The layout up to a constant angle, if the type of the array is known; the
        direction of rotation follows from it.
    source : {"frames", "events"}, optional
        Default: events if there are any, as they do not alias.
    roi : (int, int, int, int), optional
        (x, y, width, height) of the lit region.

    Returns
    -------
    Candidates
        All layouts that are compatible with the recording and the arguments.

    Raises
    ------
    ValueError
        If the recording does not show a rotating polarizer.
    """
    if direction not in (1, -1, 0):
        raise ValueError(f"direction must be 1, -1 or 0, got {direction!r}")
    if source is None:
        source = "frames" if recording.info.event_count == 0 else "events"
    times, signal = _place_signals(recording, source, roi)
    scores = [float(np.mean([_correlation(signal[:, i], signal[:, j])
                             for i, j in pairing])) for pairing in _PAIRINGS]
    best, rival = np.argsort(scores)[:2]
    pairs = _PAIRINGS[best]
    if scores[best] > _MOST_CORRELATION or (
            scores[rival] - scores[best] < _LEAST_LEAD):
        raise ValueError(
            "the four places must see a rotating polarizer, but no pairing of them is "
            "anticorrelated: mean correlations are "
            + ", ".join(f"{score:.2f}" for score in scores))
    (p, q), (r, s) = pairs
    phase = np.unwrap(np.arctan2(signal[:, r] - signal[:, s],
                                 signal[:, p] - signal[:, q]))
    turned = float(phase[-1] - phase[0])
    cycles = abs(turned) / (2 * np.pi)
    if cycles < _LEAST_CYCLES:
        raise ValueError(
            "the polarizer must turn by at least a quarter turn, but its light went "
            f"through {cycles:.2f} periods")
    sense = 1 if turned > 0 else -1
    layouts = [layout for layout in ALL_LAYOUTS
               if _orthogonal(layout, p, q) and _orthogonal(layout, r, s)]
    if family is not None:
        of_family = [layout for layout in layouts if len({
            (_angle(layout, i) - _angle(family, i)) % 180 for i in range(4)}) == 1]
        if not of_family:
            raise ValueError(
                f"family {family} cannot be right: orthogonal polarizers stand at "
                f"places {pairs}")
        layouts = of_family
        follows = sense * _step(layouts[0], p, r)
        if direction and follows != direction:
            raise ValueError(
                f"family {family} and direction {direction} contradict each other: the "
                f"polarizer turned {'counter-' if follows > 0 else ''}clockwise")
        direction = follows
    if direction:
        # The phase increases with the angle if the polarizer at r is at +45 deg.
        layouts = [layout for layout in layouts
                   if _step(layout, p, r) == sense * direction]
        if known_angle is not None:
            t, angle = known_angle
            if not times[0] <= t <= times[-1]:
                raise ValueError(
                    f"known_angle must lie in {times[0]}..{times[-1]} us, got {t}")
            zero = float(angle - sense * direction * np.interp(t, times, phase) / 2)
            layouts = sorted(layouts, key=lambda one: abs((np.deg2rad(
                _angle(one, p)) - zero + np.pi / 2) % np.pi - np.pi / 2))[:1]
    return Candidates(
        tuple(layouts), pairs, scores[best], scores[rival], cycles, direction, source)


def _correlation(a: NDArray[np.float64], b: NDArray[np.float64]) -> float:
    norm = float(np.sqrt(np.sum(a * a) * np.sum(b * b)))
    return float(np.sum(a * b)) / norm if norm > 0 else 0.0


def _angle(layout: Layout, place: int) -> int:
    return layout.angles_deg[place // 2][place % 2]


def _orthogonal(layout: Layout, i: int, j: int) -> bool:
    return abs(_angle(layout, i) - _angle(layout, j)) == 90


def _step(layout: Layout, i: int, j: int) -> int:
    """Return 1 if the polarizer at place j is at +45 degrees from i, -1 if at -45."""
    return 1 if (_angle(layout, j) - _angle(layout, i)) % 180 == 45 else -1
