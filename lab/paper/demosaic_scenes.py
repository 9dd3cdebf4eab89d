"""Scenes of known polarization for demosaicing: made ones, and images of the user's.

A made scene is drawn with 2 to 4 samples per pixel and axis, blurred as by a lens
(Gaussian, sigma .4 to .7 pixels) and averaged over each pixel, channel by channel:
what four cameras behind four polarizers would measure at one place.
"""
from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from pdavis_cv.tools._common import UsageError

ANGLES_DEG = (0, 45, 90, 135)
Fields = tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]
"""S0 (0 to about 1), DoLP and AoP (radians), each (H, W)."""


def make(name: str, shape: tuple[int, int], seed: int) -> NDArray[np.float32]:
    """Return the four channels of a made scene behind ideal polarizers.

    Parameters
    ----------
    name : str
        Of `MADE`.
    shape : (int, int)
        Height and width in pixels, even.
    seed : int

    Returns
    -------
    ndarray of float32, shape (4, H, W)
        In the order of ``CHANNELS``; S0 is at most about 1.
    """
    pitch, blur, draw = MADE[name]
    fine = shape[0] * pitch, shape[1] * pitch
    s0, dolp, aop = draw(fine, pitch, np.random.default_rng((seed, len(name))))
    quad = np.stack([0.5 * s0 * (1 + dolp * np.cos(2 * (aop - angle)))
                     for angle in np.deg2rad(ANGLES_DEG)])
    quad = np.stack([ndimage.gaussian_filter(plane, blur * pitch) for plane in quad])
    quad = quad.reshape(4, shape[0], pitch, shape[1], pitch).mean((2, 4))
    return np.asarray(quad / 1.2, np.float32)


def _fractal(
    shape: tuple[int, int], rng: np.random.Generator, slope: float
) -> NDArray[np.float64]:
    """Return noise whose amplitude falls with frequency by a power (natural: 1)."""
    height, width = shape
    frequency = np.hypot(np.fft.fftfreq(height)[:, None], np.fft.rfftfreq(width))
    frequency[0, 0] = np.inf
    noise = np.fft.rfft2(rng.standard_normal(shape)) * frequency**-slope
    field = np.fft.irfft2(noise, shape)
    return np.asarray(field / field.std())


def _leaves(shape: tuple[int, int], pitch: int, rng: np.random.Generator) -> Fields:
    """Draw discs and boxes over each other, radii r^-2.5: edges as in natural images.

    Most differ from what they cover in intensity, DoLP and AoP, some in two of these.
    """
    s0, dolp, aop = np.full(shape, 0.5), np.full(shape, 0.2), np.zeros(shape)
    y, x = np.indices(shape)
    least, most = 3.0 * pitch, 70.0 * pitch
    for _ in range(450):
        r = (least**-1.5 + (most**-1.5 - least**-1.5) * rng.random()) ** (-1 / 1.5)
        at_x, at_y = rng.random() * shape[1], rng.random() * shape[0]
        turn = rng.random() * np.pi
        part = (slice(max(int(at_y - 1.5 * r), 0), int(at_y + 1.5 * r) + 1),
                slice(max(int(at_x - 1.5 * r), 0), int(at_x + 1.5 * r) + 1))
        dx, dy = x[part] - at_x, y[part] - at_y
        u = dx * np.cos(turn) + dy * np.sin(turn)
        v = dy * np.cos(turn) - dx * np.sin(turn)
        if rng.integers(3) == 0:
            inside = u * u + v * v < r * r
        else:
            inside = (np.abs(u) < r) & (np.abs(v) < r * rng.uniform(0.15, 0.9))
        same = rng.integers(6)
        if same != 1:
            s0[part][inside] = np.exp(rng.uniform(np.log(0.08), 0))
        if same != 2:
            dolp[part][inside] = rng.beta(1, 4)
        if same != 3:
            aop[part][inside] = rng.random() * np.pi
        s0[part][inside] *= 1 + rng.uniform(-0.3, 0.3) / r * u[inside]
    s0 *= np.exp(0.12 * _fractal(shape, rng, 1.2))
    dolp = np.clip(dolp * np.exp(0.3 * _fractal(shape, rng, 1.6)), 0, 0.95)
    return s0, dolp, aop + 0.12 * _fractal(shape, rng, 1.6)


