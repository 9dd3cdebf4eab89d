"""Calibration: the measured parameters of one camera."""
from __future__ import annotations

import dataclasses
import io
import json
import os
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdavis_cv._arrays import read_arrays
from pdavis_cv._beside import write_beside
from pdavis_cv._checks import sensor_shape
from pdavis_cv._types import Facts, Image
from pdavis_cv.errors import CalibrationError
from pdavis_cv.pixel.model import PixelModel
from pdavis_cv.sensor import Layout

FORMAT_VERSION = 1
"""Version of the file format; files of a newer version are rejected."""

_MOST_BYTES = 1 << 29
"""Largest size of all planes together: 41 bytes for each of 13 million pixels."""
_POSITIVE = ("theta_on", "theta_off", "gain")
_PLANES = (
    "theta_on", "theta_off", "theta_on_sigma", "theta_off_sigma", "dark", "dark_noise",
    "gain", "analyser", "usable")
_POSITIVE_NUMBERS = (
    "clip_dn", "bandwidth_hz", "bandwidth_hz_per_dn", "bandwidth_sigma")
_NUMBERS = (*_POSITIVE_NUMBERS, "clock_offset_us")
# Fields that must be given together.
_TOGETHER = (("theta_on", "theta_off"),)
_LEARNED = ("thresholds_sigma", "clock_offset_sigma_us", "black_dn", "black_sigma_dn")


