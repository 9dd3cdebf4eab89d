"""Compiled kernels (private); typed in pdavis_cv/_kernels.pyi."""
from ._aedat4 import (
    aedat4_events,
    aedat4_table_bytes,
    aedat4_table_floats,
    aedat4_table_times,
)
from ._aps import cds, correct
from ._build import DEBUG
from ._demosaic import bilinear, superpixel
from ._elementwise import exp
from ._floor import floor_sum
from ._leaky import (
    cf_frame,
    cf_frame_literal,
    check_events,
    leak_events,
    leak_events_map,
    leak_read,
    log_frame,
)
from ._polarization import aop, aop_dolp, dolp, mix, polarize, stokes

__all__ = [
    "DEBUG",
    "aedat4_events",
    "aedat4_table_bytes",
    "aedat4_table_floats",
    "aedat4_table_times",
    "aop",
    "aop_dolp",
    "bilinear",
    "cds",
    "cf_frame",
    "cf_frame_literal",
    "check_events",
    "correct",
    "dolp",
    "exp",
    "floor_sum",
    "leak_events",
    "leak_events_map",
    "leak_read",
    "log_frame",
    "mix",
    "polarize",
    "stokes",
    "superpixel",
]
