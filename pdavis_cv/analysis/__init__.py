"""Measuring polarization images: regions, traces, loads, optics."""
from pdavis_cv.analysis.align import (
    Clock,
    align_by_correlation,
    align_by_offset,
    align_by_triggers,
)
from pdavis_cv.analysis.cycles import PhaseLaw
from pdavis_cv.analysis.event_tone import event_hz
from pdavis_cv.analysis.fan import SectorSummary, Wheel, summarise_sectors
from pdavis_cv.analysis.harmonics import (
    HarmonicFit,
    Harmonics,
    Wave,
    fit_harmonics,
    loop_area,
    of_aop,
    of_dolp,
    specimen_errors,
)
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
from pdavis_cv.analysis.optics import birefringence, retardance, subtract_background
from pdavis_cv.analysis.periodic import Periodic, fit_periodic
from pdavis_cv.analysis.roi import Roi, parse_roi, read_rois
from pdavis_cv.analysis.rotation import RotationFit, fit_rotation
from pdavis_cv.analysis.score import KnownLight, Score, Scorer, axial_difference
from pdavis_cv.analysis.spectrum import Tone, dominant_tone
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
    "HarmonicFit",
    "Harmonics",
    "KnownLight",
    "LeftOutFrames",
    "LoadTrace",
    "Periodic",
    "PhaseLaw",
    "PredictionScore",
    "Roi",
    "RotationFit",
    "Score",
    "Scorer",
    "SectorSummary",
    "Tone",
    "TraceRecorder",
    "Traces",
    "Wave",
    "Wheel",
    "align_by_correlation",
    "align_by_offset",
    "align_by_triggers",
    "axial_difference",
    "birefringence",
    "dominant_tone",
    "event_counts",
    "event_hz",
    "events_by_phase",
    "fit_harmonics",
    "fit_periodic",
    "fit_rotation",
    "loop_area",
    "observed",
    "of_aop",
    "of_dolp",
    "parse_roi",
    "pixel_intervals",
    "pooled",
    "read_load",
    "read_rois",
    "region_statistics",
    "retardance",
    "specimen_errors",
    "subtract_background",
    "summarise_sectors",
]
