"""A frame as the reconstructions take it: dark and gain removed, clipping marked."""
from __future__ import annotations

from pdavis_cv.aps import clip_level, correct
from pdavis_cv.calibration.model import Calibration
from pdavis_cv.recording.base import ApsFrame

__all__ = ["corrected"]


def corrected(frame: ApsFrame, known: Calibration | None) -> ApsFrame:
    """Return the frame without dark and gain, unusable and clipped pixels not valid.

    Parameters
    ----------
    frame : ApsFrame
        Of the whole sensor.
    known : Calibration or None
        Without a clip level, the pile-up at the top of the frame's histogram is taken.

    Notes
    -----
    What is at the converter's full scale is clipped, however few pixels are, and
    whatever clip level is known.
    """
    dark, gain, clip_dn = (None, None, None) if known is None else (
        known.dark, known.gain, known.clip_dn)
    if clip_dn is None:
        clip_dn = clip_level(frame.dn, frame.full_scale_dn)
    limit = frame.full_scale_dn if clip_dn is None else min(
        clip_dn, frame.full_scale_dn)
    dn, valid = correct(frame.dn, dark, gain, limit, frame.valid)
    if known is not None and known.usable is not None:
        valid &= known.usable
    return frame.replace(dn=dn, valid=valid, reset=None, signal=None)
