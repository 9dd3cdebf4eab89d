"""The public names of a package, whose errors name the argument of another type.

Functions and methods take what behaves as their annotations say.  If a call fails
inside and an argument is of another type, that is said instead; arrays that do not fit
are named with their shapes.  A call that succeeds takes a microsecond longer.
"""
from __future__ import annotations

import contextlib
import functools
import importlib
import inspect
import numbers
import re
import sys
import types
import typing
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any, Literal

import lazy_loader
import numpy as np
from numpy.typing import ArrayLike, NDArray

from pdavis_cv.errors import PdavisError

_NUMBERS = {float: numbers.Real, int: numbers.Integral, complex: numbers.Complex,
            bool: bool | np.bool_}
_SEQUENCES: tuple[type[Any], ...] = (list, tuple, dict, set, bytes, np.ndarray)


def attached(package: str, file: str) -> tuple[Any, Any, list[str]]:
    """Return ``__getattr__``, ``__dir__`` and ``__all__`` as the package's stub says.

    See `lazy_loader.attach_stub`.
    """
    get, names, every = lazy_loader.attach_stub(package, file)

    return lambda name: public(package, name, get(name)), names, every


def public(package: str, name: str, one: Any) -> Any:
    """Return a public name's object as it is found from now on."""
    if inspect.isfunction(one):
        one = explained(one)
        one.__module__ = package    # where it is found, by pickle too
    elif inspect.isclass(one) and not issubclass(one, Exception) and (
            name != "VideoCapture"):    # it errs as cv2's does
        for base in one.__mro__:
            ours = base.__module__.startswith("pdavis_cv")
            for called, call in [*vars(base).items()] if ours else ():
                if inspect.isfunction(call) and not hasattr(call, "__wrapped__") and (
                        called == "__init__" or not called.startswith("_")):
                    setattr(base, called, explained(call))
    vars(sys.modules[package])[name] = one
    return one


def explained(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return a function whose errors name an argument that is of another type."""
    @functools.wraps(function)
    def call(*arguments: Any, **named: Any) -> Any:
        with _explaining(function, arguments, named):
            return function(*arguments, **named)

    @functools.wraps(function)
    def steps(*arguments: Any, **named: Any) -> Iterator[Any]:
        with _explaining(function, arguments, named):
            yield from function(*arguments, **named)

    return steps if inspect.isgeneratorfunction(function) else call


@contextlib.contextmanager
def _explaining(function: Any, arguments: Any, named: Any) -> Iterator[None]:
    try:
        yield
    except (PdavisError, OSError, ImportError, MemoryError, Warning):
        raise
    except Exception as error:
        try:
            given = inspect.signature(function).bind(*arguments, **named).arguments
        except TypeError:       # it lacks an argument
            raise error from None
        told = isinstance(error, TypeError | ValueError) and any(
            re.search(rf"(?<!')\b{name}\b", str(error)) for name in given)
        for name, value in given.items():
            if not told and not _is_taken(function, name, value):
                raise TypeError(f"{name} must be {_wanted(function, name)}, got "
                                f"{type(value).__name__}") from error
        # So do NumPy and kernels speak of arrays.
        if not told and re.search("broadcast|^Buffer|contiguous|too large", str(error)):
            shapes = (f"{name} {getattr(value, 'shape', type(value).__name__)}"
                      for name, value in given.items() if name != "self")
            raise ValueError(f"{', '.join(shapes)}: {error}") from error
        raise


def _is_taken(function: Any, name: str, value: Any) -> bool:
    """Return whether a value is of the type of an argument, as far as is known."""
    annotation = function.__annotations__.get(name, Any)
    try:
        hint = typing.get_type_hints(
            types.SimpleNamespace(__annotations__={name: annotation}),
            function.__globals__, _Names())[name]
    except NameError:       # imported for type checkers only, and not public
        return True
    return fits(value, hint)


def _wanted(function: Any, name: str) -> str:
    found = re.search(rf"^ *(?:\w+, )*{name}(?:, \w+)* : (.+)$",
                      inspect.getdoc(function) or "", re.MULTILINE)
    return str(found[1] if found else function.__annotations__[name])


class _Names(dict[str, Any]):
    """The public names: some modules import them for type checkers only."""

    def __missing__(self, name: str) -> Any:
        for room in ("", ".analysis", ".batch", ".calibration", ".live", ".simulation"):
            with contextlib.suppress(AttributeError):
                return getattr(importlib.import_module(f"pdavis_cv{room}"), name)
        raise KeyError(name)


def fits(value: Any, hint: Any) -> bool:
    """Return whether a value is of an annotated type, or may be taken for it."""
    kind, inside = typing.get_origin(hint), typing.get_args(hint)
    if kind is NDArray:     # since NumPy 2.5 it is a name of its own
        kind = np.ndarray
    if isinstance(value, np.ndarray) and not value.ndim and isinstance(
            kind, type) and issubclass(kind, Iterable):
        return False        # although it has an __iter__
    if kind is np.ndarray:      # of void: of events, on which `as_events` decides
        return "void" in str(inside[-1]) or (isinstance(value, np.ndarray) and (
            value.dtype.kind in ("biufcV" if "Any" in str(inside[-1]) else "biufc")))
    if hint == ArrayLike:
        with contextlib.suppress(ValueError):
            return np.asarray(value).dtype.kind in "biufc"
        return False
    if kind in (typing.Union, types.UnionType):
        return any(fits(value, one) for one in inside)
    if kind is Literal:
        return isinstance(value, str | int) and value in inside
    if kind is tuple and inside[-1:] != (...,):
        return isinstance(value, tuple | list) and len(value) == len(inside) and all(
            map(fits, value, inside))
    if isinstance(kind, type):
        if (isinstance(value, str) and str not in inside) or not isinstance(
                value, (kind, list) if kind is tuple else kind):
            return False
        if isinstance(value, Mapping) and issubclass(kind, Mapping):
            return all(fits(one, inside[1]) for one in value.values())
        return not isinstance(value, _SEQUENCES) or all(
            fits(one, inside[0]) for one in iter(value))
    if hint is None or hint is type(None):
        return value is None
    if hint in _NUMBERS:
        return isinstance(value, _NUMBERS[hint])
    return hint is Any or not isinstance(hint, type) or getattr(
        hint, "_is_protocol", False) or isinstance(value, hint)
