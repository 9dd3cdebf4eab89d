"""From degree of linear polarization to retardance and birefringence.

Circularly polarized light through a linear retarder delta leaves with
DoLP = |sin(delta)|, as in a tendon under circular illumination.
"""
from __future__ import annotations

import warnings

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pdavis_cv._checks import fitting, floats, planes, positive
from pdavis_cv.errors import AnalysisWarning

FloatArray = NDArray[np.float64]

# From here on the derivative of asin exceeds 3 and noise folds back at 1.
_NEAR_WRAP = 0.95


def retardance(
    dolp: ArrayLike, dolp_se: ArrayLike | None = None
) -> tuple[FloatArray, FloatArray | None]:
    """Return the retardance asin(DoLP) of a sample in circularly polarized light.

    Parameters
    ----------
    dolp : array_like
        Degree of linear polarization; values outside 0..1 give NaN.
    dolp_se : array_like, optional
        Its standard error.

    Returns
    -------
    retardance : ndarray of float64
        Radians, 0..pi/2; a retardance r above pi/2 reads as pi - r.
    se : ndarray of float64 or None
        Standard error, to first order.

    Warns
    -----
    AnalysisWarning
        If a value is above 0.95: beyond pi/2 retardance folds back.
    """
    p = floats("dolp", dolp)
    inside = (p >= 0) & (p <= 1)
    delta = np.full(p.shape, np.nan)
    np.arcsin(p, out=delta, where=inside)
    near = np.count_nonzero(p > _NEAR_WRAP)
    if near:
        warnings.warn(
            f"{near} of {p.size} DoLP values exceed {_NEAR_WRAP}: retardance may have "
            "passed 90 degrees, where asin(DoLP) folds back", AnalysisWarning,
            stacklevel=3)
    if dolp_se is None:
        return delta, None
    slope = np.sqrt(np.maximum(1 - np.where(inside, p, 0) ** 2, 0))
    error = fitting("dolp_se", floats("dolp_se", dolp_se), p.shape)
    se = np.divide(error, slope, out=np.full(p.shape, np.nan),
                   where=inside & (slope > 0))
    return delta, se


def birefringence(
    retardance: ArrayLike, *, thickness_um: float, wavelength_nm: float
) -> FloatArray:
    """Return the difference of refractive indices, delta * wavelength / (2 pi d).

    Parameters
    ----------
    retardance : array_like
        Radians.
    thickness_um : float
        Thickness of the sample in micrometres.
    wavelength_nm : float
        Wavelength in nanometres.

    Returns
    -------
    ndarray of float64

    Raises
    ------
    ValueError
        If thickness or wavelength is not positive.

    Examples
    --------
    >>> float(birefringence(2 * np.pi, thickness_um=100, wavelength_nm=500))
    0.005
    """
    thickness_um = positive("thickness_um", thickness_um)
    wavelength_nm = positive("wavelength_nm", wavelength_nm)
    return floats("retardance", retardance) * (wavelength_nm * 1e-3) / (
        2 * np.pi * thickness_um)


def subtract_background(stokes: ArrayLike, background: ArrayLike) -> FloatArray:
    """Remove the linear polarization that is there without a sample.

    The normalised S1/S0 and S2/S0 of the background are subtracted, which holds
    to first order for a weak residual of the illumination; S0 is kept.

    Parameters
    ----------
    stokes : array_like, shape (3, ...)
        S0, S1, S2 with the sample.
    background : array_like, shape (3, ...)
        S0, S1, S2 without it; broadcast to ``stokes``.

    Returns
    -------
    ndarray of float64, shape (3, ...)
        Where the background has no light, NaN.

    Raises
    ------
    ValueError
        If an array does not hold three planes.
    """
    s = planes("stokes", stokes, 3)
    b = fitting("background", planes("background", background, 3), s.shape)
    ratio = np.full((2, *b.shape[1:]), np.nan)
    np.divide(b[1:], b[:1], out=ratio, where=np.broadcast_to(b[:1] > 0, ratio.shape))
    s[1:] -= ratio * s[0]
    return s
