"""Correct frames for reconstruction: remove dark and gain, mark saturated pixels."""
from __future__ import annotations

from dataclasses import dataclass

from pdavis_cv.aps import correct, peak_width, pile_up
from pdavis_cv.calibration.model import Calibration
from pdavis_cv.recording.base import ApsFrame


@dataclass(frozen=True)
class Clipping:
    """Estimate, from the frames so far, of the DN at which pixels saturate.

    Saturated pixels pile up in a peak at the upper end of a frame's histogram.

    Parameters
    ----------
    full_scale_dn : int
        Full scale of the converter.
    level_dn : float or None
        Lower edge of the peak; None if there was none.
    top_dn : int
        Brightest value of the frame in which the peak first appeared.
    brightest_dn : int
        Brightest value of all frames, without hot pixels.
    """

    full_scale_dn: int
    level_dn: float | None = None
    top_dn: int = 0
    brightest_dn: int = 0

    def after(self, frame: ApsFrame) -> Clipping:
        """Return the estimate updated with one more frame.

        A saturated pixel never gets brighter.  So a peak is discarded when a frame
        shows values above it by more than its width, and a peak that lies as far below
        the values of earlier frames is taken as part of the scene.
        """
        full_scale = frame.full_scale_dn
        if full_scale != self.full_scale_dn:
            return Clipping(full_scale).after(frame)
        top, edge = pile_up(frame.dn, full_scale)
        if top is None:
            return self
        width = peak_width(full_scale)
        level, peak = self.level_dn, self.top_dn
        if level is not None and top > peak + width:
            level = None
        brightest = max(self.brightest_dn, top)
        if edge is not None and top >= brightest - width:
            level, peak = (edge, top) if level is None else (min(level, edge), peak)
        return Clipping(full_scale, level, peak, brightest)


class FrameCorrection:
    """Correct the frames of one stream, in order.

    Pixels at the converter's full scale are always saturated.  Without a calibrated
    clip level, the level is estimated from the peak at the upper end of the histograms
    of all frames so far, so that a pixel does not become valid because fewer others are
    saturated.  That estimate, `clipping`, may be set to an earlier one.  A still image
    is a stream of one frame.
    """

    def __init__(self, known: Calibration | None) -> None:
        self._known = known
        self.clipping = Clipping(0)

    def __call__(self, frame: ApsFrame) -> ApsFrame:
        """Return the next frame without dark and gain; unusable pixels are marked."""
        known = self._known
        dark, gain, clip_dn = (None, None, None) if known is None else (
            known.dark, known.gain, known.clip_dn)
        if clip_dn is None:
            self.clipping = self.clipping.after(frame)
            clip_dn = self.clipping.level_dn
        limit = frame.full_scale_dn if clip_dn is None else min(
            clip_dn, frame.full_scale_dn)
        dn, valid = correct(frame.dn, dark, gain, limit, frame.valid)
        if known is not None and known.usable is not None:
            valid &= known.usable
        return frame.replace(dn=dn, valid=valid, reset=None, signal=None)
