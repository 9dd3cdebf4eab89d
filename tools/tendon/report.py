"""The report of ``pdavis tendon``: one HTML file that contains all figures."""
from __future__ import annotations

import base64
import io
import json
import os
from collections.abc import Iterable, Sequence
from importlib.resources import files
from typing import Any

import numpy as np

from pdavis_cv import analysis, render
from pdavis_cv._beside import write_beside
from pdavis_cv._packages import package
from pdavis_cv._text import drawn, for_script, page_text

from .findings import Findings
from .results import clock_of, error_of, rounded, rows_of

_TOGETHER_DEG = 60.0        # largest deviation of phases that get a map of their range
_LEAST_REACH_DEG = 5.0      # smallest range of that map, so that it does not show noise
_COLOURS = ("tab:orange", "tab:blue", "tab:green", "tab:pink")
_STYLE = """
body{font:15px/1.45 system-ui,sans-serif;max-width:62em;margin:2em auto;padding:0 1em;
color:#222}h1{font-size:1.5em}h2{font-size:1.15em;margin-top:2em}img{max-width:100%}
table{border-collapse:collapse;margin:.6em 0}td,th{padding:.2em .8em;text-align:right;
border-bottom:1px solid #ddd}td:first-child,th:first-child{text-align:left}
.traces{position:relative}.traces i{position:absolute;width:1px;background:#888;
pointer-events:none}.traces pre{position:absolute;margin:0;padding:.4em .7em;
border:1px solid #bbb;background:#fffffff0;pointer-events:none}
.warn{background:#fff3cd;border-left:4px solid #e0a800;padding:.5em 1em}
pre{background:#f6f6f6;padding:1em;overflow:auto;font-size:12px}
"""


def matplotlib() -> Any:
    """Return matplotlib's Figure, or raise an error that says how to install it."""
    package("matplotlib", "the report needs matplotlib: pip install matplotlib")
    from matplotlib.figure import Figure
    return Figure


def write_report(path: str | os.PathLike[str], found: Findings) -> None:
    """Write the report; the file appears when it is complete."""
    name = str(found.facts.get("input", {}).get("name", "recording"))
    parts = [
        "<!doctype html><html lang=en><meta charset=utf-8>",
        f"<title>Tendon report</title><style>{_STYLE}</style>",
        f"<h1>Loaded sample: {page_text(name)}</h1>",
        *(f"<p class=warn>{page_text(message)}</p>" for message in found.messages),
        *(f"<p class=warn>{page_text(text)}</p>" for text in found.facts["assumed"]),
        "<h2>Load</h2>", _load_table(found),
    ]
    if found.still is not None:
        parts += ["<h2>One moment</h2>", _image(render.png_of(found.still))]
    parts += ["<h2>Mean maps</h2>", "<p>Of the mean Stokes vector of all frames; "
              "coordinates are sensor pixels.</p>", _figure(_mean_maps, found, 3.4)]
    parts += [
        "<h2>Traces</h2>", "<p>Lines: fused images, with one standard error. Dots: "
        "frames alone. Point at a curve to read its values.</p>",
        _hover(found),
        "<h2>Average cycle</h2>", "<p>Line: DoLP of the light. Dots: frames, which "
        "show its mean over their exposure.</p>", _figure(_cycle, found, 3.2),
        "<h2>Drift</h2>", _drift_table(found)]
    if any(found.loops):
        parts += ["<h2>Loop</h2>", _figure(_loop, found, 3.6)]
    if found.light.maps is not None:
        parts += ["<h2>Maps of the load's effect</h2>",
                  f"<p>Of DoLP at {found.load_hz:.4f} Hz; phase where the amplitude "
                  "exceeds three standard errors. Coordinates are sensor pixels.</p>",
                  _figure(_maps, found, 3.4)]
    facts = json.dumps(found.facts, indent=1, default=str)
    parts += ["<h2>Origin</h2>", f"<pre>{page_text(facts)}</pre></html>"]
    with write_beside(path) as part:
        part.write_text("\n".join(parts), encoding="utf-8")


