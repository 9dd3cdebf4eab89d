"""The quantities of an image: the one list, with units, ranges and how they are drawn.

Every list of quantities is made from `QUANTITIES`: those of ``pdavis export``, stacks
and labelled arrays, outputs of `VideoCapture`, panes of the viewer, and the docs.  A
quantity stands in this table or is another package's entry point.
"""
from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from pdavis_cv.polarimetry import PolarFrame
from pdavis_cv.registry import Registry

INTENSITY = "DN/ms"
"""Unit of intensities; 1 in their range is full scale of the converter."""
_VARIANCE = "a method that knows its variance, such as kalman"
_UNIFORM = math.pi / math.sqrt(12)  # sigma of a uniformly distributed angle


@dataclass(frozen=True, kw_only=True)
class Quantity:
    """A number for each pixel of an image, and how it is drawn.

    Parameters
    ----------
    name : str
        Lower case, the same everywhere: ``--quantities``, ``output=``, datasets in
        files.  With ``_bgr`` it is the name of its picture.
    title : str
        What it is, for people.
    symbol : str
        Short form of the title; default: the name.
    plane : callable
        From a `PolarFrame` to an array of shape (H, W); None = not known of this image.
    unit : str
        ``"DN/ms"``, ``"rad"`` (shown in degrees) or ``"1"``.
    range : (float, float)
        Possible values, at the ends of its colours; of ``"DN/ms"`` in parts of the
        converter's full scale.
    colours : {"grey", "viridis", "hue", "events"}
        Grey of an intensity that is not negative follows the tone curve, with gain and
        gamma; hue goes round.
    aliases : tuple of str
        Other names that are understood.
    dtype : dtype
        Of the array; float32 in stacks, NaN = not valid.
    needs : str
        What `plane` needs, if it may return None.
    pane : bool
        Whether the viewer's page has a button for it.
    """

    name: str
    title: str
    plane: Callable[[PolarFrame], NDArray[Any] | None]
    unit: str = "1"
    range: tuple[float, float] = (0.0, 1.0)
    colours: str = "grey"
    aliases: tuple[str, ...] = ()
    dtype: DTypeLike = np.float32
    needs: str = "another method"
    pane: bool = True
    symbol: str = ""

    @property
    def of_events(self) -> bool:
        """Whether it is drawn from events, and so belongs to no image."""
        return self.colours == "events"

    @property
    def light(self) -> bool:
        """Whether it is an intensity that is not negative."""
        return self.unit == INTENSITY and self.range[0] == 0

    def of(self, frame: PolarFrame) -> NDArray[Any]:
        """Return it for an image.

        Parameters
        ----------
        frame : PolarFrame

        Returns
        -------
        ndarray of `dtype`, shape (H, W)
            May be read-only; pixels that are not valid keep their computed values.

        Raises
        ------
        ValueError
            If the method does not provide it, or `plane` returns another shape.
        """
        values = self.plane(frame)
        if values is None:
            raise ValueError(f"{self.name} needs {self.needs}")
        values = np.asarray(values, self.dtype)
        if values.shape != frame.shape:
            raise ValueError(f"{self.name} must have the image's shape {frame.shape}, "
                             f"got {values.shape}")
        return values

    def ends(self, full: float) -> tuple[float, float]:
        """Return `range`, with `full` as full scale of an intensity."""
        low, high = self.range
        return (low * full, high * full) if self.unit == INTENSITY else (low, high)

    def shown(self, white: float) -> tuple[float, float]:
        """Return `range`, or of an intensity the part of it within `white`."""
        if self.unit != INTENSITY:
            return self.range
        return max(self.range[0], -1.0) * white, min(self.range[1], 1.0) * white


def _of_attribute(name: str) -> Callable[[PolarFrame], NDArray[Any] | None]:
    return lambda frame: getattr(frame, name)


def _of_channel(index: int) -> Callable[[PolarFrame], NDArray[Any]]:
    return lambda frame: frame.quad[index]


def _stokes(name: str, title: str, low: float, high: float, **more: Any) -> Quantity:
    return Quantity(name=name, title=title, unit=INTENSITY, range=(low, high),
                    plane=_of_attribute(name), **more)


_OURS = (
    *(Quantity(name=name, title=name.upper(), plane=_of_channel(i), unit=INTENSITY,
               pane=False) for i, name in enumerate(("i0", "i45", "i90", "i135"))),
    _stokes("s0", "intensity S0", 0, 2, aliases=("intensity",),
            symbol="S0"),
    _stokes("s1", "S1", -1, 1, pane=False),
    _stokes("s2", "S2", -1, 1, pane=False),
    Quantity(name="aop", title="angle of polarization", plane=_of_attribute("aop"),
             unit="rad", range=(0, math.pi), colours="hue", aliases=("aolp",),
             symbol="AoP"),
    Quantity(name="dolp", title="degree of linear polarization", colours="viridis",
             plane=_of_attribute("dolp"), aliases=("dop",), symbol="DoLP"),
    Quantity(name="events", title="ON less OFF events", unit="events", range=(-3, 3),
             colours="events", plane=lambda frame: None,
             needs="the events since the image before: VideoCapture or the viewer"),
    Quantity(name="sigma_aop", title="standard deviation of AoP", unit="rad",
             plane=_of_attribute("sigma_aop"), range=(0, _UNIFORM), needs=_VARIANCE,
             symbol="\N{GREEK SMALL LETTER SIGMA} AoP"),
    Quantity(name="sigma_dolp", title="standard deviation of DoLP", needs=_VARIANCE,
             plane=_of_attribute("sigma_dolp"), pane=False),
    Quantity(name="dolp_debiased", title="DoLP corrected for noise", needs=_VARIANCE,
             plane=_of_attribute("dolp_debiased"), colours="viridis", pane=False),
    Quantity(name="quality", title="QUALITY", plane=_of_attribute("quality"),
             needs="events with offsets='redundancy'", pane=False),
    Quantity(name="valid", title="usable pixels, 255", range=(0, 255), dtype=np.uint8,
             pane=False,
             plane=lambda frame: frame.valid.view(np.uint8) * np.uint8(255)),
)

QUANTITIES: Registry[Quantity] = Registry(
    "quantity", {one.name: one for one in _OURS}, Quantity,
    group="pdavis_cv.quantities")
"""The quantities by name."""

GROUPS = {"quad": ("i0", "i45", "i90", "i135"), "stokes": ("s0", "s1", "s2")}
"""Names that stand for several quantities."""


def quantity(name: str) -> Quantity:
    """Return a quantity by its name or an alias, in any case.

    ValueError if there is none; ImportError if another package's cannot be used.
    """
    wanted = name.lower()
    if wanted not in QUANTITIES:
        for one in QUANTITIES.usable().values():
            if wanted in one.aliases:
                return one
    return QUANTITIES[wanted]


def chosen(names: Sequence[str]) -> tuple[Quantity, ...]:
    """Return the quantities that are asked for, a group as its members.

    One that is unknown or belongs to no image, or none at all, is a ValueError.
    """
    if isinstance(names, str) or not names:
        raise ValueError(
            f"quantities must be a sequence of at least one name, got {names!r}")
    found = [quantity(one) for name in names
             for one in GROUPS.get(name.lower(), (name,))]
    for one in found:
        if one.of_events:
            raise ValueError(f"{one.name} needs {one.needs}")
    return tuple(found)
