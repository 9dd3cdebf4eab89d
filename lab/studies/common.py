"""What the studies share: one constant found and the one in the code, side by side."""
from __future__ import annotations

import argparse
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]


@dataclass(frozen=True)
class Found:
    """A constant: what the study finds, what the code has, how far they may differ.

    Parameters
    ----------
    name : str
        In the code, with its module.
    found, code : float
        Value found, value in the code.
    within : float
        Largest relative difference.
    at_least, at_most : bool
        The code's value may be larger, or smaller, than the one found.
    """

    name: str
    found: float
    code: float
    within: float = 0.01
    at_least: bool = False
    at_most: bool = False

    @property
    def agrees(self) -> bool:
        """Whether the code has what was found."""
        if self.at_least or self.at_most:
            return self.code >= self.found if self.at_least else self.code <= self.found
        return abs(self.found - self.code) <= self.within * abs(self.code)

    def __str__(self) -> str:
        sign = "at least " if self.at_least else "at most " if self.at_most else ""
        return (f"{self.name}: {self.found:.5g} found, {sign}{self.code:.6g} in the "
                f"code{'' if self.agrees else ' must be CHANGED'}")


def kernel_constant(file: str, name: str) -> float:
    """Return the number of a name, as ``name = 1.5`` or ``#define name 1.5``."""
    text = (ROOT / "_kernels" / file).read_text()
    found = re.search(rf"\b{name}\s*(?:=\s*)?([-\d.e+]+)", text)
    if found is None:
        raise LookupError(f"{file} must give {name} a number, found none")
    return float(found.group(1))


def main(study: Callable[[bool], list[Found]], argv: Sequence[str] | None = None
         ) -> int:
    """Run a study from the command line; return 1 if the code differs."""
    parser = argparse.ArgumentParser(description=study.__doc__)
    parser.add_argument("--quick", action="store_true", help="fewer cases, as tests do")
    found = study(parser.parse_args(argv).quick)
    for one in found:
        print(one)
    return 0 if all(one.agrees for one in found) else 1
