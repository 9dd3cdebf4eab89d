"""Checks of parameters; errors name the argument, the rule and the value."""
from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from typing import Any

from pdavis_cv._checks import MOST_ANGLE, MOST_RPM, plain, real_number, whole_number

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


Rule = Callable[[str, Any], Any]
"""Given the name and value of an argument, returns the value, or raises ValueError."""


def require(name: str, value: Any, holds: bool, rule: str) -> Any:
    """Return a value; raise ValueError unless the rule holds."""
    if not holds:
        raise ValueError(f"{name} must {rule}, got {value!r}")
    return value


def positive(name: str, value: Any) -> Any:
    """Require a finite number above 0."""
    return require(name, value, 0 < real_number(value) < math.inf,
                   "be positive and finite")


def within(low: float, high: float) -> Rule:
    """Return the rule that a number lies in low..high."""
    return lambda name, value: require(
        name, value, low <= real_number(value) <= high, f"lie in {low:g}..{high:g}")


def whole(low: int, high: int) -> Rule:
    """Return the rule that a number is whole and of low..high."""
    return lambda name, value: whole_number(name, value, low, high)


def instance(kind: type) -> Rule:
    """Return the rule that an object is of a type."""
    return that(lambda value: isinstance(value, kind), f"be a {kind.__name__}")


def that(holds: Callable[[Any], bool], rule: str) -> Rule:
    """Return a rule in the words of an error."""
    return lambda name, value: require(name, value, holds(value), rule)


FRACTION = within(0, 1)
LIGHT = within(0, MOST_LIGHT)
RPM = within(-MOST_RPM, MOST_RPM)
ANGLE = within(-MOST_ANGLE, MOST_ANGLE)


def rules(*each: Rule) -> dict[str, Any]:
    """Return the metadata of a field of a `Checked` dataclass: rules of its value."""
    return {"rules": each}


def ruled(default: Any, *each: Rule) -> Any:
    """Return a field with a default and rules of its value."""
    return dataclasses.field(default=default, metadata=rules(*each))


class Checked:
    """Base of dataclasses whose fields have `rules`; a default None needs none.

    NumPy's numbers become Python's, which do not overflow.
    """

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):  # type: ignore[arg-type]
            value = plain(getattr(self, field.name))
            if value is not None or field.default is not None:
                for rule in field.metadata.get("rules", ()):
                    value = rule(field.name, value)
            object.__setattr__(self, field.name, value)


def affordable(what: str, size: float, /, **because: object) -> None:
    """Refuse arguments with which a simulation would need too much memory.

    The data `what` take about `size` bytes because of these arguments.
    """
    if not size <= MOST_BYTES:
        raise ValueError(
            f"{' and '.join(because)} must leave {what} within {MOST_BYTES >> 30} GiB, "
            f"got {', '.join(f'{value!r}' for value in because.values())}, which "
            f"would take about {size / 2**30:.3g} GiB")
