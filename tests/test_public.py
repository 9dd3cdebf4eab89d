"""The public names and signatures, held against a list that is changed on purpose.

After a change that is meant: ``python tests/test_public.py`` writes the list anew.
"""
import inspect
from pathlib import Path

import pdavis_cv

LIST = Path(__file__).with_name("public_names.txt")


def described():
    """Return a line for each public name, and for each method of a public class."""
    lines = []
    for name in sorted(pdavis_cv.__all__):
        value = getattr(pdavis_cv, name)
        if inspect.isclass(value):
            lines.append(f"class {name}")
            if not issubclass(value, Exception):
                lines += [f"  {name}.{member}{signature(what)}"
                          for member, what in sorted(vars(value).items())
                          if not member.startswith("_")]
        else:
            lines.append(name + signature(value))
    return lines


def signature(value):
    value = getattr(value, "__func__", value)
    return str(inspect.signature(value)) if inspect.isroutine(value) else ""


def test_public_names_and_signatures_change_only_on_purpose():
    assert described() == LIST.read_text().splitlines()


if __name__ == "__main__":
    LIST.write_text("\n".join(described()) + "\n")
