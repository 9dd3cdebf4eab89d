"""Demosaicing: four full images from the 2x2 polarizer mosaic."""
from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from pdavis_cv import _kernels
from pdavis_cv._checks import output, typed
from pdavis_cv._types import Image
from pdavis_cv.colour_mosaic import COLOUR_METHODS, colour_channels
from pdavis_cv.sensor import Layout

DEMOSAIC_METHODS = ("bilinear", "superpixel", "binned", "guided")
"""Values of the ``demosaic`` arguments."""

HALF_SIZE = frozenset(("superpixel", "binned"))
"""Methods whose images have one pixel per 2x2 cell."""

REACH = {"bilinear": 4, "superpixel": 0, "binned": 4, "guided": 9}
"""Distance up to which an image depends on pixels outside its region.

Bilinear: 1, and 3 more where it extrapolates at a border.  Guided: windows of radius 1,
2 and 2, the 2 pixels of a weight, and 2 more for replacing an unusable sample."""

PIXEL_DTYPES = tuple(map(np.dtype, (np.uint8, np.uint16, np.float32)))

GUIDED_DTYPE = np.dtype([(name, "<f4") for name in (
    "floor", "across", "gain", "most", "additive", "noise", "coarse")])
"""Constants of ``"guided"``, dimensionless.

``floor``: relative variance of a channel difference away from edges.
``across``: fraction of the intensity's change along the other axis that disturbs it.
``gain``, ``most``: weight of the second fit, ``gain`` times the fraction of the first
one's residual that it explains, at most ``most``.  It exceeds 1, as a smoothed residual
is smaller than the residual.
``additive``: weight of the model that channel differences are locally constant, against
the one that they are proportional to the intensity; the latter alone divides by 0
behind a crossed polarizer.
``noise``: ratio of the noise variance in the intensity's detail to the relative
variance of differences.  For white noise it is 64/9 * .64 = 4.6: a 3x3 difference has
9/64 of a sample's variance, the detail .64.  It is smaller, as edges disturb the
differences too.
``coarse``: likewise of what 3x3 means have more than 7x7; 0 leaves that as it is."""

# Found by lab/studies/demosaic_constants.py.
_GUIDED = np.array([(1e-3, 0.3, 3.0, 2.0, 1.0, 3.5, 0.0)], GUIDED_DTYPE)
# Of the grey mosaic of colours.  What is left of their pattern is noise as well; and
# with less, smooth light of 2,000 electrons has more noise than after polanalyser.
GREY = np.array([(1e-3, 0.3, 3.0, 2.0, 1.0, 20.0, 5.0)], GUIDED_DTYPE)


