"""Pictures of `python -m lab.paper`."""
from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from .page import mean
from .print_style import COLUMN_IN, PAGE_IN, letters, look, new_figure
from .rotation import INTERVALS_US, Comparison, Trace
from .run import SHOWN, Row

if TYPE_CHECKING:
    from matplotlib.figure import Figure


# Limits that the paper states of its camera with events (text beside its Figs. 2 and
# 3): turns per minute, and degrees or points of DoLP.
_PAPER_AOP = ((60.0, 5.0), (1000.0, 10.0))
_PAPER_GROWTH = ((1000.0, 8.0),)
_BAND = (0.05, 0.5, 0.95)


def _quantiles(
    rows: Sequence[Row], across: str, column: str, growth: bool
) -> tuple[list[float], NDArray[np.float64]]:
    """Return settings, and 5, 50 and 95 % of the specimens at each, shape (3, N)."""
    settings = sorted({getattr(row, across) for row in rows})
    specimens = sorted({(row.seed, row.start_deg) for row in rows})
    values = np.array([[mean(
        [row for row in rows if (row.seed, row.start_deg) == specimen
         and getattr(row, across) == setting], column)
        for setting in settings] for specimen in specimens])
    if growth:
        values = 100 * (values - values[:, :1])
    known = np.isfinite(values).any(0)
    found = np.full((3, len(settings)), np.nan)
    found[:, known] = np.nanquantile(values[:, known], _BAND, axis=0)
    return settings, found


def errors(
    axes: Any, rows: Sequence[Row], across: str, column: str, *, label: str,
    scale: str = "log", growth: bool = False,
) -> None:
    """Draw a column against a setting, a line per method.

    Lines are medians of the specimens, bands their 5 to 95 %.

    Parameters
    ----------
    axes : matplotlib.axes.Axes
    rows : sequence of Row
    across, column : str
        Columns of the rows.
    label : str
        Of the vertical axis.
    scale : {"log", "linear"}
        Of the vertical axis.
    growth : bool
        Draw 100 times the difference from the lowest setting.
    """
    from matplotlib.ticker import FuncFormatter, LogLocator

    for name in SHOWN:
        mine = [row for row in rows if row.method == name]
        if not mine:
            continue
        settings, (low, middle, high) = _quantiles(mine, across, column, growth)
        if not np.isfinite(middle).any():
            continue
        axes.plot(settings, middle, label=name, **look(name))
        if (high > low).any():
            axes.fill_between(settings, low, high, color=look(name)["color"],
                              alpha=0.15, linewidth=0)
    plain = FuncFormatter(lambda value, _: f"{value:g}")
    axes.set_xscale("log")
    axes.set_yscale(scale)
    if across == "rpm":
        axes.set_xticks(sorted({row.rpm for row in rows}))
        axes.xaxis.set_major_formatter(plain)
        axes.xaxis.set_minor_formatter("")
    if scale == "log":
        bottom, top = axes.get_ylim()
        if top < 200 * bottom:  # else there are too many
            axes.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
            axes.yaxis.set_minor_formatter("")
        axes.yaxis.set_major_formatter(plain)
    axes.set_ylabel(label)


def _legend(drawing: Figure, panels: Sequence[Any]) -> None:
    """Draw one legend of all panels below, as many columns as fit."""
    handles = {label: handle for each in panels for handle, label in zip(
        *each.get_legend_handles_labels(), strict=True)}
    drawing.legend(handles.values(), handles.keys(), loc="outside lower center",
                   ncols=int(drawing.get_size_inches()[0] / 1.7))


def rotation_figure(figure: str, result: Comparison) -> Figure:
    """Draw errors against speed, and the events of the slowest and the fastest turn.

    Parameters
    ----------
    figure : {"fig2", "fig3"}
    result : Comparison

    Returns
    -------
    Figure
        Errors of super-pixels with the least that the physics allows; what the paper
        draws, with its limits; events below.
    """
    drawing = new_figure(PAGE_IN, 5.4)
    panels = drawing.subplots(2, 3)
    letters(panels.reshape(-1))
    first, second, third = panels[0]
    rows = result.rows
    errors(first, rows, "rpm", "aop_error_deg", label="AoP error (degrees)")
    first.set_title("super-pixels")
    _bounds(first, result, "aop_deg")
    if figure == "fig3":
        errors(second, rows, "rpm", "dolp_error", label="DoLP error")
        second.set_title("super-pixels")
        _bounds(second, result, "dolp")
        errors(third, rows, "rpm", "dolp_error_roi", scale="linear", growth=True,
               label="growth of DoLP error (points)")
        _limits(third, _PAPER_GROWTH, "paper, network: less")
    else:
        errors(second, rows, "rpm", "aop_error_roi_deg", label="AoP error (degrees)")
        second.set_title("mean of the region")
        _bounds(second, result, "aop_deg", region=True)
        _limits(second, _PAPER_AOP, "paper, with events: less")
        errors(third, rows, "rpm", "dolp_roi", scale="linear", label="DoLP")
        third.axhline(1, color="black", linewidth=0.8, label="truth")
    third.set_title("mean of the region")
    for each in panels[0]:
        each.set_xlabel("turns per minute")
    _legend(drawing, panels[0])
    _rates(panels[1, 0], result)
    _intervals(panels[1, 1], result)
    _raster(panels[1, 2], result)
    drawing.suptitle(result.rotation.title)
    return drawing


