"""What images show of the camera: their full scale, and colour filters."""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdavis_cv.sensor import Layout

BITS = (8, 10, 12, 14, 16)
"""Bits of converters."""
LEAST_CLIPPED = 16
"""Fewest samples at the brightest value that are taken as clipped."""
PILE = 4
"""How many times as many they are as those of the value below, at least."""
LEAST_SPREAD = 0.08
"""Smallest relative difference of colours' means that counts."""
LEAST_SIGMAS = 8.0
MOST_CELLS = 1 << 14


def measured_full_scale(images: Sequence[NDArray[Any]]) -> int | None:
    """Return the value at which samples of 10, 12, .. bits are clipped, None without.

    They are unsigned integers, whose bits may be shifted up: 4092 = 1023 x 4.
    """
    top = max(int(image.max(initial=0)) for image in images)
    step = top & -top

    def samples(value: int) -> int:
        return sum(int(np.count_nonzero(image == value)) for image in images)

    if not top or samples(top) < max(LEAST_CLIPPED, PILE * samples(top - step)):
        return None
    sizes = {1 << bits for bits in BITS}
    return top if {top // step + 1, top + step} <= sizes else None


def assumed_full_scale(images: Sequence[NDArray[Any]]) -> int:
    """Return the full scale of 12, 16 or 32 bits that holds all values."""
    top = max(float(image.max(initial=0)) for image in images)
    return next((full for full in (4095, 65535) if top <= full), 2**32 - 1)


def found_colours(mosaic: NDArray[Any]) -> str | None:
    """Return the colours of a colour and polarization camera, None of a monochrome one.

    They are 16, of the 4x4 cell, by row; see `Layout`.  The camera's filters cover 2x2
    pixels each, two of which, on a diagonal, are green, so that their means differ with
    period 4.  Red is taken as the one in the first row.
    """
    best: Layout | None = None
    spread = 0.0
    for y, x in ((0, 0), (0, 1), (1, 0), (1, 1)):
        means = _means_of_blocks(mosaic[y:, x:])
        if means is not None and np.ptp(means) > spread:
            spread = float(np.ptp(means))
            apart, other = abs(means[0] - means[3]), abs(means[1] - means[2])
            # Where red and blue are as bright as each other, they are the darker two.
            green_first = apart < other if max(apart, other) > spread / 3 else (
                means[0] + means[3] > means[1] + means[2])
            order = "grbg" if green_first else "rggb"
            best = replace(Layout.SONY, colours=order).crop(-x, -y)
    return None if best is None else best.colours


def _means_of_blocks(mosaic: NDArray[Any]) -> NDArray[Any] | None:
    """Return the means of 2x2 blocks of 4x4 cells, None if they are no colours."""
    rows, columns = (side // 4 for side in mosaic.shape)
    if rows * columns < 16:
        return None
    # Rows of cells are left out of large images, evenly.
    step = max(rows * columns // MOST_CELLS, 1)
    cells = mosaic[:4 * rows, :4 * columns].reshape(rows, 4, 4 * columns)[::step]
    rows = len(cells)
    parts = cells.astype(np.float32).reshape(rows, 2, 2, columns, 2, 2)
    pairs = parts[:, :, 0] + parts[:, :, 1]
    blocks = (pairs[..., 0] + pairs[..., 1]) / 4
    whole = blocks.mean(axis=(1, 3), keepdims=True)
    # Relative to their cell, so that the scene's brightness cancels.
    relative = (blocks / np.maximum(whole, 1)).transpose(1, 3, 0, 2).reshape(4, -1)
    means: NDArray[Any] = relative.mean(axis=1)
    sigma = float(relative.std(axis=1).max()) / np.sqrt(rows * columns)
    spread = np.ptp(means)
    green = min(abs(means[0] - means[3]), abs(means[1] - means[2]))
    colours = (spread >= max(LEAST_SPREAD, LEAST_SIGMAS * sigma)
               and green <= spread / 3)
    return means if colours else None
