"""Records that methods share with their kernels (``_kernels/_model.pxd``)."""
from __future__ import annotations

import numpy as np

__all__ = ["NO_GAP", "STATE_DTYPE", "STORED_DTYPE", "TRACK_DTYPE", "TUNING_DTYPE",
           "WAVE_DTYPE"]

STORED_DTYPE = np.dtype([
    ("t", "<i8"), ("x", "<u2"), ("y", "<u2"), ("p", "u1"), ("next", "<i4")])
"""A stored event (t in us) and the index of its pixel's next event, -1 for none."""

TRACK_DTYPE = np.dtype([
    ("last", "<i8"), ("n_off", "<f8"), ("n_on", "<f8"), ("gap", "<u4"),
    ("first", "<i4")])
"""A pixel's past events: stamp (2 t + p) of the last one; counts of OFF and ON events
since the last comparison; twice the gap (us) between the last two events plus the
polarity of the earlier one, or `NO_GAP`; index of the first stored event after them, -1
for none."""

NO_GAP = 2**32 - 2
"""Gap of a pixel whose last two events are missing or more than 35 minutes apart."""

STATE_DTYPE = np.dtype([
    ("base", "<f8"), ("theta_on", "<f8"), ("theta_off", "<f8"), ("prior_on", "<f8"),
    ("prior_off", "<f8")])
"""State of a pixel: log intensity at the last event counted, up to an offset; its
thresholds, and those stated; natural-log units."""

TUNING_DTYPE = np.dtype([
    ("bandwidth_hz", "<f8"), ("bandwidth_hz_per_intensity", "<f8")])
"""Corner frequency of the photoreceptor, Hz; its increase per DN/ms, Hz."""

WAVE_DTYPE = np.dtype([
    ("start_us", "<i8"), ("turns_per_us", "<f8"), ("cosine", "<f8"), ("sine", "<f8"),
    ("of_light", "<f8")])
"""Ripple of a lamp in one block (see `Wave`); its frequency is in turns per us."""
