"""Make pictures and videos from the sample recording and from simulated cameras.

The sample is a piece of a real DAVIS346 recording; that camera has no polarizers.
An ideal camera looks at a polarizer that turns at 200 RPM, a camera with the faults of
a real one at 1000 RPM, where frames are blurred and stale; the true angle is shown, and
the error of the reconstructed one is printed.
"""
from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pdavis_cv import PolarFrame, aop, export, fuse, render
from pdavis_cv.data import example_recording
from pdavis_cv.recording.base import Recording
from pdavis_cv.render.colours import Picture
from pdavis_cv.simulation import (
    Camera,
    RotatingPolarizer,
    Truth,
    rotating_polarizer,
)

from . import export as export_tool
from ._common import Parser, command

__all__ = ["axial_difference", "main", "mean_aop"]

RPM, FAST_RPM = 200, 1000
METHODS = ("frames", "cf")
NO_POLARIZERS = "this camera has no polarizers: AoP and DoLP are noise"


@command
def main(argv: Sequence[str] | None = None) -> int:
    """Run ``pdavis demo``."""
    parser = Parser("demo", __doc__ or "", "pdavis demo -o demo")
    parser.add_argument(
        "-o", "--out", type=Path, default=Path("demo"), metavar="FOLDER",
        help="where to write; default demo")
    folder = parser.parse_args(argv).out
    render.opencv()
    folder.mkdir(parents=True, exist_ok=True)
    code = _sample(folder)
    if code == 0:
        _polarizer(folder, "ideal", RPM, rotating_polarizer(RPM, 1.0),
                   thresholds=(0.15, 0.15), shown_us=1_000_000)
        # 1.3 % more, lest the turn keeps step with the frames.
        scene = RotatingPolarizer(rpm=1.013 * FAST_RPM)
        camera = Camera.preset("nominal")
        _polarizer(folder, "nominal", FAST_RPM, camera.record(scene, 1.0),
                   thresholds=(0.16, 0.18), shown_us=200_000)
        print(f"The results are in {folder.resolve()}")
    return code


def _sample(folder: Path) -> int:
    path = example_recording()
    common = [str(path), "--layout", "pdavis", "--title", NO_POLARIZERS]
    stem = folder / path.stem
    return (
        export_tool.main([*common, "--fps", "200", "--slow", "10",
                          "-o", f"{stem}.mp4"])
        or export_tool.main([*common, "--at", "0.15", "-o", f"{stem}.png"]))


def _polarizer(
    folder: Path, camera: str, rpm: int, recorded: tuple[Recording, Truth], *,
    thresholds: tuple[float, float], shown_us: int,
) -> None:
    """Film a rotating polarizer and hold the results against the truth.

    The error is that of one second; its last ``shown_us`` are shown.
    """
    recording, truth = recorded
    times = np.arange(0, 1_000_000, 1000)
    strips = {"truth": truth.aop(times)}
    titles = {"truth": f"truth: {rpm} RPM, {shown_us / 1e6:g} s from left to right"}
    images: dict[str, list[PolarFrame]] = {}
    for method in METHODS:
        images[method] = list(fuse(
            recording, method=method, times_us=times, thresholds=thresholds))
        # A pixel that has drifted below the floor is not usable; its neighbours are.
        seen = np.array([2 * frame.valid.mean() > 1 for frame in images[method]])
        strips[method] = np.array([
            mean_aop(frame) if usable else np.nan
            for frame, usable in zip(images[method], seen, strict=True)])
        error = np.rad2deg(np.mean(
            axial_difference(strips[method], strips["truth"])[seen]))
        titles[method] = f"{method}: mean error {error:.1f} degrees"
        print(f"{camera} polarizer at {rpm} RPM, {method}: "
              f"AoP error {error:.1f} degrees")
    shown = slice(len(times) - shown_us // 1000, None)
    times = times[shown]
    strips = {name: strip[shown] for name, strip in strips.items()}
    path = folder / f"polarizer_{rpm}rpm.png"
    export.write_png(path, _strips(strips, titles))
    print(f"wrote {path}: AoP over time")
    path = folder / f"polarizer_{rpm}rpm.mp4"
    with export.VideoFile(path, 25) as video:
        step = 4 * shown_us // 1_000_000 or 1  # ms from image to image, at 25 fps
        title = (f"AoP of a polarizer turning at {rpm} RPM, {camera} camera   "
                 f"{40 / step:g} x slower than life")
        for i in range(0, len(times), step):
            video.add(_dials(i, times, strips, title))
    print(f"wrote {path}: the same, {40 / step:g} times slower")


def _strips(strips: dict[str, NDArray[np.float64]], titles: dict[str, str]
            ) -> Picture:
    rows = [render.panel(
        render.aop_bgr(np.broadcast_to(strip, (56, len(strip)))), titles[name],
        legend="aop" if name == METHODS[-1] else None)
        for name, strip in strips.items()]
    return render.tile([render.stack(rows, gap=6)], columns=1)


def _dials(i: int, times: NDArray[np.int64], strips: dict[str, NDArray[np.float64]],
           title: str) -> Picture:
    panels = [render.panel(_dial(strip[i]), name, legend="aop")
              for name, strip in strips.items()]
    return render.tile(
        panels, columns=len(panels),
        title=f"{title}   t = {times[i] / 1e6:.3f} s")


def _dial(angle: float, side: int = 240) -> Picture:
    """Fill a square with an angle's colour and draw the angle as a line."""
    picture = render.aop_bgr(np.full((side, side), angle))
    if np.isfinite(angle):
        middle, reach = side / 2, 0.42 * side
        dx, dy = reach * np.cos(angle), -reach * np.sin(angle)
        cv2 = render.opencv()
        ends = [(round(middle + sign * dx), round(middle + sign * dy))
                for sign in (-1, 1)]
        cv2.line(picture, *ends, (0, 0, 0), 3, cv2.LINE_AA)
    return picture


def mean_aop(frame: PolarFrame) -> float:
    """Return the angle of the mean S1, S2 of an image's usable pixels, radians."""
    return float(aop(frame.s1[frame.valid].mean(), frame.s2[frame.valid].mean()))


def axial_difference(
    a: NDArray[np.float64], b: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return how far axial angles are apart, radians, 0..pi/2."""
    return np.abs((a - b + np.pi / 2) % np.pi - np.pi / 2)


if __name__ == "__main__":
    raise SystemExit(main())
