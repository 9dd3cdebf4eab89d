"""The site: `make docs`.  Sphinx, as NumPy, SciPy and scikit-image use it.

numpydoc reads the docstrings as they are, MyST the pages as they show on a code host.
Nothing is fetched by a reader's browser: formulas are MathML, fonts the system's.
The pages of reference/ are written from the code by `api_pages.py`.
"""
import re
import shutil
import sys
from pathlib import Path

import latex2mathml.converter

import pdavis_cv

HERE = Path(__file__).parent
LAB = HERE.parent / "lab" / "docs"
sys.path.insert(0, str(HERE))

import api_pages  # noqa: E402  (beside this file)

project = "pdavis_cv"
author = "the authors of pdavis_cv"
version = release = pdavis_cv.__version__
extensions = ["myst_parser", "numpydoc", "sphinx.ext.autodoc"]
myst_enable_extensions = ["dollarmath"]
myst_heading_anchors = 3
numpydoc_show_class_members = False
default_role = "py:obj"      # as numpydoc has single backticks
autodoc_mock_imports = ["imageio", "pims"]
autodoc_typehints = "none"
autodoc_member_order = "groupwise"
html_theme = "furo"
html_title = f"pdavis_cv {version}"
html_math_renderer = "mathml"
html_copy_source = False
html_static_path = ["_static"]
html_css_files = ["math.css"]
html_extra_path = ["fan.webm", "tendon.webm"]

PARTS = {
    "Tutorials": ["start/opencv", "start/notebook", "start/microscopy",
                  "start/robotics", "start/any-camera", "start/turning",
                  "start/sony", "start/jaer-dv", "start/calibration"],
    "How to": ["tools", "recipes", "applications", "calibration", "score",
               "demosaicing", "batch", "live", "formats", "promises", "glossary"],
    "Reference": ["reference/options", "reference/opencv", "reference/quantities", *(
        f"reference/{room}" for room in api_pages.ROOMS)],
    "Theory": ["theory/index"],
    "Evidence": ["lab/index", *sorted(
        f"lab/{path.stem}" for path in LAB.glob("*.md") if path.stem != "index")],
    "Development": ["architecture"],
}
"""Pages of each part, in order; `index` stays readable without Sphinx."""


def add_contents(_app, name, source):
    """Append the tables of contents that Sphinx wants to the pages that lead.

    The site has the pages of `lab/docs` in a folder of its own.
    """
    source[0] = re.sub(r"\]\(\.\./((?:\.\./)*)lab/docs/", r"](\1lab/", source[0])
    source[0] = source[0].replace("](../../docs/", "](../")
    if name == "index":
        for title, pages in PARTS.items():
            source[0] += toctree(pages, title)
    elif name == "theory/index":
        pages = sorted(path.stem for path in (HERE / "theory").glob("*.md"))
        source[0] += toctree([page for page in pages if page != "index"])


def toctree(pages, title=None):
    """Return a hidden table of contents in MyST."""
    caption = [f":caption: {title}"] if title else []
    return "\n".join(["", "```{toctree}", ":hidden:", *caption, "", *pages, "```", ""])


def inline(self, node):
    """Write a formula within a line."""
    self.body.append(latex2mathml.converter.convert(node.astext()))
    raise api_pages.skip_node()


def block(self, node):
    """Write a formula on its own."""
    self.body.append(latex2mathml.converter.convert(node.astext(), display="block"))
    raise api_pages.skip_node()


def setup(app):
    """Connect what is here."""
    api_pages.write(HERE / "reference")
    shutil.copytree(LAB, HERE / "lab", dirs_exist_ok=True)
    app.connect("source-read", add_contents)
    app.add_html_math_renderer("mathml", (inline, None), (block, None))
