"""Smoother of the frame offset: frames after a time count as those before it."""
from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdavis_cv import _kernels
from pdavis_cv.reconstruct.lamp import Lamplight
from pdavis_cv.reconstruct.tracks import Tracks, as_bytes

__all__ = ["GAP_DTYPE", "NODE_DTYPE", "PAST_DTYPE", "Smoother"]

NODE_DTYPE = np.dtype([
    ("level", "<f4"), ("h_on", "<f4"), ("h_off", "<f4"), ("noise", "<f4"),
    ("drift", "<f4"), ("n_on", "<i4"), ("n_off", "<i4")])
"""What a frame said of one pixel (see ``_tracks.pxd``)."""

PAST_DTYPE = np.dtype([
    ("base", "<f8"), ("var", "<f8"), ("t", "<i8"), ("n_on", "<i4"), ("n_off", "<i4")])
"""What the frames on one side of a time say of one pixel."""

GAP_DTYPE = np.dtype([
    ("before", PAST_DTYPE), ("after", PAST_DTYPE), ("drift", "<f8")])
"""What those on both sides say."""

_LEAST = 8


class Smoother:
    """Frames between the time that is read and the last one seen, as measurements.

    A frame is added as `slot` received it.  Once it lies before every later read, it
    is folded into one estimate of the past.

    Parameters
    ----------
    shape : (int, int)
        (height, width).

    Attributes
    ----------
    totals : ndarray of int32, shape (H, W, 2)
        Events up to each pixel's last sample, ON and OFF.
    """

    def __init__(self, shape: tuple[int, int]) -> None:
        self.totals = np.zeros((*shape, 2), np.int32)
        self._past = np.zeros(shape, PAST_DTYPE)
        self._past["var"] = -1
        self._nodes = np.zeros((_LEAST, *shape), NODE_DTYPE)
        self._times = np.zeros((_LEAST, shape[1]), np.int64)
        self._order: tuple[int, ...] = ()
        self._reserved: tuple[int, ...] = ()
        self._gap = np.zeros(shape, GAP_DTYPE)
        self._passed: NDArray[np.int32] | None = None

    def slot(self, times: NDArray[np.int64]) -> NDArray[Any]:
        """Return where the measurements of the next frame go.

        Parameters
        ----------
        times : ndarray of int64, shape (W,)
            Middle of its exposure by column, us.

        Returns
        -------
        ndarray of NODE_DTYPE, shape (H, W)
            Valid until the next call.
        """
        free = set(range(len(self._nodes))).difference(
            self._order, self._reserved)
        if not free:
            free = {len(self._nodes)}
            self._nodes = np.concatenate([self._nodes, np.zeros_like(self._nodes)])
            self._times = np.concatenate([self._times, np.zeros_like(self._times)])
        at = min(free)
        self._times[at] = times
        self._order = (*self._order, at)
        self._passed = None
        nodes: NDArray[Any] = self._nodes[at]
        return nodes

    def pass_until(self, t_us: int, state: NDArray[np.float64]) -> None:
        """Fold the frames into the past whose middle is at or before t_us.

        ``state`` (H, W, 9) is that of `KalmanFilter`; its thresholds count.
        """
        while self._order and int(self._times[self._order[0]].max()) <= t_us:
            at, *rest = self._order
            _kernels.smooth_past(
                self._nodes[at], self._times[at], state, self._past)
            self._order = tuple(rest)
            self._passed = None

    def read(
        self, t_us: int, known_us: int, tracks: Tracks, tuning: NDArray[np.float64],
        lamp: Lamplight, state: NDArray[np.float64], most: float,
        log: NDArray[np.float32], variance: NDArray[np.float32],
        valid: NDArray[np.bool_],
    ) -> None:
        """Write log intensity and variance at t_us (see ``smooth_read``).

        ``known_us`` is after t_us, and the events up to then count.
        """
        order = np.array(self._order, np.int32)
        passed = (self._times[order] <= t_us).sum(0, np.int32)
        if self._passed is None or not np.array_equal(passed, self._passed):
            _kernels.smooth_gap(
                self._nodes, self._times, order, passed, state, self._past, self._gap)
            self._passed = passed
        tracks.chain_late(known_us)
        _kernels.smooth_read(
            t_us, known_us, tracks.store, tracks.link, tracks.first, tuning,
            lamp.waves, lamp.start_us, tracks.late, self._gap, state, most, log,
            variance, valid.view(np.uint8))

    def mark(self) -> Mapping[str, Any]:
        """Return copies of what adding and folding frames changes.

        Until `restore`, frames that are there now are not overwritten.
        """
        self._reserved = self._order
        return {"totals": self.totals.copy(), "past": self._past.copy(),
                "order": self._order}

    def state(self) -> Mapping[str, Any]:
        """Return copies of everything."""
        order = list(self._order)
        return {"totals": self.totals.copy(), "past": self._past.copy(),
                "times": self._times[order],
                "nodes": [as_bytes(self._nodes[at]).copy() for at in order]}

    def restore(self, state: Mapping[str, Any]) -> None:
        """Take over copies of what `state`, or `mark` just before, returned."""
        self.totals[:], self._past[:] = state["totals"], state["past"]
        self._passed = None
        self._order, self._reserved = state.get("order", ()), ()
        if "nodes" not in state:
            return
        for nodes, times in zip(state["nodes"], state["times"], strict=True):
            as_bytes(self.slot(times))[:] = nodes