def summary(found: Findings) -> tuple[list[str], dict[str, Any]]:
    """Return the results as lines of text and as facts by name."""
    lines, rows = [], rows_of(found)
    for row in rows:
        if row["note"]:
            lines.append(f"{row['region']}: DoLP {row['dolp']:.4f}, {row['note']}")
            continue
        lines.append(
            f"{row['region']}: {row['frequency_hz']:.4f} +- "
            f"{row['frequency_se_hz']:.2g} Hz, "
            f"DoLP {row['dolp']:.4f} +- {row['dolp_se']:.2g}, amplitude "
            f"{row['dolp_amplitude']:.4f} +- {row['dolp_amplitude_se']:.2g}, phase "
            f"{row['phase_deg']:.1f} +- {row['phase_se_deg']:.2g} deg at the start")
        if "lag_behind_load_deg" in row:
            lines[-1] += (
                f", {row['lag_behind_load_deg']:.1f} +- "
                f"{row['lag_behind_load_se_deg']:.2g} deg behind the load, loop area "
                f"{row['loop_area']:.3g} +- {row['loop_area_se']:.2g}")
    assumed = found.facts["assumed"]
    facts: dict[str, Any] = {"load_hz": found.load_hz, "regions": rows,
                             "messages": found.messages, "assumed": assumed}
    lines += assumed
    if found.clock is not None:
        facts["clock"] = clock_of(found)
        lines.append(f"load file: {_clock(found.clock)}")
    return lines, facts


def _table(header: Sequence[str], rows: Iterable[Sequence[Any]]) -> str:
    def cells(kind: str, row: Sequence[Any]) -> str:
        return "".join(f"<{kind}>{page_text(v)}</{kind}>" for v in row)
    return ("<table><tr>" + cells("th", header) + "</tr>"
            + "".join(f"<tr>{cells('td', row)}</tr>" for row in rows) + "</table>")


def _load_table(found: Findings) -> str:
    known = (("frequency_hz", "frequency / Hz"), ("dolp", "mean DoLP"),
             ("dolp_amplitude", "amplitude"), ("phase_deg", "phase at start / deg"),
             ("lag_behind_load_deg", "behind the load / deg"),
             ("loop_area", "loop area per cycle"),
             ("aop_deg", "mean AoP / deg"),
             ("retardance_deg", "retardance / deg"),
             ("birefringence", "birefringence"), ("note", ""))
    rows = [rounded(row) for row in rows_of(found)]
    shown = [(name, title) for name, title in known if any(
        row.get(name, "") != "" for row in rows)]
    text = _table(["region", *(title for _, title in shown)], (
        (row["region"], *(_with_error(row, name) for name, _ in shown))
        for row in rows))
    if found.clock is not None:
        text += (f"<p>Load file, aligned by {found.clock.how}: "
                 f"{_clock(found.clock)}.</p>")
    return text


def _clock(clock: analysis.Clock) -> str:
    text = f"its zero lies at {clock.offset_s:.4f} s"
    if clock.how == "offset":
        return text
    return (f"{text} (+- {1e3 * clock.offset_se_s:.2g} ms), its clock is "
            f"{clock.skew_ppm:.0f} +- {clock.skew_se_ppm:.0f} ppm slow")


def _with_error(row: dict[str, Any], name: str) -> str:
    value = row.get(name, "")
    error = row.get(error_of(name))
    return str(value) if error is None else f"{value} \u00b1 {error}"


def _drift_table(found: Findings) -> str:
    """Return the changes of S0, S1 / S0 and S2 / S0 over the recording."""
    rows = []
    for roi, fit in zip(found.fused.rois, found.light.fit.regions, strict=False):
        s0 = fit.coefficients[0, 0]
        rows.append((roi.name, *(
            f"{change / s0:+.2e} \u00b1 {error / s0:.1e}"
            for change, error in zip(fit.slope, fit.slope_se, strict=True))))
    return _table(("region", "S0", "S1", "S2"), rows) + (
        "<p>Change from the first to the last frame, as a part of the mean S0.</p>")


def _image(data: bytes, more: str = "") -> str:
    text = base64.b64encode(data).decode()
    return f'<img {more}src="data:image/png;base64,{text}">'


def _drawn(draw: Any, found: Findings, height: float) -> tuple[bytes, Any]:
    """Return a figure as PNG, and the figure itself for the positions of its axes."""
    figure = matplotlib()(figsize=(9, height), layout="constrained")
    draw(figure, found)
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=110)
    return buffer.getvalue(), figure


