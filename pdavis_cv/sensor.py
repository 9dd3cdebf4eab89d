"""Sensors and the layouts of their polarizers."""
from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import ClassVar

from pdavis_cv._checks import typed
from pdavis_cv.errors import LayoutError, LayoutWarning

CHANNELS = (0, 45, 90, 135)
"""Polarizer angle in degrees of each plane of a (4, H, W) array."""

NOMINAL_THRESHOLDS = (0.2, 0.2)
"""Contrast thresholds ON and OFF that are assumed if none are known, ln units.

The default of v2e for DAVIS cameras (Hu, Liu, Delbruck, CVPR Workshops 2021).  Values
of cameras lie between 0.14 (Haessig et al., table S1) and about 0.4.
"""


_BAYER = {"rggb": (0, 0), "grbg": (0, 2), "gbrg": (2, 0), "bggr": (2, 2)}
"""Place of its first pixel, (row, column), in the 4x4 cell of the first one."""


def _bayer(row: int, column: int) -> str:
    """Return the colours of a 4x4 cell, by row, that begins at a place of RGGB."""
    return "".join("RGGB"[(row + r) % 4 // 2 * 2 + (column + c) % 4 // 2]
                   for r in range(4) for c in range(4))


_COLOURS = {_bayer(row, column) for row in range(4) for column in range(4)}


@dataclass(frozen=True, slots=True)
class Layout:
    """Polarizer angles of the 2x2 cell, ``angles_deg[row % 2][col % 2]``.

    Angles are in degrees, counter-clockwise as displayed with row 0 at the top,
    0 along a row, the camera looking towards the source.  Operations return the
    layout of the image after the same operation on its pixels; mirrors and turns
    also turn the angles, because the world is mirrored or turned with the image.

    Parameters
    ----------
    row0, row1 : (int, int)
        Angles of the pixels in even and in odd rows, left to right; together a
        permutation of 0, 45, 90, 135.
    owner : str, optional
        Name of the sensor whose layout this is, as of ``Layout.SONY`` and what is made
        from it; None = known by its angles only.  It does not count in comparisons.
    colours : str, optional
        Colour filters, each over 2x2 pixels: ``"RGGB"`` and so on, by row, if the
        first filter begins at the first pixel; the attribute, and what any crop has,
        are the 16 letters of the 4x4 cell by row.  None = monochrome.

    Raises
    ------
    LayoutError
        If the four angles are not a permutation of 0, 45, 90, 135, or the colours are
        none of a Bayer mosaic.

    Examples
    --------
    >>> Layout.PDAVIS.flip_x() == Layout.SONY
    True
    """

    row0: tuple[int, int]
    row1: tuple[int, int]
    owner: str | None = field(default=None, compare=False, repr=False)
    colours: str | None = None

    PDAVIS: ClassVar[Layout]
    SONY: ClassVar[Layout]

    def __post_init__(self) -> None:
        try:
            rows = tuple(tuple(int(a) for a in row) for row in (self.row0, self.row1))
            exact = all(
                a == b for row, got in zip(rows, (self.row0, self.row1), strict=True)
                for a, b in zip(row, got, strict=True))
        except (TypeError, ValueError, OverflowError):
            rows, exact = (), False
        if (not exact or [len(row) for row in rows] != [2, 2]
                or sorted(rows[0] + rows[1]) != list(CHANNELS)):
            raise LayoutError(
                "layout must hold each of 0, 45, 90, 135 degrees once in two rows of "
                f"two, got {self.row0!r}, {self.row1!r}")
        object.__setattr__(self, "row0", rows[0])
        object.__setattr__(self, "row1", rows[1])
        if self.colours is not None:
            place = _BAYER.get(self.colours.lower())
            cell = self.colours.upper() if place is None else _bayer(*place)
            if cell not in _COLOURS:
                raise LayoutError(
                    f"colours of a layout must be one of {', '.join(_BAYER)}, or the "
                    f"16 of a 4x4 cell of them, got {self.colours!r}")
            object.__setattr__(self, "colours", cell)

    @classmethod
    def of(cls, value: Layout | str) -> Layout:
        """Return a layout by its name or angles; a Layout as it is.

        Parameters
        ----------
        value : Layout or str
            ``"pdavis"``, ``"sony"``, or four angles in degrees by row, as
            ``"135,90,0,45"``; with colours after a hyphen, as ``"sony-rggb"``.

        Raises
        ------
        TypeError
            If it is neither a Layout nor a text.
        LayoutError
            If there is no such layout.

        Examples
        --------
        >>> Layout.of("135,90,0,45") == Layout.PDAVIS
        True
        """
        if isinstance(value, Layout):
            return value
        typed("layout", value, str, "a Layout or its name")
        text, hyphen, colours = value.strip().lower().partition("-")
        if hyphen:
            return replace(cls.of(text), colours=colours)
        named = {"pdavis": cls.PDAVIS, "sony": cls.SONY}.get(text)
        if named is not None:
            return named
        try:
            a, b, c, d = (int(angle) for angle in text.split(","))
        except ValueError:
            raise LayoutError(
                "layout must be pdavis, sony or four angles by row such as "
                f"135,90,0,45, got {value!r}") from None
        return cls((a, b), (c, d))

    @classmethod
    def stored(cls, angles: str, owner: object = None) -> Layout:
        """Return the layout that a file holds: four angles and perhaps its owner.

        Raises
        ------
        LayoutError
            If the angles are no layout.
        """
        found = cls.of(angles)
        known = isinstance(owner, str) and owner in SENSORS
        return replace(found, owner=str(owner) if known else None)

    @property
    def stored_angles(self) -> str:
        """The angles as a file holds them: by row, with commas, and the colours."""
        colours = self.colours and f"-{self._order}"
        return ",".join(str(angle) for angle in (*self.row0, *self.row1)) + (
            colours or "")

    @property
    def _order(self) -> str | None:
        """The colours by their short name, if they have one."""
        return next((name for name, place in _BAYER.items()
                     if _bayer(*place) == self.colours), self.colours)

    @property
    def sensor(self) -> Sensor | None:
        """The sensor whose layout this is, None if it is known by its angles only."""
        return None if self.owner is None else SENSORS[self.owner]

    @property
    def angles_deg(self) -> tuple[tuple[int, int], tuple[int, int]]:
        """The cell, ``angles_deg[row % 2][col % 2]``, in degrees."""
        return self.row0, self.row1

    @property
    def places(self) -> tuple[int, int, int, int]:
        """Position of each channel in the cell: ``2 * (row % 2) + col % 2``."""
        cell = (*self.row0, *self.row1)
        a, b, c, d = (cell.index(angle) for angle in CHANNELS)
        return a, b, c, d

    def flip_x(self, width: int = 4) -> Layout:
        """Layout after a left-right mirror (``np.fliplr``) of an image this wide."""
        return self._moved(lambda r, c: (r, width - 1 - c), -1)

    def flip_y(self, height: int = 4) -> Layout:
        """Layout after a top-bottom mirror (``np.flipud``) of an image this high."""
        return self._moved(lambda r, c: (height - 1 - r, c), -1)

    def rot90(self, k: int = 1, size: tuple[int, int] = (4, 4)) -> Layout:
        """Layout after ``np.rot90(image, k)`` (counter-clockwise).

        Parameters
        ----------
        k : int
            Number of quarter turns.
        size : (int, int)
            (height, width) of the image before turning; only parity matters, and with
            colours the rest of a division by 4.
        """
        layout, (height, width) = self, size
        for _ in range(k % 4):
            layout, height, width = layout._turned(width), width, height
        return layout

    def _turned(self, width: int) -> Layout:
        return self._moved(lambda r, c: (c, width - 1 - r), turn_deg=90)

    def crop(self, x: int, y: int) -> Layout:
        """Layout of an image whose first pixel was at column x, row y of this one."""
        return self._moved(lambda r, c: (r + y, c + x))

    def _moved(
        self, source: Callable[[int, int], tuple[int, int]], sign: int = 1,
        turn_deg: int = 0,
    ) -> Layout:
        """Return the layout of an image of which a pixel was at source(row, column)."""
        cell = self.angles_deg
        at = [source(r, c) for r in range(4) for c in range(4)]
        a, b, c, d = ((sign * cell[y % 2][x % 2] + turn_deg) % 180
                      for y, x in (at[0], at[1], at[4], at[5]))
        colours = self.colours and "".join(
            self.colours[y % 4 * 4 + x % 4] for y, x in at)
        return Layout((a, b), (c, d), self.owner, colours)

    def __str__(self) -> str:
        colours = self.colours and f" {self._order}"
        return (f"(({self.row0[0]}, {self.row0[1]}), ({self.row1[0]}, {self.row1[1]}))"
                f"{colours or ''}")


Layout.PDAVIS = Layout((135, 90), (0, 45), "pdavis")
Layout.SONY = Layout((90, 45), (135, 0), "sony")


@dataclass(frozen=True, slots=True)
class Sensor:
    """Properties of a type of sensor.

    Parameters
    ----------
    name : str
        Name of the sensor or camera.
    size : (int, int)
        (height, width) in pixels.
    layout : Layout or None
        Nominal polarizer layout; None for a chip without polarizers, or whose
        polarizers are not known.
    extinction_ratio : float or None
        Nominal ratio of largest to smallest response to linearly polarized light.
    full_scale_dn : int or None
        Largest value of the converter, None if there is none.
    pixel_um : float
        Pixel pitch in micrometres.
    mismatch : (float, float, float)
        Prior standard deviations of the pixels' relative sensitivity, angle of the
        polarizer in degrees, and extinction ratio.
    offset_dn : float
        Prior standard deviation of a pixel's offset after double sampling, DN.
    chip : str
        Name of the chip under the polarizers, as files give it; default: `name`.

    Notes
    -----
    ``mismatch`` and ``offset_dn`` are assumptions, not data: docs/theory/priors.md
    gives their origin, and the values of the cameras on which methods are scored.
    """

    name: str
    size: tuple[int, int]
    layout: Layout | None
    extinction_ratio: float | None
    full_scale_dn: int | None
    pixel_um: float
    mismatch: tuple[float, float, float] = (0.02, 0.7, 3.0)
    offset_dn: float = 2.0
    chip: str = ""

    PDAVIS: ClassVar[Sensor]
    SONY: ClassVar[Sensor]
    DAVIS346: ClassVar[Sensor]
    DAVIS240: ClassVar[Sensor]
    DVS128: ClassVar[Sensor]

    @classmethod
    def of(cls, value: Sensor | str) -> Sensor:
        """Return a sensor by its name; a Sensor as it is.

        Parameters
        ----------
        value : Sensor or str
            One of ``SENSORS``: ``"pdavis"``, ``"sony"``, ``"davis346"``, ...; or the
            full name.

        Raises
        ------
        TypeError
            If it is neither a Sensor nor a text.
        ValueError
            If there is no such sensor.
        """
        if isinstance(value, Sensor):
            return value
        typed("sensor", value, str, "a Sensor or its name")
        text = value.strip().lower()
        for key, one in SENSORS.items():
            if text in (key, one.name.lower()):
                return one
        raise ValueError(f"sensor must be one of {', '.join(SENSORS)}, got {value!r}")

    @classmethod
    def of_chip(cls, name: str | None) -> Sensor | None:
        """Return the chip that the name of a camera in a file begins with, or None."""
        text = (name or "").lower()
        return next((one for key, one in SENSORS.items()
                     if not one.chip and text.startswith(key)), None)


PDAVIS_EXTINCTION_RATIO = 40.0
# Haessig et al., "Sensor design and fabrication" and Fig. 1; IMX250MZR data sheet.
Sensor.PDAVIS = Sensor("PDAVIS", (260, 346), Layout.PDAVIS, PDAVIS_EXTINCTION_RATIO,
                       1023, 18.5, chip="DAVIS346")
Sensor.SONY = Sensor("Sony IMX250MZR", (2048, 2448), Layout.SONY, 350.0, 4095, 3.45,
                     (0.005, 0.2, 20.0), 0.5, chip="IMX250")
# Lichtsteiner et al. 2008; Brandli et al. 2014; iniVation's specifications.
Sensor.DAVIS346 = Sensor("DAVIS346", (260, 346), None, None, 1023, 18.5)
Sensor.DAVIS240 = Sensor("DAVIS240", (180, 240), None, None, 1023, 18.5)
Sensor.DVS128 = Sensor("DVS128", (128, 128), None, None, None, 40.0)

SENSORS = {"pdavis": Sensor.PDAVIS, "sony": Sensor.SONY, "davis346": Sensor.DAVIS346,
           "davis240": Sensor.DAVIS240, "dvs128": Sensor.DVS128}
"""The sensors that a caller can name."""


def resolve_layout(
    caller: Layout | None = None,
    calibration: Layout | None = None,
    recording: Layout | None = None,
    *,
    stacklevel: int = 2,
) -> Layout:
    """Return the layout to use: that of the caller, the calibration or the recording.

    Two that disagree are a LayoutError; one without colours agrees with one that has
    them.  If none is known, a LayoutWarning says that PDAVIS is assumed, and that AoP
    has an unknown zero.
    """
    known = [(name, layout) for name, layout in (
        ("layout argument", caller), ("calibration", calibration),
        ("recording", recording)) if layout is not None]
    for name, layout in known[1:]:
        first = known[0][1]
        if layout.angles_deg != first.angles_deg or (
                layout.colours and first.colours and layout != first):
            raise LayoutError(
                f"the {known[0][0]} says {first}, the {name} says {layout}: "
                "one of them is wrong")
    if known:
        found = next((one for _, one in known if one.owner), known[0][1])
        return replace(found, colours=next(
            (one.colours for _, one in known if one.colours), None))
    warnings.warn(
        f"polarizer layout unknown: assuming Layout.PDAVIS = {Layout.PDAVIS}; the "
        f"alternative is Layout.SONY = {Layout.SONY}. Until one is given "
        "(layout=...), AoP has an unknown zero.",
        LayoutWarning, stacklevel=stacklevel + 1)
    return Layout.PDAVIS
