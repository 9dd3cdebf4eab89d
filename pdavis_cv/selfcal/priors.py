"""Priors of a DAVIS pixel's parameters, before any of its data are used."""
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

Leak events are ON events without a change of the light, and look like a lower ON
threshold.  Their number per period of the light is constant, so a recording at one
speed hardly separates them from the ratio of the thresholds.  The rate is 0.1 per
second at room temperature (Nozaki and Delbruck, IEEE Trans. Electron Devices 64, 2017),
and more in bright light and at low thresholds (specifications of the PDAVIS paper: 0.7
at the lowest, under 26 DN/ms).
"""

USUAL_MISMATCH = 0.035
"""Pixel-to-pixel standard deviation of a threshold relative to its mean.

The specifications of the PDAVIS paper (table of the sensor).
"""

TYPICAL_BANDWIDTH = (300.0, 0.0, 0.5)
"""Bandwidth assumed before any data: Hz, Hz per DN/ms, standard deviation of the ln.

It is used until causal images have a long enough past; the standard deviation is
propagated to the variance of the images.
"""

USUAL_BANDWIDTH = (300.0, 0.0, 1.5)
"""Prior of the fit: corner frequency of bright pixels at usual DAVIS biases, in Hz; no
part proportional to the light; standard deviation of the ln.

The mean is the order of magnitude that Brandli et al. (2014) and Lichtsteiner et al.
(2008) state for office light; 1.5 in ln (a factor of 4.5) spans their bias settings.
"""
