"""The picture of `python -m lab.bench`: how time grows with events and with pixels."""
from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from matplotlib.figure import Figure


Curve = list[tuple[float, float]]
"""Positions on an axis, and the milliseconds that an image takes there."""


def draw(curves: Mapping[str, Mapping[str, Curve]]) -> Figure:
    """Draw time against each axis, both logarithmic.

    A dotted line through the last point of each curve is time in proportion to the
    axis: growth is linear at most where the curve is not below it.

    Parameters
    ----------
    curves : mapping
        Axis -> name of a case -> Curve.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(5 * len(curves), 4.5), layout="constrained")
    panels = figure.subplots(1, len(curves), squeeze=False)[0]
    for axes, (axis, by_case) in zip(panels, curves.items(), strict=True):
        for name, curve in by_case.items():
            x, y = zip(*curve, strict=True)
            line, = axes.loglog(x, y, "o-", label=name)
            axes.loglog(x, [y[-1] * each / x[-1] for each in x], ":",
                        color=line.get_color(), alpha=0.5)
        axes.set_xlabel(axis)
        axes.set_ylabel("time per image, ms")
        axes.grid(alpha=0.3)
        axes.legend()
    return figure
