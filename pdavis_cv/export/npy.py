"""NumPy files: one array and a JSON file that says what it is, or several arrays."""
from __future__ import annotations

import zipfile
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pdavis_cv.export.embedded import to_json
from pdavis_cv.export.files import write_json
from pdavis_cv.export.stacks import StackFile


class NpyFile(StackFile):
    """Write a ``.npy`` (T, quantity, H, W), which ``numpy.load`` can map.

    Quantities, their units, times and the provenance are in a JSON file, whose name is
    the path's with ``.json`` added.
    """

    def _finish(self, part: Path, stack: NDArray[np.float32]) -> None:
        with part.open("wb") as file:
            np.lib.format.write_array_header_2_0(file, {
                "descr": "<f4", "fortran_order": False, "shape": stack.shape})
            for image in stack:     # numpy.save does not notice a full disk
                file.write(image.data)
        write_json(self.path.with_name(self.path.name + ".json"), {
            "provenance": self.facts, "axes": "T, quantity, row, column",
            "quantities": self.quantities, "units": [*self.units.values()],
            "invalid": "NaN", "t_us": self.times_us})


class NpzFile(StackFile):
    """Write a ``.npz`` with each quantity (T, H, W), ``t_us`` (T,), ``provenance``.

    The provenance is JSON, a string of shape ().
    """

    def _finish(self, part: Path, stack: NDArray[np.float32]) -> None:
        with zipfile.ZipFile(part, "w", zipfile.ZIP_STORED) as archive:
            for c, name in enumerate(self.quantities):
                with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                    np.lib.format.write_array_header_2_0(member, {
                        "descr": "<f4", "fortran_order": False,
                        "shape": (self.count, *stack.shape[2:])})
                    for t in range(self.count):
                        member.write(np.ascontiguousarray(stack[t, c]).data)
            for name, array in (
                    ("t_us", np.array(self.times_us, np.int64)),
                    ("provenance", np.array(to_json(self.facts)))):
                with archive.open(f"{name}.npy", "w") as member:
                    np.lib.format.write_array(member, array, allow_pickle=False)
