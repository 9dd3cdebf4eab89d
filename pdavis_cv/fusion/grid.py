"""The regular times of images: round(k * 1e6 / fps) after the first, exactly."""
from __future__ import annotations

from fractions import Fraction


def grid_us(index: int, fps: Fraction) -> int:
    """Return index / fps in us, rounded half to even as by round()."""
    us, rest = divmod(index * 1_000_000 * fps.denominator, fps.numerator)
    return us + (2 * rest + (us & 1) > fps.numerator)


def grid_count(span_us: int, fps: Fraction) -> int:
    """Return how many images are less than a span after the first, itself included."""
    if span_us <= 0:
        return 0
    last = int(span_us * fps / 1_000_000) + 1   # rounding can shift it
    while grid_us(last, fps) >= span_us:
        last -= 1
    return last + 1
