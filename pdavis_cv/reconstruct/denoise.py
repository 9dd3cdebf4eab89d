"""Denoising of events that leaves the polarizers apart."""
from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdavis_cv import _kernels
from pdavis_cv._checks import sensor_shape, whole_number
from pdavis_cv._workers import Workers
from pdavis_cv.events import FAR, as_events, timed_events
from pdavis_cv.reconstruct.base import Estimate, Reconstructor
from pdavis_cv.reconstruct.lamp import Wave
from pdavis_cv.reconstruct.stream_clock import StreamClock
from pdavis_cv.recording.base import ApsFrame

__all__ = ["Denoised", "EventDenoiser"]

RATE_WINDOW_US = 250_000
"""Interval in us after which the pixels' event rates are updated and compared."""
RATE_SHARE = 0.25
"""Weight of the last interval in the exponential mean of a pixel's rate, which so
remembers about a second."""
HOT_FLOOR_HZ, HOT_FACTOR = 6.0, 4.0
"""A pixel is hot if its rate exceeds floor + factor x the median of its neighbours'.

The floor keeps Poisson fluctuations from taking a pixel of a whole chip for hot in an
hour (4.5 Hz are enough, studies/denoise.py); the factor leaves room for edges.
"""
WINDOW_US = 50_000
"""How long an event supports its neighbours, us: a window twice as long would save less
than .5 % of the events of a polarizer at 30 RPM (studies/denoise.py)."""
SUPPORT = 2
"""Neighbours of eight that an edge passes in any direction (studies/denoise.py)."""
_NEIGHBOURS = 8
"""Behind the same polarizer and two rows or columns away, by the layout."""
_NEVER = -(2**62)
"""A time in us before all stamps; differences to it fit 64 bits."""
_FORGOTTEN = 64
"""Intervals without an event after which rates are 0 to float32's accuracy."""