def _figure(draw: Any, found: Findings, height: float) -> str:
    return _image(_drawn(draw, found, height)[0])


def _hover(found: Findings) -> str:
    """Return the figure of traces, its numbers, and the script that shows them.

    The script has forty lines; a plotting library would add 4 MB to each report.
    """
    data, figure = _drawn(_traces, found, 3.0 * 3)
    panes = []
    for axes, (name, unit, turn) in zip(figure.axes, (
            ("DoLP", "", False), ("AoP", " deg", True),
            ("events", " per s", False)), strict=True):
        box = axes.get_position()
        key = {"DoLP": "dolp", "AoP": "aop", "events": "event_rate"}[name]
        lines = [
            _line(source, roi, table, found.seconds(traces.t_us), key, turn)
            for source, traces in (("", found.fused), ("frames, ", found.frames))
            if traces is not None and (traces is found.fused or key != "event_rate")
            for roi, table in zip(
                (roi.name for roi in traces.rois), traces.table, strict=True)]
        panes.append({
            "name": name, "unit": unit, "left": box.x0, "right": box.x1,
            "top": 1 - box.y1, "bottom": 1 - box.y0, "span": axes.get_xlim(),
            "lines": lines})
    script = files("pdavis_cv.tools.tendon").joinpath("hover.js").read_text("utf-8")
    return (f'<div class=traces>{_image(data, "id=traces ")}<i hidden></i>'
            "<pre hidden></pre></div>"
            f"<script>const PANES = {for_script(panes)};\n{script}</script>")


def _line(
    source: str, roi: str, table: Any, seconds: Any, key: str, turn: bool
) -> dict[str, Any]:
    """Return a trace for the script: five digits, null where there is no value."""
    def digits(values: Any) -> list[float | None]:
        return [float(f"{value:.5g}") if np.isfinite(value) else None
                for value in values]

    values = _degrees(table[key]) if turn else table[key]
    se = table[key + "_se"] if key + "_se" in table.dtype.names else None
    return {"name": source + roi, "t": [round(float(t), 6) for t in seconds],
            "values": digits(values),
            "se": None if se is None else digits(np.rad2deg(se) if turn else se)}


def _traces(figure: Any, found: Findings) -> None:
    dolp, aop, rate = figure.subplots(3, 1, sharex=True)
    t = found.seconds(found.fused.t_us)
    for i, (roi, table) in enumerate(zip(
            found.fused.rois, found.fused.table, strict=True)):
        colour = _COLOURS[i % len(_COLOURS)]
        for axes, name, turn in ((dolp, "dolp", False), (aop, "aop", True)):
            values, se = table[name], table[name + "_se"]
            if turn:  # degrees, unwrapped about the mean to avoid jumps at 0
                values, se = _degrees(values), np.rad2deg(se)
            axes.fill_between(
                t, values - se, values + se, color=colour, alpha=0.3, lw=0)
            axes.plot(t, values, color=colour, lw=1, label=drawn(roi.name))
        rate.plot(t, table["event_rate"] / 1e3, color=colour, lw=0.8)
        if found.frames is not None:
            part = found.frames.table[i]
            when = found.seconds(found.frames.t_us)
            dolp.errorbar(when, part["dolp"], part["dolp_se"], fmt="o", ms=3, lw=0.8,
                          color="0.4", label="frames" if i == 0 else None)
            aop.plot(when, _degrees(part["aop"]), "o", ms=3, color="0.4")
    dolp.set_ylabel("DoLP")
    dolp.legend(loc="upper right", fontsize=8)
    aop.set_ylabel("AoP / deg")
    rate.set_ylabel("events / ms")
    rate.set_xlabel("time / s")


def _degrees(aop: Any) -> Any:
    unit = np.exp(2j * aop)
    middle = np.angle(np.nanmean(unit))
    return np.rad2deg((np.angle(unit * np.exp(-1j * middle)) + middle) / 2)


