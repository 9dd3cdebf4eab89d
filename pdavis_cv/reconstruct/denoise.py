"""Denoising of events by the support of neighbours behind the same polarizer."""
from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdavis_cv import _kernels
from pdavis_cv._checks import sensor_shape, whole_number
from pdavis_cv._types import Events, Parameters, State
from pdavis_cv.events import FAR, as_events, timed_events
from pdavis_cv.reconstruct.stream_clock import StreamClock

RATE_WINDOW_US = 250_000
"""Interval in us after which the pixels' event rates are updated and compared."""
RATE_SHARE = 0.25
"""Weight of the last interval in the exponential mean of a pixel's rate, whose time
constant is thus about a second."""
HOT_FLOOR_HZ, HOT_FACTOR = 6.0, 4.0
"""A pixel is hot if its rate exceeds floor + factor x the median of its neighbours'.

The floor limits false detections by Poisson fluctuations to one pixel of a chip per
hour (4.5 Hz are enough, lab/studies/denoise.py); the factor allows for edges.
"""
WINDOW_US = 50_000
"""How long an event supports its neighbours, us: a window twice as long would save less
than .5 % of the events of a polarizer at 30 RPM (lab/studies/denoise.py)."""
SUPPORT = 2
"""Number of the eight neighbours, at least, that an edge of any direction has passed
before it reaches a pixel (lab/studies/denoise.py)."""
_NEIGHBOURS = 8
"""Number of nearest pixels behind the same polarizer, two rows or columns away."""
_NEVER = -(2**62)
"""A time in us before all stamps; differences to it fit 64 bits."""
_FORGOTTEN = 64
"""Number of intervals without an event after which a rate is 0 in float32."""


MARGIN = 4
"""Distance in pixels up to which others count: whether a neighbour, two pixels away, is
hot depends on its own."""


class EventDenoiser:
    """Background activity filter that compares pixels of the same polarizer.

    Adjacent pixels have other polarizers, so that their light changes differently; the
    eight pixels two rows or columns away have the same one.  An event is kept if at
    least `support` of them had an event of its polarity in the last `window_us`, and
    its pixel is not hot, i.e. does not have far more events than they.

    Parameters
    ----------
    shape : (int, int)
        (height, width).
    window_us : int
        How long an event supports its neighbours.
    support : int
        Number of neighbours that must support an event, 1 to 8.

    Raises
    ------
    ValueError
        If a parameter is out of range.

    Notes
    -----
    Noise of n Hz per pixel is reduced to about n (8 n w)^2 / 8 for `support` 2 and a
    window of w seconds; hot pixels are detected after a quarter of a second.  The
    result does not depend on how the stream is cut into packets.
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
        self._stop_us: int | None = None   # end of the present interval of rates

    @property
    def parameters(self) -> Parameters:
        """Parameters that make an equal EventDenoiser."""
        return {"window_us": self._window_us, "support": self._support}

    @property
    def hot(self) -> NDArray[np.bool_]:
        """Pixels that are hot now, shape (H, W)."""
        return self._hot.astype(np.bool_)

    def keep(self, events: Any) -> NDArray[np.bool_]:
        """Process events that follow those taken earlier; return which are kept.

        If an event lies outside the sensor or is late, a ValueError names it, and those
        before it have been taken.
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
                break           # it lies off the sensor or is late: `took` raises
            # The rates of all intervals that end at or before this event.
            passed = (int(events["t"][at]) - self._stop_us) // RATE_WINDOW_US + 1
            self._stop_us += passed * RATE_WINDOW_US
            for _ in range(min(passed, _FORGOTTEN)):
                _kernels.denoise_rates(
                    self._counts, self._rates, self._hot, RATE_SHARE,
                    1e6 / RATE_WINDOW_US, HOT_FLOOR_HZ, HOT_FACTOR)
        self._clock.took(events, at)
        return keep.view(np.bool_)

    def filter(self, events: Any) -> Events:
        """Process events and return those that are kept (see `keep`)."""
        events = as_events(events)
        kept: Events = events[self.keep(events)]
        return kept

    def state(self) -> State:
        """Return copies of everything that events change."""
        return {"last_us": self._clock.last_us, "times": self._times.copy(),
                "counts": self._counts.copy(), "rates": self._rates.copy(),
                "hot": self._hot.copy(), "stop_us": self._stop_us}

    def restore(self, state: State) -> None:
        """Take over copies of what `state` returned."""
        self._clock.last_us, self._stop_us = state["last_us"], state["stop_us"]
        self._times[:], self._counts[:] = state["times"], state["counts"]
        self._rates[:], self._hot[:] = state["rates"], state["hot"]
