import ast
import inspect
import os
import re
import runpy
import subprocess
import sys
import tomllib
from importlib.metadata import files as installed_files
from importlib.resources import files
from pathlib import Path

import pytest
from homes import HOMES, ROOMS

import pdavis_cv
from pdavis_cv import _kernels


def test_stub_lists_every_kernel():
    tree = ast.parse(files(pdavis_cv).joinpath("_kernels.pyi").read_text())
    stubbed = {n.name for n in tree.body
               if isinstance(n, (ast.FunctionDef, ast.ClassDef))}
    stubbed |= {n.target.id for n in tree.body if isinstance(n, ast.AnnAssign)}
    assert stubbed == set(_kernels.__all__)
    for name in stubbed:
        assert hasattr(_kernels, name)


def test_the_flavour_under_test_is_the_one_asked_for():
    assert (os.environ.get("PDAVIS_CV_DEBUG", "0") != "0") == _kernels.DEBUG


def test_every_kernel_source_is_compiled(root):
    setup = ast.parse((root / "setup.py").read_text())
    listed = {n.targets[0].id: n.value for n in setup.body if isinstance(n, ast.Assign)}
    names = [name for which in ("KERNELS", "SOURCE_TREE_ONLY")
             for name in ast.literal_eval(listed[which])]
    sources = [path.stem for path in (root / "_kernels").glob("*.pyx")]
    assert sorted(sources) == sorted(names)


def test_what_benchmarks_compare_with_is_in_no_wheel():
    compiled = {path.name.partition(".")[0] for path in Path(_kernels.__file__).parent
                .iterdir() if path.suffix in (".so", ".pyd")}
    assert "_increments" in compiled
    assert ("_floor" in compiled) == ("site-packages" not in pdavis_cv.__file__)


def test_every_folder_with_code_is_packaged(root):
    project = tomllib.loads((root / "pyproject.toml").read_text())
    folders = {path.parent for top in ("pdavis_cv", "tools")
               for path in (root / top).rglob("__init__.py")}
    names = {".".join(folder.relative_to(root).parts) for folder in folders}
    names = {re.sub(r"^tools\b", "pdavis_cv.tools", name) for name in names}
    listed = project["tool"]["setuptools"]["packages"]
    assert names | {"pdavis_cv._kernels"} == set(listed)
    assert listed == sorted(listed)


def test_the_version_is_the_same_everywhere(root):
    for name, pattern in (
            ("pyproject.toml", r'^version = "(.*)"'),
            ("CITATION.cff", r"^version: (.*)"),
            (".zenodo.json", r'"version": "(.*)"'),
            ("recipe/meta.yaml", r'set version = "(.*)"')):
        found = re.search(pattern, (root / name).read_text(), re.M)
        assert found[1] == pdavis_cv.__version__, name


def test_the_recipe_requires_what_the_package_does(root):
    project = tomllib.loads((root / "pyproject.toml").read_text())["project"]
    recipe = (root / "recipe" / "meta.yaml").read_text()
    run = recipe.partition("  run:\n")[2].partition("\n\n")[0]
    assert {line.strip("- ").replace(" ", "") for line in run.splitlines()} == {
        "python", *project["dependencies"]}
    assert f"license: {project['license']}" in recipe


@pytest.mark.parametrize(("expression", "fine"), [
    ("MIT", True), ("GPL-3.0-only AND MIT", False), ("GPL-3.0-only OR MIT", True),
    ("MPL-2.0 AND MIT", False), ("(GPL-2.0-only OR MIT) AND BSD-3-Clause", True),
    ("MIT AND (GPL-2.0-only OR GPL-3.0-only)", False),
    ("Apache-2.0 WITH LLVM-exception", True), ("LicenseRef-any", False)])
def test_licences_are_parsed(root, expression, fine):
    pytest.importorskip("packaging.licenses")
    sbom = runpy.run_path(str(root / ".ci" / "sbom.py"))
    assert sbom["taken"](expression, sbom["PERMISSIVE"]) is fine


def test_every_public_name_comes_from_its_home():
    import importlib
    for name in pdavis_cv.__all__:
        value = getattr(pdavis_cv, name)
        home = HOMES.get(name)
        if home is not None:
            module = importlib.import_module(f"pdavis_cv.{home}")
            assert inspect.unwrap(getattr(module, name)) is inspect.unwrap(value)


def test_only_doors_list_their_names(root):
    listing = {path for room in ("pdavis_cv", "tools")
               for path in (root / room).rglob("*.py")
               if re.search(r"^__all__\b", path.read_text(), re.M)}
    assert {path.name for path in listing} == {"__init__.py"}


def test_an_unknown_name_is_an_attribute_error():
    with pytest.raises(AttributeError, match="no 'fuze'; did you mean fuse"):
        pdavis_cv.fuze  # noqa: B018


def test_import_loads_neither_scipy_nor_cv2_nor_numpy_submodules():
    code = ("import sys, pdavis_cv; "
            "print(*sorted({'numpy', 'scipy', 'cv2', 'tqdm'} & set(sys.modules)))")
    out = subprocess.run([sys.executable, "-P", "-c", code], check=True,
                         capture_output=True, text=True).stdout
    assert out.split() == []


def test_fusing_loads_neither_scipy_nor_cv2():
    code = ("import sys; from pdavis_cv import VideoCapture, fuse, simulation; "
            "print(*sorted({'scipy', 'cv2'} & set(sys.modules)))")
    out = subprocess.run([sys.executable, "-P", "-c", code], check=True,
                         capture_output=True, text=True).stdout
    assert out.split() == []


def test_every_shipped_datum_is_named_and_its_notice_ships(root):
    shipped = {entry.name for entry in files("pdavis_cv.data").iterdir()
               if entry.is_file() and entry.suffix not in (".py", ".pyc")}
    data = {name for name in shipped if not name.startswith("LICENSE.")}
    assert "davis346_short.aedat4" in data
    table = (root / "THIRD_PARTY.md").read_text()
    carried = {path.name for path in installed_files("pdavis-cv") or ()
               if ".dist-info" in str(path)}
    assert "THIRD_PARTY.md" in carried
    for name in data:
        row = next((row for row in table.splitlines()
                    if row.startswith("|") and f"`{name}`" in row), "")
        assert row, f"THIRD_PARTY.md does not name {name}"
        notices = re.findall(r"LICENSE\.[\w-]+", row)
        for notice in notices:
            assert notice in shipped
            assert notice in carried
        assert notices or "made by this project" in row, f"{name}: no notice"


def test_every_public_name_has_a_home_and_type_checkers_see_it():
    assert set(pdavis_cv.__all__) == {"__version__", *HOMES, *ROOMS}
    assert all(getattr(pdavis_cv, room).__name__ == f"pdavis_cv.{room}"
               for room in ROOMS)