def demosaic(
    mosaic: Image,
    layout: Layout | str,
    method: str = "bilinear",
    out: NDArray[np.float32] | None = None,
    *,
    valid: NDArray[np.bool_] | None = None,
    variance: NDArray[np.float32] | None = None,
) -> NDArray[np.float32]:
    """Interpolate I0, I45, I90 and I135 from a mosaic.

    Parameters
    ----------
    mosaic : ndarray of uint8, uint16 or float32, shape (H, W)
        Linear intensity, row 0 at the top.
    layout : Layout or str
        Polarizer in front of each pixel, and its colour filter if it has one.
    method : {"bilinear", "superpixel", "binned", "guided"}
        With colours, the first or the last.
        ``"bilinear"``: each channel at every pixel, from its nearest samples.  Exact
        on constant and linear fields, borders included: a missing neighbour is
        extrapolated from the two nearest samples of its channel in that direction
        (from one, if a side is shorter than 4 and there is no other).
        ``"superpixel"``: one value per 2x2 cell, without interpolation; the channels
        are up to a pixel apart.
        ``"binned"``: one value per 2x2 cell, the mean of ``"bilinear"`` over it; all
        channels are at the cell's centre.
        ``"guided"``: each channel at every pixel; sharper than ``"bilinear"``, with
        a half to a third of its error in AoP and DoLP (docs/demosaicing.md).  The
        intensity comes from the pixels of the mosaic, and the differences of channels,
        in proportion to it, from their surroundings, weighted by the absence of edges.
        The residual is added as far as neighbours agree on it.
    out : ndarray of float32, shape of the result, optional
        Overwritten and returned.
    valid : ndarray of bool, shape (H, W), optional
        True = usable.  ``"guided"`` then ignores the values of the other samples, and
        replaces them by usable ones of their channel two pixels away.  The other
        methods use all samples; `demosaic_valid` returns which pixels are affected.
        With colours both replace them by usable ones four pixels away first.
    variance : ndarray of float32, shape (H, W), optional
        Variance of each usable sample's logarithm.  ``"guided"`` then adds less of the
        residual of its first fit, as part of it is noise.  ``"bilinear"`` extrapolates
        at borders with half of the slope, which carries the errors of two samples.  The
        other methods do not use it.

    Returns
    -------
    ndarray of float32, shape (4, H, W), or (4, H/2, W/2) for the two per cell
        In the order of ``CHANNELS``, independent of the layout; in the unit of
        ``mosaic``.  With colours (3, 4, H, W): of red, green and blue light.

    Raises
    ------
    TypeError
        If ``mosaic``, ``valid`` or ``variance`` has another dtype.
    ValueError
        If a side is 1 (``"bilinear"``, ``"guided"``; below 4 with colours) or odd (the
        two per cell), the method is unknown or none for colours, or ``out``,
        ``valid`` or ``variance`` does not fit.

    Examples
    --------
    >>> cell = np.array([[135, 90], [0, 45]], np.uint8)
    >>> demosaic(cell, Layout.PDAVIS)[:, 0, 0].tolist()
    [0.0, 45.0, 90.0, 135.0]
    """
    mosaic, layout = checked_mosaic(mosaic), Layout.of(layout)
    check_method(method, mosaic.shape, layout)
    if valid is not None:
        valid = _checked_valid(valid)
    if variance is not None:
        variance = np.asarray(variance)
        if variance.dtype != np.float32:
            raise TypeError(f"variance must be float32, got {variance.dtype}")
        variance = np.ascontiguousarray(variance)
    for name, array in (("valid", valid), ("variance", variance)):
        if array is not None and array.shape != mosaic.shape:
            raise ValueError(f"{name} must have the mosaic's shape {mosaic.shape}, got "
                             f"{array.shape}")
    height, width = mosaic.shape
    if layout.colours:
        out = output(out, (3, 4, height, width), np.float32, mosaic)
        if mosaic.size:
            clean = ALL_CLEAN
            if valid is not None and not valid.all():
                mosaic = filled_samples(mosaic, valid, 4)
                clean = _eroded(valid).view(np.uint8)
            colour_channels(mosaic, layout, method, clean, GREY, out)
        return out
    places = places_of(layout)
    if method in HALF_SIZE:
        height, width = height // 2, width // 2
    out = output(out, (4, height, width), np.float32, mosaic)
    if not mosaic.size:
        return out
    if method == "superpixel":
        for channel, place in zip(out, places, strict=True):
            channel[:] = mosaic[place // 2::2, place % 2::2]
    elif method == "binned":
        _kernels.binned(mosaic, places, scratch_rows(10, mosaic.shape[1]), out)
    elif method == "guided":
        clean, noise = ALL_CLEAN, _NO_NOISE if variance is None else variance
        if valid is not None and not valid.all():
            mosaic = filled_samples(mosaic, valid)
            clean = _eroded(valid).view(np.uint8)
            if variance is not None:
                noise = np.where(valid, variance, np.float32(0))
        _kernels.guided(mosaic, clean, noise, places, _GUIDED,
                        scratch_rows(144, width), out)
    else:
        _kernels.bilinear(
            mosaic, places, variance is not None, scratch_rows(2, width), out)
    return out


def demosaic_valid(
    valid: NDArray[np.bool_], layout: Layout | str, method: str = "bilinear"
) -> NDArray[np.bool_]:
    """Return where the four values of ``demosaic`` come from usable samples only.

    The mask is (H, W), or (H/2, W/2) for the two methods per cell.  For ``"guided"``,
    which avoids unusable samples: where the pixel's own is usable and the 5x5 around it
    contain a square of nine usable ones.  The union of the four channels' supports is
    the same for every layout.
    """
    valid = _checked_valid(valid)
    check_method(method, valid.shape, Layout.of(layout))
    if method == "superpixel":
        return _all_of_cell(valid)
    if not valid.size:
        return valid[::2, ::2].copy() if method in HALF_SIZE else valid.copy()
    if method == "guided":
        return valid & ~_eroded(_eroded(~_eroded(valid)))
    reached = np.empty_like(valid, order="C")
    _kernels.reached(
        np.ascontiguousarray(valid).view(np.uint8), (0, len(valid)),
        np.empty(valid.shape[1], np.uint8), reached.view(np.uint8))
    return _all_of_cell(reached) if method == "binned" else reached


def demosaic_variance(
    variance: NDArray[np.float32], layout: Layout | str, method: str = "bilinear", *,
    valid: NDArray[np.bool_],
) -> NDArray[np.float32]:
    """Interpolate the samples' variances, (H, W), to the pixels of ``demosaic``.

    A channel gets the local variance of its samples, not that of their mean: as
    neighbouring results share samples, a mean over a region accounts for them by
    `pdavis_cv.analysis.pixels_per_sample`.  At borders variances are mirrored, as
    extrapolation could make them negative.  For ``"guided"`` interpolation is bilinear;
    of samples that are not `valid` it takes nothing.
    """
    check_method(method, variance.shape)
    if method == "superpixel":
        return demosaic(variance, layout, method)
    if method == "guided" and not valid.all():
        variance = filled_samples(variance, valid)
    planes = np.empty((4, *variance.shape), np.float32)
    if variance.size:
        _kernels.bilinear_variance(
            np.ascontiguousarray(variance), places_of(layout),
            scratch_rows(2, variance.shape[1]), planes)
    if method == "binned":
        height, width = variance.shape
        planes = planes.reshape(4, height // 2, 2, width // 2, 2).mean((2, 4))
    return planes


ALL_CLEAN = np.empty((0, 0), np.uint8)
_NO_NOISE = np.empty((0, 0), np.float32)


def _checked_valid(valid: NDArray[np.bool_]) -> NDArray[np.bool_]:
    valid = np.asarray(valid)
    if valid.dtype != np.bool_:
        raise TypeError(f"valid must be bool, got {valid.dtype}")
    if valid.ndim != 2:
        raise ValueError(f"valid must be (H, W), got shape {valid.shape}")
    return valid


def _all_of_cell(valid: NDArray[np.bool_]) -> NDArray[np.bool_]:
    rows = valid[0::2] & valid[1::2]
    return np.ascontiguousarray(rows[:, 0::2] & rows[:, 1::2])


def _and_beside(valid: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return the AND of each row and its one or two neighbours."""
    out = valid.copy()
    out[1:] &= valid[:-1]
    out[:-1] &= valid[1:]
    return out


def _eroded(valid: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return the AND over the 3x3 around each pixel, inside the image."""
    return np.ascontiguousarray(_and_beside(_and_beside(valid).T).T)


def filled_samples(
    mosaic: Image, valid: NDArray[np.bool_], step: int = 2
) -> NDArray[np.float32]:
    """Replace each unusable sample by the mean of the usable ones `step` pixels away.

    Two: of the same channel; four: of the same colour too.  If there are none, the
    sample is kept, or 0 if it is not finite.
    """
    filled = mosaic.astype(np.float32)
    filled[~(valid | np.isfinite(filled))] = 0
    y, x = np.nonzero(~valid)
    total, count = np.zeros(len(y), np.float32), np.zeros(len(y), np.float32)
    for dy, dx in ((-step, 0), (0, -step), (0, step), (step, 0)):
        row, column = y + dy, x + dx
        inside = ((row >= 0) & (row < mosaic.shape[0])
                  & (column >= 0) & (column < mosaic.shape[1]))
        row, column = row[inside], column[inside]
        usable = valid[row, column]
        total[inside] += np.where(usable, filled[row, column], np.float32(0))
        count[inside] += usable
    known = count > 0
    filled[y[known], x[known]] = total[known] / count[known]
    return filled


def checked_mosaic(mosaic: Image) -> Image:
    """Return mosaic, C-contiguous and aligned, after checking its dtype and sides."""
    typed("mosaic", mosaic, np.ndarray, "an ndarray")
    if mosaic.dtype not in PIXEL_DTYPES:
        raise TypeError(f"mosaic must be uint8, uint16 or float32, got {mosaic.dtype}")
    if mosaic.ndim != 2:
        raise ValueError(f"mosaic must be (H, W), got shape {mosaic.shape}")
    return np.require(mosaic, None, ("C", "A"))


def check_method(
    method: str, shape: tuple[int, ...], layout: Layout | None = None
) -> None:
    """Raise ValueError unless the method is known and fits shape (H, W) and layout."""
    if method not in DEMOSAIC_METHODS:
        raise ValueError(
            f"demosaic method must be one of {', '.join(DEMOSAIC_METHODS)}, got "
            f"{method!r}")
    least = 2 if layout is None or not layout.colours else 4
    if least == 4 and method not in COLOUR_METHODS:
        raise ValueError(f"demosaic method of a mosaic of colours must be one of "
                         f"{', '.join(COLOUR_METHODS)}, got {method!r}")
    if method in HALF_SIZE:
        if shape[0] % 2 or shape[1] % 2:
            raise ValueError(
                f"{method} needs an even height and width, got (height, width) = "
                f"{shape}")
    elif 0 not in shape and min(shape) < least:
        raise ValueError(
            f"{method} needs a height and width of at least {least}, got (height, "
            f"width) = {shape}")


def places_of(layout: Layout | str) -> NDArray[np.intp]:
    """Return the place of each channel in the cell, as an array for kernels."""
    return _places(Layout.of(layout))


def scratch_rows(rows: int, width: int) -> NDArray[np.float32]:
    """Return scratch memory for the kernels: a number of rows."""
    return np.empty(rows * (width + 32) + 32, np.float32)


@lru_cache(maxsize=24)  # the number of layouts
def _places(layout: Layout) -> NDArray[np.intp]:
    places = np.array(layout.places, np.intp)
    places.flags.writeable = False
    return places
