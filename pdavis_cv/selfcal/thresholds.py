"""Contrast thresholds of all pixels: empirical-Bayes shrinkage of their estimates.

The filter estimates each pixel's thresholds with a wide prior.  The scatter over the
pixels gives the width that the prior should have had; each estimate is then shrunk
towards the nominal value accordingly, and systematic errors are added to its
covariance.
"""
from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pdavis_cv.selfcal.priors import USUAL_MISMATCH
from pdavis_cv.selfcal.uncertainty import FRAME_CORRELATION, SystematicErrors

__all__ = ["shrink_to_population", "variance_inflation"]

_Symmetric = tuple[
    NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]

# Bounds on the estimated pixel-to-pixel variance.  Upper: estimated again with sample
# variances x 2.  Lower: half the usual mismatch variance.
_CONSERVATIVE_INFLATION, _MIN_MISMATCH_SHARE = 2.0, 0.5

_MAX_SPREAD_RATIO = 4.0
"""Errors are taken as correlated, and the rescaling of variances rejected, if it makes
the pixel-to-pixel variance exceed the conservative one by this factor."""

_MIN_PIXELS = 12
"""Minimum number of pixels for a variance estimate."""

_EM_STEPS = 30
"""Number of steps of expectation-maximisation, which converges in fewer than 20."""

# Most pixels from which a variance is estimated.
_SPREAD_PIXELS, _INFLATION_PIXELS = 4000, 20_000

_MIN_INFORMED = 0.7
"""A pixel counts in `variance_inflation` if the second half of the data reduced its
variance by at least this factor."""

_LEAST_OF_NOMINAL, _MOST_OF_NOMINAL = 0.3, 3.0
"""Bounds of an estimated threshold relative to the prior mean: a factor of 3 covers the
thresholds of DAVIS cameras, between 0.14 and about 0.4."""

_MAD_PER_SIGMA, _CLIP_SIGMAS = 0.6745, 3
"""Median of the absolute value of a standard normal number; bound on normalised
differences in `variance_inflation`, in robust standard deviations, against outliers."""

_LEAST_SPREAD = 0.01
"""Numerical floor of the pixel-to-pixel sigma, as a share of the prior sigma."""

# Ridge of a pixel's information matrix, relative to its trace and absolute (1 / ln^2),
# so that the inverse exists for pixels without any information; numerical.
_RIDGE, _LEAST_INFORMATION = 1e-9, 1e-30