@dataclass(frozen=True, kw_only=True, eq=False)
class Calibration:
    """The measured parameters of one camera; every field is optional.

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
    theta_on_sigma, theta_off_sigma : ndarray of float32, shape (H, W), optional
        Standard errors of the thresholds.
    dark : ndarray of float32, shape (H, W), optional
        Dark offset in DN, subtracted after correlated double sampling.
    dark_noise : ndarray of float32, shape (H, W), optional
        Temporal standard deviation of one dark frame, DN.
    gain : ndarray of float32, shape (H, W), optional
        Factor by which dark-subtracted DN are multiplied.
    analyser : ndarray of float32, shape (H, W, 3), optional
        Response of each pixel, after dark and gain, to S0, S1 and S2 of the light;
        an ideal polarizer at angle a has (1, cos 2a, sin 2a) / 2.
    usable : ndarray of bool, shape (H, W), optional
        False for hot and dead pixels.
    clip_dn : float, optional
        DN, before dark and gain, from which a pixel counts as saturated.
    bandwidth_hz : float, optional
        Corner frequency of the event pixels' photoreceptor, constant part.
    bandwidth_hz_per_dn : float, optional
        Corner frequency per DN per ms, the part proportional to intensity.
    bandwidth_sigma : float, optional
        Relative standard error of both.  If it is given, ``kalman`` refines the
        bandwidth from each recording; otherwise the bandwidth is taken as exact.
    clock_offset_us : float, optional
        Offset added to the frames' exposure times to bring them to the clock of the
        events, microseconds; positive if events trail frames.
    learned : mapping of str to object
        What recordings told beside these (`fuse(...).camera`): ``thresholds_sigma``,
        the relative error that all thresholds share; ``clock_offset_sigma_us``, with
        which ``kalman`` refines the offset, which is exact otherwise;
        ``black_dn`` and ``black_sigma_dn``, what frames lack of the light; ``model``, a
        `PixelModel` of what else events and frames tell of light.
    notes : mapping of str to object
        Provenance and conditions, JSON values: wavelength in nm, f-number,
        temperature, how each part was measured.

    Raises
    ------
    ValueError
        If a field has the wrong shape, is not finite, or is not positive where it must
        be.
    """

    sensor_size: tuple[int, int]
    chip: str | None = None
    serial: str | None = None
    layout: Layout | None = None
    theta_on: NDArray[np.float32] | None = None
    theta_off: NDArray[np.float32] | None = None
    theta_on_sigma: NDArray[np.float32] | None = None
    theta_off_sigma: NDArray[np.float32] | None = None
    dark: NDArray[np.float32] | None = None
    dark_noise: NDArray[np.float32] | None = None
    gain: NDArray[np.float32] | None = None
    analyser: NDArray[np.float32] | None = None
    usable: NDArray[np.bool_] | None = None
    clip_dn: float | None = None
    bandwidth_hz: float | None = None
    bandwidth_hz_per_dn: float | None = None
    bandwidth_sigma: float | None = None
    clock_offset_us: float | None = None
    learned: Facts = field(default_factory=dict)
    notes: Facts = field(default_factory=dict)

    def __post_init__(self) -> None:
        height, width = sensor_shape(self.sensor_size, "sensor_size")
        object.__setattr__(self, "sensor_size", (height, width))
        for name in _PLANES:
            if getattr(self, name) is not None:
                object.__setattr__(self, name, self._checked_plane(name))
        for name in _POSITIVE_NUMBERS:
            value = getattr(self, name)
            if value is not None and not 0 < float(value) < np.inf:
                raise ValueError(f"{name} must be positive, got {value}")
        if self.clock_offset_us is not None and not np.isfinite(self.clock_offset_us):
            raise ValueError(
                f"clock_offset_us must be finite, got {self.clock_offset_us}")
        for pair in _TOGETHER:
            if len({getattr(self, name) is None for name in pair}) > 1:
                raise ValueError(f"{' and '.join(pair)} must be given together")
        for name, value in self.learned.items():
            if not (isinstance(value, PixelModel) if name == "model" else
                    name in _LEARNED and isinstance(value, (int, float, np.floating))
                    and 0 < value < np.inf):
                raise ValueError(f"learned must hold positive {', '.join(_LEARNED)} "
                                 f"and a model, got {name!r}: {value!r}")
        for name in ("learned", "notes"):
            object.__setattr__(self, name, MappingProxyType(dict(getattr(self, name))))

    def _checked_plane(self, name: str) -> Image:
        value = getattr(self, name)
        depth = (3,) if name == "analyser" else ()
        shape = (*self.sensor_size, *depth)
        if np.shape(value) != shape:
            raise ValueError(f"{name} must have shape {shape}, got {np.shape(value)}")
        if name == "usable" and np.asarray(value).dtype != np.bool_:
            raise ValueError(f"usable must be bool, got {np.asarray(value).dtype}")
        plane: Image = np.array(value, np.bool_ if name == "usable" else np.float32)
        bad = ~np.isfinite(plane)
        if name in _POSITIVE:
            bad |= ~np.greater(plane, 0)
        if bad.any():
            y, x = np.argwhere(bad)[0][:2]
            rule = "positive" if name in _POSITIVE else "finite"
            raise ValueError(
                f"{name} must be {rule} everywhere, got {plane[y, x]} at x={x}, y={y}")
        plane.flags.writeable = False
        return plane

    @property
    def parts(self) -> tuple[str, ...]:
        """Names of the fields that are set."""
        return (*(name for name in ("layout", *_PLANES, *_NUMBERS)
                  if getattr(self, name) is not None), *self.learned)

    @property
    def extinction_ratio(self) -> NDArray[np.float64] | None:
        """Ratio of largest to smallest response of each pixel, shape (H, W)."""
        if self.analyser is None:
            return None
        a = self.analyser.astype(np.float64)
        swing = np.hypot(a[..., 1], a[..., 2])
        return np.asarray((a[..., 0] + swing) / np.maximum(a[..., 0] - swing, 1e-9))

    @property
    def angle(self) -> NDArray[np.float64] | None:
        """Angle of each pixel's polarizer in radians, [0, pi), shape (H, W)."""
        if self.analyser is None:
            return None
        a = self.analyser.astype(np.float64)
        return np.asarray(np.arctan2(a[..., 2], a[..., 1]) / 2 % np.pi)

    def replace(self, **parts: Any) -> Calibration:
        """Return a copy with some fields replaced."""
        return dataclasses.replace(self, **parts)

    def merge(self, other: Calibration) -> Calibration:
        """Return this calibration with the fields of another one of the same camera.

        A field that both have is taken from the other.

        Raises
        ------
        CalibrationError
            If the two belong to different cameras or have different layouts.
        """
        for name in ("sensor_size", "serial", "chip", "layout"):
            mine, theirs = getattr(self, name), getattr(other, name)
            if None not in (mine, theirs) and mine != theirs:
                raise CalibrationError(
                    f"calibrations can be merged only for one camera, but {name} is "
                    f"{mine} here and {theirs} there")
        known = {name: getattr(other, name)
                 for name in ("chip", "serial", "layout", *_PLANES, *_NUMBERS)
                 if getattr(other, name) is not None}
        return self.replace(**known, learned={**self.learned, **other.learned},
                            notes={**self.notes, **other.notes})

    def check_fits(
        self, sensor_size: tuple[int, int], serial: str | None = None
    ) -> None:
        """Raise CalibrationError if it belongs to another camera.

        Raises
        ------
        CalibrationError
            If size or serial number differ; the message says which.
        """
        if self.sensor_size != tuple(sensor_size):
            raise CalibrationError(
                f"calibration is of a {self.sensor_size} sensor (height, width), the "
                f"recording of {tuple(sensor_size)}")
        if None not in (self.serial, serial) and self.serial != serial:
            raise CalibrationError(
                f"calibration is of camera {self.serial}, the recording of camera "
                f"{serial}")

    def cropped(self, rows: slice, columns: slice) -> Calibration:
        """Return the calibration cropped to a part of the sensor.

        Parameters
        ----------
        rows, columns : slice
            Both with a start and a stop inside the sensor.
        """
        planes = {name: getattr(self, name)[rows, columns] for name in _PLANES
                  if getattr(self, name) is not None}
        layout = self.layout and self.layout.crop(columns.start, rows.start)
        return dataclasses.replace(
            self, sensor_size=(rows.stop - rows.start, columns.stop - columns.start),
            layout=layout, **planes)

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Write an npz file without pickles; return its path.

        Raises
        ------
        TypeError
            If ``notes`` hold a value that JSON cannot represent.
        """
        path = Path(path)
        head = {
            "format_version": FORMAT_VERSION, "sensor_size": self.sensor_size,
            "chip": self.chip, "serial": self.serial, "notes": dict(self.notes),
            "layout": None if self.layout is None else self.layout.angles_deg,
            "colours": None if self.layout is None else self.layout.colours,
            "learned": {name: value.as_lists() if name == "model" else value
                        for name, value in self.learned.items()},
            **{name: getattr(self, name) for name in _NUMBERS}}
        planes = {name: getattr(self, name) for name in _PLANES
                  if getattr(self, name) is not None}
        buffer = io.BytesIO()
        np.savez_compressed(buffer, head=np.array(json.dumps(head)), **planes)
        with write_beside(path) as part:
            part.write_bytes(buffer.getvalue())
        return path

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Calibration:
        """Read a file that `save` wrote.

        Raises
        ------
        FileNotFoundError
            If there is no such file.
        CalibrationError
            If the file is damaged, has another format, or a newer version.
        """
        path = Path(path)
        try:
            data = read_arrays(path, _MOST_BYTES)
            if "head" not in data:
                raise CalibrationError(f"{path}: not a calibration file")
            head = json.loads(str(data["head"]))
            version = head["format_version"]
            if version > FORMAT_VERSION:
                raise CalibrationError(
                    f"{path}: format version {version} is newer than "
                    f"{FORMAT_VERSION}, the latest that this version reads")
            planes: dict[str, Any] = {
                name: data[name] for name in _PLANES if name in data}
        except CalibrationError:
            raise
        except FileNotFoundError:
            raise
        except (OSError, ValueError, LookupError, TypeError,
                RecursionError) as error:
            raise CalibrationError(
                f"{path}: not a calibration file, or damaged: {error}") from None
        try:
            cell, learned = head["layout"], dict(head.get("learned", {}))
            if "model" in learned:
                learned["model"] = PixelModel.of_lists(learned["model"])
            for name in (*_NUMBERS, "colours"):
                head.setdefault(name, None)     # missing in files of earlier versions
            return cls(
                sensor_size=tuple(head["sensor_size"]), chip=head["chip"],
                serial=head["serial"], notes=head["notes"],
                layout=None if cell is None else Layout(
                    tuple(cell[0]), tuple(cell[1]), colours=head["colours"]),
                learned=learned, **{name: head[name] for name in _NUMBERS}, **planes)
        except (LookupError, TypeError, ValueError, AttributeError,
                OverflowError) as error:
            raise CalibrationError(f"{path}: damaged: {error}") from None
