"""Regions of interest: rectangles, polygons, GeoJSON, files of Fiji's ROI manager."""
from __future__ import annotations

import json
import zipfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pdavis_cv._packages import package
from pdavis_cv._remote import as_path

_MOST_BYTES = 1 << 26
"""Largest size of all regions of an archive, bytes; one has a few hundred."""
_TOGETHER = 1 << 18
"""Pairs of an edge and a row that are looked at together; a choice."""
_UNSUPPORTED = ("LINE", "FREELINE", "POLYLINE", "NOROI", "ANGLE", "POINT")


@dataclass(frozen=True, eq=False)
class Roi:
    """A region in sensor pixels, row 0 at the top.

    A pixel belongs to the region if its centre, (column + 1/2, row + 1/2), lies inside.
    Overlapping rings follow the even-odd rule: a ring inside another one is a hole.

    Parameters
    ----------
    name : str
        Its name in plots and columns.
    rings : tuple of ndarray of float64, shape (N, 2)
        Corners (x, y) in pixels; the top left corner of the sensor is (0, 0).
    rectangle : (int, int, int, int), optional
        (x, y, width, height) if the region is one, else None.
    """

    name: str
    rings: tuple[NDArray[np.float64], ...]
    rectangle: tuple[int, int, int, int] | None = None

    @classmethod
    def from_rectangle(
        cls, x: int, y: int, width: int, height: int, name: str = "roi"
    ) -> Roi:
        """Return the region of ``width`` by ``height`` pixels from (x, y) on.

        Parameters
        ----------
        x, y, width, height : int
            In sensor pixels.
        name : str
            Its name in plots and columns.

        Returns
        -------
        Roi

        Raises
        ------
        ValueError
            If the region is empty.
        """
        x, y, width, height = int(x), int(y), int(width), int(height)
        if width <= 0 or height <= 0:
            raise ValueError(f"roi {name!r} must not be empty, got {width}x{height}")
        ring = np.array([(x, y), (x + width, y), (x + width, y + height),
                         (x, y + height)], np.float64)
        return cls(name, (ring,), (x, y, width, height))

    @classmethod
    def from_polygon(cls, corners: ArrayLike, name: str = "roi") -> Roi:
        """Return the region inside a closed polygon.

        Parameters
        ----------
        corners : array_like, shape (N, 2)
            (x, y) in pixels, N >= 3.
        name : str
            Its name in plots and columns.

        Returns
        -------
        Roi

        Raises
        ------
        ValueError
            If there are fewer than three corners, or one is not finite.
        """
        ring = np.array(corners, np.float64)
        if ring.ndim != 2 or ring.shape[1:] != (2,) or len(ring) < 3:
            raise ValueError(
                f"roi {name!r} must have three or more corners (x, y), got shape "
                f"{ring.shape}")
        if not np.isfinite(ring).all():
            raise ValueError(f"roi {name!r} must have finite corners")
        return cls(name, (ring,))

    @property
    def bounds(self) -> tuple[float, float, float, float]:
        """(left, top, right, bottom) in pixels."""
        corners = np.concatenate(self.rings)
        (left, top), (right, bottom) = corners.min(0), corners.max(0)
        return float(left), float(top), float(right), float(bottom)

    def mask(
        self, shape: tuple[int, int], *, origin: tuple[int, int] = (0, 0),
        scale: int = 1,
    ) -> NDArray[np.bool_]:
        """Return which pixels of an image belong to the region.

        Parameters
        ----------
        shape : (int, int)
            (height, width) of the image.
        origin : (int, int)
            (x, y) of the image's top left corner on the sensor.
        scale : int
            Sensor pixels per image pixel; 2 for super-pixel images.

        Returns
        -------
        ndarray of bool, shape (H, W)

        Raises
        ------
        ValueError
            If the region leaves the image, holds no pixel, or is a rectangle that
            cuts through super-pixels.
        """
        height, width = shape
        left, top, right, bottom = self.bounds
        x0, y0 = origin
        x1, y1 = x0 + width * scale, y0 + height * scale
        if left < x0 or top < y0 or right > x1 or bottom > y1:
            raise ValueError(
                f"roi {self.name!r} must lie inside the image (x {x0}..{x1}, y "
                f"{y0}..{y1}), got x {left:g}..{right:g}, y {top:g}..{bottom:g}")
        if self.rectangle is not None and any(
                (value - first) % scale for value, first in zip(
                    self.rectangle, (x0, y0, 0, 0), strict=True)):
            raise ValueError(
                f"roi {self.name!r} must have even x, y, width and height for "
                f"super-pixel images, got {self.rectangle}")
        rings = [(ring - origin) / scale for ring in self.rings]
        mask = _inside(rings, height, width)
        if not mask.any():
            raise ValueError(f"roi {self.name!r} must hold a pixel's centre, got none")
        return mask


