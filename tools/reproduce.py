"""pdavis reproduce: the paper's figures 2 and 3, from a simulated camera.

Error of AoP and DoLP against the speed of rotation, for every method, with the light
in front of the camera as truth: a table (CSV), a page (Markdown) and a figure.
"""
from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pdavis_cv.export import beside
from pdavis_cv.fusion import fuse
from pdavis_cv.recording.base import Recording
from pdavis_cv.simulation import PRESETS, Camera, RotatingPolarizer, Scene, Truth
from pdavis_cv.simulation.scenes import RotatingPlate
from pdavis_cv.tools._common import Parser, command

__all__ = ["FIGURES", "main", "score"]

RPMS = (30, 60, 100, 200, 500, 1000)
# Speeds locked to the frame clock would flatter or ruin a method.
OFF_LOCK = 1.013
METHODS: dict[str, dict[str, Any]] = {
    "frames": {"method": "frames"},
    "events": {"method": "events"},
    "cf": {"method": "cf"},
    "kalman causal": {"method": "kalman", "causal": True},
    "kalman": {"method": "kalman", "thresholds": "in-situ"},
}
COLUMNS = ("method", "rpm", "aop_error_deg", "dolp_error", "events_per_pixel_s",
           "median_interval_us")
STATED = {
    "fig2": "AoP error below 5 degrees under 60 RPM for both cameras; below 10 degrees "
            "up to 1000 RPM for the methods that use events; frames alias above about "
            "100 RPM.",
    "fig3": "Growth of the DoLP error over 30 RPM: below 0.08 up to 1000 RPM for the "
            "network, over 0.5 for the frames of the Sony camera.",
}


def _polarizer(rpm: float) -> Scene:
    return RotatingPolarizer(rpm=rpm, start_angle=0.3)


def _plate(rpm: float) -> Scene:
    return RotatingPlate(rpm=rpm)


FIGURES = {"fig2": ("rotating polarizer", _polarizer),
           "fig3": ("fixed polarizer, rotating quarter-wave plate", _plate)}


def score(
    recording: Recording, truth: Truth, *, settle_us: int = 1_000_000,
    step_us: int = 1000, **parameters: Any,
) -> tuple[float, float]:
    """Return mean absolute errors over macropixels, every ``step_us`` once settled.

    Parameters
    ----------
    recording, truth
        As a `Camera` returns them.
    settle_us, step_us : int
        First time that counts, and the interval.
    **parameters
        Of `fuse`.

    Returns
    -------
    aop_error : float
        Radians, where the true DoLP exceeds 0.2.
    dolp_error : float
    """
    times = np.arange(settle_us, truth.stop_us - 60_000, step_us)
    angle, degree = truth.aop(times), truth.dolp(times)
    aop, dolp = [], []
    for image, a, d in zip(
            fuse(recording, times_us=times, demosaic="superpixel", **parameters),
            angle, degree, strict=True):
        if d > 0.2:
            aop.append(np.abs((image.aop - a + np.pi / 2) % np.pi - np.pi / 2).mean())
        dolp.append(np.abs(image.dolp - d).mean())
    return float(np.mean(aop)), float(np.mean(dolp))


@command
def main(argv: Sequence[str] | None = None) -> int:
    """Simulate, score, write; return 0."""
    parser = Parser("reproduce", (__doc__ or "").split("\n\n")[0],
                    "pdavis reproduce fig2 -o fig2 --camera nominal")
    parser.add_argument("figure", choices=sorted(FIGURES))
    parser.add_argument("-o", "--output", required=True, metavar="STEM",
                        help="writes STEM.csv, STEM.md and, with matplotlib, STEM.png "
                             "and STEM.svg")
    parser.add_argument("--camera", default="nominal", choices=sorted(
        name for name in PRESETS if PRESETS[name]["dvs"] is not None))
    parser.add_argument("--rpm", type=float, nargs="+", default=list(RPMS))
    parser.add_argument("--seed", type=int, default=1, help="which specimen")
    parser.add_argument("--seconds", type=float, default=3.0)
    parser.add_argument("--step-us", type=int, default=1000)
    args = parser.parse_args(argv)
    rows = _rows(args.figure, args.camera, args.rpm, args.seed, args.seconds,
                 args.step_us)
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(COLUMNS)
    writer.writerows([row[0], *(f"{value:.6g}" for value in row[1:])] for row in rows)
    stem = Path(args.output)
    _write(stem.with_suffix(".csv"), text.getvalue().encode())
    page = _page(args.figure, args.camera, args.seed, rows)
    _write(stem.with_suffix(".md"), page.encode())
    print(page)
    _draw(stem, args.figure, rows)
    return 0


