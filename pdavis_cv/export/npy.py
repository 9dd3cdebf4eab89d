"""One NumPy array file, with a JSON file that says what is in it."""
from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

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
