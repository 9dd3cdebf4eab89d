"""The names of this room, and the module of each: the only list of them."""
from .align import (
    Clock as Clock,
    align_by_correlation as align_by_correlation,
    align_by_triggers as align_by_triggers,
)
from .cycles import PhaseLaw as PhaseLaw
from .fan import (
    SectorSummary as SectorSummary,
    Wheel as Wheel,
    summarise_sectors as summarise_sectors,
)
from .harmonics import (
    HarmonicFit as HarmonicFit,
    Harmonics as Harmonics,
    Wave as Wave,
    fit_harmonics as fit_harmonics,
    loop_area as loop_area,
    mosaic_errors as mosaic_errors,
    of_aop as of_aop,
    of_dolp as of_dolp,
    specimen_errors as specimen_errors,
)
from .left_out import (
    CLASSES as CLASSES,
    HALVES as HALVES,
    LeftOutFrames as LeftOutFrames,
    PredictionScore as PredictionScore,
    observed as observed,
    pooled as pooled,
)
from .load import LoadTrace as LoadTrace, read_load as read_load
from .optics import (
    birefringence as birefringence,
    retardance as retardance,
    subtract_background as subtract_background,
)
from .periodic import Periodic as Periodic, fit_periodic as fit_periodic
from .roi import Roi as Roi, parse_roi as parse_roi, read_rois as read_rois
from .tones import event_hz as event_hz, trace_hz as trace_hz
from .traces import (
    TRACE_DTYPE as TRACE_DTYPE,
    TraceRecorder as TraceRecorder,
    Traces as Traces,
    axial_difference as axial_difference,
    event_counts as event_counts,
    region_statistics as region_statistics,
)
from .zero import found_zero as found_zero
