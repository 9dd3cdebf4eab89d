"""Tables, maps and JSON of `pdavis tendon`."""
from __future__ import annotations

import argparse
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdavis_cv import analysis, export
from pdavis_cv.analysis import of_aop, of_dolp

from .findings import Findings, Loop

FloatArray = NDArray[np.float64]

_CYCLE = 60     # points of a cycle in tables


def waves_of(
    args: argparse.Namespace, found: Findings
) -> list[dict[str, analysis.Wave] | None]:
    """Return what is periodic in each region; None where no amplitude can be told."""
    quantities: dict[str, Callable[[FloatArray], FloatArray] | None] = {
        "dolp": of_dolp, "aop": of_aop, "s0": None}
    if args.thickness_um is not None:
        def retardance(stokes: FloatArray) -> FloatArray:
            return np.arcsin(np.minimum(of_dolp(stokes), 1))

        quantities["retardance"] = retardance
        quantities["birefringence"] = lambda stokes: analysis.birefringence(
            retardance(stokes), thickness_um=args.thickness_um,
            wavelength_nm=args.wavelength_nm)
    fit = found.light.fit
    if not fit.regions:
        return [None] * len(fit.reasons)
    return [None if reason else {
        name: harmonics.wave(of, errors) for name, of in quantities.items()}
        for harmonics, reason, errors in zip(
            fit.regions, fit.reasons, found.light.errors, strict=True)]


def loop_of(found: Findings, region: int) -> Loop | None:
    """Return the loop of a region over the load, None if the load misses the frames."""
    load, clock, light = found.load, found.clock, found.light
    waves = found.waves[region]
    if load is None or clock is None or waves is None:
        return None
    at = np.rint(clock.to_us(load.t_s)).astype(np.int64)
    during = (at >= light.t_us[0]) & (at <= light.t_us[-1])
    if np.count_nonzero(during) < 4 * (1 + light.fit.harmonics + light.fit.degree):
        return None
    force = analysis.fit_harmonics(
        light.fit.law, at[during], load.primary[during, None],
        harmonics=light.fit.harmonics, degree=light.fit.degree)
    x, y = force.wave(), waves["dolp"]
    delay = 2 * np.pi * found.load_hz * float(np.nan_to_num(clock.offset_se_s))
    area, area_se = analysis.loop_area(x, y, delay)
    lag = np.angle(np.exp(1j * (x.phase[0] - y.phase[0])))
    return Loop(
        force.cycle(_CYCLE)[0], of_dolp(light.fit.regions[region].cycle(_CYCLE)),
        float(np.rad2deg(lag)), float(np.rad2deg(math.hypot(
            float(x.phase_se), float(y.phase_se), delay))), area, area_se)


def rows_of(found: Findings) -> list[dict[str, Any]]:
    """Return the results of each region: values and their standard errors by name."""
    light, rows = found.light, []
    law = light.fit.law
    for i, roi in enumerate(found.fused.rois):
        row: dict[str, Any] = {
            "region": roi.name, "pixels": int(light.pixels[i]),
            "frames": len(light.t_us)}
        waves = found.waves[i]
        if waves is None:
            mean = light.stokes[i].mean(0)
            rows.append(row | {
                "dolp": float(of_dolp(mean)), "s0_dn_per_ms": float(mean[0]),
                "aop_deg": float(np.rad2deg(of_aop(mean[:, None])[0])),
                "note": f"no amplitude: {light.fit.reasons[i]}"})
            continue
        row |= {"frequency_hz": law.hz, "frequency_se_hz": law.hz_se}
        for name, unit, turn in (
                ("dolp", "", 1.0), ("aop", "_deg", 180 / np.pi),
                ("s0", "_dn_per_ms", 1.0), ("retardance", "_deg", 180 / np.pi),
                ("birefringence", "", 1.0)):
            if name not in waves:
                continue
            wave = waves[name]
            row |= {f"{name}{unit}": turn * float(wave.mean),
                    f"{name}_se{unit}": turn * float(wave.mean_se),
                    f"{name}_amplitude{unit}": turn * float(wave.amplitude[0]),
                    f"{name}_amplitude_se{unit}": turn * float(wave.amplitude_se)}
            if name == "dolp":
                row |= {
                    "phase_deg": float(np.rad2deg(wave.phase[0])),
                    "phase_se_deg": float(np.rad2deg(
                        np.hypot(wave.phase_se, law.phase_se))),
                    "phase_reference": "cosine at the start of the recording",
                    "distortion": round(float(np.linalg.norm(
                        wave.amplitude[1:]) / wave.amplitude[0]), 4)}
        loop = found.loops[i] if found.loops else None
        if loop is not None:
            row |= {"lag_behind_load_deg": loop.lag_deg,
                    "lag_behind_load_se_deg": loop.lag_se_deg,
                    "loop_area": loop.area, "loop_area_se": loop.area_se}
        rows.append(row | {"note": ""})
    return rows


