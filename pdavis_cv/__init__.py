"""Frames and events of a polarization event camera, fused.

The names below load at first use, so that importing the package is cheap.
"""
from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

# Public name -> the module that defines it.
_HOME = {
    "AnalysisWarning": "errors",
    "BusWarning": "errors",
    "CalibrationError": "errors",
    "CalibrationWarning": "errors",
    "DamagedFileWarning": "errors",
    "ExposureWarning": "errors",
    "LayoutError": "errors",
    "LayoutWarning": "errors",
    "PdavisError": "errors",
    "PdavisWarning": "errors",
    "RecordingError": "errors",
    "CHANNELS": "sensor",
    "Layout": "sensor",
    "Sensor": "sensor",
    "EVENT_DTYPE": "events",
    "as_events": "events",
    "Analyser": "analyser",
    "cds": "aps",
    "demosaic": "mosaic",
    "PolarFrame": "polarimetry",
    "aop": "polarimetry",
    "dolp": "polarimetry",
    "polarization": "polarimetry",
    "stokes": "polarimetry",
    "IMU_DTYPE": "recording.base",
    "TRIGGER_DTYPE": "recording.base",
    "ApsFrame": "recording.base",
    "Packet": "recording.base",
    "Recording": "recording.base",
    "recording_from_arrays": "recording.memory",
    "ComplementaryFilter": "reconstruct.cf",
    "KalmanFilter": "reconstruct.kalman",
    "FrameHold": "reconstruct.frames",
    "Estimate": "reconstruct.base",
    "Reconstructor": "reconstruct.base",
    "Snapshot": "reconstruct.base",
    "METHODS": "reconstruct.methods",
    "Calibration": "calibration.model",
    "DEFAULT_METHOD": "fusion",
    "fuse": "fusion",
}
_ROOMS = ("analysis", "calibration", "export", "render", "simulation")

__all__ = ["__version__", *_HOME, *_ROOMS]

if TYPE_CHECKING:
    from pdavis_cv import analysis, calibration, export, render, simulation
    from pdavis_cv.analyser import Analyser
    from pdavis_cv.aps import cds
    from pdavis_cv.calibration.model import Calibration
    from pdavis_cv.errors import (
        AnalysisWarning,
        BusWarning,
        CalibrationError,
        CalibrationWarning,
        DamagedFileWarning,
        ExposureWarning,
        LayoutError,
        LayoutWarning,
        PdavisError,
        PdavisWarning,
        RecordingError,
    )
    from pdavis_cv.events import EVENT_DTYPE, as_events
    from pdavis_cv.fusion import DEFAULT_METHOD, fuse
    from pdavis_cv.mosaic import demosaic
    from pdavis_cv.polarimetry import PolarFrame, aop, dolp, polarization, stokes
    from pdavis_cv.reconstruct.base import Estimate, Reconstructor, Snapshot
    from pdavis_cv.reconstruct.cf import ComplementaryFilter
    from pdavis_cv.reconstruct.frames import FrameHold
    from pdavis_cv.reconstruct.kalman import KalmanFilter
    from pdavis_cv.reconstruct.methods import METHODS
    from pdavis_cv.recording.base import (
        IMU_DTYPE,
        TRIGGER_DTYPE,
        ApsFrame,
        Packet,
        Recording,
    )
    from pdavis_cv.recording.memory import recording_from_arrays
    from pdavis_cv.sensor import CHANNELS, Layout, Sensor


def __getattr__(name: str) -> Any:
    if name in _ROOMS:
        return importlib.import_module(f"pdavis_cv.{name}")
    if name not in _HOME:
        raise AttributeError(f"module 'pdavis_cv' has no attribute {name!r}")
    value = getattr(importlib.import_module(f"pdavis_cv.{_HOME[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(__all__)
