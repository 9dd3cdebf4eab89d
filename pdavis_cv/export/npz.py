"""NPZ files with one array per quantity."""
from __future__ import annotations

import zipfile
from pathlib import Path

import numpy as np

from pdavis_cv.export.embedded import to_json
from pdavis_cv.export.stacks import HEADER, StackFile

__all__ = ["NpzFile"]


class NpzFile(StackFile):
    """Write a ``.npz`` with each quantity (T, H, W), ``t_us`` (T,), ``provenance``.

    The provenance is JSON, a string of shape ().
    """

    def _finish(self) -> Path:
        height, width = self.shape or (0, 0)
        shape = (self.count, len(self.quantities), height, width)
        stack = np.memmap(self.unfinished, np.dtype("<f4"), "r", HEADER, shape)
        part = self.part
        try:
            with zipfile.ZipFile(part, "w", zipfile.ZIP_STORED) as archive:
                for c, name in enumerate(self.quantities):
                    with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                        np.lib.format.write_array_header_2_0(member, {
                            "descr": "<f4", "fortran_order": False,
                            "shape": (self.count, height, width)})
                        for t in range(self.count):
                            member.write(np.ascontiguousarray(stack[t, c]).data)
                for name, array in (
                        ("t_us", np.array(self.times_us, np.int64)),
                        ("provenance", np.array(to_json(self.facts)))):
                    with archive.open(f"{name}.npy", "w") as member:
                        np.lib.format.write_array(member, array, allow_pickle=False)
        except BaseException:
            part.unlink(missing_ok=True)
            raise
        finally:
            # Unmap before the file is removed; the array would keep it open.
            stack._mmap.close()  # type: ignore[attr-defined]
        return part
