"""docs/theory agrees with itself, and its table of priors with the code."""
import re
from pathlib import Path

import pytest

from pdavis_cv import Sensor
from pdavis_cv.fusion.learning import MEASURED_RATIO
from pdavis_cv.pixel.learn import SPREAD
from pdavis_cv.reconstruct.cf import GAIN_FLOOR
from pdavis_cv.sensor import NOMINAL_THRESHOLDS
from pdavis_cv.simulation.populations import POPULATIONS

DOCS = Path(__file__).resolve().parent.parent / "docs"
PAGES = sorted((DOCS / "theory").glob("*.md"))
INDEX = (DOCS / "theory" / "index.md").read_text()


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_links_lead_somewhere(page):
    for target in re.findall(r"\]\(([^)#]+)(?:#[^)]*)?\)", page.read_text()):
        if "://" not in target:
            assert (page.parent / target).exists(), f"{page.name}: {target}"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_pages_are_in_the_index_and_their_references_too(page):
    assert page.stem == "index" or f"({page.name})" in INDEX
    cited = re.findall(r"\[[^\]\[(]*?([A-Z][a-z]+ \d{4})", page.read_text())
    for name in cited:
        assert f"- [{name}]" in INDEX or f"[{name}] " in page.read_text().rsplit(
            "References:", 1)[-1], f"{page.name}: {name}"


def test_the_table_of_priors_has_the_numbers_of_the_code():
    page = (DOCS / "theory" / "priors.md").read_text()
    gain, angle, ratio = Sensor.PDAVIS.mismatch

    def row(start, *values):
        line = next(line for line in page.splitlines() if line.startswith(f"| {start}"))
        cells = line.split(" | ")[1]
        assert [float(x) for x in re.findall(r"\d*\.?\d+", cells)] == list(values), line

    row("`nominal_thresholds`", *NOMINAL_THRESHOLDS)
    row("start of methods that learn", MEASURED_RATIO)
    row("`Sensor.PDAVIS.extinction_ratio`", Sensor.PDAVIS.extinction_ratio)
    row("`Sensor.PDAVIS.mismatch`", gain)
    row("the same, angle", angle)
    row("the same, extinction ratio", ratio)
    row("`Sensor.PDAVIS.offset_dn`", Sensor.PDAVIS.offset_dn)
    row("`SPREAD`", SPREAD)
    assert f"`GAIN_FLOOR` {GAIN_FLOOR}" in page


def test_the_ranges_of_drawn_cameras_are_those_of_the_page():
    page = (DOCS / "theory" / "priors.md").read_text()
    for part, name, text in (
            ("dvs", "theta_on", "{:.2f} to {:.2f}"),
            ("dvs", "cutoff_hz", "{:g} to {:g}"),
            ("aps", "offset_fpn_dn", "{:g} to {:g}"),
            ("optics", "extinction_ratio", "{:g} to {:g}")):
        limits = POPULATIONS["drawn"][part][name]
        said = text.format(limits.low, limits.high)
        assert said.replace("0.", ".") in page.replace("0.", "."), name


def test_docstrings_do_not_cite_what_is_not_here():
    root = DOCS.parent
    for folder in ("pdavis_cv", "_kernels", "tools", "tests", "lab"):
        for path in (root / folder).rglob("*.py*"):
            if path.suffix in (".py", ".pyx", ".pxd", ".pyi"):
                for cited in re.findall(r"docs/theory/[\w-]+\.md", path.read_text()):
                    assert (root / cited).exists(), f"{path.name} cites {cited}"


@pytest.fixture(scope="module")
def source():
    """Return the words of the source, and the names of its files."""
    files = [path for folder in ("pdavis_cv", "_kernels", "tools", "lab", "tests")
             for path in (DOCS.parent / folder).rglob("*")
             if path.suffix in (".py", ".pyx", ".pxd", ".pyi", ".h")
             and path.name != Path(__file__).name]
    words = {word for path in files for word in re.findall(r"\w+", path.read_text())}
    return words, {path.name for path in files}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_names_of_the_code_are_in_the_code(page, source):
    words, files = source
    named = set(re.findall(r"`([^`]+)`", page.read_text()))
    for name in named:
        if name.startswith("pdavis ") or name.rsplit("/", 1)[-1] in files:
            continue
        assert words.issuperset(re.findall(r"[A-Za-z_]\w+", name)), name
