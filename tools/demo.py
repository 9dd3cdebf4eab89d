"""Make pictures and a video from the included recordings.

FOLDER receives two simulated recordings of a polarization event camera, a wheel of
polarizers (fan) and a loaded tendon, with pictures of the results; a picture that
compares the measured angle of a polarizer at 1000 RPM with the truth; and the intensity
of a real recording, from a camera without polarizers.
"""
from __future__ import annotations

import argparse
import shlex
import shutil
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pdavis_cv import PolarFrame, Recording, aop, export, fuse, render
from pdavis_cv._beside import write_beside
from pdavis_cv._opencv import opencv
from pdavis_cv.analysis import Roi, TraceRecorder, axial_difference
from pdavis_cv.data import example_recording
from pdavis_cv.render import ToneCurve
from pdavis_cv.simulation import Camera, RotatingPolarizer, example_truth

from . import export as export_tool, fan as fan_tool
from ._common import Parser, add_json_option, command, for_people, tell
from ._options import opened
from ._progress import stage

METHODS = ("frames", "kalman")
_FAN = ("--fps", "100", "--slow", "5", "--scale", "4", "--start", "0.25",
        "--stop", "0.75")
RPM = 1000
_TURNING = 1.013 * RPM  # not a multiple of the frame rate
_STEP_US = 2000
_SHOWN_US = 200_000     # of the polarizer, at the end
_TENDON_HZ = 200
_WINDOW_US = 20_000     # of the events that are shown
_FILES = ("fan.aedat4", "tendon.aedat4", "fan.webm", "fan.png", "tendon.png",
          f"polarizer_{RPM}rpm.png", f"{example_recording().stem}.webm")
_MOMENT = 0.7           # time of the tendon that is shown, relative to its length
_COLOURS = {"truth": (255, 255, 255), "frames": (150, 150, 150),
            "kalman": (80, 220, 255)}  # BGR


@command
def main(argv: Sequence[str] | None = None) -> int:
    """Run ``pdavis demo``."""
    parser = Parser("demo", __doc__ or "", "pdavis demo -o demo")
    parser.add_argument(
        "-o", "--out", type=Path, default=Path("demo"), metavar="FOLDER",
        help="output folder; default demo")
    add_json_option(parser)
    args = parser.parse_args(argv)
    with for_people(args):
        code, facts = _shown(args)
    if code == 0:
        tell(args, (), wrote=[args.out / name for name in _FILES], **facts)
    return code


def _shown(args: argparse.Namespace) -> tuple[int, dict[str, Any]]:
    """Write everything; return an exit code, and errors against the truth."""
    folder = args.out
    opencv()
    folder.mkdir(parents=True, exist_ok=True)
    kept = {name: folder / f"{name}.aedat4" for name in ("fan", "tendon")}
    for name, path in kept.items():
        with write_beside(path) as part:
            shutil.copyfile(example_recording(name), part)
        _say(f"wrote {path}: a simulated recording")
    code = fan_tool.main([
        str(kept["fan"]), "-o", str(folder / "fan.webm"),
        "--still", str(folder / "fan.png"), *_FAN])
    if code:
        return code, {}
    args.layout = None
    stage("the tendon, by its frames and fused")
    with opened(args, kept["tendon"]) as recording:
        dolp = _tendon(folder / "tendon.png", recording)
    stage(f"a polarizer at {RPM} RPM, simulated and fused")
    aop_deg = _polarizer(folder / f"polarizer_{RPM}rpm.png")
    real = example_recording()      # it has no polarizers: its intensity is shown
    code = export_tool.main([
        str(real), "--layout", "pdavis", "--quantities", "s0", "--fps", "100",
        "--slow", "10", "--title", "a real DAVIS346",
        "-o", f"{folder / real.stem}.webm"])
    if code == 0:
        _say(f"The results are in {folder.resolve()}\n"
             "More of one recording:\n  " + shlex.join((
                 # as it was called: it need not be on the PATH
                 sys.argv[0] if Path(sys.argv[0]).name == "pdavis" else "pdavis",
                 "export", str(kept["fan"]), "-o", "more.webm",
                 "--fps", "200", "--slow", "8")))
    return code, {"tendon_dolp_error": dolp, "polarizer_aop_error_deg": aop_deg}


