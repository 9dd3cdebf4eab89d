"""One recording by several workers: the same bits as by one.

One process reads the recording and notes what a state of the whole sensor is told;
workers tell it to states of stripes, or of pieces of time.
"""
from __future__ import annotations

import itertools
import operator
import os
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Executor, Future
from contextlib import closing
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pdavis_cv._workers import Workers
from pdavis_cv.fusion.engine import Fusion
from pdavis_cv.fusion.handover import (
    Handed,
    Place,
    Reading,
    Shelf,
    hand_over,
    memory_for,
    taken,
)
from pdavis_cv.fusion.images import Samples, samples_of
from pdavis_cv.fusion.options import FusionOptions
from pdavis_cv.fusion.states import AsItArrives, Held, InOrder, Script, Told, states_of
from pdavis_cv.fusion.window import Roi, Window, window_of
from pdavis_cv.polarimetry import PolarFrame
from pdavis_cv.reconstruct.base import WHOLE_SENSOR, Reconstructor
from pdavis_cv.recording.base import Source

__all__ = ["fuse_tiles", "tiles"]

_IMAGES = 64
"""In a piece of work: its state is handed on after it.  With fewer that costs more than
a few percent, with more the images of several stripes take more memory."""
_READ = "read"


def tiles(shape: tuple[int, int], n: int) -> tuple[Roi, ...]:
    """Divide a sensor into stripes of whole polarizer cells.

    Parameters
    ----------
    shape : (int, int)
        (height, width) of the sensor.
    n : int
        How many; fewer where there are fewer rows of cells.

    Returns
    -------
    tuple of (int, int, int, int)
        Each is the ``roi`` of a stripe, (x, y, width, height), from top to bottom.
        What `fuse` gives for it is that part of the whole result; it computes as many
        rows around it as the method and demosaicing need.

    Raises
    ------
    ValueError
        If `n` is not positive.

    Examples
    --------
    >>> tiles((260, 346), 2)
    ((0, 0, 346, 130), (0, 130, 346, 130))
    """
    return _stripes((0, 0, shape[1], shape[0]), n)


