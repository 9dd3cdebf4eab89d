"""OME-TIFF: T, C, Y, X float32 with names, sizes, times and provenance."""
from __future__ import annotations

import itertools
from pathlib import Path
from typing import Any

import numpy as np

from pdavis_cv.export.provenance import to_json
from pdavis_cv.export.stacks import HEADER, StackFile

__all__ = ["OmeTiffFile"]

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
        try:
            import tifffile
        except ImportError:
            raise ImportError(
                "OME-TIFF needs tifffile: pip install tifffile") from None
        self._tifffile = tifffile
        super().__init__(*arguments, **options)

    def _finish(self) -> Path:
        shape = (self.count, len(self.quantities), *(self.shape or (0, 0)))
        stack = np.memmap(self.unfinished, np.dtype("<f4"), "r", HEADER, shape)
        part = self.part
        try:
            with self._tifffile.TiffWriter(
                    part, bigtiff=stack.nbytes > _CLASSIC_END, byteorder="<",
                    ome=True) as file:
                file.write(
                    (np.ascontiguousarray(stack[t, c]) for t in range(shape[0])
                     for c in range(shape[1])),
                    shape=shape, dtype="<f4", photometric="minisblack",
                    compression="zlib", compressionargs={"level": _LEVEL},
                    metadata=self._metadata(), **self._resolution())
        except BaseException:
            part.unlink(missing_ok=True)
            raise
        finally:
            # Unmap before the file is removed; the array would keep it open.
            stack._mmap.close()  # type: ignore[attr-defined]
        return part

    def _resolution(self) -> dict[str, Any]:
        """Return the TIFF tags of the pixel size, as plain ImageJ ignores OME-XML."""
        if self.pixel_um is None:
            return {}
        return {"resolution": 2 * (_UM_PER_CM / self.pixel_um,),
                "resolutionunit": "CENTIMETER"}

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
        if self.pixel_um is not None:
            for axis in "XY":
                found[f"PhysicalSize{axis}"] = self.pixel_um
                found[f"PhysicalSize{axis}Unit"] = "\N{MICRO SIGN}m"
        steps = {b - a for a, b in itertools.pairwise(self.times_us)}
        if steps and max(steps) - min(steps) <= 1:
            found |= {"TimeIncrement": min(steps) / 1e6, "TimeIncrementUnit": "s"}
        return found
