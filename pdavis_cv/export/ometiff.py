"""OME-TIFF: T, C, Y, X float32 with names, sizes, times and provenance."""
from __future__ import annotations

import itertools
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdavis_cv._beside import write_beside
from pdavis_cv._packages import package
from pdavis_cv._types import Facts, Image
from pdavis_cv.export.embedded import to_json
from pdavis_cv.export.stacks import StackFile

_CLASSIC_END = 2**32 - 2**24
_UM_PER_CM = 1e4
_LEVEL = 1  # of zlib; higher levels take longer and hardly compress noise better


class OmeTiffFile(StackFile):
    """Write an OME-TIFF for Fiji (Bio-Formats), napari, QuPath, bioio and tifffile.

    Channels are named by the quantities; ``aop`` is in radians.  The annotation with
    the provenance also holds the units.  Compression is lossless (zlib).  Files that
    may reach 4 GB are BigTIFF.

    Raises
    ------
    ImportError
        If tifffile (extra ``[export]``) is not installed.
    """

    def __init__(self, *arguments: Any, **options: Any) -> None:
        self._tifffile = tifffile()
        super().__init__(*arguments, **options)

    def _finish(self, part: Path, stack: NDArray[np.float32]) -> None:
        count, channels = stack.shape[:2]
        with self._tifffile.TiffWriter(
                part, bigtiff=stack.nbytes > _CLASSIC_END, byteorder="<",
                ome=True) as file:
            file.write(
                (np.ascontiguousarray(stack[t, c]) for t in range(count)
                 for c in range(channels)),
                shape=stack.shape, dtype="<f4", photometric="minisblack",
                compression="zlib", compressionargs={"level": _LEVEL},
                metadata=self._metadata(), **_resolution(self.pixel_um))

    def _metadata(self) -> dict[str, Any]:
        first, channels = self.times_us[0], len(self.quantities)
        seconds = [
            (now - first) / 1e6 for now in self.times_us for _ in range(channels)]
        found: dict[str, Any] = {
            "axes": "TCYX", "Creator": "pdavis_cv",
            "Name": self.path.name.removesuffix(".tif").removesuffix(".ome"),
            "Channel": {"Name": list(self.quantities)},
            "Plane": {"DeltaT": seconds, "DeltaTUnit": ["s"] * len(seconds)},
            "CommentAnnotation": {
                "Namespace": "pdavis_cv/provenance",
                "Value": to_json({**self.facts, "first_t_us": first})}}
        found |= _physical_size(self.pixel_um)
        steps = {b - a for a, b in itertools.pairwise(self.times_us)}
        if steps and max(steps) - min(steps) <= 1:
            found |= {"TimeIncrement": min(steps) / 1e6, "TimeIncrementUnit": "s"}
        return found


def tifffile() -> Any:
    """Return the package, or raise an error that says how to install it."""
    return package("tifffile", "OME-TIFF needs tifffile: pip install tifffile")


def _resolution(pixel_um: float | None) -> dict[str, Any]:
    """Return the TIFF tags of the pixel size, as plain ImageJ ignores OME-XML."""
    if pixel_um is None:
        return {}
    return {"resolution": 2 * (_UM_PER_CM / pixel_um,), "resolutionunit": "CENTIMETER"}


def _physical_size(pixel_um: float | None) -> dict[str, Any]:
    if pixel_um is None:
        return {}
    return {key: value for axis in "XY" for key, value in (
        (f"PhysicalSize{axis}", pixel_um),
        (f"PhysicalSize{axis}Unit", "\N{MICRO SIGN}m"))}


def write_maps(
    path: str | os.PathLike[str], maps: Mapping[str, tuple[Image, str]], *,
    facts: Facts, pixel_um: float | None = None,
) -> None:
    """Write maps of the same scene as the channels of an OME-TIFF.

    Parameters
    ----------
    path : path
        File to write; appears when it is complete.
    maps : mapping of str to (ndarray of shape (H, W), str)
        Maps and their units by name; NaN = not known.  A channel's name has its unit
        in brackets, as OME has no other place for it.
    facts : mapping of str to object
        Provenance, in an annotation.
    pixel_um : float, optional
        Size of a pixel in the object, micrometres.

    Raises
    ------
    ImportError
        If tifffile (extra ``[export]``) is not installed.
    OSError
        If it cannot be written.
    ValueError
        If there are no maps, or their shapes differ.
    """
    if len({np.shape(values) for values, _ in maps.values()}) != 1:
        raise ValueError(f"maps must be of one shape, got {list(maps)}")
    named = [f"{name} ({unit})" if unit else name for name, (_, unit) in maps.items()]
    stack = np.stack([values for values, _ in maps.values()]).astype("<f4")
    with write_beside(path) as part, tifffile().TiffWriter(
            part, byteorder="<", ome=True) as file:
        file.write(
            stack, photometric="minisblack", compression="zlib",
            compressionargs={"level": _LEVEL}, **_resolution(pixel_um), metadata={
                "axes": "CYX", "Creator": "pdavis_cv",
                "Name": Path(path).name.removesuffix(".ome.tif"),
                "Channel": {"Name": named}, **_physical_size(pixel_um),
                "CommentAnnotation": {"Namespace": "pdavis_cv/provenance",
                                      "Value": to_json(facts)}})
