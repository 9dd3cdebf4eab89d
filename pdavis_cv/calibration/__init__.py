"""Calibration of one camera, and how its parts are measured."""
from pdavis_cv.calibration.frames import dark_frame, flat_frame, mean_frame
from pdavis_cv.calibration.layout import detect_layout
from pdavis_cv.calibration.model import Calibration
from pdavis_cv.calibration.sweep import fit_sweep, read_sweep
from pdavis_cv.calibration.thresholds import thresholds_from_biases

__all__ = [
    "Calibration",
    "dark_frame",
    "detect_layout",
    "fit_sweep",
    "flat_frame",
    "mean_frame",
    "read_sweep",
    "thresholds_from_biases",
]
