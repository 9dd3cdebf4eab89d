"""Tone curves for intensities of high dynamic range."""
from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pdavis_cv.render.colours import _GREY_TABLE, Picture, _masked

__all__ = ["ToneCurve"]


@dataclass(frozen=True)
class ToneCurve:
    """Grey from intensity by one fixed curve, so that a video cannot flicker.

    The curve is linear in the dark and logarithmic above, asinh(I / knee) scaled
    so that 0 is black and ``white`` white: every octave above the knee gets an
    equal share of the grey values.  A pixel's grey depends on its own value alone.

    Parameters
    ----------
    white : float
        Intensity of grey 255, above 0.
    knee : float
        Intensity where the curve turns logarithmic, above 0; at or above ``white``
        the curve is nearly linear.

    Raises
    ------
    ValueError
        If a number is not positive.
    """

    white: float
    knee: float

    def __post_init__(self) -> None:
        for name in ("white", "knee"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value > 0):
                raise ValueError(f"{name} must be positive, got {value!r}")

    @classmethod
    def of(
        cls, images: Iterable[ArrayLike], valid: Iterable[NDArray[np.bool_]] = ()
    ) -> Self:
        """Fit a curve to some images of a recording, once, before a video is made.

        Parameters
        ----------
        images : iterable of array_like of float, shape (H, W)
            Intensities, e.g. of ten images spread over the recording.
        valid : iterable of ndarray of bool, shape (H, W)
            True = usable, one per image; default: all.

        Returns
        -------
        ToneCurve
            White at the 99.5 % quantile plus a tenth, knee at the 20 % quantile.

        Raises
        ------
        ValueError
            If no pixel is finite and positive.
        """
        masks = list(valid)
        values = []
        for i, image in enumerate(images):
            plane = np.asarray(image, np.float64)
            values.append((plane if not masks else plane[masks[i]]).ravel())
        pixels = np.concatenate(values) if values else np.empty(0)
        pixels = pixels[np.isfinite(pixels) & (pixels > 0)]
        if not pixels.size:
            raise ValueError("images must hold a positive pixel, got none")
        low, high = np.quantile(pixels, (0.2, 0.995))
        return cls(1.1 * float(high), float(low))

    def grey(self, intensity: ArrayLike) -> NDArray[np.uint8]:
        """Return grey values.

        Parameters
        ----------
        intensity : array_like of float, shape (H, W)
            In the unit of ``white``.

        Returns
        -------
        ndarray of uint8, shape (H, W)
        """
        value = np.maximum(np.nan_to_num(np.asarray(intensity, np.float64)), 0)
        top = np.arcsinh(self.white / self.knee)
        share = np.arcsinh(value / self.knee) * (255 / top)
        return np.asarray(np.rint(np.minimum(share, 255)), np.uint8)

    def bgr(
        self, intensity: ArrayLike, valid: NDArray[np.bool_] | None = None
    ) -> Picture:
        """Return a grey picture; pixels that are not valid become `INVALID`.

        Parameters
        ----------
        intensity : array_like of float, shape (H, W)
            In the unit of ``white``.
        valid : ndarray of bool, shape (H, W), optional
            True = usable.

        Returns
        -------
        ndarray of uint8, shape (H, W, 3)
            BGR.
        """
        value = np.asarray(intensity, np.float64)
        return _masked(_GREY_TABLE.take(self.grey(value), axis=0), valid, value)
