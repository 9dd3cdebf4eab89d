"""Prior knowledge about a DAVIS pixel, before its own data are looked at."""
from __future__ import annotations

from pdavis_cv.sensor import THRESHOLD_SIGMA

__all__ = ["CLOCK_OFFSET_SIGMA_US", "LEAK_HZ", "THRESHOLD_SIGMA",
           "TYPICAL_BANDWIDTH", "USUAL_BANDWIDTH", "USUAL_MISMATCH"]

CLOCK_OFFSET_SIGMA_US = 5000.0
"""Prior standard deviation of the offset between the clocks of frames and events, about
0: events trail frames by 3 to 7 ms on the two cameras that were measured.
"""

LEAK_HZ = (0.2, 0.08)
"""Leak events of a pixel per second at usual biases, mean and standard deviation.

ON events without a change of the light pass for a lower ON threshold.  Over a period
of the light their effect is constant, so a recording at one speed hardly tells it from
the ratio of the thresholds.  0.1 per second at room temperature (Nozaki and Delbruck,
IEEE Trans. Electron Devices 64, 2017), more in bright light and at low thresholds
(specifications of the PDAVIS paper: 0.7 at the lowest, under 26 DN/ms).
"""

USUAL_MISMATCH = 0.035
"""Pixel-to-pixel standard deviation of a threshold relative to its mean.

The specifications of the PDAVIS paper (table of the sensor).
"""

TYPICAL_BANDWIDTH = (300.0, 0.0, 0.5)
"""Photoreceptor before any data: Hz, Hz per DN/ms, standard deviation of the ln.

Used while causal images have too short a past; the standard deviation counts in the
variance of the images.
"""

USUAL_BANDWIDTH = (300.0, 0.0, 1.5)
"""Prior of the fit: corner frequency of bright pixels at usual DAVIS biases, in Hz,
none of it in proportion to the light, and the standard deviation of its ln.

The mean is the order of magnitude that Brandli et al. (2014) and Lichtsteiner et al.
(2008) state for office light; 1.5 in ln (a factor of 4.5) spans their bias settings.
"""
