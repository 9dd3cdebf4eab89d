"""Pictures of `pdavis reproduce`."""
from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from .page import mean
from .rotation import (
    INTERVALS_US,
    Comparison,
    Trace,
)
from .run import METHODS, Row

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["errors", "range_figure", "rotation_figure", "style"]

_COLOURS = {
    "truth": "black", "Sony 50 fps": "tab:olive", "Sony 75 fps": "tab:brown",
    "Sony 50 fps, own times": "tab:pink", "frames": "tab:gray",
    "frames, own times": "silver", "events": "tab:purple",
    "events, redundancy": "tab:red", "cf": "tab:orange",
    "kalman causal": "tab:cyan", "kalman": "tab:blue", "kalman offline": "navy"}


def style(name: str) -> dict[str, Any]:
    """Colour and line of a method, the same in every picture."""
    line = "--" if name.startswith("Sony") else ":" if "own times" in name else "-"
    known = {"color": _COLOURS[name]} if name in _COLOURS else {}
    return {"linestyle": line, "linewidth": 1.3, **known}


def errors(
    axes: Any, rows: Sequence[Row], across: str, column: str, *, label: str,
    growth: bool = False,
) -> None:
    """Draw a column against a setting, a line per method.

    Parameters
    ----------
    axes : matplotlib.axes.Axes
    rows : sequence of Row
    across, column : str
        Columns of the rows.
    label : str
        Of the vertical axis.
    growth : bool
        Draw 100 times the difference from the lowest setting, on a linear axis.
    """
    from matplotlib.ticker import FuncFormatter

    for name in METHODS:
        mine = [row for row in rows if row.method == name]
        settings = sorted({getattr(row, across) for row in mine})
        values = np.array([mean([row for row in mine if getattr(row, across) == value],
                                column) for value in settings])
        if not np.isfinite(values).any():
            continue
        if growth:
            values = 100 * (values - values[0])
        axes.plot(settings, values, marker=".", label=name, **style(name))
    axes.set_xscale("log")
    if not growth:
        axes.set_yscale("log")
        plain = FuncFormatter(lambda value, _: f"{value:g}")
        axes.yaxis.set_major_formatter(plain)
        low, high = axes.get_ylim()
        if high < 30 * low:  # else there are too many
            axes.yaxis.set_minor_formatter(plain)
    axes.set_ylabel(label)
    axes.grid(alpha=0.3)


def _legend(drawing: Figure, axes: Any) -> None:
    drawing.legend(*axes.get_legend_handles_labels(), fontsize=9,
                   ncols=int(drawing.get_size_inches()[0] / 1.8),
                   loc="outside lower center")


def _traces(axes: Any, traces: Sequence[Trace], quantity: str) -> None:
    for trace in traces:
        values = getattr(trace, quantity)
        if quantity == "aop":
            values = np.rad2deg(values)
            # A jump from 180 to 0 is no line.
            values = np.where(np.abs(np.diff(values, prepend=values[0])) > 90,
                              np.nan, values)
        wide = {"linewidth": 3, "alpha": 0.35} if trace.method == "truth" else {}
        axes.plot((trace.t_us - trace.t_us[0]) / 1000, values,
                  **{**style(trace.method), **wide}, label=trace.method)
    axes.set_xlabel(f"ms, at {traces[0].rpm:g} RPM")
    axes.set_ylabel("AoP (degrees)" if quantity == "aop" else "DoLP")
    if quantity == "aop":
        axes.set_yticks((0, 45, 90, 135, 180))
    else:
        axes.set_ylim(-0.05, 1.4)
    axes.grid(alpha=0.3)


def rotation_figure(figure: str, result: Comparison) -> Figure:
    """Draw errors, events and traces of one scene."""
    from matplotlib.figure import Figure

    drawing = Figure(figsize=(15, 11), layout="constrained")
    axes = drawing.subplots(3, 3)
    growth = figure == "fig3"
    errors(axes[0, 0], result.rows, "rpm", "aop_error_deg",
           label="AoP error of super-pixels (degrees)")
    errors(axes[0, 1], result.rows, "rpm", "dolp_error_roi" if growth else "dolp_error",
           label="growth of the region's DoLP error (points)" if growth else
           "DoLP error of super-pixels", growth=growth)
    for each in axes[0, :2]:
        each.set_xlabel("turns per minute")
    _legend(drawing, axes[0, 0])
    _rates(axes[0, 2], result)
    speeds = sorted({trace.rpm for trace in result.traces})
    for column, rpm in zip((0, 1), (speeds[0], speeds[-1]), strict=True):
        shown = [trace for trace in result.traces if trace.rpm == rpm]
        _traces(axes[1, column], shown, "aop")
        _traces(axes[2, column], shown, "dolp")
    _intervals(axes[1, 2], result)
    _raster(axes[2, 2], result)
    drawing.suptitle(f"{figure}: {result.rotation.title}")
    return drawing


