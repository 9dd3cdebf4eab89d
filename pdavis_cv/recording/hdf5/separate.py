"""Images of an HDF5 file that are separate datasets, in the layout of rpg."""
from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray


class SeparateImages:
    """The images of rpg's layout, which are separate datasets, as one stack.

    They are in the group ``/images``; those without a numeric ``timestamp`` are left
    out. `dataset` returns a checked dataset of numbers for (group, name, dimensions),
    `member` what lies in this file for (group, name).
    """

    def __init__(self, group: Any, dataset: Callable[[Any, str, int], Any],
                 member: Callable[[Any, str], Any]) -> None:
        images = {name: member(group, name) for name in group}
        found = sorted((float(image.attrs["timestamp"]), name) for name, image in
                       images.items() if "timestamp" in image.attrs)
        self._group, self._dataset = group, dataset
        self._names = [name for _, name in found]
        self.times = np.array([t for t, _ in found], np.float64)
        first = dataset(group, self._names[0], 2).shape if found else (0, 0)
        self.shape = (len(found), *first)

    def __len__(self) -> int:
        return len(self._names)

    def __getitem__(self, k: int) -> NDArray[Any]:
        image: NDArray[Any] = self._dataset(self._group, self._names[k], 2)[()]
        if image.shape != self.shape[1:]:
            raise ValueError(f"an image of shape {image.shape}")
        return image
