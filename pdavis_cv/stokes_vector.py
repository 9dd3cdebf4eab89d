"""Stokes parameters of intensities, angle and degree of linear polarization."""
from __future__ import annotations

import math
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pdavis_cv import _kernels
from pdavis_cv._checks import output
from pdavis_cv.analyser import Analyser, stokes_gain

_Array = TypeVar("_Array", bound=NDArray[Any])

UNIFORM_SIGMA_RAD = math.pi / math.sqrt(12)
"""Standard deviation of a uniformly distributed axial angle, radians."""


def stokes(
    quad: ArrayLike,
    analyser: ArrayLike | Analyser | None = None,
    out: NDArray[np.float32] | None = None,
    *,
    extinction_ratio: float | None = None,
) -> NDArray[np.float32]:
    """Return S0, S1 and S2 of four intensities.

    Parameters
    ----------
    quad : array_like, shape (4, ...)
        I0, I45, I90, I135, linear intensity; converted to float32.
    analyser : Analyser, or array_like of shape (4, 3) or (4, 3, H, W), optional
        Responses of the channels to S0, S1, S2, solved by least squares.  Default:
        S0 = (I0 + I45 + I90 + I135) / 2, S1 = I0 - I90, S2 = I45 - I135.
    out : ndarray of float32, shape (3, ...), optional
        Overwritten and returned.
    extinction_ratio : float, optional
        S1 and S2 are multiplied by (ER + 1) / (ER - 1); not together with
        ``analyser``, which says it more exactly.

    Returns
    -------
    ndarray of float32, shape (3, ...)
        In the unit of ``quad``; S0 is the light in front of the polarizers.

    Raises
    ------
    TypeError
        If ``quad`` does not hold real numbers.
    ValueError
        If shapes do not fit, ``extinction_ratio`` is not greater than 1 or is given
        together with ``analyser``.
    """
    planes = real("quad", quad)
    if planes.ndim < 1 or planes.shape[0] != 4:
        raise ValueError(f"quad must have shape (4, ...), got {planes.shape}")
    solution = solution_of(analyser, extinction_ratio, planes.shape[1:])
    gain = stokes_gain(extinction_ratio)
    out = output(out, (3, *planes.shape[1:]), np.float32, planes, solution)
    if solution is None:
        _kernels.stokes(flat(planes), gain, flat(out))
    else:
        _kernels.mix(flat(planes), solution.reshape(12, -1), flat(out))
    return out


def aop(
    s1: ArrayLike, s2: ArrayLike, out: NDArray[np.float32] | None = None
) -> NDArray[np.float32]:
    """Return the angle of polarization, atan2(S2, S1) / 2 in [0, pi).

    Parameters
    ----------
    s1, s2 : array_like, equal shapes
        Converted to float32.
    out : ndarray of float32, the same shape, optional
        Overwritten and returned.

    Returns
    -------
    ndarray of float32
        Radians, counter-clockwise as displayed with row 0 at the top, 0 along a row;
        within 2.1e-7 of the exact value.  A value that rounds to float32 pi is 0, and
        so is the angle of S1 = S2 = 0.  NaN gives NaN.

    Raises
    ------
    TypeError
        If an input does not hold real numbers.
    ValueError
        If shapes differ or ``out`` does not fit.

    Examples
    --------
    >>> float(aop(0, 1)), float(aop(1, 0))
    (0.7853981852531433, 0.0)
    """
    first, second = _alike(s1=s1, s2=s2)
    out = output(out, first.shape, np.float32, first, second)
    _kernels.aop(first.reshape(-1), second.reshape(-1), out.reshape(-1))
    return out