def _texture(shape: tuple[int, int], pitch: int, rng: np.random.Generator) -> Fields:
    """Draw three independent fractal fields, without edges."""
    s0 = np.clip(np.exp(0.5 * _fractal(shape, rng, 1.5) - 0.7), 0.02, 1.1)
    dolp = 0.5 / (1 + np.exp(1 - _fractal(shape, rng, 1.9)))
    return s0, dolp, 0.8 * _fractal(shape, rng, 1.9)


def _edges(shape: tuple[int, int], pitch: int, rng: np.random.Generator) -> Fields:
    """Draw stars of even sectors that differ in S0, in DoLP, in AoP, and in all."""
    fields = np.empty(shape), np.empty(shape), np.empty(shape)
    height, width = shape[0] // 2, shape[1] // 2
    y, x = np.indices((height, width))
    count = int(rng.integers(14, 22))
    for star in range(4):
        at_y = height / 2 + rng.uniform(-9, 9)
        at_x = width / 2 + rng.uniform(-9, 9)
        turned = np.arctan2(y - at_y, x - at_x) + rng.random()
        sector = (turned / (2 * np.pi) * count).astype(int) % count
        s0, dolp = rng.uniform(0.15, 1, count), rng.uniform(0, 0.7, count)
        aop = rng.random(count) * np.pi
        if star in (1, 2):
            s0[:] = 0.6
        if star in (0, 2):
            dolp[:] = 0.35
        if star in (0, 1):
            aop[:] = aop[0]
        part = (slice(star // 2 * height, (star // 2 + 1) * height),
                slice(star % 2 * width, (star % 2 + 1) * width))
        for field, values in zip(fields, (s0, dolp, aop), strict=True):
            field[part] = values[sector]
    return fields


def _tissue(shape: tuple[int, int], pitch: int, rng: np.random.Generator) -> Fields:
    """Draw crimped fibres: bright lines 5 to 17 pixels apart, AoP along them."""
    y, x = np.indices(shape)
    crimp = np.sin(2 * np.pi * x / (60 * pitch) + 0.6 * _fractal(shape, rng, 2.2))
    across = y + pitch * (0.9 * crimp + 7.2 * _fractal(shape, rng, 2.4))
    lines = sum(np.sin(2 * np.pi * across / (period * pitch) + 6 * rng.random()
                       + 0.5 * _fractal(shape, rng, 2)) / 2
                for period in (5.0, 9.0, 17.0))
    s0 = 0.4 * np.exp(0.35 * lines + 0.2 * _fractal(shape, rng, 1.5))
    down, right = np.gradient(ndimage.gaussian_filter(across, 3 * pitch))
    dolp = np.clip(0.25 + 0.08 * lines + 0.08 * _fractal(shape, rng, 1.8), 0, 0.9)
    return s0, dolp, -(np.arctan2(down, right) + np.pi / 2)


def _fan(shape: tuple[int, int], pitch: int, rng: np.random.Generator) -> Fields:
    """Draw six sectors of polarizer, 30 degrees apart, before a texture."""
    y, x = np.indices(shape)
    turned = np.arctan2(y - shape[0] / 2, x - shape[1] / 2) + rng.random()
    sector = (turned / (2 * np.pi) * 6).astype(int) % 6
    s0 = 0.6 * np.exp(0.15 * _fractal(shape, rng, 1.4))
    return s0, np.full(shape, 0.95), sector * np.pi / 6


def _polarizer(shape: tuple[int, int], pitch: int, rng: np.random.Generator) -> Fields:
    """Draw a texture behind one polarizer."""
    s0 = 0.6 * np.exp(0.3 * _fractal(shape, rng, 1.4))
    return s0, np.full(shape, 0.97), np.full(shape, rng.random() * np.pi)


def _waves(shape: tuple[int, int], pitch: int, rng: np.random.Generator) -> Fields:
    """Draw plane waves of 8 to 60 pixels in S0, DoLP and AoP alike, without edges."""
    y, x = np.indices(shape)

    def field() -> NDArray[np.float64]:
        total, count = np.zeros(shape), 12
        for wave in range(count):
            length = 8 * (60 / 8) ** ((wave + rng.random()) / count) * pitch
            turn = 2 * np.pi * rng.random()
            total += np.sin(2 * np.pi * ((x * np.cos(turn) + y * np.sin(turn)) / length
                                         + rng.random()))
        return np.asarray(total / total.std())

    return (0.35 * np.exp(0.35 * field()), 0.4 + 0.3 * np.clip(field() / 2, -1, 1),
            0.6 * field())


_REFRACTION = 1.5
"""Refractive index of the objects' varnish: of acrylic paint and of most plastics."""


def _paint(shape: tuple[int, int], pitch: int, rng: np.random.Generator
           ) -> NDArray[np.float64]:
    """Return an albedo: a texture, and on half of the surfaces blots or stripes."""
    albedo = np.exp(0.25 * _fractal(shape, rng, rng.uniform(1.2, 1.8))
                    + rng.uniform(np.log(0.06), np.log(0.8)))
    dark = rng.uniform(0.15, 0.7)
    kind = rng.integers(4)
    if kind == 0:
        blots = _fractal(shape, rng, rng.uniform(1.4, 2)) > rng.uniform(-0.5, 0.8)
        albedo *= np.where(blots, 1, dark)
    elif kind == 1:
        y, x = np.indices(shape)
        turn, period = np.pi * rng.random(), rng.uniform(5, 25) * pitch
        along = (x * np.cos(turn) + y * np.sin(turn)) / period
        albedo *= np.where(np.sin(2 * np.pi * along) > rng.uniform(-0.6, 0.6), 1, dark)
    return albedo


def _objects(shape: tuple[int, int], pitch: int, rng: np.random.Generator) -> Fields:
    """Draw varnished balls, rods and boards under lamps, by Fresnel's equations.

    Light from within a surface is polarized in the plane of its normal, light that is
    mirrored across it, so DoLP and AoP follow the shape and the lamps, S0 also the
    paint, and dark paint is the more polarized.
    """
    y, x = np.indices(shape).astype(np.float64)
    total, first, second = np.zeros(shape), np.zeros(shape), np.zeros(shape)
    lamps = rng.standard_normal((6, 3))
    lamps[:, 2] = np.abs(lamps[:, 2]) + 0.3
    lamps /= np.linalg.norm(lamps, axis=1, keepdims=True)
    power, width = rng.uniform(0.1, 1, 6), rng.uniform(0.15, 0.6, 6)

    def lay(part: tuple[slice, slice], slopes: NDArray[np.float64],
            inside: NDArray[np.bool_]) -> None:
        bumps = [0.02 * _fractal(inside.shape, rng, 2.0) for _ in range(2)]
        normal = np.stack([slopes[0] + bumps[0], slopes[1] + bumps[1],
                           np.sqrt(np.clip(1 - slopes[0]**2 - slopes[1]**2, 0.02, 1))])
        normal /= np.linalg.norm(normal, axis=0)
        mirrored = 2 * normal[2] * normal
        mirrored[2] -= 1
        facing = np.tensordot(lamps, normal, 1).clip(0)
        diffuse = _paint(inside.shape, pitch, rng) * (
            0.4 + np.tensordot(power, facing, 1))
        glare = 0.25 + sum(
            p * np.exp((np.tensordot(lamp, mirrored, 1) - 1) / wide**2) / wide
            for lamp, p, wide in zip(lamps, power, width, strict=True))
        cosine = normal[2]
        root = np.sqrt(_REFRACTION**2 - 1 + cosine**2)
        across = ((cosine - root) / (cosine + root))**2
        along = ((_REFRACTION**2 * cosine - root) / (_REFRACTION**2 * cosine + root))**2
        gloss = rng.choice([0.1, 0.5, 1.0])
        s0 = diffuse + gloss * glare * (across + along) / 2
        polarized = (diffuse * (across - along) / (2 - across - along)
                     - gloss * glare * (across - along) / 2)
        azimuth = np.arctan2(-normal[1], normal[0])
        total[part][inside] = s0[inside]
        first[part][inside] = (polarized * np.cos(2 * azimuth))[inside]
        second[part][inside] = (polarized * np.sin(2 * azimuth))[inside]

    horizon = int(rng.uniform(0.35, 0.75) * shape[0])
    for rows in (slice(0, horizon), slice(horizon, shape[0])):
        part = rows, slice(0, shape[1])
        slopes = rng.uniform(-0.6, 0.6, (2, 1, 1)) * np.ones((2, *y[part].shape))
        lay(part, slopes, np.ones(y[part].shape, bool))
    for _ in range(rng.integers(14, 40)):
        high, wide = rng.uniform(6, 60, 2) * pitch
        at_y, at_x = rng.random() * shape[0], rng.random() * shape[1]
        reach = np.hypot(high, wide)
        part = (slice(max(int(at_y - reach), 0), int(at_y + reach) + 1),
                slice(max(int(at_x - reach), 0), int(at_x + reach) + 1))
        turn = np.pi * rng.random()
        dx, dy = x[part] - at_x, y[part] - at_y
        u = (dx * np.cos(turn) + dy * np.sin(turn)) / wide
        v = (dy * np.cos(turn) - dx * np.sin(turn)) / high
        inside = (np.abs(u) < 1) & (np.abs(v) < 1)
        shape_of_it = rng.integers(3)
        if shape_of_it == 0:     # ball
            inside &= u * u + v * v < 1
        elif shape_of_it == 1:   # rod
            u = np.zeros_like(u)
        else:                    # board
            u, v = (np.full_like(u, tilt) for tilt in rng.uniform(-0.6, 0.6, 2))
        lay(part, np.stack([u * np.cos(turn) - v * np.sin(turn),
                            u * np.sin(turn) + v * np.cos(turn)]), inside)
    bright = np.quantile(total, 0.98)
    return (total / np.maximum(total, bright), np.hypot(first, second) / total,
            np.arctan2(second, first) / 2)


MADE: Mapping[str, tuple[int, float, Callable[
    [tuple[int, int], int, np.random.Generator], Fields]]] = {
    "leaves": (3, 0.45, _leaves),
    "objects": (3, 0.7, _objects),
    "texture": (2, 0.45, _texture),
    "waves": (2, 0.45, _waves),
    "edges": (4, 0.4, _edges),
    "tissue": (2, 0.45, _tissue),
    "fan": (3, 0.4, _fan),
    "polarizer": (2, 0.45, _polarizer),
}
"""Name -> samples per pixel along each axis, the lens' sigma in pixels, the drawing."""

# scene_0.png, scene-45.tif, scene_I090.png, scene135deg.bmp, or 0.png in a folder.
_NAME = re.compile(r"^(.*?)[ _.-]*(?:i|pol)?0*(0|45|90|135)(?:deg)?$", re.IGNORECASE)
_ENDINGS = (".png", ".tif", ".tiff", ".bmp", ".jpg", ".jpeg", ".pgm")


def four_angle_folder(folder: Path) -> dict[str, NDArray[np.float32]]:
    """Read the scenes of a folder and its folders, four images to a scene.

    Parameters
    ----------
    folder : Path
        The four images of a scene are named alike up to the angle at the end: 0, 45,
        90 or 135, with zeros before and ``deg`` behind if one likes (``cup_0.png``,
        ``cup_045.png`` ...).  Of colour images the green channel is used.

    Returns
    -------
    dict of str to ndarray of float32, shape (4, H, W)
        Channels, 1 = full scale of the files; an odd last row or column is cut off.

    Raises
    ------
    UsageError
        If there is no scene of four, or four differ in size.
    """
    import cv2

    found: dict[str, dict[int, Path]] = {}
    for path in sorted(folder.rglob("*")):
        match = _NAME.match(path.stem)
        if match and path.suffix.lower() in _ENDINGS:
            name = str(path.relative_to(folder).parent / match[1])
            found.setdefault(name, {})[int(match[2])] = path
    scenes = {}
    for name, files in found.items():
        if len(files) < 4:
            continue
        planes: list[NDArray[Any]] = []
        for angle in ANGLES_DEG:
            plane = cv2.imread(str(files[angle]), cv2.IMREAD_UNCHANGED)
            if plane is None or plane.dtype not in (np.uint8, np.uint16):
                raise UsageError(f"{files[angle]}: not an image of 8 or 16 bits")
            planes.append(plane if plane.ndim == 2 else plane[..., 1])
            if (planes[-1].shape, plane.dtype) != (planes[0].shape, planes[0].dtype):
                raise UsageError(
                    f"{files[angle]}: {plane.dtype} {plane.shape}, unlike the scene's "
                    f"first image, {planes[0].dtype} {planes[0].shape}")
        quad = np.stack(planes)
        height, width = quad.shape[1] // 2 * 2, quad.shape[2] // 2 * 2
        full = np.iinfo(quad.dtype).max
        scenes[name.removeprefix("./")] = (
            quad[:, :height, :width] / np.float32(full)).astype(np.float32)
    if not scenes:
        raise UsageError(
            f"{folder}: no scene of four images that end in 0, 45, 90 and 135")
    return scenes