def _bounds(axes: Any, result: Comparison, what: str, region: bool = False) -> None:
    """Draw the least errors, AoP or DoLP, and a band of their standard error.

    Those of the event camera are black, those of the Sony camera as grey as its frames.
    """
    for camera, colour, label in (
            ("event camera", "black", "bound, not calibrated"),
            ("Sony 50 fps", "#777777", "bound, Sony not calibrated")):
        mine = [each for each in result.limits if each.camera == camera]
        if not mine:
            continue
        speeds = [each.rpm for each in mine]
        bounds = [each.optics.of_region(each.pixels) if region else each.optics
                  for each in mine]
        least = np.array([getattr(bound, what) for bound in bounds])
        spread = np.array([bound.aop_spread_deg if what == "aop_deg" else
                           bound.dolp_spread for bound in bounds])
        if not region:
            spread /= np.sqrt([each.pixels for each in mine])
        spread /= np.sqrt(max(1, result.specimens))
        axes.plot(speeds, least, color=colour, linestyle=(0, (5, 1)), label=label)
        axes.fill_between(speeds, np.maximum(least - spread, least / 10),
                          least + spread, color=colour, alpha=0.2, linewidth=0)
        if camera == "event camera" and not region:
            axes.plot(speeds, [getattr(each.frame, what) for each in mine],
                      color="0.45", linestyle=(0, (4, 1, 1, 1, 1, 1)),
                      label="bound, one frame")


def _limits(axes: Any, stated: Sequence[tuple[float, float]], label: str) -> None:
    """Draw what the paper states as arrows that point below it."""
    for rpm, most in stated:
        axes.plot(rpm, most, marker="_", color="black", markersize=9, linestyle="",
                  markeredgewidth=1.2)
        axes.annotate("", (rpm, most), (0, -10), textcoords="offset points",
                      arrowprops={"arrowstyle": "<-", "linewidth": 0.9})
    axes.plot([], [], marker="_", color="black", linestyle="", label=label)


def traces_figure(result: Comparison) -> Figure:
    """Draw AoP and DoLP over time, a line of panels per method, truth behind."""
    names = [trace.method for trace in result.traces if trace.method != "truth"]
    names = list(dict.fromkeys(names))
    speeds = sorted({trace.rpm for trace in result.traces})
    drawing = new_figure(PAGE_IN, 0.7 + 0.75 * len(names))
    grid = drawing.subplots(len(names), 2 * len(speeds), sharex="col", squeeze=False)
    by_name = {(trace.method, trace.rpm): trace for trace in result.traces}
    columns = [(quantity, rpm) for quantity in ("aop", "dolp") for rpm in speeds]
    for axes, (name, (quantity, rpm)) in zip(
            grid.reshape(-1), ((name, column) for name in names for column in columns),
            strict=True):
        trace = by_name.get((name, rpm))
        if trace is None:
            axes.set_axis_off()
            continue
        truth = by_name["truth", rpm]
        start_us = int(truth.t_us[0])
        axes.set_xlim(0, (truth.t_us[-1] - start_us) / 1000)
        _trace(axes, truth, start_us, quantity, color="0.78", linewidth=3.0)
        _trace(axes, trace, start_us, quantity, linewidth=0.9,
               color="black" if "Sony" in name else look(name)["color"])
        if axes in grid[0]:
            axes.set_title(("AoP (°)" if quantity == "aop" else "DoLP")
                           + f", {rpm:g} RPM")
        if axes in grid[-1]:
            axes.set_xlabel("time (ms)")
    for axes, name in zip(grid[:, 0], names, strict=True):
        axes.set_ylabel(name.replace(", ", ",\n"), rotation=0, ha="right", va="center")
    letters(grid[0])
    drawing.suptitle(f"{result.rotation.title}; grey: truth")
    return drawing


