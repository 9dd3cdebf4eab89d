"""Plugin for napari: reads recordings, and OME-TIFFs of `pdavis export`.

napari finds it through ``napari.yaml`` next to this file, and makes a widget of
`fuse_recording` from its annotations, which therefore must not be strings.
"""
import json
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from numpy.typing import NDArray

from pdavis_cv.data import example_recording
from pdavis_cv.fusion import fuse
from pdavis_cv.polarimetry import PolarFrame
from pdavis_cv.quantities import INTENSITY, QUANTITIES
from pdavis_cv.reconstruct.methods import METHODS
from pdavis_cv.recording.open import open_recording
from pdavis_cv.render import aop_bgr

if TYPE_CHECKING:
    import napari.types

Layer = tuple[NDArray[np.float32], dict[str, Any], str]

_QUANTITIES = ("s0", "aop", "dolp")
_BRIGHT = 99.5  # percentile of an intensity that is shown as white
_METHODS = ("what fits the file", *METHODS)
_LAYOUTS = ("as the file says", "pdavis", "sony")
_CREATOR = 'Creator="pdavis_cv"'


def get_reader(path: str | Sequence[str]) -> Callable[[Any], list[Layer]] | None:
    """Return a reader, from a path to layers, or None for what is not supported.

    Of several paths, the first is checked.
    """
    first = path if isinstance(path, str) else path[0]
    if not first.lower().endswith((".tif", ".tiff")):
        return read_recording
    return read_stack if _CREATOR in _description(first) else None


def read_recording(path: str | Sequence[str]) -> list[Layer]:
    """Fuse a recording, one image for each of its frames, into three layers.

    They are S0, AoP (radians) and DoLP, float32 (T, H, W), NaN where not valid.  Of
    several paths, the first is read.
    """
    with open_recording(path if isinstance(path, str) else path[0]) as recording:
        return _layers(fuse(recording))


def fan() -> list[Layer]:
    """Return the layers of the included recording of a wheel of polarizers."""
    return read_recording(str(example_recording("fan")))


def tendon() -> list[Layer]:
    """Return the layers of the included recording of a loaded tendon."""
    return read_recording(str(example_recording("tendon")))


def fuse_recording(
    recording: Path, method: Annotated[str, {"choices": _METHODS}] = _METHODS[0],
    images_per_second: float = 0.0, start_s: float = 0.0, seconds: float = 1.0,
    layout: Annotated[str, {"choices": _LAYOUTS}] = _LAYOUTS[0],
) -> "list[napari.types.LayerDataTuple]":
    """Fuse a part of a recording into layers; napari makes a widget of this function.

    Parameters
    ----------
    recording : Path
        The file.
    method : str
        One of ``METHODS``, or what fits the file.
    images_per_second : float
        0: one image for each frame.
    start_s, seconds : float
        Time of the first image after the start of the recording, and duration; all
        images are kept in memory.
    layout : str
        Name of a `Layout`, for files without polarizer layout.

    Returns
    -------
    list of (ndarray, dict, str)
        As for `read_recording`.

    Raises
    ------
    ValueError
        If there is no image in that interval.
    """
    with open_recording(
            recording, layout=None if layout == _LAYOUTS[0] else layout) as opened:
        first = opened.info.start_us or opened.scan().start_us or 0
        start = first + round(start_s * 1e6)
        return _layers(fuse(
            opened, method=None if method == _METHODS[0] else method,
            fps=images_per_second or None, start_us=start,
            stop_us=start + round(seconds * 1e6)))


def _layers(fused: Iterable[PolarFrame]) -> list[Layer]:
    images = list(fused)
    if not images:
        raise ValueError("no image lies in that part of the recording")
    planes = {name: np.stack([
        np.where(image.valid, QUANTITIES[name].of(image), np.nan) for image in images])
        for name in _QUANTITIES}
    times = [image.t_us or 0 for image in images]
    step = float(np.median(np.diff(times))) / 1e6 if len(times) > 1 else 1.0
    return [_layer(name, plane.astype(np.float32), (step, None),
                   dict(images[0].provenance)) for name, plane in planes.items()]


def read_stack(path: str | Sequence[str]) -> list[Layer]:
    """Read an OME-TIFF from `export.OmeTiffFile`, one layer per quantity.

    A layer is float32 (T, H, W), with scales in s and um if known.  Of several paths,
    the first is read.
    """
    import tifffile
    first = path if isinstance(path, str) else path[0]
    root = ElementTree.fromstring(_description(first))
    found = {name: root.find(f".//{{*}}{name}") for name in ("Pixels", "Value")}
    pixels, value = found["Pixels"], found["Value"]
    if pixels is None:
        raise ValueError(f"{first}: its OME-XML must describe pixels")
    sizes = [int(pixels.attrib[f"Size{axis}"]) for axis in "TCYX"]
    data = tifffile.imread(first).reshape(sizes)
    size_um = pixels.get("PhysicalSizeX")
    scale = (float(pixels.get("TimeIncrement", "1")),
             float(size_um) if size_um else None)
    facts = json.loads(value.text) if value is not None and value.text else {}
    names = [channel.attrib["Name"] for channel in pixels.findall("{*}Channel")]
    return [_layer(name, data[:, c], scale, facts) for c, name in enumerate(names)]


def _layer(
    name: str, data: NDArray[np.float32], scale: tuple[float, float | None],
    facts: dict[str, Any],
) -> Layer:
    """Return a layer; its scale is s per image and um per pixel, None if not known."""
    # A stack may have a quantity of a package that is not installed here.
    one = QUANTITIES.get(name) or QUANTITIES["s0"]
    top = 1.0
    if one.unit == INTENSITY:
        usable = data[np.isfinite(data)]
        top = (float(np.percentile(usable, _BRIGHT)) if usable.size else 0.0) or 1.0
    step, size_um = scale
    side = size_um or 1.0
    unit = "um" if size_um else "pixel"
    return data, {
        "name": name, "scale": (step, side, side), "units": ("s", unit, unit),
        "axis_labels": ("t", "y", "x"), "contrast_limits": one.shown(top),
        "colormap": _colormap(one.colours), "metadata": facts}, "image"


def _colormap(colours: str) -> str | dict[str, Any]:
    if colours != "hue":
        return "viridis" if colours == "viridis" else "gray"
    turn = np.linspace(0, np.pi, 257, dtype=np.float32)[None]
    return {"name": "AoP", "colors": aop_bgr(turn)[0, :, ::-1] / 255}


def _description(path: str) -> str:
    """Return the text in a TIFF's first directory, "" if there is none."""
    import tifffile
    with tifffile.TiffFile(path) as file:
        return str(file.pages[0].aspage().description or "")
