"""A reader for napari: recordings, and OME-TIFFs that `pdavis export` wrote.

napari finds it by ``napari.yaml`` beside this file.
"""
from __future__ import annotations

import json
import math
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdavis_cv import export
from pdavis_cv.fusion import fuse
from pdavis_cv.recording.open import open_recording

__all__ = ["get_reader", "read_recording", "read_stack"]

Layer = tuple[NDArray[np.float32], dict[str, Any], str]

_QUANTITIES = ("S0", "AoP", "DoLP")
_COLOURS = {"AoP": "hsv", "DoLP": "viridis"}
_LIMITS = {"AoP": (0.0, math.pi), "DoLP": (0.0, 1.0)}
_BRIGHT = 99.5  # per cent of an intensity's pixels that are not shown as white
_CREATOR = 'Creator="pdavis_cv"'


def get_reader(path: str | Sequence[str]) -> Callable[[Any], list[Layer]] | None:
    """Return what reads a file, None if it is not ours.

    Parameters
    ----------
    path : str or sequence of str
        As napari passes it; of several the first is looked at.

    Returns
    -------
    callable or None
        Takes a path and returns layers.
    """
    first = path if isinstance(path, str) else path[0]
    if not first.lower().endswith((".tif", ".tiff")):
        return read_recording
    return read_stack if _CREATOR in _description(first) else None


def read_recording(path: str | Sequence[str]) -> list[Layer]:
    """Fuse a recording, one image for each of its frames, into three layers.

    Parameters
    ----------
    path : str or sequence of str
        A recording; of several the first is read.

    Returns
    -------
    list of (ndarray, dict, str)
        S0, AoP (radians) and DoLP, float32 (T, H, W), NaN where not valid.
    """
    with open_recording(path if isinstance(path, str) else path[0]) as recording:
        images = list(fuse(recording))
    planes = {name: np.stack([
        np.where(image.valid, export.plane(image, name), np.nan) for image in images])
        for name in _QUANTITIES}
    times = [image.t_us or 0 for image in images]
    step = float(np.median(np.diff(times))) / 1e6 if len(times) > 1 else 1.0
    return [_layer(name, plane.astype(np.float32), (step, 1.0, 1.0),
                   dict(images[0].provenance)) for name, plane in planes.items()]


def read_stack(path: str | Sequence[str]) -> list[Layer]:
    """Read an OME-TIFF of `export.OmeTiffFile` into a layer per quantity.

    Parameters
    ----------
    path : str or sequence of str
        The file; of several the first is read.

    Returns
    -------
    list of (ndarray, dict, str)
        A layer per channel, float32 (T, H, W), scaled in s and um where those are
        known.
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
    size_um = float(pixels.get("PhysicalSizeX", "1"))
    scale = (float(pixels.get("TimeIncrement", "1")), size_um, size_um)
    facts = json.loads(value.text) if value is not None and value.text else {}
    names = [channel.attrib["Name"] for channel in pixels.findall("{*}Channel")]
    return [_layer(name, data[:, c], scale, facts) for c, name in enumerate(names)]


def _layer(
    name: str, data: NDArray[np.float32], scale: tuple[float, float, float],
    facts: dict[str, Any],
) -> Layer:
    limits = _LIMITS.get(name)
    if limits is None:
        usable = data[np.isfinite(data)]
        top = float(np.percentile(usable, _BRIGHT)) if usable.size else 1.0
        limits = (min(0.0, -top if name in ("S1", "S2") else 0.0), top or 1.0)
    return data, {
        "name": name, "scale": scale, "contrast_limits": limits,
        "colormap": _COLOURS.get(name, "gray"), "metadata": facts}, "image"


def _description(path: str) -> str:
    """Return the text in a TIFF's first directory, "" if there is none."""
    import tifffile
    with tifffile.TiffFile(path) as file:
        return str(file.pages[0].aspage().description or "")
