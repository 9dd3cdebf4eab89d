"""Figure 2 from a user's own recordings: the truth is a fit to each of them."""
from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pdavis_cv import open_recording
from pdavis_cv.calibration.model import Calibration
from pdavis_cv.errors import PdavisError
from pdavis_cv.recording.base import IMU_DTYPE, TRIGGER_DTYPE, Recording
from pdavis_cv.recording.memory import MemoryRecording
from pdavis_cv.sensor import Layout, Sensor
from pdavis_cv.simulation import RotatingPolarizer, Scene
from pdavis_cv.tools._common import UsageError

from .page import table
from .rotation_fit import RotationFit, fit_rotation
from .run import SETTLE_US, TAIL_US, Case, Take

# A region of 12x12 pixels, as the paper's.
_SIDE = 12


@dataclasses.dataclass(frozen=True)
class Fitted:
    """A file, what was fitted to it, and the case made of it."""

    path: Path
    fit: RotationFit
    case: Case


def fit_files(
    paths: Sequence[Path], *, layout: Layout | None,
    roi: tuple[int, int, int, int] | None, seconds: float,
    nominal: tuple[float, float] | None, calibration: Calibration | None = None,
) -> list[Fitted]:
    """Read a region of each recording and fit the rotation to it.

    Parameters
    ----------
    paths : sequence of Path
        Recordings of a polarizer that turns at a constant speed.
    layout : Layout or None
        Default the recording's.
    roi : (int, int, int, int) or None
        (x, y, width, height), on even numbers; default 12x12 pixels in the middle.
    seconds : float
        How much of each, from its beginning.
    nominal : (float, float) or None
        Thresholds (on, off) to start from.
    calibration : Calibration or None
        Of the camera.

    Raises
    ------
    UsageError
        If a recording cannot be fitted; the message names it and says why.
    """
    found = []
    for path in paths:
        with open_recording(path, layout=layout) as whole:
            try:
                x, y, w, h = roi or middle_of(whole.info.sensor_size)
                part = region_of(whole, (x, y, w, h), round(seconds * 1e6))
                info = part.info
                ratio = (info.sensor or Sensor.PDAVIS).extinction_ratio
                fit = fit_rotation(part, extinction_ratio=ratio)
            except PdavisError:
                raise
            except ValueError as error:
                raise UsageError(f"{path}: {error}") from None
        assert info.start_us is not None
        assert info.stop_us is not None
        take = Take(part, fit, info.start_us, info.stop_us)
        if take.last_us - take.settled_us < TAIL_US:
            raise UsageError(f"{path}: must be longer than "
                             f"{(SETTLE_US + 2 * TAIL_US) / 1e6:g} s")
        options: dict[str, Any] = {}
        if nominal is not None:
            options["nominal_thresholds"] = nominal
        if calibration is not None:
            options["calibration"] = calibration.cropped(
                slice(y, y + h), slice(x, x + w))
        found.append(Fitted(path, fit, _case(take, fit, options)))
    return found


def _case(take: Take, fit: RotationFit, options: Mapping[str, Any]) -> Case:
    start = float(fit.aop(take.start_us))

    def light(s0: float) -> Scene:  # before a simulated Sony camera
        return RotatingPolarizer(
            rpm=fit.rpm, start_angle=start, dolp=min(fit.degree, 1.0), s0=s0)

    return Case(scene="polarizer", light=light, rpm=float(f"{abs(fit.rpm):.4g}"),
                camera="recording", seed=0, start_deg=math.degrees(start),
                seconds=(take.stop_us - take.start_us) / 1e6, existing=take,
                true_rpm=fit.rpm, options=options)


def middle_of(size: tuple[int, int]) -> tuple[int, int, int, int]:
    """Return (x, y, width, height) of a small region, on even numbers."""
    height, width = size
    w, h = min(_SIDE, width // 2 * 2), min(_SIDE, height // 2 * 2)
    return (width - w) // 4 * 2, (height - h) // 4 * 2, w, h


def region_of(
    recording: Recording, roi: tuple[int, int, int, int], limit_us: int
) -> Recording:
    """Return the beginning of a region of a recording, in memory.

    Raises
    ------
    ValueError
        If the region is not on even numbers inside the sensor, or nothing is in it.
    """
    height, width = recording.info.sensor_size
    x, y, w, h = roi
    if any(side % 2 for side in roi) or not (
            x >= 0 and y >= 0 and w > 0 and h > 0 and x + w <= width
            and y + h <= height):
        raise ValueError(f"roi must be even numbers inside the {width}x{height} "
                         f"sensor, got {x},{y},{w},{h}")
    first = next((packet.start_us for packet in recording.packets()
                  if packet.start_us is not None), None)
    if first is None:
        raise ValueError("recording must not be empty")
    events, frames, last = [], [], first
    for packet in recording.packets(first, first + limit_us):
        inside = packet.events[(packet.events["x"] >= x) & (packet.events["x"] < x + w)
                               & (packet.events["y"] >= y)
                               & (packet.events["y"] < y + h)]
        inside["x"] -= x
        inside["y"] -= y
        events.append(inside)
        frames += [frame.cropped(slice(y, y + h), slice(x, x + w))
                   for frame in packet.frames]
        last = packet.stop_us or last
    layout = recording.info.layout or Layout.PDAVIS
    info = dataclasses.replace(
        recording.info, sensor_size=(h, w), layout=layout.crop(x, y), start_us=first,
        stop_us=last, event_count=sum(map(len, events)), frame_count=len(frames),
        imu_count=0, trigger_count=0)
    return MemoryRecording(info, np.concatenate(events), tuple(frames),
                           np.empty(0, IMU_DTYPE), np.empty(0, TRIGGER_DTYPE))


def fits_page(fitted: Sequence[Fitted], roi: tuple[int, int, int, int] | None
              ) -> list[str]:
    """Return the Markdown of what was fitted."""
    where = (f"{_SIDE}x{_SIDE} pixels in the middle" if roi is None
             else f"{roi[2]}x{roi[3]} pixels at ({roi[0]}, {roi[1]})")
    lines = []
    for each in fitted:
        fit = each.fit
        lines.append((
            each.path.name, f"{fit.rpm:+.4f} +- {fit.rpm_sigma:.4f}",
            f"{math.degrees(fit.angle):.3f} +- {math.degrees(fit.angle_sigma):.3f} at "
            f"{fit.origin_us} us", f"{fit.degree:.3f}",
            f"{math.degrees(fit.residual):.2f}", str(fit.frames)))
    return [
        "# fig2, from recordings", "",
        f"Region: {where}. The truth is a fit of constant speed to the frames of each "
        "recording, its speed and sense told by the events; positive turns are "
        "counter-clockwise. An error that the whole region has in common, such as of "
        "the polarizers' mean angle, is therefore not seen. Sony cameras are simulated "
        "at the speed found.", "",
        *table(("recording", "turns per minute", "AoP in degrees", "DoLP",
                "frames about the fit, degrees", "frames"), lines)]
