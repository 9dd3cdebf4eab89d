"""Fuse frames and events of a polarization event camera.

The names below are imported at first use, so that importing the package is fast.
"""
from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

# The module that defines each public name.
_HOME = {
    "AnalysisWarning": "errors",
    "CalibrationError": "errors",
    "DamagedFileWarning": "errors",
    "DeviceError": "errors",
    "ExposureWarning": "errors",
    "LayoutError": "errors",
    "LayoutWarning": "errors",
    "PdavisError": "errors",
    "PdavisWarning": "errors",
    "RecordingError": "errors",
    "WeightsError": "errors",
    "WindowWarning": "errors",
    "CHANNELS": "sensor",
    "Layout": "sensor",
    "Sensor": "sensor",
    "EVENT_DTYPE": "events",
    "EventSlice": "events",
    "accumulate": "events",
    "as_events": "events",
    "slices": "events",
    "time_surface": "events",
    "voxel_grid": "events",
    "Analyser": "analyser",
    "cds": "aps",
    "deblur": "reconstruct.deblur",
    "demosaic": "mosaic",
    "unpack": "packed",
    "PolarFrame": "polarimetry",
    "aop": "stokes_vector",
    "debias_dolp": "stokes_vector",
    "dolp": "stokes_vector",
    "polarization": "polarimetry",
    "stokes": "stokes_vector",
    "IMU_DTYPE": "recording.base",
    "TRIGGER_DTYPE": "recording.base",
    "ApsFrame": "recording.base",
    "FileRecording": "recording.files",
    "Format": "recording.format",
    "Packet": "recording.base",
    "Recording": "recording.base",
    "RecordingInfo": "recording.base",
    "Source": "recording.base",
    "recording_from_arrays": "recording.memory",
    "source_from_packets": "recording.stream",
    "FORMATS": "recording.registry",
    "open_recording": "recording.open",
    "Aedat2Writer": "recording.aedat2.writer",
    "write_aedat2": "recording.aedat2.writer",
    "Aedat4Writer": "recording.aedat4.writer",
    "write_aedat4": "recording.aedat4.writer",
    "ComplementaryFilter": "reconstruct.cf",
    "KalmanFilter": "reconstruct.kalman",
    "AOP_EVENT_DTYPE": "reconstruct.aop_events",
    "AopEvents": "reconstruct.aop_events",
    "EventDenoiser": "reconstruct.denoise",
    "EventHighPass": "reconstruct.events",
    "EventRedundancy": "reconstruct.redundancy",
    "FireNet": "reconstruct.firenet",
    "FrameHold": "reconstruct.frames",
    "Joint": "reconstruct.firenet",
    "Weights": "reconstruct.weights",
    "response_table": "reconstruct.firenet",
    "Estimate": "reconstruct.base",
    "Reconstructor": "reconstruct.base",
    "Needs": "reconstruct.base",
    "Snapshot": "reconstruct.base",
    "METHODS": "reconstruct.methods",
    "Calibration": "calibration.model",
    "DEFAULT_METHOD": "reconstruct.methods",
    "FusionOptions": "fusion.options",
    "bandwidth_in_situ": "fusion.learning",
    "clock_offset_in_situ": "fusion.learning",
    "fuse": "fusion.iteration",
    "thresholds_in_situ": "fusion.learning",
    "SOURCES": "live.address",
    "LinkFaults": "live.faults",
    "LiveSource": "live.base",
    "Session": "live.session",
    "SessionStats": "live.statistics",
    "open_source": "live.address",
    "Server": "viewer.server",
    "serve": "viewer.server",
    "view": "viewer.server",
    "patched_cv2": "adapters.patching",
    "CaptureStatus": "capture.video",
    "VideoCapture": "capture.video",
    "CAP_PDAVIS": "capture.constants",
    "CAP_PDAVIS_AOP": "capture.constants",
    "CAP_PDAVIS_AOP_BGR": "capture.constants",
    "CAP_PDAVIS_BGR": "capture.constants",
    "CAP_PDAVIS_DOLP": "capture.constants",
    "CAP_PDAVIS_DOLP_BGR": "capture.constants",
    "CAP_PDAVIS_EVENTS_BGR": "capture.constants",
    "CAP_PDAVIS_I0": "capture.constants",
    "CAP_PDAVIS_I45": "capture.constants",
    "CAP_PDAVIS_I90": "capture.constants",
    "CAP_PDAVIS_I135": "capture.constants",
    "CAP_PDAVIS_QUAD": "capture.constants",
    "CAP_PDAVIS_S0": "capture.constants",
    "CAP_PDAVIS_S1": "capture.constants",
    "CAP_PDAVIS_S2": "capture.constants",
    "CAP_PDAVIS_STOKES": "capture.constants",
    "CAP_PDAVIS_VALID": "capture.constants",
    "CAP_PROP_PDAVIS_CAPTURE_FPS": "capture.constants",
    "CAP_PROP_PDAVIS_CAUSAL": "capture.constants",
    "CAP_PROP_PDAVIS_CUTOFF_HZ": "capture.constants",
    "CAP_PROP_PDAVIS_DEMOSAIC": "capture.constants",
    "CAP_PROP_PDAVIS_EXPOSURE_US": "capture.constants",
    "CAP_PROP_PDAVIS_FPS": "capture.constants",
    "CAP_PROP_PDAVIS_GAIN": "capture.constants",
    "CAP_PROP_PDAVIS_GAMMA": "capture.constants",
    "CAP_PROP_PDAVIS_LAYOUT": "capture.constants",
    "CAP_PROP_PDAVIS_LOG": "capture.constants",
    "CAP_PROP_PDAVIS_METHOD": "capture.constants",
    "CAP_PROP_PDAVIS_OUTPUT": "capture.constants",
    "CAP_PROP_PDAVIS_POS_US": "capture.constants",
    "CAP_PROP_PDAVIS_START_US": "capture.constants",
    "CAP_PROP_PDAVIS_WHITE": "capture.constants",
}
_ROOMS = ("analysis", "batch", "calibration", "export", "render", "simulation")

