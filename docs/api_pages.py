"""Write the pages of reference/ from the code: names by room, options, properties."""
import ast
import importlib
import inspect
import re
from pathlib import Path

from docutils import nodes

import pdavis_cv
from pdavis_cv.capture import constants
from pdavis_cv.fusion.options import FusionOptions
from pdavis_cv.reconstruct.methods import factory_of

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
            "analyser": "polarimetry", "mosaic": "polarimetry", "aps": "recording",
            "packed": "recording", "selfcal": "calibration"}
_INSIDE = {
    "fusion": ("fusion",), "live": ("live",), "batch": ("batch",), "data": ("data",),
    "calibration": ("calibration", "selfcal"), "analysis": ("analysis",),
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
    texts |= {"options": _options(), "opencv": _opencv()}
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
    for name in pdavis_cv.METHODS:
        made = factory_of(name)
        needs = made.needs if inspect.isclass(made) else None
        given = [key for key, value in inspect.signature(made).parameters.items()
                 if value.kind is value.KEYWORD_ONLY
                 and key not in ("theta_on", "theta_off", "response")]
        methods.append((
            f"``{name}``", *(("", "", "") if needs is None else (
                _yes(needs.events), _yes(needs.frames),
                ", ".join(sorted(needs.learned)))),
            ", ".join(f"``{key}``" for key in given)))
    return "\n".join([
        *_title("Options and methods"),
        "What ``fuse``, ``VideoCapture`` and the commands that fuse take.", "",
        *_table((2, 2, 3, 9), *rows), *_title("Methods", "-"),
        "``method=`` or ``--method``; its parameters are keyword arguments, or "
        "``--set NAME=VALUE``.", "", *_table((2, 1, 1, 2, 6), *methods)])


def _yes(value):
    return "yes" if value else "no"


def _opencv():
    """Outputs and properties of VideoCapture, from the comments of their numbers."""
    source = inspect.getsource(constants)
    found = re.findall(r"^(CAP_(?:PROP_)?PDAVIS_\w+) = (\d+) +# (.*)$", source, re.M)
    outputs = [("flag", "name", "value", "what")]
    properties = [("property", "value", "set", "what")]
    for name, number, text in found:
        if name.startswith("CAP_PROP_"):
            can = text.startswith("set: ")
            properties.append((f"``{name}``", number, _yes(can),
                               text.removeprefix("set: ")))
        else:
            outputs.append((
                f"``{name}``", f'``"{constants.NAMES_OF_OUTPUTS[int(number)]}"``',
                number, text))
    others = [name for name in constants.__all__ if name.startswith("CAP_PDAVIS_")
              and not any(name == one[0] for one in found)]
    for name in others:
        number = getattr(constants, name)
        outputs.append((f"``{name}``", f'``"{constants.NAMES_OF_OUTPUTS[number]}"``',
                        str(number), "as the one before"))
    head, *rows = outputs
    rows.sort(key=lambda row: int(row[2]))
    return "\n".join([
        *_title("OpenCV: outputs and properties"),
        "Flags of ``VideoCapture.retrieve`` and values of ``CAP_PROP_PDAVIS_OUTPUT``; "
        "the names do as well, as in ``VideoCapture(..., output=\"aop\")``.", "",
        *_table((4, 2, 1, 6), head, *rows),
        "Properties of ``get`` and ``set``, beside OpenCV's own:", "",
        *_table((5, 1, 1, 6), *properties)])
