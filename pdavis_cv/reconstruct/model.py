"""Records that the Kalman method shares with its kernels (``_kernels/_model.pxd``)."""
from __future__ import annotations

import numpy as np

__all__ = ["EXPOSURE_DTYPE", "GAP_DTYPE", "LANES", "LANE_VALUES", "NODE_DTYPE",
           "NO_GAP", "PAST_DTYPE", "REST_PLANES", "SAMPLE_DTYPE", "SMOOTH_PLANES",
           "STATE_DTYPE", "STORED_DTYPE", "TRACK_DTYPE", "TUNING_DTYPE", "WAVE_DTYPE"]

STORED_DTYPE = np.dtype([
    ("t", "<i8"), ("x", "<u2"), ("y", "<u2"), ("p", "u1"), ("next", "<i4")])
"""A stored event (t in us) and the index of its pixel's next event, -1 for none."""

TRACK_DTYPE = np.dtype([
    ("last", "<i8"), ("n_off", "<f8"), ("n_on", "<f8"), ("gap", "<u4"),
    ("first", "<i4")])
"""A pixel's past events: stamp (2 t + p) of the last one; counts of OFF and ON events
since the last sample, which include the change lost in refractory periods, in
thresholds; twice the gap (us) between the last two events plus the polarity of the
earlier one, or `NO_GAP`; index of the first stored event after them, -1 for none."""

NO_GAP = 2**32 - 2
"""Gap of a pixel whose last two events are missing or more than 35 minutes apart."""

STATE_DTYPE = np.dtype([
    ("base", "<f8"), ("theta_on", "<f8"), ("theta_off", "<f8"),
    ("var_base", "<f8"), ("cov_base_on", "<f8"), ("cov_base_off", "<f8"),
    ("var_on", "<f8"), ("cov_on_off", "<f8"), ("var_off", "<f8"),
    ("prior_on", "<f8"), ("prior_off", "<f8"), ("pull", "<f8"),
    ("frame_log", "<f8"), ("hot", "<f8"), ("moves", "<f8"),
    ("sampled_us", "<i8"), ("samples", "<i4"), ("seen_on", "<f8"),
    ("seen_off", "<f8"), ("part", "<f8"), ("unlit_log", "<f4"),
    ("first_difference", "<f4"), ("second_difference", "<f4"), ("quiet", "<f4")])
"""State (base, theta_on, theta_off) of a pixel and its covariance, natural-log units.

``base`` is the log intensity (ln DN/ms) at the last event before ``sampled_us``, the
middle of the exposure of the last sample used.  ``samples`` counts the samples used (0:
base is undefined), ``seen_on`` and ``seen_off`` all events up to then.  ``prior_on``
and ``prior_off`` are the initial thresholds.  ``pull`` is d(base) / d(offset of all
frames), ln per DN.  ``frame_log`` is the last sample as measured.  ``hot`` is the log
of the odds that the pixel is hot, relative to the prior odds; ``moves`` is the mean
square change of log intensity between two samples of a hot pixel, ln^2.  ``part`` is
the fraction of the last event's threshold by which a pixel at rest has moved on, as it
was assumed for the samples since then.  ``unlit_log`` is the last sample without the
lamp's ripple; its backward differences of first and second order follow.  ``quiet`` is
the number of samples in sequence, up to the last, before which no event had come since
the sample before.
"""

TUNING_DTYPE = np.dtype([
    ("leak_per_s", "<f8"), ("noise_per_event", "<f8"), ("bandwidth_hz", "<f8"),
    ("bandwidth_hz_per_intensity", "<f8"), ("bandwidth_sigma", "<f8"),
    ("frame_sigma", "<f8"), ("shot_share", "<f8"), ("read_variance", "<f8"),
    ("shot_variance", "<f8"), ("offset_dn", "<f8"), ("valid_variance", "<f8"),
    ("motion_variance", "<f8"), ("p_noise", "<f8"), ("still_us", "<f8"),
    ("refractory_us", "<f8"), ("threshold_drift", "<f8"),
    ("holds_part", "<f8"), ("needs_sample", "<f8"), ("jitter_us", "<f8")])
"""Parameters of the filter, in the order of the fields.

Process noise: variance of the sum of events per second and per event, thresholds^2.
Photoreceptor: corner frequency, Hz; its increase per DN/ms, Hz; relative standard error
of both.  Measurement noise: sigma of ln intensity after de-blurring; factor on the
variance of read and shot noise; variance of read noise, DN^2; of shot noise, DN^2 per
DN; sigma of an offset common to all frames, DN.  Validity: largest variance, ln^2.
Interpolation: error variance of interpolation between events, thresholds^2; probability
that an event of a pixel at rest is noise; gap between two events at which rest and
motion are equally likely, us (0: all gaps are interpolated); refractory period, us.
Then the variance of the thresholds' relative change from frame to frame; whether a
pixel at rest keeps ``part`` (1) or not (0); whether images leave out pixels without
a sample (1), because something else replaces them, or not (0); and the standard
deviation of events' time stamps, us."""

SAMPLE_DTYPE = np.dtype([("log", "<f4"), ("variance", "<f4"), ("per_dn", "<f4")])
"""A frame's sample of one pixel: ln intensity, variance of its read and shot noise
(ln^2; 0: not usable), and change of ln intensity per DN."""

EXPOSURE_DTYPE = np.dtype([("begin", "<i8"), ("middle", "<i8"), ("end", "<i8")])
"""Begin, middle and end of a column's exposure, us."""

WAVE_DTYPE = np.dtype([
    ("start_us", "<i8"), ("turns_per_us", "<f8"), ("cosine", "<f8"), ("sine", "<f8"),
    ("of_light", "<f8")])
"""Ripple of a lamp in one block (see `Wave`); its frequency is in turns per us."""

NODE_DTYPE = np.dtype([
    ("level", "<f4"), ("h_on", "<f4"), ("h_off", "<f4"), ("noise", "<f4"),
    ("drift", "<f4"), ("n_on", "<f8"), ("n_off", "<f8")])
"""A frame's measurement of one pixel, as the smoother takes it: level of log intensity,
its derivatives by the thresholds, its variance, process noise since the frame before,
and counts of events up to it."""

PAST_DTYPE = np.dtype([
    ("base", "<f8"), ("var", "<f8"), ("t", "<i8"), ("n_on", "<f8"), ("n_off", "<f8")])
"""Estimate of one pixel from all frames on one side of a time: log intensity, variance
(negative: no frame), time in us, and counts of events up to it."""

GAP_DTYPE = np.dtype([
    ("before", PAST_DTYPE), ("after", PAST_DTYPE), ("drift", "<f8")])
"""Estimates from the frames before and after a time, and process noise in between."""

REST_PLANES, SMOOTH_PLANES = 4, 6
"""Number of float32 planes cached for pixels at rest: log intensity; its variance at an
epoch; growth of the variance per second; variance of an offset common to all frames.
The smoother adds the growth of log intensity per second, and of the variance per
squared second."""

LANES, LANE_VALUES = 64, 20
"""Moving pixels that are read together, and the memory cached for each of them, in
float32."""