def _say(line: str) -> None:
    print(line, flush=True)


def _tendon(path: Path, recording: Recording) -> dict[str, float]:
    """Show the tendon at one time, and its mean DoLP over time.

    Returns the mean error of that DoLP, by method.
    """
    height, width = recording.info.sensor_size
    whole = [Roi.from_rectangle(0, 0, width, height, "all")]
    images, traces = {}, {}
    for method, rate in zip(METHODS, (None, _TENDON_HZ), strict=True):
        images[method] = list(fuse(recording, method=method, fps=rate))
        recorder = TraceRecorder(whole)
        for image in images[method]:
            recorder.add(image)
        traces[method] = recorder.traces()
    fused = images["kalman"][round(_MOMENT * len(images["kalman"]))]
    now = fused.t_us or 0
    held = [image for image in images["frames"] if (image.t_us or 0) <= now][-1]
    seen = recording.events()
    seen = seen[(seen["t"] >= now - _WINDOW_US) & (seen["t"] < now)]
    scale, tone = 3, ToneCurve.of([held.s0], [held.valid])
    times = traces["kalman"].t_us
    truth = example_truth("tendon")
    mean = np.array([[part.mean() for part in truth.image(t)] for t in times])
    true = np.hypot(mean[:, 1], mean[:, 2]) / mean[:, 0]
    lines = [
        render.Line(times / 1e6, true, _COLOURS["truth"], "truth"),
        *(render.Line(trace.t_us / 1e6, trace.table["dolp"][0], _COLOURS[name], name,
                      dots=name == "frames") for name, trace in traces.items())]
    export.write_png(path, render.tendon_sheet(
        held, render.events_on((height, width), seen), fused,
        render.chart(lines, (220, 3 * (scale * width + 8) + 8), span_s=(0.0, 1.0),
                     limits=(0.25, 0.65), title="mean DoLP; time / s"),
        grey=tone.seen, top=0.8, scale=scale,
        title=f"a simulated tendon pulled at 4.3 Hz   t = {now / 1e6:.3f} s"))
    error = {name: float(np.nanmean(np.abs(
        trace.table["dolp"][0] - np.interp(trace.t_us, times, true))))
        for name, trace in traces.items()}
    _say(f"wrote {path}: mean error of the tendon's DoLP "
         + ", ".join(f"{name} {value:.3f}" for name, value in error.items()))
    return error


def _polarizer(path: Path) -> dict[str, float]:
    """Compare the angle of a polarizer at 1000 RPM with the truth.

    Returns the error over one second, in degrees by method; the last part is shown.
    """
    recording, truth = Camera.preset("nominal").record(
        RotatingPolarizer(rpm=_TURNING), 1.0)
    times = np.arange(0, 1_000_000, _STEP_US)
    strips, errors = {"truth": truth.aop(times)}, {}
    titles = {"truth": f"truth: {RPM} RPM, {_SHOWN_US / 1e6:g} s from left to right"}
    for method in METHODS:
        images = list(fuse(recording, method=method, times_us=times))
        # Single pixels may have drifted below the floor and be unusable.
        seen = np.array([2 * frame.valid.mean() > 1 for frame in images])
        strips[method] = np.array([
            mean_aop(frame) if usable else np.nan
            for frame, usable in zip(images, seen, strict=True)])
        errors[method] = error = float(np.rad2deg(np.mean(np.abs(
            axial_difference(strips[method], strips["truth"])[seen]))))
        titles[method] = f"{method}: mean error {error:.1f} degrees"
        _say(f"polarizer at {RPM} RPM, {method}: AoP error {error:.1f} degrees")
    shown = -(_SHOWN_US // _STEP_US)
    rows = [render.panel(
        render.aop_bgr(np.broadcast_to(strip[shown:].repeat(6), (56, -6 * shown))),
        titles[name], legend="aop" if name == METHODS[-1] else None)
        for name, strip in strips.items()]
    export.write_png(path, render.tile([render.stack(rows, gap=6)], columns=1))
    _say(f"wrote {path}: AoP over time")
    return errors


def mean_aop(frame: PolarFrame) -> float:
    """Return the angle of the mean S1, S2 of an image's usable pixels, radians."""
    return float(aop(frame.s1[frame.valid].mean(), frame.s2[frame.valid].mean()))
