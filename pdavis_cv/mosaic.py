"""Demosaicing: four full images from the 2x2 polarizer mosaic."""
from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdavis_cv import _kernels
from pdavis_cv._checks import output
from pdavis_cv.sensor import Layout

__all__ = ["DEMOSAIC_METHODS", "demosaic", "demosaic_valid"]

DEMOSAIC_METHODS = ("bilinear", "superpixel")
"""What the ``demosaic`` arguments take."""

PIXEL_DTYPES = tuple(map(np.dtype, (np.uint8, np.uint16, np.float32)))


def demosaic(
    mosaic: NDArray[Any],
    layout: Layout,
    method: str = "bilinear",
    out: NDArray[np.float32] | None = None,
) -> NDArray[np.float32]:
    """Interpolate I0, I45, I90 and I135 from a mosaic.

    Parameters
    ----------
    mosaic : ndarray of uint8, uint16 or float32, shape (H, W)
        Linear intensity, row 0 at the top.
    layout : Layout
        Polarizer in front of each pixel.
    method : {"bilinear", "superpixel"}
        ``"bilinear"``: each channel at every pixel, from its nearest samples.  Exact
        on constant and linear fields, borders included: a missing neighbour is
        extrapolated from the two nearest samples of its channel in that direction
        (from one, if a side is shorter than 4 and there is no other).
        ``"superpixel"``: one value per 2x2 cell, nothing invented; the channels lie
        up to a pixel apart.
    out : ndarray of float32, shape of the result, optional
        Overwritten and returned.

    Returns
    -------
    ndarray of float32, shape (4, H, W), or (4, H/2, W/2) for ``"superpixel"``
        In the order of ``CHANNELS``, whatever the places in the cell; the unit of
        ``mosaic``.

    Raises
    ------
    TypeError
        If ``mosaic`` has another dtype.
    ValueError
        If a side is 1 (``"bilinear"``) or odd (``"superpixel"``), the method is
        unknown or ``out`` does not fit.

    Examples
    --------
    >>> cell = np.array([[135, 90], [0, 45]], np.uint8)
    >>> demosaic(cell, Layout.PDAVIS)[:, 0, 0].tolist()
    [0.0, 45.0, 90.0, 135.0]
    """
    mosaic = checked_mosaic(mosaic)
    check_method(method, mosaic.shape)
    height, width = mosaic.shape
    places = places_of(layout)
    if method == "superpixel":
        out = output(out, (4, height // 2, width // 2), np.float32, mosaic)
        _kernels.superpixel(mosaic, places, out)
    else:
        out = output(out, (4, height, width), np.float32, mosaic)
        if mosaic.size:
            scratch = scratch_rows(2, width)
            _kernels.bilinear(mosaic, places, scratch, out)
    return out


def demosaic_valid(
    valid: NDArray[np.bool_], layout: Layout, method: str = "bilinear"
) -> NDArray[np.bool_]:
    """Tell where no unusable pixel went into any channel of ``demosaic``.

    Parameters
    ----------
    valid : ndarray of bool, shape (H, W)
        True = usable.
    layout : Layout
        Polarizer in front of each pixel.  The union of the four channels' supports
        is the same for every layout.
    method : {"bilinear", "superpixel"}
        As in `demosaic`.

    Returns
    -------
    ndarray of bool, shape (H, W), or (H/2, W/2) for ``"superpixel"``
        True where every sample that the four values are made of is usable.

    Raises
    ------
    TypeError
        If ``valid`` is not bool, ``layout`` not a Layout.
    ValueError
        If the shape does not fit the method, as in `demosaic`.
    """
    valid = np.asarray(valid)
    if valid.dtype != np.bool_:
        raise TypeError(f"valid must be bool, got {valid.dtype}")
    if valid.ndim != 2:
        raise ValueError(f"valid must be (H, W), got shape {valid.shape}")
    check_method(method, valid.shape)
    places_of(layout)
    if method == "superpixel":
        rows = valid[0::2] & valid[1::2]
        return np.asarray(rows[:, 0::2] & rows[:, 1::2])
    if not valid.size:
        return valid.copy()
    return _all_of_three(_all_of_three(valid).T).T.copy()


def _all_of_three(valid: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """AND of each row and its neighbours; a missing one is made as `demosaic` does."""
    last = len(valid) - 1
    out = valid.copy()
    out[1:] &= valid[:-1]
    out[:-1] &= valid[1:]
    if last > 2:
        out[0] &= valid[3]
        out[last] &= valid[last - 3]
    return out


def checked_mosaic(mosaic: NDArray[Any]) -> NDArray[Any]:
    """Return mosaic, C-contiguous, after checking its dtype and dimensions."""
    if not isinstance(mosaic, np.ndarray):
        raise TypeError(f"mosaic must be an ndarray, got {type(mosaic).__name__}")
    if mosaic.dtype not in PIXEL_DTYPES:
        raise TypeError(
            f"mosaic must be uint8, uint16 or float32, got {mosaic.dtype}")
    if mosaic.ndim != 2:
        raise ValueError(f"mosaic must be (H, W), got shape {mosaic.shape}")
    return np.ascontiguousarray(mosaic)


def check_method(method: str, shape: tuple[int, ...]) -> None:
    """Raise ValueError unless method is known and can work on an image (H, W)."""
    if method not in DEMOSAIC_METHODS:
        raise ValueError(
            f"demosaic method must be one of {', '.join(DEMOSAIC_METHODS)}, got "
            f"{method!r}")
    if method == "superpixel":
        if shape[0] % 2 or shape[1] % 2:
            raise ValueError(
                "superpixel needs an even height and width, got (height, width) = "
                f"{shape}")
    elif 0 not in shape and min(shape) < 2:
        raise ValueError(
            "bilinear needs a height and width of at least 2, got (height, width) = "
            f"{shape}")


def places_of(layout: Layout) -> NDArray[np.intp]:
    """Return the place of each channel in the cell, as the kernels take it."""
    if not isinstance(layout, Layout):
        raise TypeError(f"layout must be a Layout, got {type(layout).__name__}")
    return _places(layout)


def scratch_rows(rows: int, width: int) -> NDArray[np.float32]:
    """Return memory for so many rows, as the kernels take it."""
    return np.empty(rows * (width + 32) + 32, np.float32)


@lru_cache(maxsize=24)  # there are no more layouts
def _places(layout: Layout) -> NDArray[np.intp]:
    places = np.array(layout.places, np.intp)
    places.flags.writeable = False
    return places
