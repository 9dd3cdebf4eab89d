"""The scripts in studies/ find the constants that the code has."""
import importlib
import sys
from pathlib import Path

import pytest

STUDIES = Path(__file__).resolve().parent.parent / "studies"
NAMES = sorted(path.stem for path in STUDIES.glob("*.py") if path.stem != "common")
LONG = ("batch", "demosaic_constants", "demosaic_events", "event_scale",
        "lamp_detection", "constants")


@pytest.fixture
def study(monkeypatch):
    """Import a study as when it is run: its folder on the path."""
    monkeypatch.syspath_prepend(str(STUDIES))
    monkeypatch.syspath_prepend(str(STUDIES.parents[1]))    # a study's processes too
    before = set(sys.modules)
    yield lambda name: importlib.import_module(name)
    for name in set(sys.modules) - before:
        if name == "common" or name in NAMES:
            del sys.modules[name]


def test_there_are_studies():
    assert {"adaptive_gain", "denoise", "dolp_bias", "event_scale",
            "lamp_detection", "silences"} <= set(NAMES)


@pytest.mark.parametrize("name", [
    pytest.param(name, marks=pytest.mark.gate) if name in LONG else name
    for name in NAMES])
def test_quick_study_finds_what_the_code_has(study, name, capsys):
    if name == "memory" and not Path("/proc/self/statm").exists():
        pytest.skip("reads /proc")
    module = study(name)
    if hasattr(module, "study"):
        found = module.study(True)
        assert found
        assert [str(one) for one in found if not one.agrees] == []
    else:
        assert module.main(["--quick"]) == 0


def test_a_constant_that_differs_is_told(study, capsys):
    common = study("common")
    differs = common.Found("x", 1.0, 1.2, 0.1)
    assert not differs.agrees
    assert common.main(lambda quick: [differs], []) == 1
    assert "x: 1 found, 1.2 in the code must be CHANGED" in capsys.readouterr().out
    assert common.Found("x", 1.0, 1.2, at_least=True).agrees
    assert not common.Found("x", 1.0, 1.2, at_most=True).agrees
