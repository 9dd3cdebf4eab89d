"""Images as labelled arrays."""
from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING

import numpy as np

from pdavis_cv._checks import typed
from pdavis_cv._packages import package
from pdavis_cv.export.embedded import to_json
from pdavis_cv.polarimetry import PolarFrame
from pdavis_cv.quantities import chosen

if TYPE_CHECKING:
    import xarray


def to_xarray(
    images: PolarFrame | Iterable[PolarFrame],
    quantities: Sequence[str] = ("s0", "aop", "dolp"),
) -> xarray.Dataset:
    """Return images as an `xarray.Dataset` with times, units and coordinates.

    Parameters
    ----------
    images : PolarFrame, or iterable of PolarFrame of one shape
        Images from `fuse`; all are kept in memory.
    quantities : sequence of str
        Names from `pdavis_cv.QUANTITIES`, or ``"quad"`` and ``"stokes"``.

    Returns
    -------
    xarray.Dataset
        A float32 variable (t_us, y, x) per quantity, NaN where a pixel is not valid,
        with attributes ``units`` and ``long_name``; coordinates are microseconds and
        sensor pixels.  A second one of ``t_us`` is ``time``, a timedelta, for
        ``swap_dims(t_us="time").resample``.
        ``provenance`` (JSON) is that of the first image.

    Raises
    ------
    ImportError
        If xarray is not installed.
    TypeError
        If something else is among the images.
    ValueError
        If a quantity is unknown or the method does not provide it, if there is no
        image, or if shapes differ.

    Examples
    --------
    >>> from pdavis_cv import fuse, open_recording
    >>> from pdavis_cv.data import example_recording
    >>> with open_recording(example_recording(), layout="pdavis") as recording:
    ...     data = to_xarray(fuse(recording, fps=50, method="cf"))
    >>> dict(data["aop"].sizes)
    {'t_us': 9, 'y': 260, 'x': 346}
    """
    labelled = package("xarray", "to_xarray needs xarray: pip install xarray")
    wanted = chosen(quantities)
    given = [images] if isinstance(images, PolarFrame) else images
    kept = list(given) if isinstance(given, Iterable) else [given]
    for one in kept:
        typed("images", one, PolarFrame,
              "PolarFrames, as fuse(recording, fps=100) makes them")
    if not kept:
        raise ValueError("images must hold at least one, got none")
    shapes = sorted({image.shape for image in kept})
    if len(shapes) > 1:
        raise ValueError(f"images must have one shape, got {shapes}")
    height, width = shapes[0]
    variables = {
        one.name: (("t_us", "y", "x"), np.stack([
            np.where(image.valid, one.of(image), np.float32(np.nan))
            for image in kept]), {"units": one.unit, "long_name": one.title})
        for one in wanted}
    times = np.array([image.t_us or 0 for image in kept], np.int64)
    coordinates = {
        "t_us": ("t_us", times, {"units": "us"}),
        "time": ("t_us", times.view("timedelta64[us]")),
        "y": ("y", np.arange(height), {"units": "pixel"}),
        "x": ("x", np.arange(width), {"units": "pixel"})}
    made: xarray.Dataset = labelled.Dataset(
        variables, coordinates, {"provenance": to_json(dict(kept[0].provenance))})
    return made
