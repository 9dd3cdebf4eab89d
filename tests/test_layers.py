"""The direction of dependencies: a room imports from lines below its own."""
import ast
from pathlib import Path

import pytest

import pdavis_cv

ROOT = Path(__file__).resolve().parents[1]

LINES = (
    ("tools",),
    ("viewer",),
    ("adapters", "batch"),
    ("capture",),
    ("live",),
    ("fusion",),
    ("analysis", "export", "render"),
    ("selfcal",),
    ("calibration",),
    ("simulation", "training"),
    ("reconstruct",),
    ("recording",),
    ("polarimetry", "stokes_vector", "analyser", "mosaic", "aps", "packed", "events"),
    ("sensor", "errors", "_arrays", "_beside", "_checks", "_opencv", "_remote",
     "_workers", "data"),
    ("_kernels",),
)
LINE = {room: i for i, line in enumerate(LINES) for room in line}
MODULES = sorted(
    path for folder in ("pdavis_cv", "tools", "_kernels")
    for path in (ROOT / folder).rglob("*.py"))


def room_of(path):
    parts = path.relative_to(ROOT).parts
    if parts[0] != "pdavis_cv":
        return parts[0]
    return parts[1].removesuffix(".py") if parts[1] != "__init__.py" else None


def imported_rooms(tree):
    """Yield (line number, room) of each import of ours, lazy names resolved."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            for alias in node.names:
                if alias.name.startswith("pdavis_cv."):
                    yield node.lineno, alias.name.split(".")[1]
        elif isinstance(node, ast.ImportFrom) and node.level == 0:
            parts = (node.module or "").split(".")
            if parts[0] != "pdavis_cv":
                continue
            for alias in node.names:
                if len(parts) > 1:
                    yield node.lineno, parts[1]
                elif alias.name in pdavis_cv._HOME:
                    yield node.lineno, pdavis_cv._HOME[alias.name].split(".")[0]
                elif alias.name != "__version__":
                    yield node.lineno, alias.name


@pytest.mark.parametrize("path", MODULES, ids=lambda p: str(p.relative_to(ROOT)))
def test_imports_point_down(path):
    room = room_of(path)
    if room is None:
        return  # the package's own table of names
    assert room in LINE, f"{room} stands in no line of the table"
    for number, other in imported_rooms(ast.parse(path.read_text())):
        assert other in LINE, f"{path.name}:{number} imports unknown room {other}"
        assert LINE[other] >= LINE[room], (
            f"{path.name}:{number}: {room} imports {other}, which stands above it")


@pytest.mark.parametrize("path", MODULES, ids=lambda p: str(p.relative_to(ROOT)))
def test_imports_are_absolute(path):
    if path.relative_to(ROOT).parts[0] != "pdavis_cv":
        return  # installed under another name than the folder's, which checkers see
    relative = [node.lineno for node in ast.walk(ast.parse(path.read_text()))
                if isinstance(node, ast.ImportFrom) and node.level]
    assert not relative, f"{path.name}: relative imports in lines {relative}"


def test_the_check_sees_an_upward_import():
    tree = ast.parse("from pdavis_cv import recording_from_arrays, calibration\n"
                     "import pdavis_cv.fusion")
    assert [room for _, room in imported_rooms(tree)] == [
        "recording", "calibration", "fusion"]


@pytest.mark.parametrize("path", sorted((ROOT / "_kernels").glob("*.p[yx][xd]")),
                         ids=lambda p: p.name)
def test_kernels_know_nothing_of_the_library(path):
    text = path.read_text()
    assert "pdavis_cv" not in text.replace("pdavis_cv._kernels", "")
    assert "cimport numpy" not in text
