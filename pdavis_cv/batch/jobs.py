"""Jobs, and names for them that depend only on their content."""
from __future__ import annotations

import dataclasses
import functools
import hashlib
import inspect
import json
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np

import pdavis_cv
from pdavis_cv._options import Options
from pdavis_cv.fusion.options import FusionOptions
from pdavis_cv.recording.options import SourceOptions
from pdavis_cv.sensor import Layout

_DIGITS = 12
"""Hexadecimal digits of the hash in a name: 48 bits.  The probability of a collision
among 10^5 jobs is 2e-5."""
_NOTHING_STATED = SourceOptions()
_WITHOUT_EFFECT = frozenset({"threads"})
"""Options that do not change any result."""


class Work(Protocol):
    """A function, or another callable, that processes one recording.

    It must be picklable; a function must therefore be defined in a module.  If it has
    an attribute ``opens`` that is False, no recording is opened: it is called with the
    text that is given in place of the path.
    """

    def __call__(
        self, recording: Any, options: FusionOptions, folder: Path, /
    ) -> Mapping[str, Any] | None:
        """Process a recording.

        Parameters
        ----------
        recording : Recording
            Open; the caller closes it.
        options : FusionOptions
        folder : Path
            Empty; its content becomes the result when the work is done.

        Returns
        -------
        mapping of str to object, or None
            Figures (numbers and texts) by the name of their column in the table.
        """
        ...


@dataclass(frozen=True)
class Job:
    """One recording, one set of options and one work.

    Parameters
    ----------
    source : str
        Path of the recording, or the text that is given in its place.
    identity : str
        SHA-256 of its content, or another text that changes with the content.
    options : FusionOptions
    work : Work
    stated : SourceOptions
        What is stated about every recording.
    """

    source: str
    identity: str
    options: FusionOptions
    work: Work
    stated: SourceOptions = _NOTHING_STATED

    @functools.cached_property
    def name(self) -> str:
        """The recording's stem and a hash of everything that the result depends on."""
        facts = [self.identity, changed_options(self.options), describe(self.work),
                 pdavis_cv.__version__, changed_options(self.stated)]
        text = json.dumps(facts, sort_keys=True)
        stem = self.source.rstrip("/").rpartition("/")[2].partition(".")[0]
        plain = re.sub(r"[^A-Za-z0-9_-]+", "_", stem)[:80] or "recording"
        return f"{plain}-{hashlib.sha256(text.encode()).hexdigest()[:_DIGITS]}"


def changed_options(options: Options) -> dict[str, Any]:
    """Return the options that differ from their defaults, for JSON.

    Options that do not change any result are left out; the method's parameters are
    merged with the options.
    """
    found = {}
    for one in dataclasses.fields(options):
        if one.name in _WITHOUT_EFFECT or one.name == "parameters":
            continue
        value = describe(getattr(options, one.name))
        if value != describe(one.default):
            found[one.name] = value
    return {**found, **{name: describe(value)
                        for name, value in options.parameters.items()}}


@functools.singledispatch
def describe(value: Any) -> Any:
    """Return a description of a value that JSON can hold; equal for equal values only.

    Arrays become shape, dtype and SHA-256, functions their name and the SHA-256 of
    their source, objects their class and attributes.
    """
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if isinstance(value, np.generic):
        return value.item()
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {"class": _qualified_name(type(value)),
                **{one.name: describe(getattr(value, one.name))
                   for one in dataclasses.fields(value)}}
    if callable(value) and hasattr(value, "__qualname__"):
        return {"function": _qualified_name(value), "source": _source_of(value)}
    return {"class": _qualified_name(type(value)), **{
        str(name): describe(part) for name, part in getattr(
            value, "__dict__", {"value": repr(value)}).items()}}


@describe.register
def _(value: np.ndarray) -> Any:
    content = hashlib.sha256(np.ascontiguousarray(value).tobytes())
    return {"shape": list(value.shape), "dtype": str(value.dtype),
            "sha256": content.hexdigest()}


@describe.register
def _(value: Layout) -> Any:
    return str(value) if value.owner is None else f"{value} of {value.owner}"


@describe.register(Mapping)
def _(value: Mapping[Any, Any]) -> Any:
    return {str(name): describe(value[name]) for name in sorted(value, key=str)}


@describe.register(list)
@describe.register(tuple)
def _(value: list[Any] | tuple[Any, ...]) -> Any:
    return [describe(part) for part in value]


@describe.register(set)
@describe.register(frozenset)
def _(value: set[Any] | frozenset[Any]) -> Any:
    return sorted((describe(part) for part in value), key=str)


@describe.register
def _(value: functools.partial) -> Any:  # type: ignore[type-arg]
    return {"partial": [describe(value.func), describe(value.args),
                        describe(value.keywords)]}


def _qualified_name(value: Any) -> str:
    return f"{value.__module__}:{value.__qualname__}"


def _source_of(value: Any) -> str | None:
    """Return the SHA-256 of the source of a function or class, None if unavailable.

    None as well for those of this library, which its version identifies.
    """
    if value.__module__.partition(".")[0] == "pdavis_cv":
        return None
    try:
        text = inspect.getsource(value)
    except (OSError, TypeError):
        return None
    return hashlib.sha256(text.encode()).hexdigest()
