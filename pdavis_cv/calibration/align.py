"""Statistics of frames for the alignment of a polarizer array on a sensor."""
from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pdavis_cv.calibration.frames import frames_of
from pdavis_cv.recording.base import ApsFrame, Recording
from pdavis_cv.sensor import Layout

__all__ = ["Alignment", "alignment"]


class Alignment(NamedTuple):
    """Statistics of one frame, in ``CHANNELS`` order.

    Attributes
    ----------
    t_us : int
        Mid-exposure.
    mean_dn, sd_dn : tuple of float
        Mean and standard deviation of each channel's pixels.
    ratio : (float, float)
        Ratio of the larger to the smaller sample of each 0/90 pair and each 45/135
        pair, averaged.  While a polarizer before the lens is turned, its largest value
        is the extinction ratio; it decreases if the array is misaligned or tilted.
    """

    t_us: int
    mean_dn: tuple[float, float, float, float]
    sd_dn: tuple[float, float, float, float]
    ratio: tuple[float, float]


def alignment(
    frames: Recording | Iterable[ApsFrame],
    layout: Layout,
    *,
    dark: NDArray[np.float32] | None = None,
    roi: tuple[int, int, int, int] | None = None,
) -> Iterator[Alignment]:
    """Yield the statistics of each frame.

    These are the numbers of steps 6 to 8 of the paper's section "PDAVIS fabrication":
    mean and standard deviation of the pixels and the extinction ratio between
    orthogonal neighbours, observed while pitch, yaw and position are adjusted.  Contact
    is reached when the ratios stay constant.

    Parameters
    ----------
    frames : Recording or iterable of ApsFrame
        Frames of uniform light through a linear polarizer.
    layout : Layout
        Polarizer layout.
    dark : ndarray of float32, shape (H, W), optional
        Dark offset in DN.
    roi : (int, int, int, int), optional
        (x, y, width, height); partial cells at its edges are left out.

    Yields
    ------
    Alignment
    """
    for frame in frames_of(frames):
        dn = frame.dn if dark is None else frame.dn - dark
        x, y, w, h = roi or (0, 0, dn.shape[1], dn.shape[0])
        top, left = y + y % 2, x + x % 2
        rows, columns = (y + h - top) // 2, (x + w - left) // 2
        cells = dn[top:top + 2 * rows, left:left + 2 * columns].reshape(
            rows, 2, columns, 2)
        planes = [cells[:, place // 2, :, place % 2].astype(np.float64)
                  for place in layout.places]
        a, b, c, d = (float(plane.mean()) for plane in planes)
        e, f, g, i = (float(plane.std()) for plane in planes)
        yield Alignment(frame.mid_us, (a, b, c, d), (e, f, g, i),
                        (_ratio(planes[0], planes[2]), _ratio(planes[1], planes[3])))


def _ratio(one: NDArray[np.float64], other: NDArray[np.float64]) -> float:
    """Return the sum of the brighter over the sum of the darker samples.

    Unlike a mean of ratios, this divides no sample by one that is mostly noise.
    """
    low, high = sorted((float(one.sum()), float(other.sum())))
    return high / max(low, 1e-9)
