"""Registry: the named things of one kind, this library's and those of other packages.

There is one each for formats, methods, sources and quantities.  Another package adds a
thing by an entry point of its name in the group ``pdavis_cv.formats``, ``.methods`` ...
"""
from __future__ import annotations

import functools
import importlib
import operator
import sys
import warnings
from collections.abc import Iterable, Iterator, Mapping
from typing import TYPE_CHECKING, Any, TypeVar, cast

from pdavis_cv.errors import PdavisWarning

if TYPE_CHECKING:   # it loads the e-mail package, which takes 20 ms
    from importlib.metadata import EntryPoint

T = TypeVar("T")


class UnknownNameError(KeyError, ValueError):
    """There is nothing of this name; the message lists the names that there are."""

    __str__ = ValueError.__str__    # that of KeyError adds quotation marks


class Registry(Mapping[str, T]):
    """The things of one kind by name: this library's, then those of other packages.

    Names cost nothing: a thing is imported when it is looked up.  One that cannot be
    used raises ImportError then, and `usable` leaves it out with a warning.

    Parameters
    ----------
    kind : str
        What each is, such as ``"method"``.
    known : mapping of str to object
        This library's, or where they are: ``"package.module:name"``.
    base : type
        Class that those of other packages are objects of, or derived from.
    attribute : str
        Attribute with the name, if a thing has it.
    group : str, optional
        Group of entry points; default: of ``"method"`` it is ``pdavis_cv.methods``.
    """

    def __init__(self, kind: str, known: Mapping[str, T | str], base: type, *,
                 attribute: str = "name", group: str | None = None) -> None:
        self.kind, self.known, self.base = kind, known, base
        self.group, self._attribute = group or f"pdavis_cv.{kind}s", attribute
        self._broken: dict[EntryPoint, str] = {}

    def __getitem__(self, name: str) -> T:
        if name in self.known:
            thing: T = loaded(self.known[name])
            return thing
        point = self._added().get(name)
        if point is None:
            raise UnknownNameError(
                f"{self.kind} must be one of {', '.join(self)}, got {name!r}"
                f"{instead(name, self)}")
        return self._loaded(point)

    def _loaded(self, point: EntryPoint) -> T:
        if point not in self._broken:
            try:
                return self._checked(point)
            except Exception as error:  # foreign code may raise anything
                self._broken[point] = f"{error}"
        raise ImportError(f"{self.kind} {point.name!r} of {point.value} cannot be "
                          f"used: {self._broken[point]}")

    def _checked(self, point: EntryPoint) -> T:
        if point.name in self.known:
            raise ValueError("the library has one of this name")
        thing: Any = point.load()
        if not (isinstance(thing, self.base) or (
                isinstance(thing, type) and issubclass(thing, self.base))):
            raise TypeError(f"{self.base.__name__} expected, got "
                            f"{getattr(thing, '__name__', type(thing).__name__)}")
        name = getattr(thing, self._attribute, point.name)
        if name != point.name:
            raise ValueError(f"its {self._attribute} is {name!r}")
        return cast(T, thing)

    def _added(self) -> Mapping[str, EntryPoint]:
        return _entry_points(self.group, tuple(sys.path))

    def __iter__(self) -> Iterator[str]:
        yield from self.known
        yield from (name for name in self._added() if name not in self.known)

    def __len__(self) -> int:
        return sum(1 for _ in self)

    def __contains__(self, name: object) -> bool:
        return name in self.known or name in self._added()

    def usable(self) -> dict[str, T]:
        """Return all things by name; a warning names what cannot be used, once."""
        found = {name: self[name] for name in self.known}
        for point in self._added().values():
            told = point in self._broken
            try:
                found[point.name] = self._loaded(point)
            except ImportError as error:
                if not told:
                    warnings.warn(str(error), PdavisWarning, stacklevel=3)
        return found


@functools.lru_cache(32)
def _entry_points(group: str, path: tuple[str, ...]) -> dict[str, EntryPoint]:
    """Return the entry points of a group by name; of two of a name, the first."""
    from importlib.metadata import entry_points
    return {point.name: point for point in reversed(tuple(entry_points(group=group)))}


def loaded(what: Any) -> Any:
    """Return an object, importing it if given as ``"package.module:name"``."""
    if not isinstance(what, str):
        return what
    module, _, name = what.partition(":")
    return operator.attrgetter(name)(importlib.import_module(module))


_MEANT = {"framerate": "fps", "frame_rate": "fps", "frame-rate": "fps",
          "show": "quantities", "output": "out", "rate": "fps", "begin": "start_us",
          "end": "stop_us", "until": "stop_us", "duration": "stop_us",
          "times": "times_us", "t": "times_us", "crop": "roi", "region": "roi",
          **dict.fromkeys(("open", "read", "load", "imread"), "open_recording")}
"""What other libraries call a thing; used where there is one of that name."""


def instead(name: object, known: Iterable[str]) -> str:
    """Return "; did you mean ...?" with the known name nearest to one, or nothing."""
    near = nearest(name, known)
    return f"; did you mean {near}?" if near else ""


def nearest(name: object, known: Iterable[str]) -> str | None:
    """Return the known name nearest to one, None if there is none near."""
    names = {one.lower(): one for one in known}
    wanted = str(name).lower()
    meant = _MEANT.get(wanted, f"{wanted}_us")
    if meant in names:
        return names[meant]
    from difflib import get_close_matches  # slow to import
    near = get_close_matches(wanted, names, 1, 0.7)
    return names[near[0]] if near else None
