"""What is to be done, and names that stay the same as long as it does."""
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
from pdavis_cv.fusion.options import FusionOptions
from pdavis_cv.sensor import Layout

__all__ = ["Job", "Work", "described", "given"]

_DIGITS = 12
"""Of the hash in a name: 48 bits, a collision among 10^5 jobs has odds of 2 in 10^5."""
_SAME_BITS = frozenset({"threads"})
"""Options that no result depends on."""


class Work(Protocol):
    """What is done with one recording: a function, or an object that can be called.

    It must pickle; a function must therefore be one of a module.  Where it has an
    attribute ``opens`` that is False, it gets the text that stands for the recording
    instead, and nothing is opened.
    """

    def __call__(
        self, recording: Any, options: FusionOptions, folder: Path, /
    ) -> Mapping[str, Any] | None:
        """Do it.

        Parameters
        ----------
        recording : Recording
            Open; closed afterwards.
        options : FusionOptions
        folder : Path
            Empty; what is written there becomes the result when the work is done.

        Returns
        -------
        mapping of str to object, or None
            Figures: numbers and texts, columns of the table.
        """
        ...


@dataclass(frozen=True)
class Job:
    """One recording, one set of options, one work.

    Parameters
    ----------
    source : str
        Path of the recording, or what stands for it.
    identity : str
        SHA-256 of its content, or another text that changes with it.
    options : FusionOptions
    work : Work
    """

    source: str
    identity: str
    options: FusionOptions
    work: Work

    @functools.cached_property
    def name(self) -> str:
        """Stem of the recording and a hash of all that the result depends on."""
        facts = [self.identity, given(self.options), described(self.work),
                 pdavis_cv.__version__]
        text = json.dumps(facts, sort_keys=True)
        stem = self.source.rstrip("/").rpartition("/")[2].partition(".")[0]
        plain = re.sub(r"[^A-Za-z0-9_-]+", "_", stem)[:80] or "recording"
        return f"{plain}-{hashlib.sha256(text.encode()).hexdigest()[:_DIGITS]}"


def given(options: FusionOptions) -> dict[str, Any]:
    """Return the options that are not as they are by default, for JSON.

    Without those that no result depends on; parameters of the method stand beside the
    others.
    """
    found = {}
    for one in dataclasses.fields(FusionOptions):
        if one.name in _SAME_BITS or one.name == "parameters":
            continue
        value = described(getattr(options, one.name))
        if value != described(one.default):
            found[one.name] = value
    return {**found, **{name: described(value)
                        for name, value in options.parameters.items()}}


@functools.singledispatch
def described(value: Any) -> Any:
    """Return what JSON can hold and changes if, and only if, a value does.

    Arrays become shape, dtype and SHA-256, functions their name and the SHA-256 of
    their source, objects their class and attributes.
    """
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if isinstance(value, np.generic):
        return value.item()
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {"class": _home(type(value)),
                **{one.name: described(getattr(value, one.name))
                   for one in dataclasses.fields(value)}}
    if callable(value) and hasattr(value, "__qualname__"):
        return {"function": _home(value), "source": _source_of(value)}
    return {"class": _home(type(value)), **{
        str(name): described(part) for name, part in getattr(
            value, "__dict__", {"value": repr(value)}).items()}}


@described.register
def _(value: np.ndarray) -> Any:
    content = hashlib.sha256(np.ascontiguousarray(value).tobytes())
    return {"shape": list(value.shape), "dtype": str(value.dtype),
            "sha256": content.hexdigest()}


@described.register
def _(value: Layout) -> Any:
    return str(value)


@described.register(Mapping)
def _(value: Mapping[Any, Any]) -> Any:
    return {str(name): described(value[name]) for name in sorted(value, key=str)}


@described.register(list)
@described.register(tuple)
def _(value: list[Any] | tuple[Any, ...]) -> Any:
    return [described(part) for part in value]


@described.register(set)
@described.register(frozenset)
def _(value: set[Any] | frozenset[Any]) -> Any:
    return sorted((described(part) for part in value), key=str)


@described.register
def _(value: functools.partial) -> Any:  # type: ignore[type-arg]
    return {"partial": [described(value.func), described(value.args),
                        described(value.keywords)]}


def _home(value: Any) -> str:
    return f"{value.__module__}:{value.__qualname__}"


def _source_of(value: Any) -> str | None:
    """Return a hash of the text that a function or class stands in, if that is known.

    Of this library's own the version says as much.
    """
    if value.__module__.partition(".")[0] == "pdavis_cv":
        return None
    try:
        text = inspect.getsource(value)
    except (OSError, TypeError):
        return None
    return hashlib.sha256(text.encode()).hexdigest()
