"""The names of this room, and the module of each: the only list of them."""
from .frames import (
    dark_frame as dark_frame,
    flat_frame as flat_frame,
    mean_frame as mean_frame,
)
from .layout import detect_layout as detect_layout
from .model import Calibration as Calibration
from .sweep import fit_sweep as fit_sweep, read_sweep as read_sweep
from .thresholds import thresholds_from_biases as thresholds_from_biases
