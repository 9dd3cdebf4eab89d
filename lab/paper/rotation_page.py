"""Words of figures 2 and 3: tables, limits, and the paper's words beside ours."""
from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from .bound import Bound
from .page import mean, pivot, table
from .rotation import Comparison
from .run import NETWORKS, OFF_LOCK, Settings

_USE_EVENTS = ("events", "cf", "firenet", "joint", "kalman")


def page(figure: str, results: Sequence[Comparison], settings: Settings,
         head: Sequence[str] | None = None) -> list[str]:
    """Return the Markdown of a figure: tables, and the paper's words beside ours."""
    cameras = sorted({row.camera for r in results for row in r.rows if "Sony" not in
                      row.method})
    lines = list(head) if head is not None else [
             f"# {figure}", "",
             f"Cameras: {', '.join(cameras)}; {settings.told_specimens}. Mean "
             "absolute errors, AoP in degrees where the true DoLP exceeds 0.2, by "
             f"turns per minute (times {OFF_LOCK}: none is locked to the frame clock), "
             "from 1 s on. Thresholds are those that the maker would state.", ""]
    for result in results:
        for camera in cameras:
            rows = [row for row in result.rows
                    if row.camera == camera or "Sony" in row.method]
            lines += [f"## {result.rotation.title}, `{camera}` camera", "",
                      "Super-pixels: AoP / DoLP.", "",
                      *pivot(rows, "rpm", ("aop_error_deg", "dolp_error")),
                      "Mean of the region: AoP / DoLP.", "",
                      *pivot(rows, "rpm", ("aop_error_roi_deg", "dolp_error_roi")),
                      "Part of the errors within one sigma (honest: 0.68): AoP / "
                      "DoLP.", "",
                      *pivot(rows, "rpm", ("aop_coverage", "dolp_coverage"))]
        lines += [*_limits_table(result), *_events_table(result)]
    stated = _stated2(results[0]) if figure == "fig2" else _stated3(results)
    lines += ["## Beside the paper", "",
              *table(("quantity", "paper", "here", ""), stated),
              "Frames are held from the end of their readout, and `own times` at "
              "their mid-exposure: held ones are wrong because they are late, those "
              "because they are blurred. `kalman causal` knows a frame when its "
              "readout ends; other methods use it from its mid-exposure on. Sony "
              "cameras are simulated: 12 bits, extinction ratio 350, 20 ms exposure "
              "(13.3 ms at 75 fps), the same part of the converter's range. The paper "
              "gives its errors in pictures and states limits, which the pictures "
              "here have as arrows.", ""]
    if any(row.method in NETWORKS for result in results for row in result.rows):
        lines += ["`firenet` and `joint` are the networks that come with the package: "
                  "the paper's and one over four channels, trained on simulated "
                  "textures, polarizers, retarders and wheels (lab/docs/networks.md), "
                  "not on these recordings and not anew for them, without the paper's "
                  "calibration per speed. They see events only, of 40 x 40 pixels, of "
                  "which the middle 12 x 12 count, and are scored at the ends of their "
                  "windows, 1/25 of a period, once their memory has settled.", ""]
    return lines


def _limits_table(result: Comparison) -> list[str]:
    """Return least errors, AoP in degrees / DoLP, by speed; whether any is beaten."""
    if not result.limits:
        return []
    speeds = list(dict.fromkeys(each.rpm for each in result.limits))
    rows = []
    for camera in dict.fromkeys(each.camera for each in result.limits):
        mine = [each for each in result.limits if each.camera == camera]
        rows += [
            (f"{camera}, any method, not calibrated",
             *(_least(each.optics) for each in mine)),
            *([(f"{camera}, mean of {mine[0].pixels} super-pixels",
                *(_least(each.optics.of_region(each.pixels)) for each in mine))]
              if camera == "event camera" else []),
            (f"{camera}, one frame's noise, all of the camera known",
             *(_least(each.frame) for each in mine)),
            (f"{camera}, held frames: delay and blur alone",
             *("{:.2f} / {:.3f}".format(*each.held) for each in mine))]
    beaten = below_bound(result)
    return ["What physics says of super-pixels (docs/theory/limits.md): the least "
            "errors, and those of ideal frames that are held. AoP / DoLP.", "",
            *table(("", *(f"{rpm:g}" for rpm in speeds)), rows),
            "Below the bound of their own camera by more than its standard error: "
            + ("; ".join(beaten) or "none") + ".", ""]


def _least(bound: Bound) -> str:
    return f"{bound.aop_deg:.2f} / {bound.dolp:.3f}"


