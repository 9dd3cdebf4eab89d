"""OME-Zarr: T, C, Y, X float32 in chunks and levels, with names, units and times."""
from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdavis_cv._packages import package
from pdavis_cv.export.embedded import to_json
from pdavis_cv.export.stacks import StackFile

_SMALLEST = 128
"""Longest side of the smallest level, at most, pixels."""
_LOOKED_AT = 16
"""Planes from which the contrast of a channel is taken."""


class OmeZarrFile(StackFile):
    """Write a folder in OME-Zarr 0.5, for napari, Fiji, bioio, ome-zarr and xarray.

    A chunk is one plane.  Each further level has every other row and column of the one
    before, because a mean of angles is none.  Channels are named by the quantities;
    ``aop`` is in radians.  The attribute ``pdavis_cv`` has the units of the quantities,
    all times and the provenance.

    Raises
    ------
    ImportError
        If zarr (extra ``[zarr]``) is not installed.
    OSError
        If the folder exists.
    """

    def __init__(self, *arguments: Any, **options: Any) -> None:
        self._zarr = package(
            "zarr", "OME-Zarr needs zarr: pip install zarr (extra [zarr])")
        super().__init__(*arguments, **options)

    def _finish(self, part: Path, stack: NDArray[np.float32]) -> None:
        steps = [1]
        while max(stack.shape[2:]) > _SMALLEST * steps[-1]:
            steps.append(2 * steps[-1])
        group = self._zarr.create_group(part, zarr_format=3, attributes={
            "ome": {"version": "0.5", "multiscales": [self._multiscales(steps)],
                    "omero": {"channels": [
                        self._channel(name, stack[:, c])
                        for c, name in enumerate(self.quantities)]}},
            "pdavis_cv": {"units": self.units, "t_us": self.times_us,
                          "provenance": json.loads(to_json(self.facts))}})
        for level, step in enumerate(steps):
            planes = stack[:, :, ::step, ::step]
            array = group.create_array(
                str(level), shape=planes.shape, dtype="float32", fill_value=np.nan,
                chunks=(1, 1, *planes.shape[2:]), dimension_names=list("tcyx"))
            for t in range(len(planes)):
                array[t] = planes[t]

    def _multiscales(self, steps: list[int]) -> dict[str, Any]:
        times, pitch = self.times_us, self.pixel_um or 1.0
        interval = (times[-1] - times[0]) / max(len(times) - 1, 1) / 1e6 or 1.0
        space = {"type": "space"} | (
            {} if self.pixel_um is None else {"unit": "micrometer"})
        return {
            "name": self.path.name.removesuffix(".zarr").removesuffix(".ome"),
            "axes": [{"name": "t", "type": "time", "unit": "second"},
                     {"name": "c", "type": "channel"},
                     {"name": "y", **space}, {"name": "x", **space}],
            "datasets": [{"path": str(level), "coordinateTransformations": [
                {"type": "scale", "scale": [interval, 1.0, step * pitch, step * pitch]}
                ]} for level, step in enumerate(steps)]}

    @staticmethod
    def _channel(name: str, planes: NDArray[np.float32]) -> dict[str, Any]:
        some = planes[::-(-len(planes) // _LOOKED_AT)]
        known = some[np.isfinite(some)]
        low, high = map(float, np.percentile(known, (1, 99)) if known.size else (0, 1))
        return {"label": name, "active": True, "color": "FFFFFF", "window": {
            "min": low, "max": high, "start": low, "end": high}}
