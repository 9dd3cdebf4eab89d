"""Compiled kernels (private); typed in pdavis_cv/_kernels.pyi."""
from ._build import DEBUG
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

__all__ = [
    "DEBUG",
    "cf_frame",
    "cf_frame_literal",
    "check_events",
    "floor_sum",
    "leak_events",
    "leak_events_map",
    "leak_read",
    "log_frame",
]