def dolp(
    s0: ArrayLike,
    s1: ArrayLike,
    s2: ArrayLike,
    out: NDArray[np.float32] | None = None,
) -> NDArray[np.float32]:
    """Return the degree of linear polarization, sqrt(S1^2 + S2^2) / S0.

    Parameters
    ----------
    s0, s1, s2 : array_like, equal shapes
        Converted to float32.
    out : ndarray of float32, the same shape, optional
        Overwritten and returned.

    Returns
    -------
    ndarray of float32
        Not clipped: noise may raise it above 1.  0 where S0 is not positive.

    Raises
    ------
    TypeError
        If an input does not hold real numbers.
    ValueError
        If shapes differ or ``out`` does not fit.
    """
    total, first, second = _alike(s0=s0, s1=s1, s2=s2)
    out = output(out, total.shape, np.float32, total, first, second)
    _kernels.dolp(total.reshape(-1), first.reshape(-1), second.reshape(-1),
                  out.reshape(-1))
    return out


def debias_dolp(
    dolp: ArrayLike, sigma: ArrayLike, out: NDArray[np.float32] | None = None
) -> NDArray[np.float32]:
    """Correct a degree of polarization for the bias by noise.

    Noise makes S1 and S2 longer, never shorter, so that DoLP reads too high: by
    sigma^2 / (2 DoLP) where it is well above the noise, by 1.25 sigma where there is
    no polarization.  The modified asymptotic estimator subtracts
    sigma^2 / (2 DoLP) * (1 - exp(-DoLP^2 / sigma^2)), which never makes it negative.
    What is left is below .05 sigma from DoLP = 2 sigma on, and about 1 sigma at
    DoLP = 0, where no estimator that is positive can be unbiased.

    Parameters
    ----------
    dolp : array_like
        Degree of linear polarization; converted to float32.
    sigma : array_like, the same shape or a scalar
        Standard deviation of S1 / S0 and S2 / S0 across the direction of polarization,
        which is 2 DoLP times that of the angle.
    out : ndarray of float32, the shape of ``dolp``, optional
        Overwritten and returned; may be ``dolp`` itself.

    Returns
    -------
    ndarray of float32

    Raises
    ------
    TypeError
        If an input does not hold real numbers.
    ValueError
        If shapes do not fit or a sigma is negative.

    References
    ----------
    S. Plaszczynski, L. Montier, F. Levrier, M. Tristram, "A novel estimator of the
    polarization amplitude from normally distributed Stokes parameters", MNRAS 439,
    4048 (2014), section 4.

    Examples
    --------
    >>> debias_dolp(np.array([0.5, 0.1]), 0.1).round(3)
    array([0.49 , 0.068], dtype=float32)
    """
    read, spread = real("dolp", dolp), real("sigma", sigma)
    if spread.shape not in ((), read.shape):
        raise ValueError(
            f"sigma must be a scalar or have dolp's shape {read.shape}, got "
            f"{spread.shape}")
    if (spread < 0).any():
        raise ValueError(f"sigma must not be negative, got {np.nanmin(spread)}")
    # Overlap is harmless, as the result is complete before it is stored.
    out = output(out, read.shape, np.float32)
    with np.errstate(divide="ignore", invalid="ignore"):
        snr = np.square(read / spread.astype(float))
        out[...] = read * (1 - np.where(snr > 0, -np.expm1(-snr) / (2 * snr), 0.5))
    return out


