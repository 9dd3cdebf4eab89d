import doctest
import importlib
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]


def modules():
    names = []
    for folder, prefix in (("pdavis_cv", "pdavis_cv"), ("tools", "pdavis_cv.tools")):
        for path in sorted((ROOT / folder).rglob("*.py")):
            if path.stem == "__main__":
                continue    # to import it runs the program
            parts = path.relative_to(ROOT / folder).with_suffix("").parts
            names.append(".".join((prefix, *(p for p in parts if p != "__init__"))))
    return names


@pytest.mark.parametrize("name", modules())
def test_examples_in_docstrings_run(name):
    try:
        module = importlib.import_module(name)
    except ModuleNotFoundError as missing:
        if missing.name is None or missing.name.startswith("pdavis_cv"):
            raise
        pytest.skip(f"{missing.name} is not installed")
    if hasattr(module, "__getattr__"):  # a door; they are tested in their own modules
        for one in [n for n in vars(module) if hasattr(vars(module)[n], "__wrapped__")]:
            delattr(module, one)
    results = doctest.testmod(module, optionflags=doctest.NORMALIZE_WHITESPACE)
    assert results.failed == 0
    lines = Path(module.__file__).read_text().splitlines()
    assert results.attempted == sum(line.strip().startswith(">>> ") for line in lines)
