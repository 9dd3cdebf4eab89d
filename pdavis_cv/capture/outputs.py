"""Outputs of VideoCapture: each quantity as numbers and as a picture."""
from __future__ import annotations

import functools
from dataclasses import dataclass

from pdavis_cv.capture import constants
from pdavis_cv.quantities import GROUPS, QUANTITIES, Quantity, quantity


@dataclass(frozen=True)
class Output:
    """What `retrieve` returns.

    The name is that of a quantity or a group of them as numbers, or with ``_bgr`` as a
    picture in BGR, which may be faded where DoLP is low.  Several quantities are the
    channels of one array.
    """

    name: str
    quantities: tuple[Quantity, ...]
    picture: bool = False
    faded: bool = False

    @property
    def quantity(self) -> Quantity:
        """The first quantity."""
        return self.quantities[0]


def output_named(name: str) -> Output:
    """Return an output by its name, in which a quantity may have its alias."""
    lower = name.lower()
    if lower in GROUPS:
        return Output(lower, tuple(map(quantity, GROUPS[lower])))
    stem = "s0_bgr" if lower == "bgr" else lower
    rest = stem.removesuffix("_bgr")
    base = rest if rest == stem else rest.removesuffix("_faded")
    try:
        one = quantity(base)
    except KeyError:
        one = None
    if one is None or (base != rest and one.colours != "hue") or (
            rest == stem and one.of_events):
        raise ValueError(f"output must be one of {', '.join(outputs())}, got {name!r}")
    found = one.name + stem.removeprefix(base)
    return Output("bgr" if found == "s0_bgr" else found, (one,), rest != stem,
                  base != rest)


@functools.cache
def _fixed() -> tuple[Output, ...]:
    """Return the outputs whose numbers are constants, by number."""
    numbers = {getattr(constants, name): name.removeprefix("CAP_PDAVIS_")
               for name in vars(constants) if name.startswith("CAP_PDAVIS_")}
    return tuple(output_named(numbers[i]) for i in range(len(numbers)))


def outputs() -> tuple[str, ...]:
    """Return the names of all outputs by number.

    Those with constants come first, then the library's others, then those of other
    packages, whose numbers depend on what is installed.
    """
    names = [one.name for one in _fixed()]
    for one in QUANTITIES.usable().values():
        names += [one.name] if not one.of_events else []
        names += ["bgr" if one.name == "s0" else f"{one.name}_bgr"]
        names += [f"{one.name}_faded_bgr"] if one.colours == "hue" else []
    return tuple(dict.fromkeys(names))


def output_at(number: int) -> Output:
    """Return the output of a number; LookupError if there is none."""
    if 0 <= number < len(_fixed()):
        return _fixed()[number]
    names = outputs()
    if not 0 <= number < len(names):
        raise LookupError(f"flag must be one of CAP_PDAVIS_* or the number of another "
                          f"output (0..{len(names) - 1}), got {number}")
    return output_named(names[number])


def number_of(value: int | str) -> int:
    """Return the number of an output: itself, or of a name such as ``"aop"``."""
    if isinstance(value, (list, tuple)):
        raise TypeError(f"output must be one name, got {value!r}; retrieve(flag) gives "
                        "others of the same image")
    if not isinstance(value, str):
        return value
    wanted = output_named(value)
    return (_fixed() if wanted in _fixed() else
            [output_named(name) for name in outputs()]).index(wanted)
