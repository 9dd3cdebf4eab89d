"""Measuring polarization images: regions, traces, loads, optics."""
from pdavis_cv.analysis.align import (
    Clock,
    Loop,
    align_by_correlation,
    align_by_offset,
    align_by_triggers,
    hysteresis,
)
from pdavis_cv.analysis.fan import SectorSummary, Wheel, summarise_sectors
from pdavis_cv.analysis.intervals import events_by_phase, pixel_intervals
from pdavis_cv.analysis.left_out import (
    CLASSES,
    HALVES,
    LeftOutFrames,
    PredictionScore,
    observed,
    pooled,
)
from pdavis_cv.analysis.load import LoadTrace, read_load
from pdavis_cv.analysis.lockin import LockIn, LockInMaps
from pdavis_cv.analysis.optics import birefringence, retardance, subtract_background
from pdavis_cv.analysis.roi import Roi, parse_roi, read_rois
from pdavis_cv.analysis.rotation import RotationFit, fit_rotation
from pdavis_cv.analysis.score import KnownLight, Score, Scorer, axial_difference
from pdavis_cv.analysis.spectrum import (
    Cycle,
    Drift,
    Tone,
    alias_warning,
    cycle_average,
    cycle_drift,
    dominant_tone,
    fit_tone,
    phase_locked,
)
from pdavis_cv.analysis.traces import (
    TRACE_DTYPE,
    TraceRecorder,
    Traces,
    event_counts,
    region_statistics,
)

__all__ = [
    "CLASSES",
    "HALVES",
    "TRACE_DTYPE",
    "Clock",
    "Cycle",
    "Drift",
    "KnownLight",
    "LeftOutFrames",
    "LoadTrace",
    "LockIn",
    "LockInMaps",
    "Loop",
    "PredictionScore",
    "Roi",
    "RotationFit",
    "Score",
    "Scorer",
    "SectorSummary",
    "Tone",
    "TraceRecorder",
    "Traces",
    "Wheel",
    "alias_warning",
    "align_by_correlation",
    "align_by_offset",
    "align_by_triggers",
    "axial_difference",
    "birefringence",
    "cycle_average",
    "cycle_drift",
    "dominant_tone",
    "event_counts",
    "events_by_phase",
    "fit_rotation",
    "fit_tone",
    "hysteresis",
    "observed",
    "parse_roi",
    "phase_locked",
    "pixel_intervals",
    "pooled",
    "read_load",
    "read_rois",
    "region_statistics",
    "retardance",
    "subtract_background",
    "summarise_sectors",
]