def below_bound(result: Comparison) -> list[str]:
    """Name methods and speeds that beat the bound by more than its standard error.

    There should be none: super-pixels' mean errors over all specimens are compared with
    the least ones of a camera that is not calibrated.
    """
    found = []
    for name in dict.fromkeys(row.method for row in result.rows):
        for each in result.limits_of(name):
            mine = [row for row in result.rows
                    if (row.method, row.rpm) == (name, each.rpm)]
            count, bound = each.pixels * result.specimens, each.optics
            for column, least, error in (
                    ("aop_error_deg", bound.aop_deg, bound.aop_error_deg(count)),
                    ("dolp_error", bound.dolp, bound.dolp_error(count))):
                if mine and mean(mine, column) < least - error:
                    found.append(f"{name}, {each.rpm:g} RPM, {column} "
                                 f"{mean(mine, column):.3f} < {least:.3f}")
    return found


def _events_table(result: Comparison) -> list[str]:
    rows = [row for row in result.rows if row.method == "kalman"] or [
        row for row in result.rows if np.isfinite(row.events_per_pixel_s)]
    speeds = sorted({row.rpm for row in rows})
    per = [[row for row in rows if row.rpm == rpm] for rpm in speeds]
    return ["Events.", "", *table(
        ("", *(f"{rpm:g}" for rpm in speeds)),
        [("events per pixel and second",
          *(f"{mean(each, 'events_per_pixel_s'):.1f}" for each in per)),
         ("median interval, ms",
          *(f"{mean(each, 'median_interval_us') / 1000:.2f}" for each in per))])]


def _over(result: Comparison, column: str, methods: Sequence[str],
          rpms: Callable[[float], bool] = lambda rpm: True) -> str:
    """Return the worst speed's mean of each method, as text."""
    parts = []
    for name in methods:
        mine = [row for row in result.rows if row.method == name and rpms(row.rpm)]
        by_speed = [mean([row for row in mine if row.rpm == rpm], column)
                    for rpm in {row.rpm for row in mine}]
        if np.isfinite(by_speed).any():
            digits = 1 if column.endswith("_deg") else 3
            parts.append(f"{name} {max(by_speed):.{digits}f}")
    return "; ".join(parts) or "-"


def _exponent(result: Comparison) -> str:
    power = _power_of_rate(result)
    return "-" if math.isnan(power) else f"rate ~ RPM^{power:.3f}"


def _power_of_rate(result: Comparison) -> float:
    """Return d ln(rate less noise) / d ln(rpm)."""
    rows = [row for row in result.rows if np.isfinite(row.events_per_pixel_s)]
    speeds = sorted({row.rpm for row in rows})
    rates = [mean([row for row in rows if row.rpm == rpm], "events_per_pixel_s")
             - np.nan_to_num(result.outside_hz) for rpm in speeds]
    if len(speeds) < 2 or min(rates) <= 0:
        return math.nan
    return float(np.polyfit(np.log(speeds), np.log(rates), 1)[0])


# Why a method is beyond what the paper states, where it is.
_WHY: Mapping[str, str] = {
    "Sony 50 fps": "held frames are late; at their own times they agree",
    "frames": "held frames are late; at their own times they agree",
    "events": "its high pass of 0.5 Hz turns slow light ahead",
    "cf": "its 1.6 Hz corner turns slow light",
}
Stated = tuple[str, str, str, str]


def _worst(result: Comparison, column: str, name: str,
           rpms: Callable[[float], bool]) -> float:
    mine = [row for row in result.rows if row.method == name and rpms(row.rpm)]
    return max((mean([row for row in mine if row.rpm == rpm], column)
                for rpm in {row.rpm for row in mine}), default=math.nan)


def _within(result: Comparison, column: str, methods: Sequence[str], most: float,
            rpms: Callable[[float], bool] = lambda rpm: True) -> str:
    """Say whether the worst speed's means lie below a limit, and if not, why."""
    beyond = [name for name in methods
              if _worst(result, column, name, rpms) >= most]
    if not beyond:
        return "agrees"
    told = "; ".join(f"{name}: {_WHY[name]}" if name in _WHY else name
                     for name in beyond)
    return f"agrees, but for {told}"


