"""Random scenes for training: maps of light and their motion."""
from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

KINDS = ("texture", "polarizer", "plate", "wheel")
"""Kinds of scenes, see `draw_motion`."""

SHARES = (0.5, 0.22, 0.16, 0.12)

MAP_SIDE = 192
"""Side of a scene's maps, in pixels of the mosaic."""

FloatArray = NDArray[np.float32]


@dataclass
class Motion:
    """The motion of a scene; rates are per window.

    Parameters
    ----------
    kind : str
        One of ``KINDS``.
    velocity : ndarray of float64, shape (2,)
        Velocity of the map in pixels of the mosaic, x and y.
    turn : float
        Rotation of the map, radians.
    zoom, zoom_rate : float
        Amplitude of the map's oscillating magnification, and its phase rate, radians.
    spin : float
        Rate of the phase 2 AoP of a rotator before the scene, radians.
    tilt : float
        Twice the axis angle of a retarder behind the rotator, radians.
    across : float
        Cosine of its retardance: transmission of the component across its axis.
    follows : float
        1 if polarization turns with the map, 0 if not; 2 if the retarder turns.
    pivot : (float, float)
        Centre of the map's rotation in the image, pixels from its middle.
    swing : float
        Phase rate of an oscillating motion, radians; 0 = steady.
    swing_dolp : float
        Relative amplitude of DoLP that oscillates with it.
    pause : float
        Probability that a pause begins in a window.
    redraw : float
        Probability that the motion changes in a window.
    """

    kind: str
    velocity: NDArray[np.float64]
    turn: float = 0.0
    zoom: float = 0.0
    zoom_rate: float = 0.0
    spin: float = 0.0
    tilt: float = 0.0
    across: float = 1.0
    follows: float = 0.0
    pivot: tuple[float, float] = (0.0, 0.0)
    swing: float = 0.0
    swing_dolp: float = 0.0
    pause: float = 0.0
    redraw: float = 0.0


@dataclass
class Path:
    """The current position of a scene."""

    x: float = 0.0
    y: float = 0.0
    angle: float = 0.0
    zoom: float = 0.0
    phase: float = 0.0
    swing: float = 0.0
    paused: int = 0


def _log_uniform(random: np.random.Generator, low: float, high: float) -> float:
    return float(np.exp(random.uniform(np.log(low), np.log(high))))


def draw_motion(random: np.random.Generator, kind: str | None = None) -> Motion:
    """Draw the motion of a scene.

    A texture moves, turns and changes its magnification.  A polarizer before uniform
    light turns by up to 2 radians of 2 AoP per window.  A plate is a retarder behind
    such a polarizer, or a turning one.  A wheel of polarizers turns, and its
    polarization with it.
    """
    if kind is None:
        kind = str(random.choice(KINDS, p=SHARES))
    sign = random.choice((-1.0, 1.0), 4)
    motion = Motion(kind, np.zeros(2), pause=0.02 * random.random(),
                    redraw=0.03 * random.random())
    if kind in ("texture", "wheel"):
        direction = random.uniform(0, 2 * np.pi)
        speed = _log_uniform(random, 0.05, 4.0)
        motion.velocity = speed * np.array((np.cos(direction), np.sin(direction)))
        if random.random() < 0.5 or kind == "wheel":
            motion.turn = sign[0] * _log_uniform(random, 0.003, 0.12)
        if random.random() < 0.3:
            motion.zoom, motion.zoom_rate = 0.3 * random.random(), 0.2 * random.random()
        motion.follows = float(random.random() < 0.7)
        if random.random() < 0.25:
            motion.swing = _log_uniform(random, 0.05, 0.8)
            motion.swing_dolp = random.random() * (random.random() < 0.6)
        motion.pivot = tuple(random.uniform(-60, 60, 2))
    if kind == "wheel":
        motion.velocity *= 0.02
        motion.turn = sign[0] * _log_uniform(random, 0.01, 0.25)
        motion.follows = 1.0
    if kind in ("polarizer", "plate") or random.random() < 0.2:
        motion.spin = sign[1] * _log_uniform(random, 0.03, 2.0)
    if kind == "plate":
        motion.across = float(np.cos(
            np.pi / 2 if random.random() < 0.6 else random.uniform(0.2, np.pi)))
        motion.tilt = random.uniform(0, 2 * np.pi)
        if random.random() < 0.4:
            # The retarder turns too: the path applies spin to its axis instead.
            motion.follows = 2.0
    return motion


def _noise(random: np.random.Generator, side: int, power: float) -> FloatArray:
    """Draw a field with amplitude spectrum f^-power, mean 0 and rms 1."""
    f = np.hypot(np.fft.fftfreq(side)[:, None], np.fft.rfftfreq(side)[None])
    f[0, 0] = 1
    shape = f.shape
    spectrum = (random.normal(size=shape) + 1j * random.normal(size=shape)) * (
        np.maximum(f, 2 / side) ** -power) * np.exp(-((f / 0.3) ** 2))
    spectrum[0, 0] = 0
    field = np.fft.irfft2(spectrum, (side, side))
    return np.asarray(field / field.std(), np.float32)