# A literal, as type checkers do not run code.
__all__ = [
    "AOP_EVENT_DTYPE",
    "CAP_PDAVIS",
    "CAP_PDAVIS_AOP",
    "CAP_PDAVIS_AOP_BGR",
    "CAP_PDAVIS_BGR",
    "CAP_PDAVIS_DOLP",
    "CAP_PDAVIS_DOLP_BGR",
    "CAP_PDAVIS_EVENTS_BGR",
    "CAP_PDAVIS_I0",
    "CAP_PDAVIS_I45",
    "CAP_PDAVIS_I90",
    "CAP_PDAVIS_I135",
    "CAP_PDAVIS_QUAD",
    "CAP_PDAVIS_S0",
    "CAP_PDAVIS_S1",
    "CAP_PDAVIS_S2",
    "CAP_PDAVIS_STOKES",
    "CAP_PDAVIS_VALID",
    "CAP_PROP_PDAVIS_CAPTURE_FPS",
    "CAP_PROP_PDAVIS_CAUSAL",
    "CAP_PROP_PDAVIS_CUTOFF_HZ",
    "CAP_PROP_PDAVIS_DEMOSAIC",
    "CAP_PROP_PDAVIS_EXPOSURE_US",
    "CAP_PROP_PDAVIS_FPS",
    "CAP_PROP_PDAVIS_GAIN",
    "CAP_PROP_PDAVIS_GAMMA",
    "CAP_PROP_PDAVIS_LAYOUT",
    "CAP_PROP_PDAVIS_LOG",
    "CAP_PROP_PDAVIS_METHOD",
    "CAP_PROP_PDAVIS_OUTPUT",
    "CAP_PROP_PDAVIS_POS_US",
    "CAP_PROP_PDAVIS_START_US",
    "CAP_PROP_PDAVIS_WHITE",
    "CHANNELS",
    "DEFAULT_METHOD",
    "EVENT_DTYPE",
    "FORMATS",
    "IMU_DTYPE",
    "METHODS",
    "SOURCES",
    "TRIGGER_DTYPE",
    "Aedat2Writer",
    "Aedat4Writer",
    "Analyser",
    "AnalysisWarning",
    "AopEvents",
    "ApsFrame",
    "Calibration",
    "CalibrationError",
    "CaptureStatus",
    "ComplementaryFilter",
    "DamagedFileWarning",
    "DeviceError",
    "Estimate",
    "EventDenoiser",
    "EventHighPass",
    "EventRedundancy",
    "EventSlice",
    "ExposureWarning",
    "FileRecording",
    "FireNet",
    "Format",
    "FrameHold",
    "FusionOptions",
    "Joint",
    "KalmanFilter",
    "Layout",
    "LayoutError",
    "LayoutWarning",
    "LinkFaults",
    "LiveSource",
    "Needs",
    "Packet",
    "PdavisError",
    "PdavisWarning",
    "PolarFrame",
    "Reconstructor",
    "Recording",
    "RecordingError",
    "RecordingInfo",
    "Sensor",
    "Server",
    "Session",
    "SessionStats",
    "Snapshot",
    "Source",
    "VideoCapture",
    "Weights",
    "WeightsError",
    "WindowWarning",
    "__version__",
    "accumulate",
    "analysis",
    "aop",
    "as_events",
    "bandwidth_in_situ",
    "batch",
    "calibration",
    "cds",
    "clock_offset_in_situ",
    "debias_dolp",
    "deblur",
    "demosaic",
    "dolp",
    "export",
    "fuse",
    "open_recording",
    "open_source",
    "patched_cv2",
    "polarization",
    "recording_from_arrays",
    "render",
    "response_table",
    "serve",
    "simulation",
    "slices",
    "source_from_packets",
    "stokes",
    "thresholds_in_situ",
    "time_surface",
    "unpack",
    "view",
    "voxel_grid",
    "write_aedat2",
    "write_aedat4",
]

