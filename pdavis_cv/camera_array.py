"""Cameras, or images, of one scene behind different polarizers: their alignment."""
from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pdavis_cv.steps import checked_images

_SIDE = 32      # least, pixels
_PIXELS = 1 << 20
"""Pixels that suffice: an image of four times as many is binned to be aligned."""
_FINE, _COARSE = 1.0, 4.0
"""Widths (sigma) of the band of detail that is compared, pixels.  Polarization changes
what is coarser: made scenes moved by .04 to .1 with 8, by .01 to .05 with 4."""
_ROUNDS, _ENOUGH = 30, 1e-3
"""Most corrections, and the one below which they end, pixels at the corners."""
_OUTLIER = 2.0
"""Difference with half of the weight, in median differences: polarized edges."""
_LEAST_CORRELATION = 0.45    # of made scenes, moves that were wrong had up to .40
_ALIKE = 4 * math.pi * _FINE**2
"""Pixels of filtered noise that differ together: as many count as one."""


@dataclass(frozen=True)
class AnalyserArray:
    """Images of one scene, each of another camera or polarizer, laid over the first.

    Parameters
    ----------
    moves : tuple of (float, float, float)
        Of each image, where what the first one shows in its middle lies: pixels to the
        right and down; and by how much it is turned, radians, counter-clockwise as
        displayed.
    errors : tuple of float
        Standard error of each image's shift, pixels, from what still differs.
    """

    moves: tuple[tuple[float, float, float], ...]
    errors: tuple[float, ...]

    @classmethod
    def found(cls, images: ArrayLike) -> Self:
        """Find the moves: whole pixels by phase correlation, then by least squares.

        What is compared is detail of the logarithm, which a polarizer changes little.

        Parameters
        ----------
        images : array_like, shape (N, H, W), sides of at least 32
            Intensities in any unit.

        Raises
        ------
        ValueError
            If an image does not show what the first one shows.
        """
        stack = checked_images(images, side=_SIDE)
        step = max(math.isqrt(stack[0].size // _PIXELS), 1)
        details = [_detail(image, step) for image in stack]
        found = [((0.0, 0.0, 0.0), 0.0)]
        for k, one in enumerate(details[1:], 1):
            move, error, alike = _registered(details[0], one)
            if alike < _LEAST_CORRELATION:
                raise ValueError(
                    f"image {k} cannot be aligned with image 0: their details have a "
                    f"correlation of {alike:.2f}")
            found.append(((step * move[0], step * move[1], move[2]), step * error))
        return cls(*(tuple(part) for part in zip(*found, strict=True)))

    def aligned(self, images: ArrayLike) -> NDArray[np.float32]:
        """Return images laid over the first one, 0 where one of them has no sample.

        Parameters
        ----------
        images : array_like, shape (N, H, W)

        Raises
        ------
        ValueError
            If there is not one image for each move.
        """
        stack = checked_images(images, "moves", len(self.moves), _SIDE)
        out = np.stack([_moved(image, move, cval=np.nan)
                        for image, move in zip(stack, self.moves, strict=True)])
        out[:, np.isnan(out).any(0)] = 0
        return out

    def __str__(self) -> str:
        return "; ".join(
            f"image {k} by {x:.2f}, {y:.2f} px (+-{error:.2f}) and "
            f"{math.degrees(turn):.2f} degrees" for k, ((x, y, turn), error) in
            enumerate(zip(self.moves, self.errors, strict=True)) if k)


def _detail(image: NDArray[Any], step: int) -> NDArray[np.float32]:
    """Return the detail of ln I, binned."""
    from scipy import ndimage
    h, w = (side // step * step for side in image.shape)
    light = image[:h, :w].reshape(h // step, step, w // step, step).mean(
        (1, 3), dtype=np.float32)
    log = np.log(np.maximum(light, max(0.02 * float(light.mean()), 1e-6)))
    fine, coarse = (ndimage.gaussian_filter(log, one) for one in (_FINE, _COARSE))
    return np.asarray(fine - coarse, np.float32)


def _moved(image: NDArray[Any], move: tuple[float, float, float], **how: Any
           ) -> NDArray[np.float32]:
    """Return what an image that is moved shows at the places of the first one."""
    from scipy import ndimage
    x, y, turn = move
    if not any(move):
        return np.asarray(image, np.float32)
    c, s = math.cos(turn), math.sin(turn)
    matrix, middle = np.array([[c, -s], [s, c]]), (np.array(image.shape) - 1) / 2
    return np.asarray(ndimage.affine_transform(
        np.asarray(image, np.float32), matrix,
        middle + np.array((y, x)) - matrix @ middle,
        order=3, **how), np.float32)


def _registered(first: NDArray[np.float32], other: NDArray[np.float32]
                ) -> tuple[tuple[float, float, float], float, float]:
    """Return move, error of the shift and correlation of two images' details."""
    h, w = first.shape
    window = np.hanning(h)[:, None] * np.hanning(w)
    cross = np.conj(np.fft.rfft2(first * window)) * np.fft.rfft2(other * window)
    peak = np.fft.irfft2(cross / np.maximum(np.abs(cross), 1e-12), first.shape)
    y, x = (int(at) for at in np.unravel_index(np.argmax(peak), peak.shape))
    move = np.array([x - w if x > w // 2 else x, y - h if y > h // 2 else y, 0.0])
    # Inside, whatever the move, and away from what filters do at borders.
    edge = [min(int(abs(shift)) + 2 * int(_COARSE), side // 3)
            for shift, side in ((move[1], h), (move[0], w))]
    inner = np.s_[edge[0]:h - edge[0], edge[1]:w - edge[1]]
    down, right = (axis - (side - 1) / 2
                   for axis, side in zip(np.mgrid[:h, :w], (h, w), strict=True))
    down, right = down[inner].ravel(), right[inner].ravel()
    wanted, reach = first[inner].ravel(), max(h, w) / 2
    for _ in range(_ROUNDS):
        warped = _moved(other, tuple(move), mode="nearest")
        gradient: Any = np.gradient(warped)
        gy, gx = (slope[inner].ravel() for slope in gradient)
        seen = warped[inner].ravel()
        off = wanted - seen
        size = np.median(np.abs(off)) * _OUTLIER + 1e-9
        root = 1 / np.sqrt(1 + (off / size)**2)
        slopes = np.stack([gx, gy, (down * gx - right * gy) / reach], 1)
        change = np.linalg.lstsq(slopes * root[:, None], off * root, rcond=None)[0]
        move += (change[0], change[1], change[2] / reach)
        if np.abs(change).max() < _ENOUGH:
            break
    strength = float(np.sqrt(np.sum(gx**2 + gy**2) / 2))
    error = float(np.sqrt(_ALIKE * np.mean(off**2))) / max(strength, 1e-12)
    alike = float(np.corrcoef(wanted, seen)[0, 1]) if wanted.any() and seen.any() else 0
    return (float(move[0]), float(move[1]), float(move[2])), error, alike
