"""How options appear on the command line: their flags and the kinds of their values."""
from __future__ import annotations

import argparse
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ._values import (
    layout_option,
    limits_option,
    offset,
    pair,
    positive,
    ratio,
    roi_option,
    since_start,
    size_option,
    thresholds,
    within,
)

if TYPE_CHECKING:  # `command` must handle an interrupt while NumPy is imported
    from pdavis_cv._options import OptionFacts, Options


def add_offered(
    group: argparse._ArgumentGroup, options: Iterable[tuple[str, OptionFacts]]
) -> None:
    """Add options to a group of a parser."""
    for name, facts in options:
        add: dict[str, Any] = {"help": facts.brief or facts.help}
        if facts.word == "flag":
            add["action"] = "store_true"
        else:
            add["type"], add["metavar"] = WORDS[facts.word]
            if facts.choices:
                add["choices"], add["metavar"] = facts.choices, None
        group.add_argument(flag_of(name, facts), dest=name, **add)


def flags() -> dict[str, tuple[str, str]]:
    """Return the flag of each option and the placeholder of its value, by its name."""
    return {name: (flag_of(name, facts), WORDS.get(facts.word, (str, ""))[1])
            for options in (fusion_options(), source_options())
            for name, facts in offered(options)}


def fusion_options() -> type[Options]:
    """Return FusionOptions, imported at first use."""
    from pdavis_cv.fusion.options import FusionOptions
    return FusionOptions


def source_options() -> type[Options]:
    """Return SourceOptions, imported at first use."""
    from pdavis_cv.recording.options import SourceOptions
    return SourceOptions


def offered(options: type[Options]) -> list[tuple[str, OptionFacts]]:
    """Return the names and facts of the options of a list that commands offer."""
    return [(name, facts) for name, facts in options.facts().items()
            if facts.word is not None]


def flag_of(name: str, facts: OptionFacts) -> str:
    """Return the name of an option on the command line, e.g. --start for start_us."""
    if facts.word in ("seconds", "offset"):     # in s there, or without a unit
        name = name.removesuffix("_us")
    return "--" + name.replace("_", "-")


WORDS: dict[str | None, tuple[Callable[[str], Any], str]] = {
    "text": (str, "NAME"),
    "number": (positive, "RATE"),
    "count": (within(1, 1024), "N"),
    "channel": (within(0, 31), "N"),
    "seconds": (since_start, "S"),
    "offset": (offset, "US"),
    "us": (within(1, 10**9), "US"),
    "bits": (within(1, 32), "BITS"),
    "dn": (within(1, 2**32), "DN"),
    "size": (size_option, "WIDTHxHEIGHT"),
    "limits": (limits_option, "NAME=N,.."),
    "region": (roi_option, "X,Y,W,H"),
    "layout": (layout_option, "LAYOUT"),
    "calibration": (Path, "NPZ"),
    "ratio": (ratio, "RATIO"),
    "thresholds": (thresholds, "T"),
    "pair": (pair, "ON,OFF"),
}
"""The parser of each kind of option, and the placeholder of its value."""