def _rates(axes: Any, result: Comparison) -> None:
    rows = [row for row in result.rows if np.isfinite(row.events_per_pixel_s)]
    speeds = sorted({row.rpm for row in rows})
    rates = [mean([row for row in rows if row.rpm == rpm], "events_per_pixel_s")
             for rpm in speeds]
    axes.loglog(speeds, rates, "o-", color="tab:green", label="events")
    axes.loglog(speeds, np.array(speeds) * rates[-1] / speeds[-1], ":", color="black",
                label="proportional to RPM")
    if np.isfinite(result.outside_hz):
        axes.axhline(result.outside_hz, color="tab:red", linestyle="--",
                     label="constant light")
    axes.set_xlabel("turns per minute")
    axes.set_ylabel("events per pixel and second")
    axes.legend(fontsize=7)
    axes.grid(alpha=0.3)


def _intervals(axes: Any, result: Comparison) -> None:
    for spectrum in result.spectra:
        part = spectrum.intervals / max(spectrum.intervals.sum(), 1)
        axes.stairs(part, INTERVALS_US / 1000, label=f"{spectrum.rpm:g} RPM")
    axes.axvline(1, color="black", linestyle=":", linewidth=1)
    axes.set_xscale("log")
    axes.set_xlim(0.05, 1000)
    axes.set_xlabel("time between a pixel's events (ms)")
    axes.set_ylabel("part of the events")
    axes.legend(fontsize=7)
    axes.grid(alpha=0.3)


def _raster(axes: Any, result: Comparison) -> None:
    ticks = []
    for k, spectrum in enumerate(result.spectra):
        t, p = spectrum.raster
        for polarity, colour, rise in ((1, "tab:green", 0.2), (0, "tab:red", -0.2)):
            axes.eventplot(t[p == polarity], lineoffsets=k + rise,
                           linelengths=0.35, linewidths=1, colors=colour)
        ticks.append(f"{spectrum.rpm:g} RPM")
    axes.set_yticks(range(len(ticks)), ticks)
    axes.set_xlabel("turns; events of one I0 pixel, ON green, OFF red")


def range_figure(figure: str, rows: Sequence[Row]) -> Figure:
    """Draw errors against speed or irradiance: a line of panels per event camera."""
    from matplotlib.figure import Figure

    across = "irradiance_uw_cm2" if figure == "dr" else "rpm"
    cameras = sorted({row.camera for row in rows if "Sony" not in row.method})
    groups = list(dict.fromkeys((row.scene, row.region) for row in rows))
    panels = [(group, "aop_error_deg", "AoP error of super-pixels (degrees)")
              for group in groups]
    if figure == "dr":
        panels.append((groups[0], "aop_range_deg", "range of AoP (degrees)"))
    drawing = Figure(figsize=(5 * len(panels), 1 + 4 * len(cameras)),
                     layout="constrained")
    grid = drawing.subplots(len(cameras), len(panels), squeeze=False)
    for line, camera in zip(grid, cameras, strict=True):
        for axes, (group, column, label) in zip(line, panels, strict=True):
            mine = [row for row in rows if (row.scene, row.region) == group
                    and (row.camera == camera or "Sony" in row.method)]
            errors(axes, mine, across, column, label=label)
            if column == "aop_range_deg":
                axes.set_yscale("linear")
                axes.set_ylim(0, 190)
            region = "" if group[1] == "all" else f", {group[1]}"
            axes.set_title(f"{group[0]}{region}; {camera}", fontsize=10)
            axes.set_xlabel("irradiance (uW/cm2)" if figure == "dr" else
                            "turns per minute")
    _legend(drawing, grid[0, 0])
    drawing.suptitle(figure)
    return drawing
