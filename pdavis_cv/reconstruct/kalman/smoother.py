"""Fixed-lag smoother: frames after a time correct the estimate as earlier ones do."""
from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdavis_cv import _kernels
from pdavis_cv._types import Records, State
from pdavis_cv._workers import Workers
from pdavis_cv.reconstruct.model import GAP_DTYPE, NODE_DTYPE, PAST_DTYPE
from pdavis_cv.reconstruct.tracks import Reader, Tracks, as_bytes

__all__ = ["Smoother"]

_LEAST = 8
"""Initial capacity in frames; it doubles when it is full."""


class Smoother:
    """Fixed-lag smoother over the frames between the time read and the last one fed.

    Each frame's measurements are written to the array that `slot` returns.  Once a
    frame precedes every later read, it is merged into one estimate of the past.

    Parameters
    ----------
    shape : (int, int)
        (height, width).

    Attributes
    ----------
    unknown : ndarray of intp, shape (N,)
        Flat indices of the pixels without a frame on either side of the last read.
    """

    def __init__(self, shape: tuple[int, int]) -> None:
        self._past = np.zeros(shape, PAST_DTYPE)
        self._past["var"] = -1
        self._nodes = np.zeros((_LEAST, *shape), NODE_DTYPE)
        self._times = np.zeros((_LEAST, shape[1]), np.int64)
        self._order: tuple[int, ...] = ()
        self._gap = np.zeros(shape, GAP_DTYPE)
        # The same for the next interval between frames, and whether it is up to date.
        self._following, self._followed = np.zeros(shape, GAP_DTYPE), False
        # Number of frames at or before the time last read, by column.
        self._passed: NDArray[np.int32] | None = None
        self._past_us = 0       # middle of the last frame merged into the past
        self._epoch_us = 0      # reference time of the reader's variances
        self.unknown = np.empty(0, np.intp)

    def slot(self, times: NDArray[np.int64]) -> Records:
        """Return the array that receives the measurements of the next frame.

        Parameters
        ----------
        times : ndarray of int64, shape (W,)
            Middle of the frame's exposure by column, us.

        Returns
        -------
        ndarray of NODE_DTYPE, shape (H, W)
            Valid until the next call.
        """
        free = set(range(len(self._nodes))).difference(self._order)
        if not free:
            free = {len(self._nodes)}
            self._nodes = np.concatenate([self._nodes, np.zeros_like(self._nodes)])
            self._times = np.concatenate([self._times, np.zeros_like(self._times)])
        at = min(free)
        self._times[at] = times
        self._order = (*self._order, at)
        self._forget()
        nodes: Records = self._nodes[at]
        return nodes

    def pass_until(self, t_us: int, states: Records) -> None:
        """Merge all frames with a middle at or before t_us into the past.

        The thresholds of ``states`` convert event counts to log intensity.
        """
        while self._order and int(self._times[self._order[0]].max()) <= t_us:
            at, *rest = self._order
            _kernels.smooth_past(
                self._nodes[at], self._times[at], states, self._past)
            self._past_us = int(self._times[at].max())
            self._order = tuple(rest)
            self._forget()

    def _forget(self) -> None:
        """Invalidate the cached estimates from the frames on both sides."""
        self._passed, self._followed = None, False

    def read(
        self, t_us: int, known_us: int, rest_us: int, tracks: Tracks, reader: Reader,
        model: tuple[NDArray[Any], NDArray[Any]], states: Records,
        shown: tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.uint8]],
        workers: Workers,
    ) -> None:
        """Write log intensity, variance and validity at t_us (see `Reader.read`).

        Events up to ``known_us``, which is after t_us, are used.
        """
        order = np.array(self._order, np.int32)
        passed = (self._times[order] <= t_us).sum(0, np.int32)
        if self._passed is None or not np.array_equal(passed, self._passed):
            if self._passed is not None and self._followed and np.array_equal(
                    passed, self._passed + 1):
                # One frame was passed and none was added: the estimates were computed
                # together with the last ones.
                self._gap, self._following = self._following, self._gap
                self._followed = False
            else:
                workers.rows(len(states), lambda first, last: _kernels.smooth_gap(
                    self._nodes, self._times, order, passed, states, self._past,
                    (first, last), self._gap, self._following))
                self._followed = bool(np.all(passed < len(order)))
            self._passed = passed
            self.unknown = np.flatnonzero(
                (self._gap["before"]["var"] < 0) & (self._gap["after"]["var"] < 0))
            # Variances refer to a time close by, that of a frame on either side.
            at = min(int(passed.max(initial=0)), len(order) - 1)
            self._epoch_us = (
                int(self._times[order[at]].max()) if len(order) else self._past_us)
            reader.forget()
        reader.read(
            t_us, known_us, rest_us, self._epoch_us,
            tracks.late_chain(known_us, reader), states, model, shown, workers,
            self._gap)

    def assign(self, other: Smoother) -> None:
        """Copy the state of an equal smoother."""
        self._take(other._past, other._past_us,
                   [other._nodes[at] for at in other._order],
                   [other._times[at] for at in other._order])

    def state(self) -> State:
        """Return copies of everything."""
        order = list(self._order)
        return {"past": as_bytes(self._past).copy(), "past_us": self._past_us,
                "times": [*self._times[order]],
                "nodes": [as_bytes(self._nodes[at]).copy() for at in order]}

    def restore(self, state: State) -> None:
        """Return to what `state` returned, which is copied."""
        self._take(state["past"], state["past_us"], state["nodes"], state["times"])

    def _take(
        self, past: NDArray[Any], past_us: int, nodes: Sequence[Records],
        times: Sequence[NDArray[np.int64]],
    ) -> None:
        np.copyto(as_bytes(self._past), as_bytes(past))
        self._past_us = past_us
        self._order = ()
        self._forget()
        for one, at in zip(nodes, times, strict=True):
            as_bytes(self.slot(at))[:] = as_bytes(one)