def _stated2(result: Comparison) -> list[Stated]:
    at, low = "aop_error_roi_deg", min(row.rpm for row in result.rows)

    def slow(rpm: float) -> bool:
        return rpm <= 60

    def slowest(rpm: float) -> bool:
        return rpm == low

    both = ("Sony 50 fps", "Sony 50 fps, own times", "frames", "frames, own times",
            *_USE_EVENTS)
    held = ("Sony 50 fps", "Sony 75 fps", "frames")
    fast = [error for name in held if math.isfinite(
        error := _worst(result, at, name, lambda rpm: rpm > 100))]
    with_dolp = ("Sony 50 fps", "frames", "cf", "firenet", "joint", "kalman")
    off = {name: error for name in with_dolp if math.isfinite(
        error := _worst(result, "dolp_error_roi", name, lambda rpm: True))}
    framed, fused = ([off[name] for name in names if name in off] for names in (
        ("frames", "Sony 50 fps"), ("cf", "firenet", "kalman")))
    return [
        ("AoP error to 60 RPM, both cameras, region's mean", "< 5 degrees",
         _over(result, at, both, slow), _within(result, at, both, 5, slow)),
        ("AoP error to 1000 RPM with events, region's mean", "< 10 degrees",
         _over(result, at, _USE_EVENTS), _within(result, at, _USE_EVENTS, 10)),
        ("frames above 100 RPM", "alias and blur", _over(
            result, at, held, lambda rpm: rpm > 100) + " degrees at worst",
         "-" if not fast else _agrees(min(fast) > 10)),
        ("DoLP of a polarizer at low speed", "nearly 1", _over(
            result, "dolp_error_roi", with_dolp, slowest) + " from 1",
         _within(result, "dolp_error_roi", with_dolp, 0.1, slowest)),
        ("DoLP to 1000 RPM", "events keep it beyond the frames' Nyquist limit", _over(
            result, "dolp_error_roi", ("Sony 50 fps", "frames", *_USE_EVENTS))
         + " from 1",
         "-" if not (framed and fused) else _agrees(max(fused) < min(framed) / 2)),
        ("event rate", "grows with RPM", _exponent(result),
         _agrees(abs(_power_of_rate(result) - 1) < 0.1)),
        ("event rate outside the polarizer", "< 1 Hz per pixel after denoising",
         "-" if np.isnan(result.outside_hz) else
         f"{result.denoised_hz:.3f} Hz under constant light, before denoising "
         f"{result.outside_hz:.2f}", _agrees(result.denoised_hz < 1)),
    ]


def _agrees(yes: object) -> str:
    return "agrees" if yes else "differs"


def _grown(result: Comparison, name: str) -> float:
    """Return the growth of the region's DoLP error from the lowest speed, points."""
    mine = [row for row in result.rows if row.method == name]
    by_speed = [mean([row for row in mine if row.rpm == rpm], "dolp_error_roi")
                for rpm in sorted({row.rpm for row in mine})]
    return 100 * (max(by_speed) - by_speed[0]) if len(by_speed) > 1 else math.nan


def _growth(result: Comparison, methods: Sequence[str]) -> str:
    found = {name: _grown(result, name) for name in methods}
    return "; ".join(f"{name} {points:+.1f}" for name, points in found.items()
                     if math.isfinite(points)) or "-"


def _of_sony(result: Comparison) -> str:
    """Say what blur and delay alone make a Sony's DoLP error grow by."""
    grown, told = _grown(result, "Sony 50 fps"), []
    if grown > 50:
        return "agrees"
    mine = result.limits_of("Sony 50 fps")
    if mine:
        held = [100 * each.held[1] for each in mine]
        told = [f"theory of 20 ms and of delay alone: {max(held) - held[0]:+.1f} points"
                f"; of the light's mean DoLP, {mine[0].mean_dolp:.2f}, it is "
                f"{grown / mine[0].mean_dolp:.0f} %, if that is the paper's measure"]
    return "; ".join(["differs in points", *told])


def _stated3(results: Sequence[Comparison]) -> list[Stated]:
    lines: list[Stated] = []
    for result in results:
        name, power = result.rotation.name, _power_of_rate(result)
        networks = [each for each in NETWORKS
                    if math.isfinite(_grown(result, each))]
        beyond = [each for each in networks if _grown(result, each) >= 8]
        lines += [
            (f"growth of the DoLP error from the lowest speed, worst speed, {name}",
             "< 8 points for the network", _growth(result, _USE_EVENTS) + " points",
             "-" if not networks else "agrees" if not beyond else
             f"{', '.join(beyond)} differs: our weights"),
            (f"the same of frames, {name}", "> 50 for the Sony", _growth(
                result, ("Sony 50 fps", "Sony 75 fps", "frames")) + " points",
             _of_sony(result)),
            (f"event rate, {name}", "directly proportional to RPM", _exponent(result),
             _agrees(abs(power - 1) < 0.1)),
            *_structure(result)]
    return lines


def _structure(result: Comparison) -> list[Stated]:
    name = result.rotation.name
    ends = sorted(result.spectra, key=lambda spectrum: spectrum.rpm)
    if len(ends) < 2:
        return []
    slow, fast = ends[0], ends[-1]
    alike = np.corrcoef(slow.by_phase.reshape(-1), fast.by_phase.reshape(-1))[0, 1]
    return [
        (f"interval between a pixel's events at {fast.rpm:g} RPM, {name}",
         "down to less than 1 ms",
         f"{100 * fast.below_1ms:.0f} % below 1 ms ({100 * slow.below_1ms:.1f} % at "
         f"{slow.rpm:g} RPM)", _agrees(fast.below_1ms > 0.1)),
        (f"ON and OFF events per I0 pixel and turn, {name}",
         "similar structure at 30 and 1000 RPM",
         f"ON {slow.per_turn[1]:.0f} and {fast.per_turn[1]:.0f}, OFF "
         f"{slow.per_turn[0]:.0f} and {fast.per_turn[0]:.0f}; correlation over the "
         f"turn {alike:.2f}", _agrees(alike > 0.7))]
