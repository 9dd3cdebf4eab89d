"""Checks of arguments that several packages share."""
from __future__ import annotations

import functools
import math
import numbers
from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from pdavis_cv._types import Image

T = TypeVar("T")
MOST_SIDE = 65_536
"""Largest side of a sensor, pixels: coordinates of events have 16 bits."""
MOST_ANGLE = 1e6
"""Bound on angles, radians: rounding of a larger phase shifts threshold crossings."""
MOST_FPS = 1_000_000
"""Largest rate of images, per second: one per tick of the clock, a microsecond."""
MOST_RPM = 3e7
"""Largest speed of what turns: half a turn per tick of the clock, a microsecond."""


def output(
    out: NDArray[Any] | None, shape: tuple[int, ...], dtype: DTypeLike,
    *inputs: NDArray[Any] | None, name: str = "out",
) -> Image:
    """Return ``out`` after checking it, or a new array with undefined contents if None.

    It must be a C-contiguous, writeable array of this shape and dtype that overlaps
    none of the inputs; errors call it `name`.
    """
    dtype = np.dtype(dtype)
    if out is None:
        return np.empty(shape, dtype)
    typed(name, out, np.ndarray, "an ndarray")
    if out.dtype != dtype:
        raise TypeError(f"{name} must be {dtype}, got {out.dtype}")
    if out.shape != shape:
        raise ValueError(f"{name} must have shape {shape}, got {out.shape}")
    if not out.flags.c_contiguous:
        raise ValueError(f"{name} must be C-contiguous, got strides {out.strides}")
    if not out.flags.aligned:
        raise ValueError(f"{name} must be aligned to its {dtype}")
    if not out.flags.writeable:
        raise ValueError(f"{name} must be writeable, got a read-only array")
    for array in inputs:
        # may_share_memory is fast, as it compares bounds only; for strided inputs it
        # may be wrong, where shares_memory is exact.
        if (array is not None and np.may_share_memory(out, array)
                and np.shares_memory(out, array)):
            raise ValueError(f"{name} must not overlap an input, got memory of one")
    return out


def typed(name: str, value: object, kind: Any, what: str) -> None:
    """Raise TypeError unless a value is of a kind; `what` says which."""
    if not isinstance(value, kind):
        raise TypeError(f"{name} must be {what}, got {type(value).__name__}")


def some(name: str, values: Sequence[T]) -> Sequence[T]:
    """Return a sequence; raise ValueError if it holds nothing."""
    if not len(values):
        raise ValueError(f"{name} must be one or more, got none")
    return values


def positive(name: str, value: float) -> float:
    """Return value as a float; raise ValueError unless it is positive and finite."""
    try:
        number = float(value)
    except (TypeError, OverflowError):
        number = math.nan
    if not (np.isfinite(number) and number > 0):
        raise ValueError(f"{name} must be positive and finite, got {value!r}")
    return number


def floats(name: str, value: Any, dtype: DTypeLike = np.float64) -> NDArray[Any]:
    """Return a copy as floats; raise TypeError if it holds anything but numbers."""
    try:
        return np.array(value, dtype)
    except (TypeError, ValueError, OverflowError):
        raise TypeError(f"{name} must be a number or an array of numbers, got "
                        f"{type(value).__name__}") from None


def planes(name: str, value: Any, count: int) -> NDArray[np.float64]:
    """Return a copy as floats; raise ValueError unless its first axis has `count`."""
    array = floats(name, value)
    if array.ndim < 1 or len(array) != count:
        raise ValueError(f"{name} must be ({count}, ...), got shape {array.shape}")
    return array


def fitting(name: str, array: NDArray[Any], shape: tuple[int, ...]) -> NDArray[Any]:
    """Return an array of a shape; raise ValueError if it cannot be broadcast to it."""
    try:
        return np.broadcast_to(array, shape)
    except ValueError:
        raise ValueError(f"{name} must have shape {shape}, got {array.shape}") from None


def real_number(value: object) -> float:
    """Return a real number as a float; NaN, which satisfies no rule, for the rest."""
    if not isinstance(value, numbers.Real):
        return math.nan
    try:
        return float(value)
    except OverflowError:       # an integer beyond the range of floats
        return math.nan


def place(name: str, value: Any, most: float = MOST_SIDE) -> tuple[float, float]:
    """Return x and y as floats; raise ValueError unless both lie within most of 0."""
    try:
        x, y = (real_number(each) for each in value)
    except (TypeError, ValueError):
        x = y = math.nan
    if not (abs(x) <= most and abs(y) <= most):
        raise ValueError(
            f"{name} must be two numbers within {most:g} of 0, got {value!r}")
    return x, y


def plain(value: Any) -> Any:
    """Convert a NumPy number, which may overflow, to a Python number."""
    return value.item() if isinstance(value, np.generic) else value


def checked_rate(name: str, value: Any) -> float | None:
    """Return a rate in Hz, or None; raise ValueError unless it is of 0 .. MOST_FPS."""
    if value is None:
        return None
    from fractions import Fraction  # slow to import
    try:
        exact = Fraction(value)
    except (TypeError, ValueError, OverflowError):
        exact = Fraction(0)
    if not 0 < exact <= MOST_FPS:
        raise ValueError(f"{name} must lie in (0, {MOST_FPS}], got {value!r}")
    fps: float = plain(value)
    return fps


def whole_number(name: str, value: float, low: int, high: int) -> int:
    """Return value as an int; raise ValueError unless it is whole and of low..high."""
    try:
        number = int(value)
    except (TypeError, ValueError, OverflowError):
        number = low - 1
    if not (low <= number <= high and number == value):
        raise ValueError(
            f"{name} must be a whole number of {low}..{high}, got {value!r}")
    return number


def sensor_shape(shape: Sequence[int], name: str = "shape") -> tuple[int, int]:
    """Return shape as (height, width); raise ValueError unless both are positive."""
    try:
        height, width = (int(side) for side in shape)
    except (TypeError, ValueError, OverflowError):
        raise ValueError(f"{name} must be (height, width), got {shape!r}") from None
    if not (0 < height <= MOST_SIDE and 0 < width <= MOST_SIDE):
        raise ValueError(f"{name} must lie in 1..{MOST_SIDE}, got {shape!r}")
    return height, width


def checked_threshold(
    name: str, value: ArrayLike, shape: tuple[int, int]
) -> float | NDArray[np.float64]:
    """Return a threshold, positive and finite: a float, or a read-only copy, (H, W)."""
    array = floats(name, value)
    if array.shape not in ((), shape):
        raise ValueError(
            f"{name} must be a scalar or have shape {shape}, got {array.shape}")
    if not np.all(np.isfinite(array) & (array > 0)):
        bad = array[~(np.isfinite(array) & (array > 0))].flat[0]
        raise ValueError(f"{name} must be positive and finite, got {bad}")
    if array.ndim == 0:
        return float(array)
    array.flags.writeable = False
    return array


def of_interval(read: Callable[..., Any]) -> Callable[..., Any]:
    """Return a method that reads an interval, once it is of numbers."""
    @functools.wraps(read)
    def checked(self: Any, start_us: Any = None, stop_us: Any = None) -> Any:
        for name, t_us in (("start_us", start_us), ("stop_us", stop_us)):
            if t_us is not None and not (isinstance(
                    t_us, numbers.Real) and t_us == t_us):
                raise TypeError(f"{name} must be a time in us or None, got {t_us!r}")
        return read(self, start_us, stop_us)
    return checked
