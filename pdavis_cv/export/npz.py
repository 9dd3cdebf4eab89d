"""NPZ files with one array per quantity."""
from __future__ import annotations

import zipfile
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pdavis_cv.export.embedded import to_json
from pdavis_cv.export.stacks import StackFile


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