def _trace(axes: Any, trace: Trace, start_us: int, quantity: str, **line: Any
           ) -> None:
    values = getattr(trace, quantity)
    if quantity == "aop":
        values = np.rad2deg(values)
        # A jump from 180 to 0 is no line.
        values = np.where(np.abs(np.diff(values, prepend=values[0])) > 90,
                          np.nan, values)
    axes.plot((trace.t_us - start_us) / 1000, values, **line)
    if quantity == "aop":
        axes.set_yticks((0, 90, 180))
        axes.set_ylim(-5, 185)
    else:
        axes.set_ylim(-0.05, 1.4)
        axes.set_yticks((0, 0.5, 1))


def _rates(axes: Any, result: Comparison) -> None:
    rows = [row for row in result.rows if np.isfinite(row.events_per_pixel_s)]
    speeds = sorted({row.rpm for row in rows})
    rates = [mean([row for row in rows if row.rpm == rpm], "events_per_pixel_s")
             for rpm in speeds]
    axes.loglog(speeds, rates, "o-", color="#009E73")
    axes.loglog(speeds, np.array(speeds) * rates[-1] / speeds[-1], ":", color="black")
    axes.annotate("dotted: in proportion", (speeds[-1], rates[-1]), (0, 7),
                  textcoords="offset points", ha="right")
    for rate, dashes, told in ((result.outside_hz, "--", "constant light"),
                               (result.denoised_hz, ":", "the same, denoised")):
        if np.isfinite(rate) and rate > 0:
            axes.axhline(rate, color="#D55E00", linestyle=dashes)
            axes.annotate(told, (speeds[-1], rate), (0, 3),
                          textcoords="offset points", ha="right")
    axes.set_xticks(speeds, [f"{rpm:g}" for rpm in speeds])
    axes.xaxis.set_minor_formatter("")
    axes.set_ylim(top=10 * max(rates))
    axes.set_xlabel("turns per minute")
    axes.set_ylabel("events per pixel and second")


def _intervals(axes: Any, result: Comparison) -> None:
    for spectrum, line in zip(result.spectra, ("-", "--"), strict=False):
        part = spectrum.intervals / max(spectrum.intervals.sum(), 1)
        axes.stairs(part, INTERVALS_US / 1000, label=f"{spectrum.rpm:g} RPM",
                    linestyle=line)
    axes.axvline(1, ymax=0.78, color="black", linestyle=":", linewidth=0.8)
    axes.set_xscale("log")
    axes.set_xlim(0.05, 1000)
    axes.set_xlabel("time between a pixel's events (ms)")
    axes.set_ylabel("part of the events")
    axes.set_ylim(0, 1.2 * axes.get_ylim()[1])  # room for the legend
    axes.legend(loc="upper center", ncols=2, handlelength=1.2, columnspacing=0.8)


def _raster(axes: Any, result: Comparison) -> None:
    ticks = []
    for k, spectrum in enumerate(result.spectra):
        t, p = spectrum.raster
        for polarity, colour, rise in ((1, "#009E73", 0.2), (0, "#D55E00", -0.2)):
            axes.eventplot(t[p == polarity], lineoffsets=k + rise,
                           linelengths=0.35, linewidths=0.6, colors=colour)
            ticks.append((k + rise, f"{'ON' if polarity else 'OFF'}, "
                                    f"{spectrum.rpm:g} RPM"))
    axes.set_yticks(*zip(*ticks, strict=True))
    axes.set_xlabel("turns; events of one I0 pixel")
    axes.grid(visible=False)


def range_figure(figure: str, rows: Sequence[Row]) -> Figure:
    """Draw errors against speed or irradiance: a line of panels per event camera."""
    across = "irradiance_uw_cm2" if figure == "dr" else "rpm"
    cameras = sorted({row.camera for row in rows if "Sony" not in row.method})
    groups = list(dict.fromkeys((row.scene, row.region) for row in rows))
    panels = [(group, "aop_error_deg", "AoP error of super-pixels (degrees)")
              for group in groups]
    if figure == "dr":
        panels.append((groups[0], "aop_error_roi_deg", "AoP error, region (degrees)"))
    drawing = new_figure(PAGE_IN if len(panels) > 1 else COLUMN_IN,
                         0.9 + 2.4 * len(cameras))
    grid = drawing.subplots(len(cameras), len(panels), squeeze=False)
    letters(grid.reshape(-1))
    for line, camera in zip(grid, cameras, strict=True):
        for axes, (group, column, label) in zip(line, panels, strict=True):
            mine = [row for row in rows if (row.scene, row.region) == group
                    and (row.camera == camera or "Sony" in row.method)]
            errors(axes, mine, across, column, label=label)
            region = "" if group[1] == "all" else f", {group[1]}"
            axes.set_title(f"{group[0]}{region}"
                           + (f"\n{camera} camera" if len(cameras) > 1 else ""))
            axes.set_xlabel("irradiance (µW/cm²)" if figure == "dr" else
                            "turns per minute")
    _legend(drawing, [grid[0, 0]])
    return drawing