def _cycle(figure: Any, found: Findings) -> None:
    axes, light = figure.subplots(), found.light
    place = np.mod(light.fit.law.cycles(light.t_us), 1)
    for i, (roi, stokes) in enumerate(zip(found.fused.rois, light.stokes, strict=True)):
        colour = _COLOURS[i % len(_COLOURS)]
        axes.plot(place, analysis.of_dolp(stokes.T), ".", ms=3, alpha=0.4, color=colour)
        if found.waves[i] is not None:
            curve = analysis.of_dolp(light.fit.regions[i].cycle(200))
            axes.plot(np.arange(200) / 200, curve, color=colour, label=drawn(roi.name))
    axes.set_xlabel(f"phase / cycles of {found.load_hz:.4f} Hz")
    axes.set_ylabel("DoLP")
    if any(found.waves):
        axes.legend(fontsize=8)


def _loop(figure: Any, found: Findings) -> None:
    axes = figure.subplots()
    for i, (roi, loop) in enumerate(zip(found.fused.rois, found.loops, strict=True)):
        if loop is None:
            continue
        axes.plot(np.append(loop.x, loop.x[:1]), np.append(loop.y, loop.y[:1]),
                  color=_COLOURS[i % len(_COLOURS)], label=drawn(roi.name))
    axes.set_xlabel("force / N" if "force_n" in found.extra else "displacement / mm")
    axes.set_ylabel("DoLP")
    axes.legend(fontsize=8)


def _maps(figure: Any, found: Findings) -> None:
    assert found.light.maps is not None
    wave = found.light.maps.wave(analysis.of_dolp)
    left, right = figure.subplots(1, 2)
    top = float(np.nanquantile(wave.amplitude[0], 0.99)) or 1.0
    shown = left.imshow(wave.amplitude[0], vmin=0, vmax=top, cmap="viridis",
                        extent=_extent(found))
    figure.colorbar(shown, ax=left, label="amplitude of DoLP", shrink=0.8)
    significant = wave.amplitude[0] > 3 * wave.amplitude_se
    phase, low, high, colours = _phase(wave.phase[0], significant)
    if significant.any():
        shown = right.imshow(phase, vmin=low, vmax=high, cmap=colours,
                             extent=_extent(found))
        figure.colorbar(shown, ax=right, label="phase / deg", shrink=0.8)
    else:
        right.set_box_aspect(phase.shape[0] / phase.shape[1])
        right.text(0.5, 0.5, "no pixel's amplitude exceeds\nthree standard errors",
                   ha="center", va="center", transform=right.transAxes)


def _extent(found: Findings) -> tuple[float, float, float, float]:
    """Return left, right, bottom and top of the maps in sensor pixels."""
    x, y, width, height = found.facts["roi"]
    return x, x + width, y + height, y


def _phase(phases: Any, significant: Any) -> tuple[Any, float, float, str]:
    """Return phases in degrees, the ends of their colours, and a colour map.

    Phases in a narrow range get a uniform map of that range, which may include 180;
    others a cyclic map of the whole turn.
    """
    middle = np.angle(np.mean(np.exp(1j * phases[significant]))
                      ) if significant.any() else 0.0
    off = np.rad2deg(np.angle(np.exp(1j * (phases - middle))))
    reach = float(np.quantile(np.abs(off[significant]), 0.99)
                  ) if significant.any() else 180.0
    if reach > _TOGETHER_DEG:
        return (np.where(significant, np.rad2deg(phases), np.nan), -180.0, 180.0,
                "twilight")
    reach = max(reach, _LEAST_REACH_DEG)
    centre = float(np.rad2deg(middle))
    return (np.where(significant, off + centre, np.nan), centre - reach,
            centre + reach, "viridis")


def _mean_maps(figure: Any, found: Findings) -> None:
    """Draw the maps of AoP and DoLP of the mean Stokes vector."""
    left, right = figure.subplots(1, 2)
    mean = found.light.raw_mean
    degree = analysis.of_dolp(mean)
    angle = np.rad2deg(analysis.of_aop(mean[:, None])[0])
    top = float(np.nanquantile(degree, 0.99))
    for axes, values, label, high, colours in (
            (left, angle, "mean AoP / deg", 180.0, "twilight"),
            (right, degree, "mean DoLP", top or 1.0, "viridis")):
        shown = axes.imshow(values, vmin=0, vmax=high, cmap=colours,
                            extent=_extent(found))
        figure.colorbar(shown, ax=axes, label=label, shrink=0.8)
