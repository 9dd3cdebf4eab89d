"""Check that layout and orientation of a recording are plausible."""
from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pdavis_cv.recording.base import ApsFrame, Recording
from pdavis_cv.sensor import Layout

_FLIPS = {"as they are": (1, 1), "mirrored left-right": (1, -1),
          "upside down": (-1, 1), "turned by 180 degrees": (-1, -1)}
_FRAMES = 40        # that are looked at: their mean errs by a sixth of what one does
_LEAST_SCORE, _LEAST_LEAD, _MOST_LEFT = 0.1, 0.05, 0.5
"""Correlation, and its lead over others, from which an orientation is told: scenes that
move had .34 and more, .17 if mirrored, others .06 and leads of .04; and what a pairing
leaves of the next best one's residual: .25, .4 and more in dim light, .6 of others."""
_PAIRINGS = {"diagonal neighbours": ((0, 3), (1, 2)),
             "neighbours in a row": ((0, 1), (2, 3)),
             "neighbours in a column": ((0, 2), (1, 3))}


@dataclass(frozen=True)
class Finding:
    """Result of one check.

    Parameters
    ----------
    what : str
        ``"orientation"`` or ``"layout"``.
    ok : bool or None
        None: the recording does not determine it.
    message : str
        One sentence for the user.
    scores : dict of str to float
        Scores of the alternatives; larger is more likely.
    """

    what: str
    ok: bool | None
    message: str
    scores: dict[str, float]


def check_recording(
    recording: Recording, layout: Layout | None = None
) -> tuple[Finding, Finding]:
    """Check whether orientation and layout of a recording of any scene are plausible.

    Orientation: the sum of the events between two frames must resemble the difference
    of the frames.  If its mirror image does so better, events and frames were stored in
    different orientations.  Layout: orthogonal channels have the same sum, I0 + I90 =
    I45 + I135.  If another pairing of the cell's places fits better, the layout (by
    default the recording's, else PDAVIS) is wrong.  A reflection of both events and
    frames, and a constant offset of the angles, cannot be found in an unknown scene:
    see `detect_layout`.
    """
    layout = layout or recording.info.layout or Layout.PDAVIS
    turned = dict.fromkeys(_FLIPS, 0.0)
    weights = 0.0
    residual = dict.fromkeys(_PAIRINGS, 0.0)
    last: ApsFrame | None = None
    change = np.zeros(recording.info.sensor_size, np.float64)
    seen = 0
    for packet in recording.packets():
        # Events are split at the end of the frame's packet instead of its mid-exposure:
        # readout is short compared with the time between frames.
        np.add.at(change, (packet.events["y"], packet.events["x"]),
                  packet.events["p"] * 2.0 - 1)
        for frame in packet.frames:
            _add_residuals(frame, residual)
            if last is not None:
                weights += _add_correlations(last, frame, change, turned)
            last, change = frame, np.zeros_like(change)
            seen += 1
        if seen >= _FRAMES:
            break
    return (_orientation(turned, weights), _pairing(layout, residual, seen))


def _smooth(image: NDArray[np.float64]) -> NDArray[np.float64]:
    """Average 4x4 pixels: whole cells, so that the mosaic does not show."""
    h, w = image.shape[0] // 4 * 4, image.shape[1] // 4 * 4
    return np.asarray(image[:h, :w].reshape(h // 4, 4, w // 4, 4).mean((1, 3)))


def _add_correlations(
    last: ApsFrame, frame: ApsFrame, change: NDArray[np.float64],
    turned: dict[str, float],
) -> float:
    step = np.log(np.maximum(frame.dn, 1.0)) - np.log(np.maximum(last.dn, 1.0))
    a, b = _smooth(step.astype(np.float64)), change
    a = a - a.mean()
    strength = float(np.abs(b).sum())
    if strength == 0 or not a.any():
        return 0.0
    for name, (v, h) in _FLIPS.items():
        other = _smooth(b[::v, ::h])
        other = other - other.mean()
        norm = float(np.sqrt((a * a).sum() * (other * other).sum()))
        turned[name] += strength * float((a * other).sum()) / norm if norm > 0 else 0.0
    return strength


def _add_residuals(frame: ApsFrame, residual: dict[str, float]) -> None:
    h, w = frame.shape[0] // 2 * 2, frame.shape[1] // 2 * 2
    cells = frame.dn[:h, :w].reshape(h // 2, 2, w // 2, 2).astype(np.float64)
    places = [cells[:, i // 2, :, i % 2] for i in range(4)]
    # A gradient of brightness looks like a wrong pairing of rows or columns: subtract
    # the one that the neighbouring cells show.  The median is robust against edges.
    level = np.pad(sum(places) / 4, 1, mode="edge")
    slope = {"neighbours in a row": (level[2:, 1:-1] - level[:-2, 1:-1]) / 2,
             "neighbours in a column": (level[1:-1, 2:] - level[1:-1, :-2]) / 2}
    for name, ((a, b), (c, d)) in _PAIRINGS.items():
        off = places[a] + places[b] - places[c] - places[d] + slope.get(name, 0.0)
        inner = off[1:-1, 1:-1] if min(off.shape) > 2 else off
        residual[name] += float(np.median(np.abs(inner)))


def _orientation(turned: dict[str, float], weights: float) -> Finding:
    scores = {name: value / weights if weights else 0.0
              for name, value in turned.items()}
    best = max(scores, key=lambda name: scores[name])
    rival = max(value for name, value in scores.items() if name != best)
    if not weights or (
            scores[best] < _LEAST_SCORE or scores[best] - rival < _LEAST_LEAD):
        return Finding("orientation", None,
                       "the orientation of events and frames does not show (too little "
                       "moves, or there are no events or frames)", scores)
    if best == "as they are":
        return Finding("orientation", True,
                       "events and frames have the same orientation", scores)
    return Finding(
        "orientation", False,
        f"events fit the frames better {best}: they were stored in different "
        "orientations, and polarizer channels are swapped", scores)


def _pairing(layout: Layout, residual: dict[str, float], seen: int) -> Finding:
    angles = [layout.angles_deg[i // 2][i % 2] for i in range(4)]
    mine = next(name for name, ((a, b), _) in _PAIRINGS.items()
                if abs(angles[a] - angles[b]) == 90)
    scores = {name: -value / max(seen, 1) for name, value in residual.items()}
    best = max(scores, key=lambda name: scores[name])
    rival = sorted(scores.values())[-2]
    if not seen or not scores[best] > _MOST_LEFT * rival:
        return Finding("layout", None, "the scene is too little polarized to tell "
                       "which polarizers are orthogonal", scores)
    if best == mine:
        return Finding("layout", True, f"orthogonal polarizers are {mine}, as layout "
                       f"{layout} says", scores)
    return Finding("layout", False, f"layout {layout} cannot be right: orthogonal "
                   f"polarizers are {best}, not {mine}", scores)
