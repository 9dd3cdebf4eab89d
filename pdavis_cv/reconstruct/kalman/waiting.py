"""A frame that waits until the events around its exposure have been fed."""
from __future__ import annotations

import numpy as np

from pdavis_cv import _kernels
from pdavis_cv.reconstruct.frames import log_exposure, usable_samples
from pdavis_cv.reconstruct.kalman.frame_noise import DN_PER_SHOT, READ_NOISE_DN
from pdavis_cv.reconstruct.model import EXPOSURE_DTYPE, SAMPLE_DTYPE
from pdavis_cv.recording.base import ApsFrame

__all__ = ["WaitingFrame"]


class WaitingFrame:
    """A frame that waits for the events of its exposure; it is immutable.

    Parameters
    ----------
    frame : ApsFrame
        The frame as read out.
    lookahead_us : int
        How long each pixel's next event is waited for, us; 0 in mode "causal".

    Attributes
    ----------
    samples : ndarray of SAMPLE_DTYPE, shape (H, W)
        Log intensity and prior noise of each pixel.
    exposures : ndarray of EXPOSURE_DTYPE, shape (W,)
        Exposure of each column.
    known_us : int
        Stream time from which on the frame can be used.
    """

    __slots__ = ("exposures", "known_us", "samples")

    def __init__(self, frame: ApsFrame, lookahead_us: int) -> None:
        self.samples = np.empty(frame.shape, SAMPLE_DTYPE)
        _kernels.kalman_samples(
            frame.dn, usable_samples(frame), log_exposure(frame), READ_NOISE_DN**2,
            DN_PER_SHOT, self.samples)
        self.exposures = np.empty(frame.shape[1], EXPOSURE_DTYPE)
        self.exposures["begin"] = frame.exposure_start_us
        self.exposures["end"] = frame.exposure_end_us
        self.exposures["middle"] = frame.column_mid_us
        # The frame is used at a fixed stream time, however the packets are cut.
        waited = int(self.exposures["middle"].max()) + lookahead_us
        self.known_us = max(int(self.exposures["end"].max()), waited if lookahead_us
                            else frame.available_us)
