"""Parse numbers, regions, layouts and options of command lines."""
from __future__ import annotations

import argparse
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from pdavis_cv import Layout, Limits

MOST = 1e18
"""Largest magnitude of numbers of options: larger ones are mistakes, and integers up to
it fit into 64 bits."""
LAST_SEED = 2**63 - 1
MOST_S = 1e12
"""Largest magnitude of times, s: in us, it is below the 2**61 of recordings."""


def numbers(text: str, count: int, kind: Callable[[str], Any] = float) -> list[Any]:
    """Parse `count` finite numbers separated by commas."""
    parts = text.split(",")
    if count == 1 and len(parts) == 2:
        raise argparse.ArgumentTypeError(f"a decimal point is needed, got {text!r}")
    try:
        if len(parts) != count:
            raise ValueError(text)
        values = [kind(part) for part in parts]
    except ValueError:
        what = f"{count} numbers with commas between them" if count > 1 else (
            "an integer" if kind is int else "a number without a unit")
        raise argparse.ArgumentTypeError(f"must be {what}, got {text!r}") from None
    if not all(abs(value) < MOST for value in values):
        raise argparse.ArgumentTypeError(
            f"numbers must lie within {MOST:g} of 0, got {text}")
    return values


def number(text: str) -> float:
    """Parse a finite number."""
    return float(numbers(text, 1)[0])


def whole(text: str) -> int:
    """Parse an integer."""
    return int(numbers(text, 1, int)[0])


def positive(text: str) -> float:
    """Parse a positive number."""
    value = number(text)
    if not value > 0:
        raise argparse.ArgumentTypeError(f"must be positive, got {text}")
    return value


def within(low: int, high: int) -> Callable[[str], int]:
    """Return a function that parses an integer from low to high."""
    def parse(text: str) -> int:
        value = whole(text)
        if not low <= value <= high:
            raise argparse.ArgumentTypeError(f"must lie in {low}..{high}, got {text}")
        return value

    return parse


def since_start(text: str) -> float:
    """Parse a time in seconds after the start of a recording."""
    value = seconds(text)
    if value < 0:
        raise argparse.ArgumentTypeError(f"must not be negative, got {text}")
    return value


def seconds(text: str) -> float:
    """Parse a time in seconds within the range of recordings."""
    value = number(text)
    if not abs(value) < MOST_S:
        raise argparse.ArgumentTypeError(
            f"times must lie within {MOST_S:g} s of 0, got {text}")
    return value


def roi_option(text: str) -> tuple[int, int, int, int]:
    """Parse X,Y,W,H."""
    x, y, width, height = numbers(text, 4, int)
    return x, y, width, height


def size_option(text: str) -> tuple[int, int]:
    """Parse WIDTHxHEIGHT into (height, width)."""
    width, cross, height = text.lower().partition("x")
    if not (cross and width.isdecimal() and height.isdecimal()):
        raise argparse.ArgumentTypeError(f"WIDTHxHEIGHT is needed, got {text!r}")
    return int(height), int(width)


def limits_option(text: str) -> Limits:
    """Parse NAME=NUMBER,.. into Limits."""
    from pdavis_cv.recording.limits import Limits
    try:
        values: dict[str, Any] = {name: number(value) for name, _, value in (
            part.partition("=") for part in text.split(","))}
        return Limits(**values)
    except (TypeError, ValueError):
        names = ", ".join(vars(Limits()))
        raise argparse.ArgumentTypeError("NAME=NUMBER,.. is needed, of a number above "
                                         f"0 and {names}, got {text!r}") from None


def layout_option(text: str) -> Layout:
    """Parse pdavis, sony or four angles by row."""
    from pdavis_cv.sensor import Layout
    try:
        return Layout.of(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from None


def thresholds(text: str) -> str | tuple[float, float]:
    return pair(text) if "," in text else text


def setting(text: str) -> tuple[str, Any]:
    name, equals, value = text.partition("=")
    if not equals or not name.isidentifier():
        raise argparse.ArgumentTypeError(f"NAME=VALUE is needed, got {text!r}")
    words = {"true": True, "false": False, "none": None}
    if value.lower() in words:
        return name, words[value.lower()]
    for kind in (int, float, lambda several: tuple(map(float, several.split(",")))):
        try:
            return name, kind(value)
        except ValueError:
            continue
    return name, value


def ratio(text: str) -> float | str:
    return text if text in ("nominal", "none") else float(numbers(text, 1)[0])


def offset(text: str) -> float | str:
    return text if text in ("learned", "none") else float(numbers(text, 1)[0])


def pair(text: str) -> tuple[float, float]:
    on, off = numbers(text, 2)
    return on, off
