"""Drift of the thresholds: what innovations of frame after frame say of it."""
from __future__ import annotations

from collections.abc import Sequence

__all__ = ["drift_product", "drift_variance", "frame_drift"]

DRIFT = 0.005
"""Relative change of thresholds from frame to frame that its variance's prior is as
wide as.  Engineering choice: 10 % in a second of the paper's cameras is far more than
temperature does to bias currents; more must be seen in many pixels.  What it was
compared with, and on which cameras, is in docs/theory/priors.md."""

CHANGE, SYSTEMATIC = 0.1, 0.002
"""Relative, standard deviations: of a change that one frame alone is believed, an
engineering choice, and of what interpolation between events does alike in all pixels
(docs/theory/selfcal.md)."""

Drift = tuple[float, float, float, float, float]


def frame_drift(normal: Sequence[float]) -> Drift:
    """Return by what both thresholds have changed since the frame before.

    Least squares over all pixels: what they have in common.

    Parameters
    ----------
    normal : sequence of float
        Sums over innovations e of variance v, whose derivatives by relative changes of
        the thresholds are p and m: of p e / v, m e / v, p p / v, p m / v and m m / v.

    Returns
    -------
    (float, float, float, float, float)
        The information W, inverse of the covariance, of both relative changes d: W d,
        ON and OFF, then W's elements ON ON, ON OFF and OFF OFF.
    """
    of_on, of_off, on, both, off = normal
    on, off = on + CHANGE**-2, off + CHANGE**-2
    whole = on * off - both * both
    change_on = (off * of_on - both * of_off) / whole
    change_off = (on * of_off - both * of_on) / whole
    # What all pixels have wrong alike is added to the covariance.
    var_on, var_off = off / whole + SYSTEMATIC**2, on / whole + SYSTEMATIC**2
    cov = -both / whole
    whole = var_on * var_off - cov * cov
    on, both, off = var_off / whole, -cov / whole, var_on / whole
    return (on * change_on + both * change_off, both * change_on + off * change_off,
            on, both, off)


def drift_product(now: Sequence[float], before: Sequence[float]) -> tuple[float, float]:
    """Return what two frames, one after the other, add to the sums of `drift_variance`.

    Innovations of a filter that keeps up are white.  If it lags behind a drift, changes
    of one frame and of the next have one sign; errors of either cancel in the mean.
    Each direction counts by its information: the ratio of the thresholds is known far
    better than their scale.

    Parameters
    ----------
    now, before : sequence of float, shape (5,)
        Of `frame_drift`; ``before`` is 0 if there was none.
    """
    return (now[0] * before[0] + now[1] * before[1],
            now[2] * before[2] + 2 * now[3] * before[3] + now[4] * before[4])


def drift_variance(sums: Sequence[float]) -> float:
    """Return the variance of the thresholds' relative change per frame, each alike.

    Parameters
    ----------
    sums : sequence of float, shape (2,)
        Of `drift_product`.
    """
    product, weight = sums
    return max(product, 0.0) / (weight + DRIFT**-4)
