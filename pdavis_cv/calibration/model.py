"""Calibration: what is known about one specimen of a camera."""
from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdavis_cv.sensor import Layout

__all__ = ["Calibration"]


@dataclass(frozen=True, kw_only=True, eq=False)
class Calibration:
    """What was measured about one camera; every part is optional.

    Parameters
    ----------
    sensor_size : (int, int)
        (height, width).
    chip : str, optional
        Chip class, e.g. ``"Davis346"``.
    serial : str, optional
        Serial number of the camera.
    layout : Layout, optional
        Polarizer layout.
    theta_on, theta_off : ndarray of float32, shape (H, W), optional
        Contrast thresholds, positive, in natural-log units.
    dark : ndarray of float32, shape (H, W), optional
        Dark offset in DN, subtracted after correlated double sampling.
    gain : ndarray of float32, shape (H, W), optional
        Factor that the dark-subtracted DN are multiplied by.
    analyser : ndarray of float32, shape (H, W, 3), optional
        Response of each pixel to S0, S1, S2.
    clip_dn : float, optional
        DN from which a pixel counts as saturated.
    notes : mapping of str to object
        Provenance and conditions.
    """

    sensor_size: tuple[int, int]
    chip: str | None = None
    serial: str | None = None
    layout: Layout | None = None
    theta_on: NDArray[np.float32] | None = None
    theta_off: NDArray[np.float32] | None = None
    dark: NDArray[np.float32] | None = None
    gain: NDArray[np.float32] | None = None
    analyser: NDArray[np.float32] | None = None
    clip_dn: float | None = None
    notes: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        size = tuple(self.sensor_size)
        for name in ("theta_on", "theta_off", "dark", "gain", "analyser"):
            array = getattr(self, name)
            if array is None:
                continue
            shape = (*size, 3) if name == "analyser" else size
            if np.shape(array) != shape:
                raise ValueError(
                    f"{name} must have shape {shape}, got {np.shape(array)}")
            frozen = np.array(array, np.float32)
            frozen.flags.writeable = False
            object.__setattr__(self, name, frozen)
        for name in ("theta_on", "theta_off", "gain"):
            array = getattr(self, name)
            if array is not None and not np.all(array > 0):
                raise ValueError(f"{name} must be positive everywhere")
        if (self.theta_on is None) != (self.theta_off is None):
            raise ValueError("theta_on and theta_off must be given together")
        object.__setattr__(self, "notes", MappingProxyType(dict(self.notes)))

    @property
    def identity(self) -> tuple[str | None, str | None, tuple[int, int]]:
        """(serial or None, chip class, size)."""
        return self.serial, self.chip, self.sensor_size
