"""Unpack pixels of 10 and 12 bits in the formats of cameras."""
from __future__ import annotations

import math
import operator

import numpy as np
from numpy.typing import NDArray

from pdavis_cv._types import Image

# Packing -> (bits of a pixel, pixels in a group, bytes of a group).
_GROUPS = {"10p": (10, 4, 5), "12p": (12, 2, 3),
           "10packed": (10, 2, 3), "12packed": (12, 2, 3)}
PACKINGS = tuple(_GROUPS)
"""Names of packings, after the pixel formats Mono10p, Mono12Packed ..."""


def unpack(
    data: bytes | NDArray[np.uint8], packing: str, shape: tuple[int, ...]
) -> NDArray[np.uint16]:
    """Unpack 10- or 12-bit pixels, such as PolarizedMono12Packed.

    ``10p`` and ``12p`` (PFNC) have no gaps, and the least significant bit is first.
    ``10packed`` and ``12packed`` (GigE Vision) put two pixels into three bytes, the
    lower bits of both into the second one.

    Parameters
    ----------
    data : bytes or ndarray of uint8
        Packed pixels; bytes after the last one are ignored.
    packing : {"10p", "12p", "10packed", "12packed"}
    shape : tuple of int
        Shape of the result, e.g. (2048, 2448), or (frames, height, width); there is no
        padding between rows or frames.

    Returns
    -------
    ndarray of uint16, `shape`
        DN, at most 1023 or 4095.

    Raises
    ------
    TypeError
        If `data` does not hold bytes.
    ValueError
        If the packing is unknown or there are not enough bytes.

    Examples
    --------
    >>> unpack(bytes([0x12, 0x34, 0x56]), "12packed", (1, 2)).tolist()
    [[292, 1379]]
    """
    if not isinstance(packing, str) or packing not in _GROUPS:
        raise ValueError(
            f"packing must be one of {', '.join(PACKINGS)}, got {packing!r}")
    bits, pixels, size = _GROUPS[packing]
    try:
        raw: Image = (np.asarray(data) if isinstance(data, np.ndarray)
                      else np.frombuffer(data, np.uint8))
        shape = tuple(operator.index(side) for side in shape)
    except TypeError as error:
        raise TypeError(
            "data must be bytes or uint8, and shape whole numbers, got "
            f"{type(data).__name__} and {shape!r}") from error
    if raw.dtype != np.uint8:
        raise TypeError(f"data must be bytes or uint8, got {raw.dtype}")
    count = math.prod(shape)
    groups, rest = divmod(count, pixels)
    # An incomplete group ends in the byte that holds the last bits of its last pixel.
    needed = groups * size + (rest * size + pixels - 1) // pixels
    if raw.size < needed:
        raise ValueError(
            f"data must hold {needed} bytes for {count} pixels of {packing}, got "
            f"{raw.size}")
    whole = np.zeros((groups + bool(rest), size), np.uint8)
    whole.reshape(-1)[:needed] = raw.reshape(-1)[:needed]
    part = whole.T.astype(np.uint16)
    out = np.empty((len(whole), pixels), np.uint16)
    for i in range(pixels):
        if packing.endswith("packed"):
            upper, lower = part[2 * i] << (bits - 8), part[1] >> (4 * i)
            out[:, i] = upper | lower & (2**(bits - 8) - 1)
        else:
            at, shift = divmod(i * bits, 8)
            out[:, i] = (
                part[at] >> shift | part[at + 1] << (8 - shift)) & (2**bits - 1)
    return out.reshape(-1)[:count].reshape(shape)
