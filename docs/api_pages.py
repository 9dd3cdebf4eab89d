"""Write the pages of reference/ from the code: names by room, options, properties."""
import ast
import importlib
import inspect
import re
from pathlib import Path

import numpy as np
from docutils import nodes

import pdavis_cv
from pdavis_cv.capture import constants
from pdavis_cv.capture.outputs import output_at, outputs
from pdavis_cv.fusion.options import FusionOptions
from pdavis_cv.quantities import GROUPS

ROOMS = {
    "fusion": "Fusing", "capture": "OpenCV's manners", "recording": "Recordings",
    "live": "Live sources", "viewer": "Viewer", "batch": "Many recordings",
    "adapters": "Adapters", "polarimetry": "Polarimetry",
    "events": "Events", "reconstruct": "Methods", "calibration": "Calibration",
    "analysis": "Analysis", "render": "Pictures", "export": "Export",
    "simulation": "Simulation", "data": "Included recordings",
    "errors": "Errors and warnings"}
"""Rooms of the house that have a page each, and its title."""

_PAGE_OF = {"sensor": "polarimetry", "stokes_vector": "polarimetry",
            "analyser": "polarimetry", "quantities": "polarimetry",
            "mosaic": "polarimetry", "aps": "recording", "packed": "recording"}
_INSIDE = {
    "fusion": ("fusion",), "live": ("live",), "batch": ("batch",), "data": ("data",),
    "calibration": ("calibration",), "analysis": ("analysis",),
    "render": ("render",), "export": ("export",), "simulation": ("simulation",)}
"""Modules whose public names a page has beside those of `pdavis_cv`."""
_PLUGINS = ("imageio_plugin", "napari_plugin", "pims_reader")
"""Modules of adapters that import a package which may be missing."""
_STUB = Path(pdavis_cv.__file__).with_suffix(".pyi")


def skip_node():
    """Return what tells docutils that a node has been written."""
    return nodes.SkipNode()


def write(folder):
    """Write all pages that differ from what is there."""
    folder.mkdir(exist_ok=True)
    texts = {room: _room(room) for room in ROOMS}
    texts |= {"options": _options(), "opencv": _opencv(), "quantities": _quantities()}
    for name, text in texts.items():
        path = folder / f"{name}.rst"
        if not path.exists() or path.read_text() != text:
            path.write_text(text)


def _title(text, mark="="):
    return [text, mark * len(text), ""]


def _room(room):
    lines = _title(ROOMS[room])
    top = [alias.name for node in ast.parse(_STUB.read_text()).body
           if isinstance(node, ast.ImportFrom) and node.module
           and _page(node.module.split(".")[0]) == room for alias in node.names]
    lines += _names("pdavis_cv", top)
    seen = {id(getattr(pdavis_cv, name)) for name in pdavis_cv.__all__}
    for inner in _INSIDE.get(room, ()):
        module = importlib.import_module(f"pdavis_cv.{inner}")
        inside = [name for name in module.__all__
                  if id(getattr(module, name)) not in seen]
        lines += [inspect.getdoc(module), ""]
        lines += _names(f"pdavis_cv.{inner}", inside)
    if room == "adapters":
        for plugin in _PLUGINS:
            lines += [
                f".. automodule:: pdavis_cv.adapters.{plugin}", "   :members:", ""]
    return "\n".join(lines)


def _page(home):
    page = _PAGE_OF.get(home, home)
    return page if page in ROOMS else "fusion"


def _names(module, names):
    lines = [f".. currentmodule:: {module}", ""]
    for name in sorted(names, key=str.lower):
        value = getattr(importlib.import_module(module), name)
        if inspect.isclass(value):
            lines += [f".. autoclass:: {name}", "   :members:", ""]
        elif inspect.isroutine(value):
            lines += [f".. autofunction:: {name}", ""]
    return lines


def _table(widths, *rows):
    lines = [".. list-table::", f"   :widths: {' '.join(map(str, widths))}",
             "   :header-rows: 1", ""]
    for row in rows:
        lines += [f"   {'-' if i else '* -'} {cell}".replace("   -", "     -", 1)
                  for i, cell in enumerate(row)]
    return [*lines, ""]


