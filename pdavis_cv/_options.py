"""Lists of options: dataclasses from which signatures and docstrings are made."""
from __future__ import annotations

import dataclasses
import functools
import inspect
import re
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, NamedTuple, Self, TypeVar

from pdavis_cv._types import Parameters


class OptionFacts(NamedTuple):
    """Type, help text and command-line form of an option.

    `type` is type and unit, as they appear in a docstring; `help` one or more
    sentences; `word` how the command line parses it, the name of a parser in
    ``tools/_options.py``, e.g. ``"text"``, ``"seconds"`` (after the start of the
    recording) or ``"flag"``; None = the command line does not offer it.  `brief` is the
    help text on the command line, by default the first sentence of `help`; `choices`
    are the allowed texts; empty = any.
    """

    type: str
    help: str
    word: str | None
    brief: str = ""
    choices: Collection[str] = ()


def option(
    default: Any, type: str, help: str, word: str | None, brief: str = "",
    choices: Collection[str] = (),
) -> Any:
    """Return a field of `Options`; see `OptionFacts`."""
    return dataclasses.field(default=default, metadata={"facts": OptionFacts(
        type, help, word, brief, choices)})


@dataclass(frozen=True, kw_only=True, eq=False)
class Options:
    """Base of the lists: checked once, frozen, picklable.

    `parameters` are those of the method, or of the format, that have no field.
    """

    parameters: Parameters = dataclasses.field(default_factory=dict)

    def __post_init__(self) -> None:
        self._put("parameters", MappingProxyType(dict(self.parameters)))

    def _put(self, name: str, value: Any) -> None:
        object.__setattr__(self, name, value)

    def replace(self, **changes: Any) -> Self:
        """Return these options with some changed; others count as `parameters`."""
        names = self.facts()
        known = {name: value for name, value in changes.items() if name in names}
        parameters = {**self.parameters, **changes.pop("parameters", {})}
        parameters |= {name: value for name, value in changes.items()
                       if name not in names}
        return dataclasses.replace(self, **known, parameters=parameters)

    @classmethod
    @functools.cache
    def facts(cls) -> Mapping[str, OptionFacts]:
        """Return the `OptionFacts` of each option, by name."""
        return MappingProxyType({
            one.name: one.metadata["facts"] for one in dataclasses.fields(cls)
            if "facts" in one.metadata})

    def __reduce__(self) -> tuple[Any, ...]:
        values = {one.name: getattr(self, one.name) for one in dataclasses.fields(self)}
        return _restored, (type(self), {**values, "parameters": dict(self.parameters)})


def _restored(kind: type[Options], values: dict[str, Any]) -> Options:
    return kind(**values)


_F = TypeVar("_F", bound=Callable[..., Any])


def names_options(*lists: type[Options], rest: str = "parameters"
                  ) -> Callable[[_F], _F]:
    """Return a decorator that writes options into a signature and a docstring.

    It takes a function, or a class with an ``__init__``, that receives the options of
    the lists in its last parameter, ``**changes`` or another name; of two options of
    one name, the first one's text is used.  A line ``{options}`` of the docstring is
    replaced by their description.  `rest` is the name, in the signature, of the keyword
    arguments that are no option.
    """
    def decorate(function: _F) -> _F:
        called = vars(function)["__init__"] if inspect.isclass(function) else function
        found = inspect.signature(called)
        *own, last = found.parameters.values()
        named = {one.name: inspect.Parameter(
            one.name, inspect.Parameter.KEYWORD_ONLY, default=one.default,
            annotation=one.type)
            for each in reversed(lists) for one in dataclasses.fields(each)
            if one.name in each.facts()}
        vars(called)["__signature__"] = found.replace(
            parameters=[*own, *(named[name] for name in _merged(*lists)),
                        last.replace(name=rest)])
        if function.__doc__ is not None:
            function.__doc__ = documented(function.__doc__, *lists)
        return function
    return decorate


_Given = TypeVar("_Given", bound=Options)


def changed(
    kind: type[_Given], options: _Given | None, changes: Mapping[str, Any]
) -> _Given:
    """Return options with some changed, of a function ``(source, options, **changes)``.

    If `options` is something else, such as a value without its name, a TypeError says
    so.
    """
    if options is None:
        options = kind()
    if not isinstance(options, kind):
        raise TypeError(f"options must be {kind.__name__}, got {options!r:.60}; single "
                        "options are given by name")
    return options.replace(**changes) if changes else options


def documented(text: str | None, *lists: type[Options]) -> str:
    """Return a docstring with its line ``{options}`` replaced by their description."""
    return "\n".join(_lines(text or "", _merged(*lists)))


def _merged(*lists: type[Options]) -> dict[str, OptionFacts]:
    found: dict[str, OptionFacts] = {}
    for each in lists:
        found = {**found, **{name: facts for name, facts in each.facts().items()
                             if name not in found}}
    return found


def _lines(text: str, options: Mapping[str, OptionFacts]) -> Iterator[str]:
    for line in text.splitlines():
        if line.strip() != "{options}":
            yield line
            continue
        indent = line[:len(line) - len(line.lstrip())]
        for name, facts in options.items():
            yield f"{indent}{name} : {facts.type}"
            # textwrap takes a millisecond for all.
            for part in re.findall(rf"\S(?:.{{,{82 - len(indent)}}}\S)?(?!\S)",
                                   facts.help):
                yield f"{indent}    {part}"