def _objects(
    random: np.random.Generator, light: FloatArray, pol: NDArray[np.complex64]
) -> None:
    """Draw half-planes and discs of different light and polarization into the maps."""
    side = light.shape[0]
    y, x = np.mgrid[:side, :side].astype(np.float32)
    for _ in range(random.integers(0, 8)):
        cx, cy = random.uniform(0, side, 2)
        if random.random() < 0.3:
            a = random.uniform(0, 2 * np.pi)
            distance = (x - cx) * np.cos(a) + (y - cy) * np.sin(a)
        else:
            stretch = random.uniform(0.5, 2)
            radius = _log_uniform(random, 4, 40)
            distance = np.hypot(x - cx, (y - cy) * stretch) - radius
        mask = np.clip(0.5 - distance / random.uniform(1, 4), 0, 1).astype(np.float32)
        light += mask * np.float32(random.normal() * 0.8)
        if random.random() < 0.7:
            new = random.random() ** 0.7 * np.exp(1j * random.uniform(0, 2 * np.pi))
            pol += mask * (np.complex64(new) - pol)


def draw_map(random: np.random.Generator, motion: Motion) -> FloatArray:
    """Draw ln S0, S1/S0 and S2/S0 of a scene at rest.

    Returns
    -------
    ndarray of float32, shape (3, MAP_SIDE, MAP_SIDE)
    """
    side = MAP_SIDE
    light = np.zeros((side, side), np.float32)
    if motion.kind == "texture" or random.random() < 0.3:
        light += _log_uniform(random, 0.03, 1.0) * _noise(
            random, side, random.uniform(0.8, 1.8))
    strongest = random.random() ** 0.5
    if motion.kind == "texture":
        degree = strongest * (0.5 + 0.5 * np.sin(
            random.uniform(0, 2) * _noise(random, side, 1.5)
            + random.uniform(0, 2 * np.pi)))
        aop2 = random.uniform(0, 2 * np.pi) + random.uniform(0, 2.5) * _noise(
            random, side, random.uniform(1.2, 2))
        pol = (degree * np.exp(1j * aop2)).astype(np.complex64)
        _objects(random, light, pol)
    elif motion.kind == "wheel":
        y, x = np.mgrid[:side, :side] - (side - 1) / 2
        n = int(random.integers(3, 9))
        place = (np.arctan2(-y, x) + np.pi) / (2 * np.pi) * n
        nearest = np.rint(place)
        edge = random.uniform(1, 4)
        weight = np.clip(
            0.5 + (place - nearest) * np.hypot(x, y) * (2 * np.pi / n / edge), 0, 1)
        aop2 = 2 * np.pi / n * np.arange(n + 1) * (1 if random.random() < 0.7 else 2)
        before = np.exp(1j * aop2[(nearest.astype(int) - 1) % n])
        after = np.exp(1j * aop2[nearest.astype(int) % n])
        pol = (max(strongest, 0.5) * (before + weight * (after - before))).astype(
            np.complex64)
    else:
        full = random.random() < 0.6
        degree = 1.0 if full else strongest
        pol = np.full((side, side), degree * np.exp(1j * random.uniform(0, 2 * np.pi)),
                      np.complex64)
        if random.random() < 0.3:
            _objects(random, light, pol)
    degree = np.abs(pol)
    pol *= np.minimum(1, 0.999 / np.maximum(degree, 1e-6))
    return np.stack((light, pol.real, pol.imag)).astype(np.float32)


def walk(
    random: np.random.Generator, motion: Motion, path: Path, steps: int
) -> NDArray[np.float64]:
    """Advance the path by one window.

    Returns
    -------
    ndarray of float64, shape (steps, 8)
        Values at the end of each step: x, y, angle and magnification of the map; the
        matrix that is applied to the polarization, row by row.
    """
    if path.paused:
        path.paused -= 1
    elif random.random() < motion.pause:
        path.paused = int(random.integers(2, 30))
    if random.random() < motion.redraw:
        again = draw_motion(random, motion.kind)
        motion.velocity, motion.turn = again.velocity, again.turn
        motion.spin, motion.swing = again.spin, again.swing
    nodes = np.empty((steps, 8))
    go = 0.0 if path.paused else 1 / steps
    for i in range(steps):
        path.swing += motion.swing * go
        pace = go * (math.cos(path.swing) if motion.swing else 1.0)
        path.x += motion.velocity[0] * pace
        path.y += motion.velocity[1] * pace
        path.angle += motion.turn * pace
        path.zoom += motion.zoom_rate * pace
        path.phase += motion.spin * pace
        magnify = math.exp(motion.zoom * math.sin(path.zoom))
        c, s = magnify * math.cos(path.angle), magnify * math.sin(path.angle)
        px, py = motion.pivot
        nodes[i, :4] = (path.x - c * px + s * py, path.y - s * px - c * py,
                        path.angle, magnify)
        nodes[i, 4:] = _passing(motion, path).ravel()
    return nodes


def _turn(angle: float) -> NDArray[np.float64]:
    c, s = math.cos(angle), math.sin(angle)
    return np.array(((c, -s), (s, c)))


def _passing(motion: Motion, path: Path) -> NDArray[np.float64]:
    """Return the matrix from S1, S2 of the map to S1, S2 at the camera."""
    rotator, axis = path.phase, motion.tilt
    if motion.follows == 2:  # a turning retarder behind a polarizer at rest
        rotator, axis = 0.0, motion.tilt + path.phase
    matrix = _turn(rotator)
    if motion.across != 1:
        matrix = _turn(axis) @ np.diag((1.0, motion.across)) @ _turn(-axis) @ matrix
    if motion.follows == 1:
        matrix = matrix @ _turn(2 * path.angle)
    if motion.swing_dolp:
        matrix *= 1 - 0.5 * motion.swing_dolp * (1 - math.sin(path.swing))
    return matrix
