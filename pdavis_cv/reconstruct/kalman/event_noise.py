"""Noise of motion and of events: its prior, and its estimate from innovations."""
from __future__ import annotations

from collections.abc import Sequence

__all__ = ["MOTION", "event_noise"]

MOTION = (0.002, 0.05, 1.0)
"""Error variance of interpolation between events (thresholds^2): prior mean; standard
error at which one frame's estimate has half its full weight; upper bound.  Engineering
choice: rotating polarizers have 0 to 0.02, the real DAVIS346 has 0.5, and a uniformly
distributed fraction of a threshold has a mean square of 1/3."""

PER_EVENT = (400.0, 0.5)
"""Process noise per event (thresholds^2) above the stated value: weight of its prior,
relative to `MOTION`'s weight of 1 (400 is a frame with forty events per pixel); upper
bound.  Engineering choice: losing a fraction p of the events makes a variance of
p / (1 - p), so the bound is a loss of a third."""

# Iterations of the alternating least-squares fit, which converges geometrically.
_TURNS = 20


def event_noise(normal: Sequence[float], per_event: float) -> tuple[float, float]:
    """Return the variances of motion and per event that fit the innovations.

    Solves the normal equations with priors and bounds by alternating between both.

    Parameters
    ----------
    normal : sequence of float
        Sums of m (e^2 / v - 1), n (e^2 / v - 1), m m, m n and n n over innovations e,
        where v is their variance without either noise, and m v and n v its derivatives
        by the two variances.
    per_event : float
        Stated variance per event, thresholds^2: prior mean and lower bound.

    Returns
    -------
    (float, float)
        Both variances, thresholds^2.
    """
    (motion, _, most), (weight, most_each), each = MOTION, PER_EVENT, per_event
    of_motion, of_events, squares, cross, squares_each = normal
    of_motion, of_events = of_motion + motion, of_events + weight * each
    for _ in range(_TURNS):
        motion = min(max((of_motion - cross * each) / (squares + 1), 0.0), most)
        each = min(max((of_events - cross * motion) / (squares_each + weight),
                       per_event), max(most_each, per_event))
    return motion, each