def error_of(name: str) -> str:
    """Return the name of the standard error of a result."""
    for unit in ("_deg", "_hz", "_dn_per_ms"):
        if name.endswith(unit):
            return name.removesuffix(unit) + "_se" + unit
    return name + "_se"


def rounded(row: dict[str, Any]) -> dict[str, Any]:
    """Return a row with as many digits as its standard errors allow: two of theirs."""
    out = dict(row)
    for name in row:
        error = row.get(error_of(name))
        if error is not None and np.isfinite(error):
            digits = 1 - math.floor(math.log10(error)) if error > 0 else 9
            for key in (name, error_of(name)):
                out[key] = round(row[key], digits)
    return out


def maps_of(found: Findings) -> dict[str, tuple[FloatArray, str]]:
    """Return the maps by name, each with its unit."""
    light = found.light
    mean = light.raw_mean
    maps = {"S0": (mean[0], "DN/ms"), "mean DoLP": (of_dolp(mean), ""),
            "mean AoP": (np.rad2deg(of_aop(mean[:, None])[0]), "deg")}
    if light.maps is not None:
        wave = light.maps.wave(of_dolp)
        maps |= {
            "amplitude of DoLP": (wave.amplitude[0], ""),
            "standard error of the amplitude": (wave.amplitude_se, ""),
            "phase of DoLP": (np.rad2deg(wave.phase[0]), "deg"),
            "standard error of the phase": (np.rad2deg(wave.phase_se), "deg"),
            "standard error of the mean DoLP": (wave.mean_se, "")}
    return maps


def clock_of(found: Findings) -> dict[str, Any] | None:
    """Return the load file's clock by name, None for what is not known."""
    return None if found.clock is None else {
        name: value if value == value else None
        for name, value in vars(found.clock).items()}


def write(args: argparse.Namespace, found: Findings) -> list[Path]:
    """Write all files except video and report; return their paths."""
    out, origin, facts = args.out, found.origin_us, found.facts
    rows, rois = rows_of(found), found.fused.rois
    names = list(dict.fromkeys(name for row in rows for name in row))
    names.append(names.pop(names.index("note")))
    table: dict[str, Any] = {"decimal": args.decimal}
    facts = {**facts, "hz": found.load_hz}
    written = [out / "maps.ome.tif"]
    export.write_maps(
        written[0], maps_of(found), facts={
            **facts, "smoothed_over": args.smooth, "phase": "of a cosine at the start"},
        pixel_um=args.pixel_um)
    export.write_csv(out / "results.csv", names, (
        [row.get(name, "") for name in names] for row in map(rounded, rows)),
        digits=7, **table)
    written += [out / "results.csv", out / "results.json", out / "traces.csv"]
    export.write_traces(out / "traces.csv", found.fused, origin_us=origin, facts=facts,
                        extra=found.extra, **table)
    written += export.write_jaer_csv(
        out / "traces-jaer.csv", found.fused, origin_us=origin, facts={})
    if found.frames is not None:
        written.append(out / "frames.csv")
        export.write_traces(written[-1], found.frames, origin_us=origin,
                            facts={**facts, "method": "frames"}, **table)
    phases = np.arange(_CYCLE) / _CYCLE
    cycles = {roi.name: light.cycle(_CYCLE) for roi, light in zip(
        rois, found.light.fit.regions, strict=False)}
    if cycles:
        written.append(out / "cycle.csv")
        export.write_csv(
            written[-1], ("roi", "phase_cycles", "dolp", "aop_deg"), (
                (name, *row) for name, cycle in cycles.items() for row in zip(
                    phases, of_dolp(cycle), np.rad2deg(of_aop(cycle)), strict=True)),
            digits=7, **table)
    if any(found.loops):
        written.append(out / "loop.csv")
        export.write_csv(
            written[-1], ("roi", "force_n" if "force_n" in found.extra else
                          "displacement_mm", "dolp"),
            ((roi.name, x, y) for roi, loop in zip(rois, found.loops, strict=True)
             if loop is not None for x, y in zip(loop.x, loop.y, strict=True)),
            digits=7, **table)
    export.write_json(out / "results.json", {
        "regions": rows, "messages": found.messages,
        "load_hz": found.load_hz, "load_hz_se": found.light.fit.law.hz_se,
        "harmonics": found.light.fit.harmonics,
        "clock": clock_of(found), "facts": facts})
    return written
