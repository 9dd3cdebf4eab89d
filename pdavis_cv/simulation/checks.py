"""Refusing impossible parameters: argument, rule, what was seen."""
from __future__ import annotations

import math

__all__ = ["at_least_zero", "fraction", "positive", "require"]


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
