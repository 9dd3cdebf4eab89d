"""The direction of dependencies: a room imports from lines below its own."""
import ast
import graphlib
from pathlib import Path

from homes import HOMES

import pdavis_cv

ROOT = Path(__file__).resolve().parents[1]

LINES = (
    ("__main__",),
    ("tools",),
    ("viewer",),
    ("adapters", "batch"),
    ("capture",),
    ("live",),
    ("fusion",),
    ("analysis", "export", "render"),
    ("calibration",),
    ("simulation",),
    ("reconstruct",),
    ("pixel",),
    ("recording",),
    ("polarimetry", "stokes_vector", "analyser", "camera_array", "steps", "turning",
     "mosaic", "colour_mosaic", "aps", "packed", "events", "quantities"),
    ("sensor", "errors", "_advice", "_arrays", "_beside", "_checks", "_opencv",
     "_door", "_options", "_packages", "_remote", "_text", "_types", "_workers", "data",
     "registry"),
    ("_kernels",),
)
LINE = {room: i for i, line in enumerate(LINES) for room in line}
MODULES = sorted(
    path for folder in ("pdavis_cv", "tools", "_kernels")
    for path in (ROOT / folder).rglob("*.py"))
TREES = {path: ast.parse(path.read_text()) for path in MODULES}


def module_of(path):
    """Return the name under which a file is imported."""
    parts = path.relative_to(ROOT).with_suffix("").parts
    parts = parts if parts[0] == "pdavis_cv" else ("pdavis_cv", *parts)
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def room_of(module):
    return module.split(".")[1] if "." in module else None


NAMES = {module_of(path) for path in MODULES}


def imported(tree, module="pdavis_cv", is_package=True):
    """Yield (line number, module) of each import of ours, lazy names resolved."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            for alias in node.names:
                if alias.name.startswith("pdavis_cv."):
                    yield node.lineno, alias.name
        elif isinstance(node, ast.ImportFrom):
            source = node.module or ""
            if node.level:
                above = module.split(".") + [""] * is_package
                source = ".".join([*above[:-node.level], source]).rstrip(".")
            if source.split(".")[0] != "pdavis_cv":
                continue
            for alias in node.names:
                whole = f"{source}.{alias.name}"
                if source == "pdavis_cv" and alias.name in HOMES:
                    yield node.lineno, f"pdavis_cv.{HOMES[alias.name]}"
                elif source != "pdavis_cv" and whole not in NAMES:
                    yield node.lineno, source
                elif alias.name != "__version__":
                    yield node.lineno, whole


def imports_of(path):
    yield from imported(TREES[path], module_of(path), path.name == "__init__.py")


def test_imports_point_down():
    upward = []
    for path in MODULES:
        room = room_of(module_of(path))
        if room is None:
            continue  # the package's own table of names
        assert room in LINE, f"{room} stands in no line of the table"
        for number, other in imports_of(path):
            other = room_of(other)
            assert other in LINE, f"{path}:{number} imports unknown room {other}"
            if LINE[other] < LINE[room]:
                upward.append(f"{path}:{number}: {room} imports {other} above it")
    assert not upward


def test_imports_are_absolute():
    relative = [f"{path}:{node.lineno}"
                for path in (ROOT / "pdavis_cv").rglob("*.py")
                for node in ast.walk(TREES[path])
                if isinstance(node, ast.ImportFrom) and node.level]
    assert not relative


def test_no_modules_of_a_room_import_each_other():
    inside = {}
    for path in MODULES:
        module = module_of(path)
        inside[module] = {other for _, other in imports_of(path)
                          if room_of(other) == room_of(module) and other != module}
    graphlib.TopologicalSorter(inside).prepare()    # CycleError names the modules


def test_the_check_sees_upward_and_circular_imports():
    tree = ast.parse("from pdavis_cv import recording_from_arrays, calibration\n"
                     "import pdavis_cv.fusion")
    assert [room_of(module) for _, module in imported(tree)] == [
        "recording", "calibration", "fusion"]
    tree = ast.parse("from .report import summary\nfrom .._common import command\n"
                     "from . import video")
    assert [module for _, module in imported(
        tree, "pdavis_cv.tools.tendon.command", is_package=False)] == [
        "pdavis_cv.tools.tendon.report", "pdavis_cv.tools._common",
        "pdavis_cv.tools.tendon.video"]


def test_kernels_know_nothing_of_the_library():
    paths = sorted((ROOT / "_kernels").glob("*.p[yx][xd]"))
    assert len(paths) > 30
    for path in paths:
        text = path.read_text()
        assert "pdavis_cv" not in text.replace("pdavis_cv._kernels", ""), path
        assert "cimport numpy" not in text, path


def test_what_is_asked_of_the_package_by_name_is_public():
    """An inner module is an attribute only once someone else has imported it."""
    asked = {(path, node.attr) for path in MODULES for node in ast.walk(TREES[path])
             if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name)
             and node.value.id == "pdavis_cv"}
    assert len(asked) > 5
    assert {(path, name) for path, name in asked
            if name not in pdavis_cv.__all__} == set()
