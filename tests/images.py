"""Scenes, mosaics and angles for the tests."""
import itertools

import numpy as np

from pdavis_cv import CHANNELS, Layout

LAYOUTS = [Layout(p[:2], p[2:]) for p in itertools.permutations(CHANNELS)]
DTYPES = (np.uint8, np.uint16, np.float32)


def random_mosaic(shape, dtype, seed=0):
    """Noise over the whole range of an integer dtype, or anything for a float."""
    rng = np.random.default_rng(seed)
    if np.issubdtype(dtype, np.integer):
        mosaic = rng.integers(0, np.iinfo(dtype).max, shape, dtype, endpoint=True)
    else:
        mosaic = rng.normal(0, 1e3, shape).astype(dtype)
    mosaic.flags.writeable = False
    return mosaic


def malus(s0, degree, angle, polarizer):
    """Intensity behind an ideal polarizer; angles in radians."""
    return s0 / 2 * (1 + degree * np.cos(2 * (angle - polarizer)))


def sample(layout, s0, degree, angle):
    """What a camera with this layout sees of the fields, each (H, W); float64."""
    y, x = np.indices(np.shape(angle)) % 2
    cell = np.deg2rad(np.array(layout.angles_deg, float))
    return malus(s0, degree, angle, cell[y, x])


def scene(shape):
    """Smooth S0, DoLP and AoP fields, each (H, W), AoP wrapping within the image."""
    y, x = np.indices(shape) / max(shape)
    return 500 + 200 * x, 0.6 + 0.2 * y, np.mod(2.5 * x + 1.5 * y**2 - 0.4, np.pi)


def apart(a, b):
    """Distance of two axial angles in radians."""
    return np.abs(np.mod(np.asarray(a, float) - b + np.pi / 2, np.pi) - np.pi / 2)
