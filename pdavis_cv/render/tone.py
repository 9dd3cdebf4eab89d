"""Tone curves: map intensity to grey by a fixed function."""
from __future__ import annotations

import functools
import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pdavis_cv import _kernels
from pdavis_cv.render.colours import INVALID, Mark, Picture, table_of, through_table

LOG_RANGE = 1023.0
"""White over black of the logarithmic curve: one count of a 10-bit converter."""

_STEPS = 65536


@dataclass(frozen=True)
class ToneCurve:
    """A fixed curve from intensity to grey, with which a video cannot flicker.

    With x = I / `white`, clipped to 0..1, grey is 255 y ** (1 / `gamma`), where y is

    - x, or
    - with a `knee`, asinh(I / knee) / asinh(white / knee): linear in the dark and
      logarithmic above, so that every octave above the knee gets an equal share, or
    - with `log`, 1 + ln(x) / ln(1023), black below x = 1 / 1023.

    Parameters
    ----------
    white : float
        Intensity of grey 255, above 0.
    knee : float, optional
        Intensity where the curve turns logarithmic, above 0; at or above ``white``
        the curve is nearly linear.
    gamma : float
        Above 0; larger values brighten everything between black and white.
    log : bool
        Excludes a `knee`.
    saturated : float, optional
        Intensity from which pixels that are not valid are too bright to measure.

    Raises
    ------
    ValueError
        If a number is not positive, or both `knee` and `log` are given.
    """

    white: float
    knee: float | None = None
    gamma: float = 1.0
    log: bool = False
    saturated: float | None = None

    def __post_init__(self) -> None:
        for name in ("white", "knee", "gamma", "saturated"):
            value = getattr(self, name)
            if value is not None and not (math.isfinite(value) and value > 0):
                raise ValueError(f"{name} must be positive, got {value!r}")
        if self.log and self.knee is not None:
            raise ValueError(f"log excludes a knee, got {self.knee!r}")

    @classmethod
    def of(
        cls, images: Iterable[ArrayLike], valid: Iterable[NDArray[np.bool_]] = (), *,
        saturated: float | None = None,
    ) -> Self:
        """Fit a curve with a knee to some images, once, before a video is made.

        Parameters
        ----------
        images : iterable of array_like of float, shape (H, W)
            Intensities, e.g. of ten images spread over the recording.
        valid : iterable of ndarray of bool, shape (H, W)
            True = usable, one per image; default: all.
        saturated : float, optional
            As for the class.

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
        return cls(1.1 * float(high), float(low), saturated=saturated)

    @functools.cached_property
    def _colours(self) -> NDArray[np.uint8]:
        """Colours by the square root of x, which gives fine steps in dim light."""
        x = (np.arange(_STEPS) / (_STEPS - 1)) ** 2
        if self.knee is not None:
            x = np.arcsinh(x * (self.white / self.knee)) / np.arcsinh(
                self.white / self.knee)
        elif self.log:
            x = np.maximum(1 + np.log(np.maximum(x, 1e-9)) / math.log(LOG_RANGE), 0)
        grey = np.rint(255 * x ** (1 / self.gamma)).astype(np.uint8)
        return np.repeat(grey[:, None], 3, axis=1)

    def bgr(
        self, intensity: ArrayLike, valid: NDArray[np.bool_] | None = None, *,
        invalid: Mark = INVALID,
    ) -> Picture:
        """Return a grey picture.

        Parameters
        ----------
        intensity : array_like of float, shape (H, W)
            In the unit of ``white``.
        valid : ndarray of bool, shape (H, W), optional
            True = usable.
        invalid : (int, int, int), or two of them
            BGR of pixels that are not valid, and of NaN; of two, stripes.

        Returns
        -------
        ndarray of uint8, shape (H, W, 3)
            BGR.
        """
        return self._through(intensity, valid, invalid, invalid)

    def seen(
        self, intensity: ArrayLike, valid: NDArray[np.bool_] | None = None
    ) -> Picture:
        """Return a grey picture in which what is too bright to measure is white.

        Parameters
        ----------
        intensity : array_like of float, shape (H, W)
            In the unit of ``white``.
        valid : ndarray of bool, shape (H, W), optional
            True = usable.

        Returns
        -------
        ndarray of uint8, shape (H, W, 3)
            BGR; pixels that are not valid are white from ``saturated`` on, and
            hatched below.
        """
        if self.saturated is None:
            return self.bgr(intensity, valid)
        return self._through(intensity, valid, INVALID, (255, 255, 255), self.saturated)

    def _through(
        self, intensity: ArrayLike, valid: NDArray[np.bool_] | None,
        none: Mark, invalid: Mark, least: float | None = None,
    ) -> Picture:
        return through_table(
            _kernels.tone_bgr, intensity, valid, (_STEPS - 1) ** 2 / self.white,
            _table(self, none, invalid), least)


@functools.lru_cache(16)
def _table(curve: ToneCurve, none: Mark, invalid: Mark) -> NDArray[np.uint8]:
    return table_of(curve._colours, none, invalid)