if TYPE_CHECKING:
    from pdavis_cv import analysis, batch, calibration, export, render, simulation
    from pdavis_cv.adapters.patching import patched_cv2
    from pdavis_cv.analyser import Analyser
    from pdavis_cv.aps import cds
    from pdavis_cv.calibration.model import Calibration
    from pdavis_cv.capture.constants import (
        CAP_PDAVIS,
        CAP_PDAVIS_AOP,
        CAP_PDAVIS_AOP_BGR,
        CAP_PDAVIS_BGR,
        CAP_PDAVIS_DOLP,
        CAP_PDAVIS_DOLP_BGR,
        CAP_PDAVIS_EVENTS_BGR,
        CAP_PDAVIS_I0,
        CAP_PDAVIS_I45,
        CAP_PDAVIS_I90,
        CAP_PDAVIS_I135,
        CAP_PDAVIS_QUAD,
        CAP_PDAVIS_S0,
        CAP_PDAVIS_S1,
        CAP_PDAVIS_S2,
        CAP_PDAVIS_STOKES,
        CAP_PDAVIS_VALID,
        CAP_PROP_PDAVIS_CAPTURE_FPS,
        CAP_PROP_PDAVIS_CAUSAL,
        CAP_PROP_PDAVIS_CUTOFF_HZ,
        CAP_PROP_PDAVIS_DEMOSAIC,
        CAP_PROP_PDAVIS_EXPOSURE_US,
        CAP_PROP_PDAVIS_FPS,
        CAP_PROP_PDAVIS_GAIN,
        CAP_PROP_PDAVIS_GAMMA,
        CAP_PROP_PDAVIS_LAYOUT,
        CAP_PROP_PDAVIS_LOG,
        CAP_PROP_PDAVIS_METHOD,
        CAP_PROP_PDAVIS_OUTPUT,
        CAP_PROP_PDAVIS_POS_US,
        CAP_PROP_PDAVIS_START_US,
        CAP_PROP_PDAVIS_WHITE,
    )
    from pdavis_cv.capture.video import CaptureStatus, VideoCapture
    from pdavis_cv.errors import (
        AnalysisWarning,
        CalibrationError,
        DamagedFileWarning,
        DeviceError,
        ExposureWarning,
        LayoutError,
        LayoutWarning,
        PdavisError,
        PdavisWarning,
        RecordingError,
        WeightsError,
        WindowWarning,
    )
    from pdavis_cv.events import (
        EVENT_DTYPE,
        EventSlice,
        accumulate,
        as_events,
        slices,
        time_surface,
        voxel_grid,
    )
    from pdavis_cv.fusion import (
        FusionOptions,
        bandwidth_in_situ,
        clock_offset_in_situ,
        fuse,
        thresholds_in_situ,
    )
    from pdavis_cv.live import (
        SOURCES,
        LinkFaults,
        LiveSource,
        Session,
        SessionStats,
        open_source,
    )
    from pdavis_cv.mosaic import demosaic
    from pdavis_cv.packed import unpack
    from pdavis_cv.polarimetry import PolarFrame, polarization
    from pdavis_cv.reconstruct.aop_events import AOP_EVENT_DTYPE, AopEvents
    from pdavis_cv.reconstruct.base import Estimate, Needs, Reconstructor, Snapshot
    from pdavis_cv.reconstruct.cf import ComplementaryFilter
    from pdavis_cv.reconstruct.deblur import deblur
    from pdavis_cv.reconstruct.denoise import EventDenoiser
    from pdavis_cv.reconstruct.events import EventHighPass
    from pdavis_cv.reconstruct.firenet import FireNet, Joint, response_table
    from pdavis_cv.reconstruct.frames import FrameHold
    from pdavis_cv.reconstruct.kalman import KalmanFilter
    from pdavis_cv.reconstruct.methods import DEFAULT_METHOD, METHODS
    from pdavis_cv.reconstruct.redundancy import EventRedundancy
    from pdavis_cv.reconstruct.weights import Weights
    from pdavis_cv.recording.aedat2.writer import Aedat2Writer, write_aedat2
    from pdavis_cv.recording.aedat4.writer import Aedat4Writer, write_aedat4
    from pdavis_cv.recording.base import (
        IMU_DTYPE,
        TRIGGER_DTYPE,
        ApsFrame,
        Packet,
        Recording,
        RecordingInfo,
        Source,
    )
    from pdavis_cv.recording.files import FileRecording
    from pdavis_cv.recording.format import Format
    from pdavis_cv.recording.memory import recording_from_arrays
    from pdavis_cv.recording.open import open_recording
    from pdavis_cv.recording.registry import FORMATS
    from pdavis_cv.recording.stream import source_from_packets
    from pdavis_cv.sensor import CHANNELS, Layout, Sensor
    from pdavis_cv.stokes_vector import aop, debias_dolp, dolp, stokes
    from pdavis_cv.viewer.server import Server, serve, view


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
