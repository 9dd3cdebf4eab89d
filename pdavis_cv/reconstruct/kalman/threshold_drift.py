"""Drift of the thresholds, estimated from the innovations of successive frames."""
from __future__ import annotations

from collections.abc import Sequence

__all__ = ["drift_product", "drift_variance", "frame_drift"]

DRIFT = 0.005
"""Prior width of the drift: standard deviation of the thresholds' relative change from
frame to frame.  Engineering choice: 10 % in a second of the paper's cameras is far more
than temperature does to bias currents, so a larger drift must show in many pixels.
docs/theory/priors.md says what it was compared with, and on which cameras."""

CHANGE, SYSTEMATIC = 0.1, 0.002
"""Relative standard deviations: prior of the change found in one frame (engineering
choice), and systematic error that interpolation between events causes in all pixels
alike (docs/theory/selfcal.md)."""

Drift = tuple[float, float, float, float, float]


def frame_drift(normal: Sequence[float]) -> Drift:
    """Return the relative change of both thresholds since the frame before.

    Weighted least squares for the change that all pixels have in common.

    Parameters
    ----------
    normal : sequence of float
        Sums over all pixels of p e / v, m e / v, p p / v, p m / v and m m / v, where e
        is the innovation, v its variance, and p and m its derivatives by the relative
        changes of the ON and the OFF threshold.

    Returns
    -------
    (float, float, float, float, float)
        Information vector W d (ON, OFF) of the relative changes d, then the elements
        ON ON, ON OFF and OFF OFF of the information matrix W, the inverse covariance.
    """
    of_on, of_off, on, both, off = normal
    on, off = on + CHANGE**-2, off + CHANGE**-2
    whole = on * off - both * both
    change_on = (off * of_on - both * of_off) / whole
    change_off = (on * of_off - both * of_on) / whole
    # The systematic error common to all pixels is added to the covariance.
    var_on, var_off = off / whole + SYSTEMATIC**2, on / whole + SYSTEMATIC**2
    cov = -both / whole
    whole = var_on * var_off - cov * cov
    on, both, off = var_off / whole, -cov / whole, var_on / whole
    return (on * change_on + both * change_off, both * change_on + off * change_off,
            on, both, off)


def drift_product(now: Sequence[float], before: Sequence[float]) -> tuple[float, float]:
    """Return what two successive frames add to the sums of `drift_variance`.

    The innovations of an optimal filter are white.  If the filter lags behind a drift,
    the changes found in one frame and the next have the same sign, while their errors
    are independent and cancel in the mean of the product.  Each direction is weighted
    by its information, as the ratio of the thresholds is known far better than their
    scale.

    Parameters
    ----------
    now, before : sequence of float, shape (5,)
        Results of `frame_drift`; ``before`` is 0 if there was no frame.
    """
    return (now[0] * before[0] + now[1] * before[1],
            now[2] * before[2] + 2 * now[3] * before[3] + now[4] * before[4])


def drift_variance(sums: Sequence[float]) -> float:
    """Return the variance of each threshold's relative change per frame.

    Parameters
    ----------
    sums : sequence of float, shape (2,)
        Discounted sums of `drift_product` over frames: product, weight.
    """
    product, weight = sums
    return max(product, 0.0) / (weight + DRIFT**-4)
