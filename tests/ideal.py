"""A rotating polarizer seen by an ideal camera: exact events, frames and truth.

Log intensity of a pixel behind its analyser is ``ln(a (1 + k cos u))`` with u
linear in time, so threshold crossings and exposure integrals have closed forms:
nothing here is sampled, and times are exact to the rounding to 1 us.
"""
from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pdavis_cv.events import EVENT_DTYPE
from pdavis_cv.recording.base import ApsFrame, Recording
from pdavis_cv.recording.memory import recording_from_arrays
from pdavis_cv.sensor import PDAVIS_EXTINCTION_RATIO, Layout
from pdavis_cv.simulation.scenes import FloatArray, RotatingPolarizer
from pdavis_cv.simulation.truth import Truth


def rotating_polarizer(
    rpm: float,
    seconds: float = 3.0,
    *,
    size: tuple[int, int] = (12, 12),
    theta: tuple[ArrayLike, ArrayLike] = (0.15, 0.15),
    dn: float = 600.0,
    fps: float = 20.0,
    exposure_us: int = 20_000,
    readout_us: int = 12_000,
    layout: Layout = Layout.PDAVIS,
    start_angle: float = 0.0,
    dolp: float = 1.0,
    extinction_ratio: float = PDAVIS_EXTINCTION_RATIO,
) -> tuple[Recording, Truth]:
    """Record a rotating polarizer with an ideal camera.

    Parameters
    ----------
    rpm : float
        Turns per minute of the polarizer, positive = counter-clockwise as
        displayed; AoP makes two cycles per turn.
    seconds : float
        Duration; the recording covers [0, seconds).
    size : (int, int)
        (height, width) of the sensor.
    theta : (array_like, array_like)
        ON and OFF threshold, positive, natural-log units; scalars or (H, W).
    dn : float
        DN that a pixel reaches when the light is parallel to its analyser.
    fps, exposure_us, readout_us : float, int, int
        Frame clock: frame k is exposed from k / fps for ``exposure_us`` and is
        available ``readout_us`` later; only complete frames are delivered.
    layout : Layout
        Polarizer layout.
    start_angle : float
        AoP at time 0, radians.
    dolp : float
        Degree of linear polarization of the light, 0..1.
    extinction_ratio : float
        Extinction ratio of the camera's analysers, largest over smallest intensity
        behind one in fully polarized light; above 1.

    Returns
    -------
    recording : Recording
        Float DN without quantisation; event times rounded to 1 us.
    truth : Truth
        The light in front of the camera.
    """
    on, off = (np.broadcast_to(np.asarray(th, np.float64), size) for th in theta)
    contrast = (extinction_ratio - 1) / (extinction_ratio + 1)
    s0 = 2 * dn / (exposure_us / 1000) / (1 + contrast)
    scene = RotatingPolarizer(rpm=rpm, s0=s0, start_angle=start_angle, dolp=dolp)
    height, width = size
    cell = np.deg2rad(np.array(layout.angles_deg, np.float64))
    angles = np.tile(cell, (height // 2 + 1, width // 2 + 1))[:height, :width]
    k = contrast * dolp
    stop_us = round(seconds * 1e6)
    events = _events(scene, angles, k, on, off, stop_us)
    frames = _frames(scene, angles, k, stop_us, fps, exposure_us, readout_us)
    recording = recording_from_arrays(
        events, frames, sensor_size=size, layout=layout)
    return recording, Truth(scene, size)


def _events(
    scene: RotatingPolarizer, angles: FloatArray, k: float, on: FloatArray,
    off: FloatArray, stop_us: int,
) -> NDArray[np.void]:
    """Events of all pixels, time-ordered; equal pixels are solved only once."""
    kinds, member = np.unique(
        np.stack((angles, on, off)).reshape(3, -1), axis=1, return_inverse=True)
    parts = []
    for i, (angle, up, down) in enumerate(kinds.T):
        u0 = 2 * (scene.start_angle - float(angle))
        speed = 2 * scene.rad_per_us
        t, p = pixel_events(u0, speed, k, float(up), float(down), stop_us)
        y, x = np.divmod(np.flatnonzero(member.ravel() == i), angles.shape[1])
        part = np.empty((len(t), len(x)), EVENT_DTYPE)
        part["t"], part["p"] = t[:, None], p[:, None]
        part["x"], part["y"] = x, y
        parts.append(part.ravel())
    events = np.concatenate(parts)
    return events[np.lexsort((events["x"], events["y"], events["t"]))]


def pixel_events(
    u0: float, speed: float, k: float, on: float, off: float, stop_us: int
) -> tuple[NDArray[np.int64], NDArray[np.uint8]]:
    """Solve one pixel that sees ``1 + k cos(u0 + speed t)``.

    Parameters
    ----------
    u0, speed : float
        Phase at time 0 in radians, and its change per us.
    k : float
        Modulation, 0 <= k < 1.
    on, off : float
        Thresholds in natural-log units.
    stop_us : int
        End of the recording; crossings before it are kept.

    Returns
    -------
    t : ndarray of int64, shape (N,)
        Microseconds.
    p : ndarray of uint8, shape (N,)
        1 = ON.
    """
    if speed == 0 or k == 0:
        return np.empty(0, np.int64), np.empty(0, np.uint8)
    if speed < 0:  # the cosine is even: let the phase run forward
        u0, speed = -u0, -speed
    start = np.log1p(k * np.cos(u0))
    end = u0 + speed * stop_us
    ups = downs = 0
    times, signs = [], []
    first, last = int(np.floor(u0 / np.pi)), int(np.floor(end / np.pi))
    for half in range(first, last + 1):  # between multiples of pi: monotonic
        rising = half % 2 != 0
        until = min(end, (half + 1) * np.pi)
        reached = np.log1p(k * np.cos(until))
        reference = start + ups * on - downs * off
        step = on if rising else -off
        n = max(0, int(np.floor((reached - reference) / step)))
        levels = reference + step * np.arange(1, n + 1)
        inside = np.arccos(np.clip(np.expm1(levels) / k, -1, 1))
        u = (half + 1) * np.pi - inside if rising else half * np.pi + inside
        times.append((u - u0) / speed)
        signs.append(np.full(n, rising, np.uint8))
        ups, downs = (ups + n, downs) if rising else (ups, downs + n)
    t = np.rint(np.concatenate(times)).astype(np.int64)
    keep = t < stop_us
    return t[keep], np.concatenate(signs)[keep]


def _frames(
    scene: RotatingPolarizer, angles: FloatArray, k: float, stop_us: int, fps: float,
    exposure_us: int, readout_us: int,
) -> list[ApsFrame]:
    """Frames whose readout ends before ``stop_us``; exposure means are exact."""
    frames = []
    half_turn = scene.rad_per_us * exposure_us  # half of the change of u
    blur = np.sinc(half_turn / np.pi)
    full = scene.s0 / 2 * exposure_us / 1000
    for i in range(int(np.ceil(stop_us * fps / 1e6))):
        start = round(i * 1e6 / fps)
        end = start + exposure_us
        if end + readout_us >= stop_us:
            break
        mid = scene.start_angle + scene.rad_per_us * (start + exposure_us / 2)
        dn = full * (1 + k * blur * np.cos(2 * (mid - angles)))
        frames.append(ApsFrame(dn, start, end, available_us=end + readout_us))
    return frames
