"""Make the animation of README.md: a wheel of polarizers, by frames and fused.

A `nominal` camera of 346x260 pixels looks at six polarizers that turn at 200 RPM; the
left half is lit 2000 times brighter.  Left: the last frame; right: frames and events
fused.  The camera's bus has no limit: the wheel makes 16 million events per second, and
a DAVIS carries about 10.  It takes some 15 s of processor time.
"""
from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence

import numpy as np

from pdavis_cv import PolarFrame, export, fuse, render
from pdavis_cv.render import Picture, ToneCurve
from pdavis_cv.simulation import Camera, Fan

RPM = 200
_SIZE = (260, 346)
_SECONDS = 0.4
_SHOWN_US = np.arange(280_000, 400_000, 2_000)  # two fifths of a turn
_PICTURES_PER_S = 20
_SEED = 1
_LEAST_DOLP = 0.3
_FULL_SCALE = 1023 / 20     # DN per ms of a frame of 20 ms


def main(argv: Sequence[str] | None = None) -> int:
    """Run ``python -m lab.readme``."""
    parser = argparse.ArgumentParser(prog="python -m lab.readme", description=__doc__)
    parser.add_argument("-o", "--out", default="docs/fan.webp", metavar="FILE",
                        help=".webp or .gif; default docs/fan.webp")
    out = parser.parse_args(argv).out
    recording, _ = Camera.preset(
        "nominal", seed=_SEED, size=_SIZE).record(Fan(rpm=RPM), _SECONDS)
    frames, fused = (
        list(fuse(recording, method=method, times_us=_SHOWN_US))
        for method in ("frames", "kalman"))
    left, right = (
        ToneCurve.of([image.quad[0] for image in images[::10]],
                     [image.valid for image in images[::10]], saturated=_FULL_SCALE / 2)
        for images in (frames, fused))
    with export.moving_file(out, _PICTURES_PER_S) as file:
        for held, now in zip(frames, fused, strict=True):
            file.add(render.stack([
                render.tile([
                    render.panel(left.seen(held.quad[0], held.valid),
                                 "intensity, by frames"),
                    render.panel(right.seen(now.quad[0], now.valid),
                                 "intensity, frames and events fused")], columns=2),
                render.tile([
                    render.panel(_angle(held), "angle of polarization, by frames"),
                    render.panel(_angle(now), "angle of polarization, fused",
                                 legend="faded")], columns=2)]))
    print(f"wrote {out}")
    return 0


def _angle(image: PolarFrame) -> Picture:
    """Return the angle, black where the light is not polarized."""
    good = render.reliable(image, least_dolp=_LEAST_DOLP)
    picture = render.aop_bgr(image.aop, image.valid)
    render.fade(picture, np.where(good, image.dolp, 0), image.valid)
    return picture


if __name__ == "__main__":
    sys.exit(main())
