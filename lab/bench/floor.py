"""What is compiled for `python -m lab.bench` alone, which wheels lack."""
from __future__ import annotations

from collections.abc import Callable
from importlib import import_module


def compiled_floor() -> Callable[..., int]:
    """Return ``floor_sum(events, step, out)``: ``out[y, x] += step[p]`` of each event.

    Returns
    -------
    callable
        Of EVENT_DTYPE, shape (N,); float32, shape (2,); float32, shape (H, W).  Returns
        how many events it took: those before the first one outside.

    Raises
    ------
    ImportError
        If the library was installed from a wheel.
    """
    try:
        floor: Callable[..., int] = import_module("pdavis_cv._kernels._floor").floor_sum
    except ImportError:
        raise ImportError("its floor is compiled only where the sources are "
                          "(pip install --editable .)") from None
    return floor
