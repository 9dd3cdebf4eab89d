"""An analyser that stands at another angle in each image of a scene at rest."""
from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pdavis_cv import _kernels
from pdavis_cv._checks import floats
from pdavis_cv.analyser import Analyser
from pdavis_cv.polarimetry import PolarFrame, adopted
from pdavis_cv.stokes_vector import propagated, stokes

_LEAST_TO_FIND = 5
"""Images that determine an ellipse, on which those of unknown angles lie."""
_PIXELS = 1 << 16       # of which angles are found
_CLEAR = 4.0
"""How many times above the third largest eigenvalue, noise, the second one must be."""
_POOLED = 5             # side of the squares whose residuals give one variance


@dataclass(frozen=True)
class AnalyserSteps:
    """A linear polarizer before an ordinary camera, at one angle for each image.

    Parameters
    ----------
    angles : sequence of float
        Angle of its transmission axis in the middle of each exposure, radians as AoP;
        at least three that differ modulo pi.
    sweep : float
        Angle by which it turns during an exposure, radians; it weakens the modulation
        by sin(sweep) / sweep, which is undone.

    Raises
    ------
    ValueError
        If the angles do not determine the Stokes parameters, or `sweep` is a half turn.

    Examples
    --------
    >>> steps = AnalyserSteps(np.deg2rad([0, 30, 60, 90]))
    >>> image = steps.polarization(np.array([1.5, 1.25, .75, .5]).reshape(4, 1, 1))
    >>> round(float(image.s0[0, 0]), 5), round(float(image.dolp[0, 0]), 5)
    (2.0, 0.5)
    """

    angles: tuple[float, ...]
    sweep: float = 0.0

    def __post_init__(self) -> None:
        angles = tuple(floats("angles", self.angles).ravel().tolist())
        object.__setattr__(self, "angles", angles)
        if not abs(self.sweep) < math.pi:
            raise ValueError(f"sweep must be less than pi, got {self.sweep}")
        if not np.isfinite(angles).all() or np.linalg.matrix_rank(
                self.response, 1e-9) < 3:
            shown = ", ".join(f"{math.degrees(angle):g}" for angle in angles)
            raise ValueError("angles must be at least three that differ modulo 180 "
                             f"degrees, got {shown or 'none'}")

    @property
    def response(self) -> NDArray[np.float64]:
        """Response of each image to S0, S1, S2; shape (N, 3)."""
        twice = 2 * np.array(self.angles)
        contrast = np.sinc(self.sweep / math.pi)
        return np.stack([np.ones_like(twice), contrast * np.cos(twice),
                         contrast * np.sin(twice)], 1) / 2

    @classmethod
    def found(cls, images: ArrayLike) -> Self:
        """Find the angles of images, up to their zero and direction.

        The first one is 0, and the second one is less than 90 degrees
        counter-clockwise from it.  Two images at one angle need not follow each other.

        Parameters
        ----------
        images : array_like, shape (N, H, W), N >= 5
            Of a scene with light of different angles of polarization.

        Raises
        ------
        ValueError
            If there are too few images, or they do not tell their angles.
        """
        stack = checked_images(images)
        pixels = stack.reshape(len(stack), -1)
        if len(stack) < _LEAST_TO_FIND:
            raise ValueError(f"images must be at least {_LEAST_TO_FIND} for their "
                             f"angles to be found, got {len(stack)}")
        pixels = pixels[:, ::max(pixels.shape[1] // _PIXELS, 1)].astype(np.float64)
        pixels = pixels - pixels.mean(0)
        size, axes = np.linalg.eigh(pixels @ pixels.T)
        # In the plane of S1 and S2 they lie on an ellipse: a x^2 + b x y + .. = 1.
        x, y = (axes[:, -2:] * np.sqrt(np.maximum(size[-2:], 0))).T / math.sqrt(
            max(size[-1], 1e-300))
        a, b, c, d, e = np.linalg.lstsq(
            np.stack([x * x, x * y, y * y, x, y], 1), np.ones(len(x)), rcond=None)[0]
        form = np.array([[a, b / 2], [b / 2, c]])
        if not (size[-2] > _CLEAR * size[-3] and np.linalg.det(form) > 0 and a > 0):
            raise ValueError("images must show light of different angles of "
                             "polarization for the analyser's angles to be found")
        centre = np.linalg.solve(2 * form, [-d, -e])
        u, v = np.linalg.cholesky(form).T @ (np.stack([x, y]) - centre[:, np.newaxis])
        angles = (np.arctan2(v, u) - math.atan2(v[0], u[0])) / 2
        if math.remainder(angles[1], math.pi) < 0:
            angles = -angles
        return cls(tuple(angles % math.pi))

    def polarization(
        self, images: ArrayLike, valid: NDArray[np.bool_] | None = None
    ) -> PolarFrame:
        """Return the image of polarization by least squares.

        Parameters
        ----------
        images : array_like, shape (N, H, W)
            Linear intensity, of a scene at rest.
        valid : ndarray of bool, shape (N, H, W), optional
            True = usable, e.g. not clipped; other samples have no weight.

        Returns
        -------
        PolarFrame
            Of what four ideal polarizers would measure.  With more than three images
            it has errors of AoP and DoLP, from the residuals of 5x5 pixels.

        Raises
        ------
        ValueError
            If there is not one image for each angle, or a shape differs.
        """
        a, stack = self.response, checked_images(images, "angles", len(self.angles))
        if stack.dtype not in (np.uint8, np.uint16):
            stack = stack.astype(np.float32)
        n, shape = len(stack), stack.shape[1:]
        if valid is not None and (valid.shape != stack.shape or valid.dtype != bool):
            raise ValueError(f"valid must be bool of shape {stack.shape}, got "
                             f"{valid.dtype} {valid.shape}")
        flat = stack.reshape(n, -1)
        ideal, solution = Analyser.ideal(), np.linalg.pinv(a).astype(np.float32)
        quad, rest = (np.empty((k, flat.shape[1]), np.float32) for k in (4, 1))
        _kernels.least_squares(
            flat, (ideal.response @ solution).astype(np.float32),
            (a @ ideal.solution).astype(np.float32), quad, rest[0])
        usable, missing = np.ones(flat.shape[1], np.bool_), np.zeros(0)
        good = None if valid is None else valid.reshape(n, -1)
        some = np.nonzero([] if good is None else ~good.all(0))[0]
        own = np.empty((3, n, len(some)))
        if good is not None and len(some):
            weight = good[:, some].astype(np.float64)
            normal = np.einsum("ip,ij,ik->pjk", weight, a, a)
            usable[some] = np.linalg.det(normal) > 1e-6
            normal[~usable[some]] = np.eye(3)
            own = np.einsum("pjk,ik,ip->jip", np.linalg.inv(normal), a, weight)
            seen = np.where(good[:, some], flat[:, some], 0)
            planes = np.einsum("jip,ip->jp", own, seen)
            quad[:, some] = ideal.response @ planes
            rest[0, some] = (weight * (seen - a @ planes)**2).sum(0)
            missing = np.zeros(flat.shape[1], np.float32)
            missing[some] = n - weight.sum(0)

        def sigmas() -> NDArray[np.float32]:
            planes = stokes(quad)
            freedom = np.maximum(
                n - 3 - missing.reshape(shape), 0) if len(some) else n - 3
            variance = _pooled(rest[0].reshape(shape)).ravel()
            variance /= np.maximum(_pooled(freedom), 1e-3).ravel()
            made = np.stack(propagated(
                tuple(planes), solution, np.broadcast_to(variance, flat.shape)))
            if len(some):
                made[:, some] = propagated(
                    tuple(planes[:, some]), own.astype(np.float32), np.broadcast_to(
                        variance[some], (n, len(some))))
            return made.reshape(3, *shape)

        return adopted(quad.reshape(4, *shape), valid=usable.reshape(shape),
                       sigmas=sigmas if n > 3 else None)


def _pooled(values: NDArray[np.float32] | int) -> NDArray[np.float32]:
    """Return the mean of squares around each pixel."""
    from scipy import ndimage
    return np.asarray(values if np.ndim(values) == 0 else ndimage.uniform_filter(
        values, _POOLED, mode="nearest"), np.float32)


def checked_images(
    images: ArrayLike, each: str = "", count: int | None = None, side: int = 0
) -> NDArray[Any]:
    """Return images (N, H, W), with sides of at least one, one for each of so many."""
    stack = np.asarray(images)
    if stack.ndim != 3 or stack.dtype.kind not in "fiub" or min(stack.shape[1:]) < side:
        least = f" with sides of at least {side}" if side else ""
        raise ValueError(f"images must be numbers of shape (N, H, W){least}, got "
                         f"{stack.dtype} {stack.shape}")
    if count is not None and len(stack) != count:
        raise ValueError(f"images must be one for each of {count} {each}, got "
                         f"{len(stack)}")
    return stack
