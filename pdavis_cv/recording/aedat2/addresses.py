"""What the addresses of an AEDAT-2.0 file without a chip's name say of the camera."""
from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

_SIZES = ((180, 240), (260, 346), (480, 640))
"""(height, width) of the usual DAVIS cameras, and of v2e."""
_REACHED = 0.95
"""Share of both sides that events must reach for a size to be assumed: noise alone
reaches them in any recording that is not very short."""
_MOST = 0.999
"""Share of the words that must have the form; the others may be damaged."""
DVS128_SIZE = 128, 128


def camera_of(samples: Iterable[NDArray[np.uint32]]
              ) -> tuple[tuple[int, int] | None, bool, str]:
    """Return (height, width) of the sensor, whether it is a DVS128, and what was seen.

    The size is None if the addresses, uint32 samples of the whole file, fit no camera,
    or several.
    """
    words = small = low = plain = 0
    x = y = -1
    for address in samples:
        words += len(address)
        small += int(np.count_nonzero(address < 1 << 16))
        low += int(np.count_nonzero((address < 1 << 16) & (address & 0x7FF != 0)))
        # Events without the flag of external inputs, and samples of frames.
        events = address[(address & 0x800003FF == 0) & (address & 0x400 == 0)]
        reads = address[address & 0x80000800 == 0x80000000]
        plain += len(events) + int(np.count_nonzero(address >> 31 | address & 0x400))
        for found in (events, reads):
            x = max(x, int((found >> 12 & 0x3FF).max(initial=0)) if len(found) else -1)
            y = max(y, int((found >> 22 & 0x1FF).max(initial=0)) if len(found) else -1)
    if not words:
        return None, False, "it holds no word"
    if small >= _MOST * words and low:
        return DVS128_SIZE, True, "all addresses are those of a DVS128"
    seen = f"its addresses reach x = {x}, y = {y}"
    if plain < _MOST * words:
        return None, False, "its addresses are those of neither a DAVIS nor a DVS128"
    size = next(((h, w) for h, w in _SIZES if x < w and y < h), None)
    reached = size is not None and (
        y + 1 >= _REACHED * size[0] and x + 1 >= _REACHED * size[1])
    return size if reached else None, False, seen


def as_davis(words: NDArray[np.uint8]) -> None:
    """Change words, uint8 (N, 8), of a DVS128 in place to those of a DAVIS of its size.

    A DVS128 has y in bits 8 to 14, x in bits 1 to 7, and bit 0 set for OFF; bit 15
    marks a falling edge of its external input.
    """
    address: NDArray[Any] = words.view(">u4")[:, 0]
    a = address.astype(np.uint32)
    address[:] = np.where(
        a & 0x8000, 0x402,
        (a >> 8 & 0x7F) << 22 | (a >> 1 & 0x7F) << 12 | (~a & 1) << 11)
