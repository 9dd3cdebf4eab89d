"""Checks of parameters; errors name the argument, the rule and the value."""
from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np

from pdavis_cv._checks import MOST_ANGLE, MOST_RPM, real_number, whole_number

MOST_BYTES = 4 << 30
"""Most bytes that a simulation may hold in memory.  Engineering choice: a laptop has
more."""
MOST_HZ = 500_000.0
"""Largest frequency: half the rate of the clock, which counts microseconds."""
MOST_LIGHT = 1e9
"""Bound on S0, DN per ms: about 300 suns on the PDAVIS."""
MOST_SEED = 2**64 - 1
"""Largest seed: the keys of random numbers have 64 bits."""
MOST_DN = 2.0**24
"""Bound on levels and noise of frames: float32 resolves 1 DN up to there."""


def require(name: str, value: object, holds: bool, rule: str) -> None:
    """Raise ValueError unless the rule holds."""
    if not holds:
        raise ValueError(f"{name} must {rule}, got {value!r}")


def present(**values: Any) -> dict[str, Any]:
    """Return the arguments that are not None: the rules hold for those given."""
    return {name: value for name, value in values.items() if value is not None}


def positive(**values: float) -> None:
    """Require finite numbers above 0."""
    for name, value in values.items():
        require(name, value, 0 < real_number(value) < math.inf,
                "be positive and finite")


def fraction(**values: float) -> None:
    """Require numbers in 0..1."""
    within(0, 1, **values)


def within(low: float, high: float, /, **values: float) -> None:
    """Require numbers in low..high."""
    for name, value in values.items():
        require(name, value, low <= real_number(value) <= high,
                f"lie in {low:g}..{high:g}")


def turning(rpm: float, **angles: float) -> None:
    """Require a speed within `MOST_RPM` of 0, and angles within `MOST_ANGLE`."""
    within(-MOST_RPM, MOST_RPM, rpm=rpm)
    within(-MOST_ANGLE, MOST_ANGLE, **angles)


def instance(kind: type, /, **values: object) -> None:
    """Require objects of a type."""
    for name, value in values.items():
        require(name, value, isinstance(value, kind), f"be a {kind.__name__}")


def python_numbers(part: Any) -> None:
    """Replace NumPy's numbers in a dataclass by Python's, which do not overflow."""
    for field in dataclasses.fields(part):
        value = getattr(part, field.name)
        if isinstance(value, np.generic):
            object.__setattr__(part, field.name, value.item())


def whole(part: Any, low: int, high: int, *names: str) -> None:
    """Require whole numbers of low..high in these fields, and make them integers."""
    for name in names:
        number = whole_number(name, getattr(part, name), low, high)
        object.__setattr__(part, name, number)


def affordable(what: str, size: float, /, **because: object) -> None:
    """Refuse arguments with which a simulation would need too much memory.

    The data `what` take about `size` bytes because of these arguments.
    """
    if not size <= MOST_BYTES:
        raise ValueError(
            f"{' and '.join(because)} must leave {what} within {MOST_BYTES >> 30} GiB, "
            f"got {', '.join(f'{value!r}' for value in because.values())}, which "
            f"would take about {size / 2**30:.3g} GiB")