def propagated(
    planes: tuple[NDArray[np.float32], ...],
    solution: NDArray[np.float32],
    variance: NDArray[np.float32],
    null: NDArray[np.float32] | None = None,
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
    """Propagate the variance of the intensities, (4, H, W) or of any number of them.

    Returns the standard deviations of AoP, of DoLP, and of (S1 / S0, S2 / S0) across
    the direction of polarization.  Weighted least squares has removed the error along
    `null`, a direction in which no light changes the four intensities.
    """
    s0, s1, s2 = (plane.astype(np.float64) for plane in planes)
    square = s1**2 + s2**2
    size = np.sqrt(square)
    var_aop, var_dolp, var_dark = (np.zeros_like(s0) for _ in range(3))
    # Covariances with n . I, where n is `null`, and the variance of n . I.
    with_aop, with_dolp, along = (np.zeros_like(s0) for _ in range(3))
    with np.errstate(divide="ignore", invalid="ignore"):
        for k in range(len(variance)):
            m0, m1, m2 = solution[0, k], solution[1, k], solution[2, k]
            slope = (s1 * m2 - s2 * m1) / (2 * square)
            var_aop += slope**2 * variance[k]
            if null is not None:
                with_aop += slope * null[k] * variance[k]
            slope = (s1 * m1 + s2 * m2) / (size * s0) - size * m0 / s0**2
            var_dolp += slope**2 * variance[k]
            if null is not None:
                with_dolp += slope * null[k] * variance[k]
                along += null[k]**2 * variance[k]
            # Without polarization the slope has no direction: use its mean square.
            var_dark += (m1**2 + m2**2) / 2 / s0**2 * variance[k]
        along = np.fmax(along, np.finfo(np.float32).tiny)
        var_aop = np.maximum(var_aop - with_aop**2 / along, 0)
        var_dolp = np.maximum(var_dolp - with_dolp**2 / along, 0)
        sigma_aop = np.fmin(np.sqrt(var_aop), UNIFORM_SIGMA_RAD)
        sigma_dolp = np.sqrt(np.where(square > 0, var_dolp, var_dark))
        across = np.sqrt(np.where(square > 0, 4 * square / s0**2 * var_aop, var_dark))
    for sigma in (sigma_dolp, across):
        sigma[~(s0 > 0)] = np.inf
    return (frozen(sigma_aop.astype(np.float32)),
            frozen(sigma_dolp.astype(np.float32)),
            frozen(across.astype(np.float32)))


def sampling_variance(
    quad: NDArray[np.float32], noise: NDArray[np.float32],
) -> NDArray[np.float32]:
    """Return the variance of channels that are taken at different places, (4, H, W).

    Where light changes over the mosaic, the four do not see the same.  By how much
    follows from the differences of each value from its four neighbours, less what
    their noise makes of them, variances of the same shape: docs/theory/demosaicing.md.
    """
    total = np.zeros_like(quad)
    for axis in (1, 2):
        edge = [(0, 0)] * 3
        edge[axis] = (1, 1)
        first, last = (np.delete(noise, at, axis) for at in (-1, 0))
        square = np.maximum(np.diff(quad, axis=axis)**2 - first - last, 0) / 16
        square = np.pad(square, edge)
        total += np.delete(square, 0, axis) + np.delete(square, -1, axis)
    return total


def solution_of(
    analyser: ArrayLike | Analyser | None,
    extinction_ratio: float | None,
    shape: tuple[int, ...],
) -> NDArray[np.float32] | None:
    """Return what solves for S0, S1, S2, or None for the ideal formulas."""
    if analyser is None:
        return None
    if extinction_ratio is not None:
        raise ValueError(
            "extinction_ratio must be None when analyser is given, got "
            f"{extinction_ratio}")
    if not isinstance(analyser, Analyser):
        analyser = Analyser(analyser)
    solution = analyser.solution
    if solution.ndim == 4 and solution.shape[2:] != shape:
        raise ValueError(
            f"analyser must have shape (4, 3) or {(4, 3, *shape)}, got "
            f"{analyser.response.shape}")
    return solution


def real(name: str, value: ArrayLike) -> NDArray[np.float32]:
    """Return value as C-contiguous float32, a view where possible."""
    array = np.asarray(value)
    if array.dtype.kind not in "fiub":
        raise TypeError(f"{name} must hold real numbers, got {array.dtype}")
    return np.require(array, np.float32, ("C", "A"))


def _alike(**values: ArrayLike) -> list[NDArray[np.float32]]:
    arrays = {name: real(name, value) for name, value in values.items()}
    if len({array.shape for array in arrays.values()}) != 1:
        shapes = ", ".join(f"{name} {a.shape}" for name, a in arrays.items())
        raise ValueError(f"{' and '.join(arrays)} must have one shape, got {shapes}")
    return list(arrays.values())


def flat(planes: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return an array of shape (C, ...) as (C, n), without copying."""
    return planes.reshape(len(planes), math.prod(planes.shape[1:]))


def frozen(array: _Array) -> _Array:
    """Return the array, made read-only."""
    array.flags.writeable = False
    return array
