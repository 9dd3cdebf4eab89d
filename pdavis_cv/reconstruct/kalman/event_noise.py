"""Noise of motion and of events: what is assumed of it, and what innovations say."""
from __future__ import annotations

from collections.abc import Sequence

__all__ = ["MOTION", "event_noise"]

MOTION = (0.002, 0.05, 1.0)
"""Variance (thresholds^2) of what interpolation between events leaves: prior, standard
deviation below which a frame's estimate of it does not count in full, and the most.
Engineering choice: turning polarizers have 0 to .02, the real DAVIS346 .5, and a part
of which nothing is known 1/3."""

PER_EVENT = (400.0, 0.5)
"""Variance of the sum of events per event (thresholds^2), beyond what is stated: what
its prior counts for, as `MOTION`'s counts for 1: a frame with forty events per pixel;
and the most.  Engineering choice: where a part p of the events is lost it is
p / (1 - p), so a third of them."""

# Turns of a least-squares fit of two numbers, which converges geometrically.
_TURNS = 20


def event_noise(normal: Sequence[float], per_event: float) -> tuple[float, float]:
    """Return the variances of motion and per event by their normal equations.

    Least squares within bounds and with priors, by turns.

    Parameters
    ----------
    normal : sequence of float
        Sums over innovations e of variance v without both, whose derivatives by the
        two are m v and n v: of m (e^2 / v - 1), n (e^2 / v - 1), m m, m n and n n.
    per_event : float
        What is assumed of the second, thresholds^2, and its least.

    Returns
    -------
    (float, float)
        thresholds^2.
    """
    (motion, _, most), (weight, most_each), each = MOTION, PER_EVENT, per_event
    of_motion, of_events, squares, cross, squares_each = normal
    of_motion, of_events = of_motion + motion, of_events + weight * each
    for _ in range(_TURNS):
        motion = min(max((of_motion - cross * each) / (squares + 1), 0.0), most)
        each = min(max((of_events - cross * motion) / (squares_each + weight),
                       per_event), max(most_each, per_event))
    return motion, each
