"""A stream of AoP events: after each event, the AoP of its macropixel."""
from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pdavis_cv import _kernels
from pdavis_cv._checks import checked_threshold, positive, sensor_shape, whole_number
from pdavis_cv.events import FAR, timed_events
from pdavis_cv.reconstruct.stream_clock import StreamClock, steps
from pdavis_cv.sensor import CHANNELS, Layout
from pdavis_cv.stokes_vector import aop

MOST_RADIUS = 32
"""Largest radius, macropixels: an event then changes 3,200 of them.  Engineering
choice; the paper has 4."""

AOP_EVENT_DTYPE = np.dtype([("t", "<i8"), ("x", "<u2"), ("y", "<u2"), ("aop", "<f4")])
"""An event with the AoP of its macropixel after it: us, pixels, radians in [0, pi)."""

TURN_DTYPE = np.dtype([(name, "<f8") for name in ("s1", "s2", "swept", "energy", "t")])

# The epoch that the weights of discounted sums refer to is moved after so many time
# constants, which keeps exponentials in range.
_SPAN = 20.0


class AopEvents:
    """Convert a stream of events to a stream of AoP events, one for each.

    Each event adds to the high-passed log intensity of its channel in its macropixel
    and in those within `radius`; AoP is computed from the four channels.  As with
    ``method="events"`` it is correct only while the means of the four channels are
    equal, and has the phase lead of the high pass: AoP is ahead, in the sense of its
    rotation, by ``atan(cutoff_hz / f) / 2``, f being the frequency of the intensity: by
    45 degrees far below the cutoff, 13 at 30 RPM, 7 at 60 RPM.

    Parameters
    ----------
    shape : (int, int)
        (height, width).
    theta_on, theta_off : float, or array_like of shape (H, W)
        Contrast thresholds, positive, in natural-log units.
    layout : Layout
        Polarizer in front of each pixel.
    cutoff_hz : float
        Corner frequency f3dB of the high pass.
    radius : int
        Radius in macropixels within which an event acts.
    correct_phase : bool
        Correct the phase lead by each macropixel's signed rate of rotation, estimated
        over about two time constants.

    Raises
    ------
    ValueError
        If a threshold, the cutoff or the shape is not positive, or the radius negative.
    TypeError
        If `layout` is not a Layout.

    Notes
    -----
    Haessig et al., supplement "Reconstructing AoP from PDAVIS events only".  An angle
    does not depend on how the stream is cut into packets.  Memory is 10 bytes per
    pixel and 8 for the thresholds.

    Examples
    --------
    >>> stream = AopEvents((260, 346), theta_on=0.2, theta_off=0.2,
    ...                    layout=Layout.PDAVIS)
    >>> on_event = {"t": [1000], "x": [3], "y": [2], "p": [1]}   # behind 90 degrees
    >>> np.rad2deg(stream.add(on_event)["aop"]).round(3).tolist()
    [90.0]
    """

    def __init__(
        self, shape: Sequence[int], *, theta_on: ArrayLike, theta_off: ArrayLike,
        layout: Layout | str, cutoff_hz: float = 0.5, radius: int = 1,
        correct_phase: bool = False,
    ) -> None:
        self.shape = height, width = sensor_shape(shape)
        on = checked_threshold("theta_on", theta_on, self.shape)
        off = checked_threshold("theta_off", theta_off, self.shape)
        self._radius = whole_number("radius", radius, 0, MOST_RADIUS)
        self._step = steps(on, off, self.shape)
        self._rate = 2e-6 * math.pi * positive("cutoff_hz", cutoff_hz)
        if not self._rate * FAR > 1:
            raise ValueError(
                f"cutoff_hz must be a time constant within 2**61 us, got {cutoff_hz!r}")
        self._correct = bool(correct_phase)
        self.layout = Layout.of(layout)
        self._axes = _axes(self.layout)
        self._span = float(round(_SPAN / self._rate))
        self._turns = np.zeros(((height + 1) // 2, (width + 1) // 2), TURN_DTYPE)
        self._epoch = np.full(1, -np.inf)
        self._clock = StreamClock(self.shape)

    def add(self, events: Any) -> NDArray[Any]:
        """Process events and return one AoP event for each.

        Parameters
        ----------
        events : ndarray of EVENT_DTYPE, shape (N,)
            Time-ordered, not before those taken earlier; or what `as_events` accepts.

        Returns
        -------
        ndarray of AOP_EVENT_DTYPE, shape (N,)

        Raises
        ------
        ValueError
            If an event lies outside the sensor or is late; the message names it, and
            those before it have been taken.
        """
        events = timed_events(events)
        out = np.empty(len(events), AOP_EVENT_DTYPE)
        if not len(events):
            return out
        if self._epoch[0] == -np.inf:
            self._epoch[0] = np.floor(events["t"][0] / self._span) * self._span
        s = np.empty((2, len(events)), np.float32)
        taken = _kernels.aop_event_stokes(
            events, self._step, self._axes, self._radius, self._clock.last_us,
            self._rate, self._span, self._correct, self._epoch, self._turns, s)
        self._clock.took(events, taken)
        for name in ("t", "x", "y"):
            out[name] = events[name]
        out["aop"] = aop(s[0], s[1])
        return out


def _axes(layout: Layout) -> NDArray[np.float64]:
    doubled = np.deg2rad(2 * np.array(CHANNELS))
    axes = np.empty((4, 2))
    axes[list(layout.places)] = np.rint(np.stack([np.cos(doubled), np.sin(doubled)], 1))
    return axes
