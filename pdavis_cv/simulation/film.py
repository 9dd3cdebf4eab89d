"""The light of a `VideoScene` on each pixel behind its polarizer."""
from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pdavis_cv.simulation.patterns import VideoScene
from pdavis_cv.simulation.scenes import FloatArray

__all__ = ["Film"]


class Film:
    """A video, cropped to a camera's region, and the responses of its pixels.

    Parameters
    ----------
    scene : VideoScene
        The video.
    analyser : ndarray of float64, shape (H, W, 3)
        Response of each pixel to S0, S1, S2.
    origin : (int, int)
        (row, column) of the camera's first pixel on the sensor.

    Attributes
    ----------
    weights : ndarray of float32, shape (3, H * W)
        Response of each pixel to I0 + I45 + I90 + I135, I0 - I90 and I45 - I135.
    """

    def __init__(
        self, scene: VideoScene, analyser: FloatArray, origin: tuple[int, int]
    ) -> None:
        self.scene = scene
        height, width = analyser.shape[:2]
        scene.check_covers(origin, (height, width))
        row, column = origin[0] - scene.origin[0], origin[1] - scene.origin[1]
        self._part = (slice(None), slice(row, row + height),
                      slice(column, column + width))
        self.weights = np.ascontiguousarray(
            analyser.reshape(-1, 3).T * [[0.5], [1.0], [1.0]], np.float32)

    def quad(self, t_us: float) -> NDArray[np.float32]:
        """Interpolate I0, I45, I90, I135 at a time, DN per ms, float32 (4, H, W)."""
        quad, last = self.scene.quad, len(self.scene.quad) - 1
        at = min(max(t_us * self.scene.fps / 1e6, 0.0), float(last))
        k = round(at)
        if abs(at - k) < 1e-6:
            return np.ascontiguousarray(quad[k][self._part], np.float32)
        k, part = int(at), at - int(at)
        return np.ascontiguousarray(
            quad[k][self._part] * (1 - part) + quad[k + 1][self._part] * part,
            np.float32)

    def light(self, quad: NDArray[np.float32], dark: float) -> NDArray[np.float32]:
        """Return the light on each pixel in DN per ms, float32 (H * W,).

        Bit-identical to `video_events`, whose operations it repeats.  ``quad`` is
        that of `quad`, ``dark`` the dark current as a light in DN per ms.
        """
        i0, i45, i90, i135 = quad.reshape(4, -1)
        half, along, across = self.weights
        return np.asarray(np.maximum(
            np.float32(dark) + half * ((i0 + i90) + (i45 + i135))
            + (along * (i0 - i90) + across * (i45 - i135)), np.float32(1e-9)))
