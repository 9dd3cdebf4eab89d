"""Docstrings of the public names, as numpydoc sees them."""
import enum
import importlib
import inspect
from enum import EnumType

from homes import HOMES
from numpydoc.validate import validate

import pdavis_cv

# Sections that are not asked for everywhere, and punctuation of lists of facts.
OPTIONAL = {"ES01", "EX01", "SA01", "PR07", "PR08", "PR09", "RT03", "RT04", "RT05",
            "YD01", "GL01", "GL02", "GL03", "RT02"}
# A method whose summary line says everything needs no sections.
OPTIONAL_IN_METHODS = {"PR01", "RT01", "SS05"}


def public_objects():
    """Return the dotted names of public functions, classes and their methods."""
    names = []
    for name in pdavis_cv.__all__:
        value, home = getattr(pdavis_cv, name), HOMES.get(name)
        if home is None or not callable(value) or isinstance(value, EnumType):
            continue
        names.append(f"pdavis_cv.{home}.{name}")
        if inspect.isclass(value) and not issubclass(value, Exception):
            names += [f"pdavis_cv.{home}.{name}.{member}"
                      for member, what in vars(value).items()
                      if not member.startswith("_")
                      and (inspect.isroutine(what) or isinstance(what, property))]
    return names


def errors_of(name):
    method = name.split(".")[-2][0].isupper()
    home, _, attribute = name.rpartition(".")
    value = None if method else getattr(importlib.import_module(home), attribute)
    members_say_it = inspect.isclass(value) and issubclass(value, enum.Enum)
    optional = OPTIONAL | (
        OPTIONAL_IN_METHODS if method or members_say_it else set())
    return [f"{name}: {code} {text}" for code, text in validate(name)["errors"]
            if code not in optional]


def test_docstrings_are_complete():
    names = public_objects()
    assert len(names) > 150
    assert not [error for name in names for error in errors_of(name)]
