import doctest
import importlib
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]


def modules(text=""):
    """Return the names of modules that hold a text."""
    names = []
    for folder, prefix in (("pdavis_cv", "pdavis_cv"), ("tools", "pdavis_cv.tools")):
        for path in sorted((ROOT / folder).rglob("*.py")):
            if path.stem == "__main__" or text not in path.read_text():
                continue    # to import the first runs the program
            parts = path.relative_to(ROOT / folder).with_suffix("").parts
            names.append(".".join((prefix, *(p for p in parts if p != "__init__"))))
    return names


def imported(name):
    try:
        return importlib.import_module(name)
    except ModuleNotFoundError as missing:
        if missing.name is None or missing.name.startswith("pdavis_cv"):
            raise
        return None     # another package is not installed


def test_every_module_can_be_imported():
    assert sum(imported(name) is not None for name in modules()) > 250


@pytest.mark.parametrize("name", modules(">>> "))
def test_examples_in_docstrings_run(name):
    module = imported(name)
    if module is None:
        pytest.skip("what it needs is not installed")
    if hasattr(module, "__getattr__"):  # a door; they are tested in their own modules
        for one in [n for n in vars(module) if hasattr(vars(module)[n], "__wrapped__")]:
            delattr(module, one)
    results = doctest.testmod(module, optionflags=doctest.NORMALIZE_WHITESPACE)
    assert results.failed == 0
    lines = Path(module.__file__).read_text().splitlines()
    assert results.attempted == sum(line.strip().startswith(">>> ") for line in lines)
