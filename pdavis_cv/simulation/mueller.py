"""Mueller matrices of diattenuators and retarders, and whether one is physical."""
from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

__all__ = ["diattenuator", "is_physical", "retarder", "rotated"]

FloatArray = NDArray[np.float64]


def diattenuator(diattenuation: ArrayLike, axis: ArrayLike = 0.0) -> FloatArray:
    """Return the Mueller matrix of an element that passes one polarization better.

    Parameters
    ----------
    diattenuation : array_like
        (T_max - T_min) / (T_max + T_min), 0..1; 1 is a polarizer.
    axis : array_like
        Angle of the polarization that passes best, radians; broadcast with the other.

    Returns
    -------
    ndarray of float64, shape (..., 4, 4)
        Normalised to a mean transmission of 1: unpolarized light keeps its intensity.
    """
    d, axis = np.broadcast_arrays(
        np.asarray(diattenuation, np.float64), np.asarray(axis, np.float64))
    matrix = np.zeros((*d.shape, 4, 4))
    matrix[..., 0, 0] = matrix[..., 1, 1] = 1
    matrix[..., 0, 1] = matrix[..., 1, 0] = d
    matrix[..., 2, 2] = matrix[..., 3, 3] = np.sqrt(np.maximum(1 - d**2, 0))
    return rotated(matrix, axis)


def retarder(retardance: ArrayLike, axis: ArrayLike = 0.0) -> FloatArray:
    """Return the Mueller matrix of a linear retarder.

    Parameters
    ----------
    retardance : array_like
        Radians by which the slow axis lags.
    axis : array_like
        Angle of the fast axis, radians; broadcast with the other.

    Returns
    -------
    ndarray of float64, shape (..., 4, 4)
        Light at +45 degrees from the fast axis gets S3 = -sin(retardance).
    """
    delta, axis = np.broadcast_arrays(
        np.asarray(retardance, np.float64), np.asarray(axis, np.float64))
    matrix = np.zeros((*delta.shape, 4, 4))
    matrix[..., 0, 0] = matrix[..., 1, 1] = 1
    matrix[..., 2, 2] = matrix[..., 3, 3] = np.cos(delta)
    matrix[..., 2, 3] = np.sin(delta)
    matrix[..., 3, 2] = -np.sin(delta)
    return rotated(matrix, axis)


def rotated(matrix: ArrayLike, angle: ArrayLike) -> FloatArray:
    """Return the Mueller matrix of an element that is rotated.

    Parameters
    ----------
    matrix : array_like, shape (..., 4, 4)
        Matrix of the element at angle 0.
    angle : array_like, shape (...)
        Radians, counter-clockwise as displayed.
    """
    matrix = np.asarray(matrix, np.float64)
    turn = 2 * np.asarray(angle, np.float64)
    back = np.zeros((*turn.shape, 4, 4))
    back[..., 0, 0] = back[..., 3, 3] = 1
    back[..., 1, 1] = back[..., 2, 2] = np.cos(turn)
    back[..., 1, 2], back[..., 2, 1] = np.sin(turn), -np.sin(turn)
    return np.asarray(np.swapaxes(back, -1, -2) @ matrix @ back)


_PAULI = np.array([[[1, 0], [0, 1]], [[1, 0], [0, -1]], [[0, 1], [1, 0]],
                   [[0, -1j], [1j, 0]]])


def is_physical(matrix: ArrayLike, tolerance: float = 1e-9) -> bool:
    """Whether a Mueller matrix is physically realisable, by a mixture of elements.

    Its coherency matrix ``sum(m[i, j] kron(sigma[i], conj(sigma[j]))) / 4`` then has
    no negative eigenvalue [Cloude 1986].

    Parameters
    ----------
    matrix : array_like, shape (..., 4, 4)
        All of them must be.
    tolerance : float
        Tolerance of an eigenvalue, relative to the mean transmission.
    """
    matrix = np.asarray(matrix, np.float64)
    products = np.einsum("iab,jcd->ijacbd", _PAULI, _PAULI.conj()).reshape(4, 4, 4, 4)
    coherency = np.einsum("...ij,ijkl->...kl", matrix, products) / 4
    low = np.linalg.eigvalsh(coherency)[..., 0]
    return bool(np.all(low >= -tolerance * np.abs(matrix[..., 0, 0])))