def shrink_to_population(
    theta: NDArray[np.float64], covariance: NDArray[np.float64],
    nominal: tuple[ArrayLike, ArrayLike], sigma: float, inflation: tuple[float, float],
    systematics: SystematicErrors | None,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Replace the prior variance `sigma`^2 by the estimated pixel-to-pixel variance.

    Empirical Bayes by expectation-maximisation.  A pixel's own information is the
    filter's posterior minus its prior.  Behind a plate that turns slowly, or in dim
    light, the errors of frames are correlated over the recording and would look like a
    spread of the thresholds; the pixel-to-pixel variance is therefore bounded by the
    estimate with twice the assumed variance of samples.

    Parameters
    ----------
    theta, covariance : ndarray of float64, shapes (2, H, W) and (H, W, 2, 2)
        Posterior of a filter with the prior `nominal`, standard deviation `sigma`.
    nominal : (on, off)
        Prior mean, scalars or (H, W).
    sigma : float
        Prior standard deviation.
    inflation : (float, float)
        Factors on the variance of ln(on / off) (see `variance_inflation`) and on that
        of the scale, the mean of e^2 / v of the innovations.  The latter does not
        include errors that frames share, so `FrameSystematics` bounds it below.
    systematics : SystematicErrors or None
        Added to the covariance; the ratio is corrected for the mean leak.

    Returns
    -------
    theta, covariance : ndarray of float64, the same shapes
    """
    on, off = (np.asarray(value, np.float64) for value in nominal)
    precision = _inverse(covariance[..., 0, 0], covariance[..., 0, 1],
                         covariance[..., 1, 1])
    # Information matrix of the samples alone, and information vector about nominal.
    matrix = (precision[0] - 1 / sigma**2, precision[1], precision[2] - 1 / sigma**2)
    vector = _times(precision, (theta[0] - on, theta[1] - off))
    correlated = FRAME_CORRELATION
    if systematics is not None:
        correlated = systematics.frames.correlated
        leak = systematics.leak_hz[0] / 2 * systematics.log_ratio_per_leak
        more = _times(matrix, (theta[0] * leak, -theta[1] * leak))
        vector = vector[0] + more[0], vector[1] + more[1]
    means = np.array([on.mean(), off.mean()])
    conservative = (max(inflation[0], _CONSERVATIVE_INFLATION),
                    max(inflation[1], _CONSERVATIVE_INFLATION))
    some = slice(None, None, max(theta[0].size // _SPREAD_PIXELS, 1))
    a, b, c, first, second = (part.ravel()[some] for part in (*matrix, *vector))
    theta_some = theta.reshape(2, -1)[:, some]
    found, bound = (
        _population_variance(
            *_inflate((a, b, c), (first, second), theta_some, each, correlated),
            means, sigma)
        for each in (inflation, conservative))
    if np.sum(found / means**2) > _MAX_SPREAD_RATIO * np.sum(bound / means**2):
        inflation = (1.0, 1.0)
    matrix, vector = _inflate(matrix, vector, theta, inflation, correlated)
    posterior = _inverse(matrix[0] + 1 / bound[0], matrix[1], matrix[2] + 1 / bound[1])
    shift = _times(posterior, vector)
    out = np.stack([np.clip(center + by, _LEAST_OF_NOMINAL * center,
                            _MOST_OF_NOMINAL * center)
                    for center, by in zip((on, off), shift, strict=True)])
    ratio, scale, mixed = _log_ratio_and_scale(posterior, out)
    mixed /= np.sqrt(ratio)
    if systematics is not None:
        # The leak is weighted by the fraction of the prior variance that data removed.
        prior = float(np.sum(bound / means**2))
        informed = np.clip(1 - ratio / prior, 0, 1)
        leak = systematics.leak_hz[1] * informed * systematics.log_ratio_per_leak
        ratio = ratio + np.minimum(leak**2, prior)
        scale += ((systematics.frames.offset_dn[0] * systematics.per_dn) ** 2
                  + systematics.common_scale_sigma**2)
    mixed *= np.sqrt(ratio)
    ratio /= 4
    total = np.empty((*theta.shape[1:], 2, 2))
    total[..., 0, 0] = out[0]**2 * (scale + ratio + mixed)
    total[..., 1, 1] = out[1]**2 * (scale + ratio - mixed)
    total[..., 0, 1] = total[..., 1, 0] = out[0] * out[1] * (scale - ratio)
    return out, total


def variance_inflation(
    half: tuple[NDArray[np.float64], NDArray[np.float64]],
    whole: tuple[NDArray[np.float64], NDArray[np.float64]],
) -> float | None:
    """Return the factor on the variance of ln(on / off), from half and all of the data.

    If variances are correct, Var(half - whole) = V_half - V_whole over the pixels.  The
    innovations are less suited, as they include errors that do not accumulate.

    Parameters
    ----------
    half, whole : (theta, covariance)
        Estimates of one filter after half of the data, and after all of them; shapes
        (2, H, W) and (H, W, 2, 2).

    Returns
    -------
    float or None
        None if fewer than 12 pixels have enough information.
    """
    some = slice(None, None, max(whole[0][0].size // _INFLATION_PIXELS, 1))
    (early, v_early), (late, v_late) = (
        (np.log(on / off), _log_ratio_and_scale(
            (matrix[:, 0, 0], matrix[:, 0, 1], matrix[:, 1, 1]), (on, off))[0])
        for (on, off), matrix in (
            (theta.reshape(2, -1)[:, some], covariance.reshape(-1, 2, 2)[some])
            for theta, covariance in (half, whole)))
    informed = (v_late < _MIN_INFORMED * v_early) & (v_late > 0)
    if np.count_nonzero(informed) < _MIN_PIXELS:
        return None
    z = (early[informed] - late[informed]) / np.sqrt(
        v_early[informed] - v_late[informed])
    # The part common to all pixels is the leak, which `SystematicErrors` includes.
    z = np.abs(z - np.median(z))
    return float(np.mean(np.minimum(
        z, _CLIP_SIGMAS * np.median(z) / _MAD_PER_SIGMA) ** 2))


def _population_variance(
    matrix: _Symmetric, vector: tuple[NDArray[np.float64], NDArray[np.float64]],
    means: NDArray[np.float64], sigma: float,
) -> NDArray[np.float64]:
    """Return the pixel-to-pixel variance of both thresholds (EM), shape (2,)."""
    usual = (USUAL_MISMATCH * means) ** 2
    variance = usual
    least = np.maximum((_LEAST_SPREAD * sigma) ** 2, _MIN_MISMATCH_SHARE * usual)
    for _ in range(_EM_STEPS):
        posterior = _inverse(
            matrix[0] + 1 / variance[0], matrix[1], matrix[2] + 1 / variance[1])
        first, second = _times(posterior, vector)
        variance = np.clip([np.mean(first**2 + posterior[0]),
                            np.mean(second**2 + posterior[2])], least, sigma**2)
    return variance


def _inflate(
    matrix: _Symmetric, vector: tuple[NDArray[np.float64], NDArray[np.float64]],
    theta: NDArray[np.float64], inflation: tuple[float, float], correlated: float,
) -> tuple[_Symmetric, tuple[NDArray[np.float64], NDArray[np.float64]]]:
    """Return the samples' information matrix and vector with inflated variances.

    The factors multiply the relative variances of on - off and of on + off, the latter
    by at least `correlated`.  Pixels without information stay without.
    """
    for_ratio, for_scale = inflation[0]**-0.5, max(inflation[1], correlated)**-0.5
    same, other = (for_scale + for_ratio) / 2, (for_scale - for_ratio) / 2
    on, off = theta
    least = _RIDGE * (matrix[0] + matrix[2]) + _LEAST_INFORMATION
    shift = _times(_inverse(matrix[0] + least, matrix[1], matrix[2] + least), vector)
    a, b, d = matrix[0] * on**2, matrix[1] * on * off, matrix[2] * off**2
    # M P M with M = (same, other; other, same), P the relative precision.
    inflated = (
        (same * same * a + 2 * same * other * b + other * other * d) / on**2,
        ((same * same + other * other) * b + same * other * (a + d)) / (on * off),
        (other * other * a + 2 * same * other * b + same * same * d) / off**2)
    return inflated, _times(inflated, (shift[0], shift[1]))


def _log_ratio_and_scale(
    covariance: _Symmetric, theta: Sequence[NDArray[np.float64]] | NDArray[np.float64]
) -> _Symmetric:
    """Return the variances of ln(on / off) and ln(on off) / 2, and their covariance."""
    first, last = covariance[0] / theta[0]**2, covariance[2] / theta[1]**2
    cross = 2 * covariance[1] / (theta[0] * theta[1])
    both = first + last
    return both - cross, (both + cross) / 4, (first - last) / 2


def _times(
    matrix: _Symmetric, vector: tuple[NDArray[np.float64], NDArray[np.float64]]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    a, b, d = matrix
    return a * vector[0] + b * vector[1], b * vector[0] + d * vector[1]


def _inverse(
    a: NDArray[np.float64], b: NDArray[np.float64], d: NDArray[np.float64]
) -> _Symmetric:
    """Invert symmetric 2 x 2 matrices; much faster than a general solver."""
    scale = 1 / (a * d - b * b)
    return d * scale, -b * scale, a * scale
