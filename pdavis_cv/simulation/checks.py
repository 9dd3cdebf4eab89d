"""Checks of parameters; errors name the argument, the rule and the value."""
from __future__ import annotations

import math

__all__ = ["affordable", "at_least_zero", "fraction", "positive", "require"]

MOST_BYTES = 4 << 30
"""Most bytes that a simulation may hold in memory.  Engineering choice: a laptop has
more."""


def require(name: str, value: object, holds: bool, rule: str) -> None:
    """Raise ValueError unless the rule holds."""
    if not holds:
        raise ValueError(f"{name} must {rule}, got {value!r}")


def positive(**values: float | None) -> None:
    """Require finite numbers above 0; None passes."""
    for name, value in values.items():
        if value is not None:
            require(name, value, math.isfinite(value) and value > 0, "be positive")


def at_least_zero(**values: float | None) -> None:
    """Require finite numbers of at least 0; None passes."""
    for name, value in values.items():
        if value is not None:
            require(name, value, math.isfinite(value) and value >= 0,
                    "not be negative")


def fraction(**values: float | None) -> None:
    """Require numbers in 0..1; None passes."""
    for name, value in values.items():
        if value is not None:
            require(name, value, 0 <= value <= 1, "lie in 0..1")


def affordable(what: str, size: float, /, **because: object) -> None:
    """Refuse arguments with which a simulation would need too much memory.

    Parameters
    ----------
    what : str
        Name of the data that need the memory.
    size : float
        Estimated bytes.
    **because : object
        Arguments that determine the size, for the message.

    Raises
    ------
    ValueError
    """
    if not size <= MOST_BYTES:
        raise ValueError(
            f"{' and '.join(because)} must leave {what} within {MOST_BYTES >> 30} GiB, "
            f"got {', '.join(f'{value!r}' for value in because.values())}, which "
            f"would take about {size / 2**30:.3g} GiB")