def _inside(
    rings: Sequence[NDArray[np.float64]], height: int, width: int
) -> NDArray[np.bool_]:
    """Return which pixel centres are inside, by the even-odd rule."""
    crossings = np.zeros((height, width + 1), np.int64)
    rows = np.arange(height) + 0.5
    for ring in rings:
        edges = np.concatenate((ring, np.roll(ring, -1, axis=0)), axis=1)
        for part in np.array_split(edges, len(edges) * height // _TOGETHER + 1):
            low, high = np.sort(part[:, 1::2]).T[:, :, None]
            edge, row = np.nonzero((rows >= low) & (rows < high))
            xa, ya, xb, yb = part[edge].T
            x = xa + (rows[row] - ya) * (xb - xa) / (yb - ya)
            first = np.clip(np.ceil(x - 0.5), 0, width).astype(np.int64)
            np.add.at(crossings, (row, first), 1)
    return (np.cumsum(crossings, axis=1)[:, :width] % 2).astype(bool)


def parse_roi(text: str) -> list[Roi]:
    """Return the regions described by a text of the command line.

    Parameters
    ----------
    text : str
        ``x,y,width,height`` or ``x1,y1;x2,y2;x3,y3...``, each optionally after
        ``name=``, or the path of a Fiji ``.roi`` or ``.zip`` or a ``.geojson``.

    Returns
    -------
    list of Roi

    Raises
    ------
    ValueError
        If the text is none of these.
    ImportError
        If the text names a Fiji file and roifile is not installed.

    Examples
    --------
    >>> parse_roi("fibre=10,20,32,16")[0].rectangle
    (10, 20, 32, 16)
    """
    if Path(text).suffix.lower() in (".roi", ".zip", ".json", ".geojson"):
        return read_rois(text)
    name, _, numbers = text.rpartition("=")
    name = name or numbers
    try:
        corners = [[float(v) for v in part.split(",")] for part in numbers.split(";")]
    except ValueError:
        corners = []
    if len(corners) == 1 and len(corners[0]) == 4:
        if not all(v.is_integer() for v in corners[0]):
            raise ValueError(
                f"roi must have whole numbers x,y,width,height, got {text!r}")
        x, y, width, height = (int(v) for v in corners[0])
        return [Roi.from_rectangle(x, y, width, height, name)]
    if len(corners) >= 3 and all(len(corner) == 2 for corner in corners):
        return [Roi.from_polygon(corners, name)]
    raise ValueError(
        "roi must be [name=]x,y,width,height or [name=]x1,y1;x2,y2;x3,y3... or a "
        f"Fiji .roi or .zip or .geojson file, got {text!r}")


def read_rois(path: str | Path) -> list[Roi]:
    """Read the regions of a Fiji ``.roi`` or ROI manager ``.zip``, or of GeoJSON.

    Parameters
    ----------
    path : str or Path
        Rectangles, ovals, polygons, freehand and composite regions of Fiji; polygons
        of GeoJSON (QuPath), in pixels, holes included.

    Returns
    -------
    list of Roi

    Raises
    ------
    ImportError
        If roifile (extra ``[roi]``) is not installed; GeoJSON does not need it.
    ValueError
        If the file has another format, or holds a line or a point.
    OSError
        If the file cannot be read.
    """
    path = as_path(path)
    if path.suffix.lower() in (".json", ".geojson"):
        return _from_geojson(path)
    roifile = package(
        "roifile", "reading Fiji regions needs roifile: pip install roifile")
    with path.open("rb") as file:
        magic = file.read(4)
    try:
        if magic not in (b"Iout", b"PK\x03\x04"):
            raise ValueError(f"first bytes {magic!r}")
        if magic.startswith(b"PK"):
            with zipfile.ZipFile(path) as archive:
                size = sum(member.file_size for member in archive.infolist())
            if size > _MOST_BYTES:
                raise ValueError(f"{size} bytes in it, at most {_MOST_BYTES} are read")
        found = roifile.roiread(path)
    except OSError:
        raise
    except Exception as error:      # roifile may raise any
        raise ValueError(f"{path}: not a Fiji ROI file, {error}") from None
    regions = found if isinstance(found, list) else [found]
    if not regions:
        raise ValueError(f"{path}: the archive holds no ROI")
    return [_from_fiji(region, path) for region in regions]


def _from_fiji(region: Any, path: Path) -> Roi:
    name = region.name or path.stem
    kind = region.roitype.name
    if kind in _UNSUPPORTED:
        raise ValueError(f"{path}: roi {name!r} is a {kind.lower()}, which has no area")
    if kind == "RECT" and not region.composite and not region.subpixelresolution:
        return Roi.from_rectangle(
            region.left, region.top, region.right - region.left,
            region.bottom - region.top, name)
    try:
        rings = tuple(np.asarray(ring, np.float64)
                      for ring in region.coordinates(multi=True) if len(ring) >= 3)
    except Exception as error:      # roifile may raise any
        raise ValueError(f"{path}: roi {name!r} is damaged, {error}") from None
    if not rings:
        raise ValueError(f"{path}: roi {name!r} has fewer than three corners")
    if not all(np.isfinite(ring).all() for ring in rings):
        raise ValueError(f"{path}: roi {name!r} must have finite corners")
    return Roi(name, rings)


def _from_geojson(path: Path) -> list[Roi]:
    """Return the polygons of GeoJSON: a geometry, a feature, or several."""
    try:
        found = json.loads(path.read_text("utf-8-sig"))
        if isinstance(found, dict):
            found = found.get("features", [found])
        regions = []
        for i, feature in enumerate(found):
            shape = feature.get("geometry", feature)
            name = (feature.get("properties") or {}).get("name") or (
                path.stem if len(found) == 1 else f"{path.stem} {i + 1}")
            parts = shape["coordinates"]
            if shape["type"] not in ("Polygon", "MultiPolygon"):
                raise ValueError(f"{name!r} is a {shape['type']}, which has no area")
            rings = parts if shape["type"] == "Polygon" else [
                ring for part in parts for ring in part]
            regions.append(Roi(str(name), tuple(
                Roi.from_polygon(np.array(ring)[:, :2], str(name)).rings[0]
                for ring in rings)))
    except (ValueError, KeyError, TypeError, AttributeError, IndexError,
            RecursionError) as error:
        raise ValueError(f"{path}: not GeoJSON of polygons, {error}") from None
    if not regions:
        raise ValueError(f"{path}: the file holds no region")
    return regions
