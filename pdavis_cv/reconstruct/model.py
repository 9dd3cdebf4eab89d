"""Records that the Kalman method shares with its kernels (``_kernels/_model.pxd``)."""
from __future__ import annotations

import numpy as np

__all__ = ["EXPOSURE_DTYPE", "GAP_DTYPE", "LANES", "LANE_VALUES", "NODE_DTYPE",
           "NO_GAP", "PAST_DTYPE", "REST_PLANES", "SAMPLE_DTYPE", "SMOOTH_PLANES",
           "STATE_DTYPE", "STORED_DTYPE", "TRACK_DTYPE", "TUNING_DTYPE", "WAVE_DTYPE"]

STORED_DTYPE = np.dtype([
    ("t", "<i8"), ("x", "<u2"), ("y", "<u2"), ("p", "u1"), ("next", "<i4")])
"""An event (t in us) and the index of its pixel's next one, -1 for none."""

TRACK_DTYPE = np.dtype([
    ("last", "<i8"), ("n_off", "<f8"), ("n_on", "<f8"), ("gap", "<u4"),
    ("first", "<i4")])
"""Stamp (2 t + p) of a pixel's last event, counts of events since the last sample, with
what a refractory period lost of the light, in thresholds; twice the gap before the last
event in us, plus the polarity of the one before, `NO_GAP` where there is none, and the
index of the first stored event after them, -1 for none."""

NO_GAP = 2**32 - 2
"""Gap of a pixel that had no two events within 35 minutes."""

STATE_DTYPE = np.dtype([
    ("base", "<f8"), ("theta_on", "<f8"), ("theta_off", "<f8"),
    ("var_base", "<f8"), ("cov_base_on", "<f8"), ("cov_base_off", "<f8"),
    ("var_on", "<f8"), ("cov_on_off", "<f8"), ("var_off", "<f8"),
    ("prior_on", "<f8"), ("prior_off", "<f8"), ("pull", "<f8"),
    ("frame_log", "<f8"), ("hot", "<f8"), ("moves", "<f8"),
    ("sampled_us", "<i8"), ("samples", "<i4"), ("seen_on", "<f8"),
    ("seen_off", "<f8"), ("part", "<f8")])
"""State (base, theta_on, theta_off) of a pixel and its covariance, natural-log units.

base is the log intensity (ln DN/ms) at the last event before ``sampled_us``, the middle
of the exposure of the last sample used; ``samples`` counts those (0: the base means
nothing), ``seen_on`` and ``seen_off`` all events up to then.  The priors are the
thresholds started from; ``pull`` is d(base) / d(offset of all frames), ln per DN.
``frame_log`` is the last sample, as it was; ``hot`` the ln of the odds that the pixel
is hot, less the prior's; ``moves`` the mean square of what log intensity changes by
between two samples, ln^2, of a hot pixel.  ``part`` is what a pixel at rest has
crossed of the last event's threshold, as samples since then were taken with it.
"""

TUNING_DTYPE = np.dtype([
    ("leak_per_s", "<f8"), ("noise_per_event", "<f8"), ("bandwidth_hz", "<f8"),
    ("bandwidth_hz_per_intensity", "<f8"), ("bandwidth_sigma", "<f8"),
    ("frame_sigma", "<f8"), ("shot_share", "<f8"), ("read_variance", "<f8"),
    ("shot_variance", "<f8"), ("offset_dn", "<f8"), ("valid_variance", "<f8"),
    ("motion_variance", "<f8"), ("doubt", "<f8"), ("still_us", "<f8"),
    ("refractory_us", "<f8"), ("threshold_drift", "<f8"),
    ("holds_part", "<f8")])
"""Process noise: variance of the sum of events, in thresholds^2, per second and per
event.  Photoreceptor: corner frequency in Hz, what an intensity of 1 DN/ms adds to it,
relative error of both.  Measurement noise: sigma of ln intensity that de-blurring
leaves, factor of the read and shot noise's variance, that of read noise in DN^2 and of
shot noise in DN^2 per DN, sigma in DN of an offset of all frames.  Variance (ln^2) up
to which an estimate is valid.  Where events come: variance in thresholds^2 of what
interpolation between them leaves; the probability that an event of a pixel at rest is
noise; gap between two events of which half say rest, us, 0: all of them are
interpolated; how long a pixel is held in reset after an event, us; variance of the
thresholds' relative change from one frame to the next; whether a pixel at rest keeps
``part`` (1) or has none (0)."""

SAMPLE_DTYPE = np.dtype([("log", "<f4"), ("variance", "<f4"), ("per_dn", "<f4")])
"""A frame's ln intensity, variance of its read and shot noise (ln^2; 0: no usable
sample), and what 1 DN more adds to it."""

EXPOSURE_DTYPE = np.dtype([("begin", "<i8"), ("middle", "<i8"), ("end", "<i8")])
"""Exposure of a column, us."""

WAVE_DTYPE = np.dtype([
    ("start_us", "<i8"), ("turns_per_us", "<f8"), ("cosine", "<f8"), ("sine", "<f8"),
    ("of_light", "<f8")])
"""Ripple of a lamp in one block (see `Wave`)."""

NODE_DTYPE = np.dtype([
    ("level", "<f4"), ("h_on", "<f4"), ("h_off", "<f4"), ("noise", "<f4"),
    ("drift", "<f4"), ("n_on", "<f8"), ("n_off", "<f8")])
"""A frame's measurement of one pixel."""

PAST_DTYPE = np.dtype([
    ("base", "<f8"), ("var", "<f8"), ("t", "<i8"), ("n_on", "<f8"), ("n_off", "<f8")])
"""Estimate of one pixel from the frames on one side of a time."""

GAP_DTYPE = np.dtype([
    ("before", PAST_DTYPE), ("after", PAST_DTYPE), ("drift", "<f8")])
"""Estimates from both sides."""

REST_PLANES, SMOOTH_PLANES = 4, 6
"""Planes of pixels at rest, float32: log intensity, its variance at an epoch, growth of
the variance per second, and variance of an offset of all frames; where later samples
count, also growth of log intensity per second, and of the variance per squared
second."""

LANES, LANE_VALUES = 64, 16
"""Moving pixels that are read together, and numbers that are kept of each."""
