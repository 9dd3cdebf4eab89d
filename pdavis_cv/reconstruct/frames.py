"""The ``frames`` method, and how a frame becomes log intensity."""
from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from pdavis_cv import _kernels
from pdavis_cv._checks import output, sensor_shape
from pdavis_cv._types import Events, Parameters, State
from pdavis_cv.reconstruct.base import Estimate, Needs, Reconstructor
from pdavis_cv.reconstruct.stream_clock import StreamClock
from pdavis_cv.recording.base import ApsFrame


def log_exposure(frame: ApsFrame) -> NDArray[np.float32]:
    """Return ln of each column's exposure in ms, float32 (W,).

    It is 0 (plain DN) where the exposure is unknown.
    """
    ms = np.subtract(frame.exposure_end_us, frame.exposure_start_us) / 1000
    log = np.log(ms, out=np.zeros(np.shape(ms)), where=ms > 0)
    return np.broadcast_to(log, frame.shape[1:]).astype(np.float32)


def log_samples(
    frame: ApsFrame, exposure: NDArray[np.float32] | None = None
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Return the log intensity of a frame, and which of its samples are usable.

    The first, float32 (H, W), is ``ln(max(DN, 1)) - exposure``: per ms, or DN where no
    exposure is known; `exposure` (W,) is by default `log_exposure`.  ``dn`` is on the
    10-bit scale; a NaN counts as below the floor.  The second, bool (H, W), is the
    frame's ``valid``, and False below 1 DN.
    """
    if exposure is None:
        exposure = log_exposure(frame)
    log = np.empty(frame.shape, np.float32)
    valid = np.empty(frame.shape, np.bool_)
    _kernels.log_frame(
        frame.dn, usable_samples(frame), exposure, log, valid.view(np.uint8))
    return log, valid


def usable_samples(frame: ApsFrame) -> NDArray[np.uint8]:
    """Return where a frame's ``valid`` is set, or 1 everywhere; shape (H, W)."""
    if frame.valid is None:
        return np.ones(frame.shape, np.uint8)
    return np.ascontiguousarray(frame.valid).view(np.uint8)


class FrameHold(Reconstructor):
    """Hold the last frame; events are ignored.

    Parameters
    ----------
    shape : (int, int)
        (height, width).
    hold : {"readout", "mid"}
        Time from which on a frame is shown: the end of its readout (``available_us``),
        or its mid-exposure.  Before the first frame no pixel is valid.

    Raises
    ------
    ValueError
        If ``hold`` or ``shape`` is something else.
    """

    method = "frames"
    needs = Needs(events=False)

    def __init__(self, shape: Sequence[int], *, hold: str = "readout") -> None:
        if hold not in ("readout", "mid"):
            raise ValueError(f"hold must be 'readout' or 'mid', got {hold!r}")
        self.shape = sensor_shape(shape)
        self._hold = hold
        self.shows_at_readout = hold == "readout"
        self._clock = StreamClock(self.shape)
        # (shown from, log intensity, valid): the frame shown, then those to come.
        # The arrays are never written to, so snapshots may share them.
        self._frames: tuple[
            tuple[int, NDArray[np.float32], NDArray[np.bool_]], ...] = ()

    @property
    def parameters(self) -> Parameters:
        """Parameters that make an equal FrameHold."""
        return {"hold": self._hold}

    def add_events(self, events: Events) -> None:
        """Check the events and record their time."""
        self._clock.check_events(events)

    def add_frame(self, frame: ApsFrame) -> None:
        """Queue the frame until it may be shown."""
        mid = self._clock.check_frame(frame)
        start = mid if self._hold == "mid" else max(mid, frame.available_us)
        log, valid = log_samples(frame)
        shown = [f for f in self._frames if f[0] <= mid][-1:]
        coming = [f for f in self._frames if f[0] > mid]
        self._frames = (*shown, *coming, (start, log, valid))

    def shows(self, t_us: int) -> object | None:
        """Identify the frame that is held (see `Reconstructor.shows`)."""
        t = self._clock.check_read(t_us)
        held = [frame for frame in self._frames if frame[0] <= t]
        return held[-1] if held else None

    def read(self, t_us: int, out: NDArray[np.float32] | None = None) -> Estimate:
        """Return the log intensity of the frame that is held at t_us."""
        t = self._clock.check_read(t_us)
        log = output(out, self.shape, np.float32)
        held = [frame for frame in self._frames if frame[0] <= t]
        if not held:
            log.fill(0)
            return Estimate(log, None, np.zeros(self.shape, np.bool_))
        log[:] = held[-1][1]
        return Estimate(log, None, held[-1][2].copy())

    def _state(self) -> State:
        return {"last_us": self._clock.last_us,
                "frames": [(t, log.copy(), valid.copy())
                           for t, log, valid in self._frames]}

    def _restore(self, state: State) -> None:
        self._clock.last_us = state["last_us"]
        self._frames = tuple((t, log.copy(), valid.copy())
                             for t, log, valid in state["frames"])