def _rows(
    figure: str, preset: str, rpms: Sequence[float], seed: int, seconds: float,
    step_us: int,
) -> list[tuple[Any, ...]]:
    rows: list[tuple[Any, ...]] = []
    camera = Camera.preset(preset, seed=seed)
    nominal = (0.15, 0.15) if preset == "ideal" else (0.16, 0.18)
    for rpm in rpms:
        recording, truth = camera.record(FIGURES[figure][1](rpm * OFF_LOCK), seconds)
        events = np.concatenate([packet.events for packet in recording.packets()])
        pixel = events["y"].astype(np.int64) * camera.size[1] + events["x"]
        order = np.argsort(pixel, kind="stable")
        same = np.diff(pixel[order]) == 0
        interval = np.diff(events["t"][order])[same]
        rate = len(events) / seconds / (camera.size[0] * camera.size[1])
        for name, parameters in METHODS.items():
            aop, dolp = score(recording, truth, step_us=step_us,
                              nominal_thresholds=nominal, **parameters)
            rows.append((name, rpm, np.rad2deg(aop), dolp, rate,
                         float(np.median(interval)) if len(interval) else np.nan))
    return rows


def _page(figure: str, camera: str, seed: int, rows: list[tuple[Any, ...]]) -> str:
    rpms = sorted({row[1] for row in rows})
    head = " | ".join(["method", *(f"{rpm:g}" for rpm in rpms), "mean"])
    lines = [f"# {figure}: {FIGURES[figure][0]}", "",
             f"Camera `{camera}`, specimen {seed}; mean absolute error over "
             "macropixels, AoP in degrees / DoLP, by turns per minute.", "",
             f"| {head} |", "|" + "---|" * (len(rpms) + 2)]
    for name in METHODS:
        mine = [row for row in rows if row[0] == name]
        cells = [f"{row[2]:.2f} / {row[3]:.3f}" for row in mine]
        mean = np.mean([row[2:4] for row in mine], axis=0)
        lines.append(" | ".join([f"| {name}", *cells,
                                 f"{mean[0]:.2f} / {mean[1]:.3f} |"]))
    first = [row for row in rows if row[0] == "frames"]
    lines += ["", "Events per pixel and second: " + ", ".join(
        f"{row[4]:.0f}" for row in first) + "; median interval in us: " + ", ".join(
        f"{row[5]:.0f}" for row in first) + ".", "",
        f"The paper states: {STATED[figure]}", "",
        "`frames` are held from the end of their readout; `kalman causal` knows a",
        "frame when its readout ends; the others use it from its mid-exposure on.", ""]
    return "\n".join(lines)


def _draw(stem: Path, figure: str, rows: list[tuple[Any, ...]]) -> None:
    try:
        from matplotlib.figure import Figure
    except ImportError:
        print("no figure: matplotlib is missing (pip install 'pdavis-cv[plot]')")
        return
    drawing = Figure(figsize=(9, 4), layout="constrained")
    for axes, column, label in zip(
            drawing.subplots(1, 2), (2, 3), ("AoP error (degrees)", "DoLP error"),
            strict=True):
        for name in METHODS:
            mine = [row for row in rows if row[0] == name]
            axes.loglog([row[1] for row in mine], [row[column] for row in mine],
                        marker="o", label=name)
        axes.set_xlabel("turns per minute")
        axes.set_ylabel(label)
        axes.grid(alpha=0.3)
    axes.legend()
    drawing.suptitle(FIGURES[figure][0])
    for suffix in ("png", "svg"):
        picture = io.BytesIO()
        drawing.savefig(picture, format=suffix)
        _write(stem.with_suffix(f".{suffix}"), picture.getvalue())


def _write(path: Path, data: bytes) -> None:
    with beside(path) as unfinished:
        unfinished.write_bytes(data)
