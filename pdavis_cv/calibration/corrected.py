"""Frames as the reconstructions take them: dark and gain removed, clipping marked."""
from __future__ import annotations

from dataclasses import dataclass

from pdavis_cv.aps import correct, peak_width, pile_up
from pdavis_cv.calibration.model import Calibration
from pdavis_cv.recording.base import ApsFrame

__all__ = ["Clipping", "FrameCorrection"]


@dataclass(frozen=True)
class Clipping:
    """Estimate, from the frames so far, of the DN at which pixels are full.

    Parameters
    ----------
    full_scale_dn : int
        Full scale of these frames.
    level_dn : float or None
        Lower edge of the pile-up; None where none was seen.
    top_dn : int
        Brightest value of the frame in which it was first seen.
    brightest_dn : int
        Brightest value of all frames, hot pixels left out.
    """

    full_scale_dn: int
    level_dn: float | None = None
    top_dn: int = 0
    brightest_dn: int = 0

    def after(self, frame: ApsFrame) -> Clipping:
        """Return what is known after one more frame.

        Notes
        -----
        A full pixel never gets brighter, so a pile-up is believed until a frame
        shows light that lies above it by more than its width, and one that lies as
        much below what was seen before is part of the scene.
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
    """Corrects the frames of one stream, one after the other.

    What is at the converter's full scale is clipped, however few pixels are, and
    whatever clip level is known.  Without a calibrated clip level the pile-up at the
    top of the histograms is taken: that of all frames so far, so that a pixel does not
    turn valid because fewer others are full.  A still image is a stream of one frame.

    Parameters
    ----------
    known : Calibration or None

    Attributes
    ----------
    clipping : Clipping
        All that frames change; may be set to what it was before.
    """

    def __init__(self, known: Calibration | None) -> None:
        self._known = known
        self.clipping = Clipping(0)

    def __call__(self, frame: ApsFrame) -> ApsFrame:
        """Return the next frame without dark and gain, what is unusable not valid.

        Parameters
        ----------
        frame : ApsFrame
            A frame of the whole sensor.
        """
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
