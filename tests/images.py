"""Scenes, mosaics and angles for the tests."""
import itertools
from fractions import Fraction

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


def encoded(path, images, codec, pixels, times=None, base=Fraction(1, 25)):
    """Write a video through PyAV; `times` counts units of `base`."""
    import av
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=25)
        stream.height, stream.width = images[0].shape
        stream.pix_fmt, stream.codec_context.time_base = pixels, base
        source = pixels if pixels.startswith("gray") else "gray"
        for k, image in enumerate(images):
            frame = av.VideoFrame.from_ndarray(image, format=source)
            frame.pts, frame.time_base = (times or range(len(images)))[k], base
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    return path