class EventDenoiser:
    """Leaves out events that no neighbour behind the same polarizer supports.

    Adjacent pixels look through other polarizers and so at other light; the eight
    pixels two rows or columns away look through the same.  An event is kept if enough
    of those had one of its polarity shortly before, and its pixel is not hot: does
    not have far more events than they.

    Parameters
    ----------
    shape : (int, int)
        (height, width).
    window_us : int
        How long an event supports its neighbours.
    support : int
        How many neighbours are needed, 1 to 8.

    Raises
    ------
    ValueError
        If a parameter is out of range.

    Notes
    -----
    Noise of n Hz per pixel is left at about n (8 n w)^2 / 8 for two supporters and a
    window of w seconds; hot pixels are known after a quarter of a second.  The result
    does not depend on how the stream is cut into packets.
    """

    def __init__(
        self, shape: Sequence[int], *, window_us: int = WINDOW_US,
        support: int = SUPPORT,
    ) -> None:
        self.shape = sensor_shape(shape)
        self._window_us = whole_number("window_us", window_us, 1, FAR)
        if support not in range(1, _NEIGHBOURS + 1):
            raise ValueError(f"support must be 1 to 8, got {support!r}")
        self._support = int(support)
        self._clock = StreamClock(self.shape)
        self._times = np.full((*self.shape, 2), _NEVER, np.int64)
        self._counts = np.zeros(self.shape, np.int32)
        self._rates = np.zeros(self.shape, np.float32)
        self._hot = np.zeros(self.shape, np.uint8)
        self._stop_us: int | None = None   # end of the window of rates

    @property
    def parameters(self) -> Mapping[str, Any]:
        """Parameters that make an equal EventDenoiser."""
        return {"window_us": self._window_us, "support": self._support}

    @property
    def hot(self) -> NDArray[np.bool_]:
        """Pixels that are hot now, shape (H, W)."""
        return self._hot.astype(np.bool_)

    def keep(self, events: Any) -> NDArray[np.bool_]:
        """Take events and tell which are kept.

        Parameters
        ----------
        events : ndarray of EVENT_DTYPE, shape (N,)
            Time-ordered, not before those taken earlier; or what `as_events` accepts.

        Returns
        -------
        ndarray of bool, shape (N,)

        Raises
        ------
        ValueError
            If an event lies outside the sensor or is late; the message names it, and
            those before it have been taken.
        """
        events = timed_events(events)
        keep = np.zeros(len(events), np.uint8)
        if len(events) and self._stop_us is None:
            self._stop_us = (int(events["t"][0]) // RATE_WINDOW_US + 1) * RATE_WINDOW_US
        at, last = 0, self._clock.last_us
        while at < len(events):
            assert self._stop_us is not None
            before = at
            at = _kernels.denoise_events(
                events, at, last, self._stop_us, self._window_us, self._support,
                self._hot, self._times, self._counts, keep)
            if at == len(events):
                break
            last = int(events["t"][at - 1]) if at > before else last
            if int(events["t"][at]) < max(self._stop_us, last):
                break           # this one is to be named
            self._end_windows(int(events["t"][at]))
        self._clock.took(events, at)
        return keep.view(np.bool_)

    def filter(self, events: Any) -> NDArray[Any]:
        """Take events and return those that are kept (see `keep`)."""
        events = as_events(events)
        kept: NDArray[Any] = events[self.keep(events)]
        return kept

    def _end_windows(self, t_us: int) -> None:
        """End the windows of rates before the one that t_us lies in."""
        assert self._stop_us is not None
        passed = (t_us - self._stop_us) // RATE_WINDOW_US + 1
        self._stop_us += passed * RATE_WINDOW_US
        for _ in range(min(passed, _FORGOTTEN)):
            _kernels.denoise_rates(
                self._counts, self._rates, self._hot, RATE_SHARE,
                1e6 / RATE_WINDOW_US, HOT_FLOOR_HZ, HOT_FACTOR)

    def state(self) -> Mapping[str, Any]:
        """Return copies of everything that events change."""
        return {"last_us": self._clock.last_us, "times": self._times.copy(),
                "counts": self._counts.copy(), "rates": self._rates.copy(),
                "hot": self._hot.copy(), "stop_us": self._stop_us}

    def restore(self, state: Mapping[str, Any]) -> None:
        """Take over copies of what `state` returned."""
        self._clock.last_us, self._stop_us = state["last_us"], state["stop_us"]
        self._times[:], self._counts[:] = state["times"], state["counts"]
        self._rates[:], self._hot[:] = state["rates"], state["hot"]


class Denoised(Reconstructor):
    """A method that is fed what an `EventDenoiser` keeps.

    Parameters
    ----------
    method : Reconstructor
        Fresh; nobody else may feed it.
    **parameters
        Of `EventDenoiser`.
    """

    def __init__(self, method: Reconstructor, **parameters: Any) -> None:
        self._inner = method
        self._denoiser = EventDenoiser(method.shape, **parameters)
        self.method, self.shape = method.method, method.shape
        self.lookahead_us = method.lookahead_us
        # A pixel's supporters may be hot by what their own neighbours do.
        self.margin = method.margin + 4
        self.needs = method.needs
        self.causal_parameters = method.causal_parameters
        self.shows_at_readout = method.shows_at_readout
        self.takes_late_frames = method.takes_late_frames

    @property
    def parameters(self) -> Mapping[str, Any]:
        """Parameters of the method, and of the denoiser as ``denoise``."""
        return {**self._inner.parameters, "denoise": dict(self._denoiser.parameters)}

    @property
    def workers(self) -> Workers:
        """Those of the method."""
        return self._inner.workers

    @workers.setter
    def workers(self, workers: Workers) -> None:
        self._inner.workers = workers

    @property
    def quality(self) -> NDArray[np.float32] | None:
        """That of the method."""
        return self._inner.quality

    def add_events(self, events: NDArray[Any]) -> None:
        """Feed what is kept of the events (see `Reconstructor.add_events`)."""
        self._inner.add_events(self._denoiser.filter(events))

    def add_frame(self, frame: ApsFrame) -> None:
        """Feed the frame."""
        self._inner.add_frame(frame)

    def add_wave(self, wave: Wave) -> None:
        """Tell how the lamp flickers."""
        self._inner.add_wave(wave)

    def retune(self, **learned: Any) -> None:
        """Go on with other parameters of the method."""
        self._inner.retune(**learned)

    def settle(self, t_us: int) -> None:
        """Let the method do what is due."""
        self._inner.settle(t_us)

    def shows(self, t_us: int) -> object | None:
        """Return what stands for what the method shows."""
        return self._inner.shows(t_us)

    def read(self, t_us: int, out: NDArray[np.float32] | None = None) -> Estimate:
        """Return the method's estimate (see `Reconstructor.read`)."""
        return self._inner.read(t_us, out)

    def intensity(self, log_intensity: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the method's intensity."""
        return self._inner.intensity(log_intensity)

    def _state(self) -> Mapping[str, Any]:
        return {"denoiser": self._denoiser.state(), "method": self._inner._state()}

    def _restore(self, state: Mapping[str, Any]) -> None:
        self._denoiser.restore(state["denoiser"])
        self._inner._restore(state["method"])