def _options():
    """Options of fuse() and their forms on the command line, and the methods."""
    rows = [("option", "on the command line", "type", "meaning")]
    for name, facts in FusionOptions.facts().items():
        flag = "--" + name.removesuffix("_us").replace("_", "-")
        rows.append((f"``{name}``", f"``{flag}``" if facts.word else "",
                     facts.type, facts.help))
    methods = [("method", "uses events", "uses frames", "learns", "parameters")]
    for name, made in pdavis_cv.METHODS.usable().items():
        needs = made.needs if inspect.isclass(made) else None
        given = [key for key, value in inspect.signature(made).parameters.items()
                 if value.kind is value.KEYWORD_ONLY
                 and key not in ("theta_on", "theta_off", "response")]
        methods.append((
            f"``{name}``", *(("", "", "") if needs is None else (
                _yes(needs.events), _yes(needs.frames),
                ", ".join(sorted(needs.learned)))),
            ", ".join(f"``{key}``" for key in given)))
    sources = [("address", "what may follow the question mark, and its default")]
    for scheme, opener in pdavis_cv.SOURCES.usable().items():
        sources.append((f"``{scheme}:``", ", ".join(
            f"``{key}={value.default}``"
            for key, value in inspect.signature(opener).parameters.items()
            if value.kind is value.KEYWORD_ONLY)))
    return "\n".join([
        *_title("Options and methods"),
        "What ``fuse``, ``VideoCapture`` and the commands that fuse take.", "",
        *_table((2, 2, 3, 9), *rows), *_title("Methods", "-"),
        "``method=`` or ``--method``; its parameters are keyword arguments, or "
        "``--set NAME=VALUE``.", "", *_table((2, 1, 1, 2, 6), *methods),
        *_title("Live addresses", "-"), *_table((2, 10), *sources)])


def _quantities():
    """Everything that an image has, from the one table."""
    rows = [("name", "also", "what", "unit", "range", "drawn in", "array")]
    for one in pdavis_cv.QUANTITIES.usable().values():
        rows.append((
            f"``{one.name}``", ", ".join(f"``{each}``" for each in one.aliases),
            one.title, one.unit, " to ".join(f"{end:.4g}" for end in one.range),
            one.colours, np.dtype(one.dtype).name))
    return "\n".join([
        *_title("Quantities"),
        "Names mean the same in ``pdavis export --quantities``, stacks, arrays of "
        "xarray, ``VideoCapture(output=...)`` and the viewer; ``_bgr`` after a name "
        "is its picture.  " + ", ".join(
            f"``{name}`` stands for {', '.join(members)}"
            for name, members in GROUPS.items())
        + ".  Ranges of intensities are in parts of the converter's full scale.", "",
        *_table((3, 2, 5, 1, 3, 2, 2), *rows)])


def _yes(value):
    return "yes" if value else "no"


def _opencv():
    """Outputs of VideoCapture, and properties from the comments of their numbers."""
    source = inspect.getsource(constants)
    properties = [("property", "value", "set", "what")]
    for name, number, text in re.findall(
            r"^(CAP_PROP_PDAVIS_\w+) = (\d+) +# (.*)$", source, re.M):
        properties.append((f"``{name}``", number, _yes(text.startswith("set: ")),
                           text.removeprefix("set: ")))
    flags = {getattr(constants, name): f"``{name}``" for name in vars(constants)
             if name.startswith("CAP_PDAVIS_")}
    rows = [("flag", "name", "value", "what")]
    for number, name in enumerate(outputs()):
        one = output_at(number)
        rows.append((
            flags.get(number, ""), f'``"{name}"``', str(number),
            ("picture of " if one.picture else "")
            + ", ".join(each.title for each in one.quantities)
            + (", faded where DoLP is low" if one.faded else "")))
    return "\n".join([
        *_title("OpenCV: outputs and properties"),
        "Flags of ``VideoCapture.retrieve`` and values of ``CAP_PROP_PDAVIS_OUTPUT``; "
        "the names do as well, as in ``VideoCapture(..., output=\"aop\")``.", "",
        *_table((4, 3, 1, 6), *rows),
        "Properties of ``get`` and ``set``, beside OpenCV's own:", "",
        *_table((5, 1, 1, 6), *properties)])