def _stripes(roi: Roi, n: int) -> tuple[Roi, ...]:
    if n < 1:
        raise ValueError(f"n must be positive, got {n}")
    x, y, width, height = roi
    n = min(n, max(height // 2, 1))
    edges = [height // 2 * i // n * 2 for i in range(n)] + [height]
    return tuple((x, y + top, width, bottom - top)
                 for top, bottom in pairwise(edges))


@dataclass(frozen=True, eq=False)
class _Stripe:
    """A part of the sensor, or all of it, that a worker computes.

    Parameters
    ----------
    window : Window
        What is computed.
    part : (slice, slice)
        Rows and columns of it that are wanted.
    make : callable
        Makes the method for the window.
    causal : bool
        Whether frames count from when they arrive on.
    """

    window: Window
    part: tuple[slice, slice]
    make: Callable[[], Reconstructor]
    causal: bool

    def seen(self, told: Sequence[Told]) -> list[Told]:
        """Return what states of this window alone are told."""
        found: list[Told] = []
        for name, args in told:
            if name == "add_events":
                events = self.window.events(args[0])
                if len(events):
                    found.append((name, (events,)))
            elif name == "add_frame":
                found.append((name, (self.window.frame(args[0]),)))
            elif name == "retune":
                found.append((name, (args[0], self.window.planes(args[1]))))
            else:
                found.append((name, args))
        return found

    def states(self) -> InOrder | AsItArrives:
        """Make states that take what `seen` returns."""
        height, width = self.window.shape
        whole = Window(slice(0, height), slice(0, width), (height, width))
        return states_of(self.make, whole, None, causal=self.causal)


@dataclass(frozen=True, eq=False)
class _Piece:
    """Some images of a stripe.

    Parameters
    ----------
    stripe : _Stripe
    told : sequence of Told
        To its states, and when they are read.
    before : Handed, Held or None
        What they held before.
    hand_on : bool
        Whether what they hold afterwards is wanted.
    slot : str or None
        Where to hand over; of the state, with ".state" behind.
    """

    stripe: _Stripe
    told: Sequence[Told]
    before: Handed | Held | None
    hand_on: bool
    slot: str | None


class _Sent(NamedTuple):
    """Samples of an image, handed over: as `Samples`."""

    intensity: Place | NDArray[np.float32]
    variance: Place | NDArray[np.float32] | None
    valid: Place | NDArray[np.bool_]
    quality: Place | NDArray[np.float32] | None


class _Sender:
    """Hands samples over.

    Parameters
    ----------
    shelf : Shelf
    """

    def __init__(self, shelf: Shelf) -> None:
        self._put = shelf.put
        self._valid: tuple[NDArray[np.bool_], Place | NDArray[np.bool_]] | None = None

    def __call__(self, samples: Samples) -> _Sent:
        """Hand over one image's; of what is valid, what has changed."""
        intensity, variance, valid, quality = samples
        if self._valid is None or not np.array_equal(valid, self._valid[0]):
            self._valid = valid, self._put(valid)
        return _Sent(self._put(intensity),
                     None if variance is None else self._put(variance),
                     self._valid[1], None if quality is None else self._put(quality))


def _work(handed: Handed | _Piece) -> tuple[list[_Sent | None], Any]:
    """Hand over the samples of each image, None for the one before's, and the state."""
    piece: _Piece = taken(handed)
    states = piece.stripe.states()
    before = taken(piece.before)
    if before is not None:
        states.take(before)
    found: list[_Sent | None] = []
    last: object | None = None
    with closing(Shelf(piece.slot)) as shelf:
        send = _Sender(shelf)
        for name, args in piece.told:
            if name != _READ:
                getattr(states, name)(*args)
                continue
            shown = states.method.shows(*args)
            if shown is not None and shown is last:
                found.append(None)
                continue
            samples = samples_of(states.method, *args)
            found.append(send(samples.part(*piece.stripe.part)))
            last = shown
    return found, (hand_over(states.held(), piece.slot and f"{piece.slot}.state")
                   if piece.hand_on else None)


class _Leader(Fusion):
    """Reads the recording, and says what its states are told.

    They do it too where the whole sensor has to be followed.

    Attributes
    ----------
    by_time : bool
        Whether time is divided, and not the sensor.
    """

    def __init__(
        self, recording: Source, options: FusionOptions, by_time: bool
    ) -> None:
        super().__init__(recording, options)
        self.by_time = by_time

    def _start(self) -> None:
        super()._start()
        assert isinstance(self._states, InOrder | AsItArrives)
        self._states = self.script = Script(self._states, follow=self.follows)
        self._set_clock(self._clock_us)     # those who are told begin at 0

    @property
    def follows(self) -> bool:
        """Whether its own states are fed."""
        return self.by_time or self._online is not None

    def held(self) -> Held | None:
        """Return what its states hold, None before anything was fed."""
        return None if self._states is None else self.script.states.held()

    def round(self) -> _Round:
        """Read on by some images."""
        images: list[tuple[int, int | None, Mapping[str, Any]]] = []
        told: list[Told] = []
        while len(images) < _IMAGES and self.advance():
            assert self.t_us is not None
            told += [*self.script.told, (_READ, (self.t_us,))]
            self.script.told.clear()
            images.append((self.t_us, self.frame_us(), self.provenance))
        return _Round(images, told)

    def stripe(self, roi: Roi) -> _Stripe:
        """Return what computes a region."""
        window = self.window if self.by_time else window_of(
            roi, self.window.size, self.margin)
        make = self.maker(window, Workers())    # there is a worker for each as it is
        return _Stripe(window, window.part(roi), make, self.options.causal)


class _Round(NamedTuple):
    """Some images: (time, mid-exposure of the frame, provenance) of each."""

    images: list[tuple[int, int | None, Mapping[str, Any]]]
    told: list[Told]


def fuse_tiles(
    recording: Source, options: FusionOptions, executor: Executor, n: int,
    by_time: bool,
) -> Iterator[PolarFrame]:
    """Yield what `fuse` yields, made by an executor from n stripes.

    The recording is read here, once, and what must be learned of it is learned here.
    Where the method's pixels depend on all others there is one stripe, and one worker:
    it is ahead by some images of what is made of its samples here.

    Parameters
    ----------
    recording : Recording or Source
    options : FusionOptions
    executor : Executor
    n : int
        How many stripes, or pieces at a time.
    by_time : bool
        Pieces of time, whose states at their beginnings come from following them here.
    """
    whole = _Leader(recording, options, by_time)
    rows, columns = whole.window.rows, whole.window.columns
    height, width = whole.window.shape
    regions = _stripes(
        (columns.start, rows.start, width, height),
        1 if whole.margin >= WHOLE_SENSOR and not by_time else n)
    return _shared(whole, executor, regions)


def _shared(
    whole: _Leader, executor: Executor, regions: Sequence[Roi]
) -> Iterator[PolarFrame]:
    waiting = deque[Future[Any]]()
    count = itertools.count()

    def submit(
        stripe: _Stripe, told: Sequence[Told], before: Handed | Held | None,
        hand_on: bool,
    ) -> None:
        # Of a stripe, or of so many pieces, the one before may still be in use.
        slot = folder and os.path.join(folder, str(next(count) % (2 * len(regions))))
        waiting.append(executor.submit(_work, hand_over(
            _Piece(stripe, stripe.seen(told), before, hand_on, slot),
            slot and f"{slot}.told")))

    with memory_for(executor) as folder:
        make = _by_time if whole.by_time else _by_stripes
        try:
            yield from make(whole, regions, waiting, submit)
        finally:
            for future in waiting:
                future.cancel()


def _by_stripes(
    whole: _Leader, regions: Sequence[Roi], waiting: deque[Future[Any]],
    submit: Callable[..., None],
) -> Iterator[PolarFrame]:
    stripes = [whole.stripe(region) for region in regions]

    def begin(now: _Round, held: Sequence[Handed | Held | None]) -> None:
        for stripe, before in zip(stripes, held, strict=True):
            submit(stripe, now.told, before, True)

    join = _Joined(whole)
    now = whole.round()
    if now.images:
        begin(now, [None] * len(stripes))
    while now.images:
        after = whole.round()       # is read while they work
        pieces = [waiting.popleft().result() for _ in stripes]
        if after.images:            # they work on while images are made and used here
            begin(after, [held for _, held in pieces])
        yield from join(now, [samples for samples, _ in pieces])
        now = after


def _by_time(
    whole: _Leader, regions: Sequence[Roi], waiting: deque[Future[Any]],
    submit: Callable[..., None],
) -> Iterator[PolarFrame]:
    rows, columns = whole.window.rows, whole.window.columns
    stripe = whole.stripe((columns.start, rows.start,
                           columns.stop - columns.start, rows.stop - rows.start))
    join, rounds = _Joined(whole), deque[_Round]()
    while True:
        while len(waiting) < len(regions):
            before = whole.held()
            now = whole.round()
            if not now.images:
                break
            rounds.append(now)
            submit(stripe, now.told, before, False)
        if not waiting:
            return
        yield from join(rounds.popleft(), [waiting.popleft().result()[0]])


class _Joined:
    """Makes images of the samples of stripes."""

    def __init__(self, whole: Fusion) -> None:
        self._whole = whole
        self._image: PolarFrame | None = None

    def __call__(
        self, now: _Round, stripes: Sequence[Sequence[_Sent | None]]
    ) -> Iterator[PolarFrame]:
        """Yield the images of a round."""
        with Reading() as reading:
            sent: Sequence[object] = ()     # what `valid` was read from
            for about, *parts in zip(now.images, *stripes, strict=True):
                found = [part for part in parts if part is not None]
                if found:
                    intensity, variance, places, quality = zip(*found, strict=True)
                    if not sent or any(map(operator.is_not, places, sent)):
                        valid, sent = _stacked(reading, places), places
                    self._image = self._whole.made(Samples(
                        _stacked(reading, intensity), _stacked(reading, variance),
                        valid, _stacked(reading, quality)), *about)
                else:
                    assert self._image is not None
                    self._image = self._image.retimed(*about)
                yield self._image


def _stacked(reading: Reading, parts: Sequence[Place | NDArray[Any] | None]) -> Any:
    """Return a plane whose stripes were sent, from top to bottom."""
    sent = [part for part in parts if part is not None]
    if not sent:
        return None
    edges = list(itertools.accumulate((part.shape[0] for part in sent), initial=0))
    plane = np.empty((edges[-1], *sent[0].shape[1:]), sent[0].dtype)
    for part, (first, last) in zip(sent, pairwise(edges), strict=True):
        reading.into(plane[first:last], part)
    return plane
