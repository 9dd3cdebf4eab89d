"""Fuse one recording with several workers, to the same bits as with one.

The coordinating process reads the recording and records the calls that feed the state
of the whole sensor.  Workers repeat the calls, each on a state of its own stripe of the
sensor or interval of time, and return the pixels that the images are made of.
"""
from __future__ import annotations

import itertools
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Executor, Future
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pdavis_cv._workers import Workers
from pdavis_cv.events import EVENT_DTYPE
from pdavis_cv.fusion.engine import Fusion
from pdavis_cv.fusion.images import Samples, samples_of
from pdavis_cv.fusion.options import FusionOptions
from pdavis_cv.fusion.shared_memory import (
    ArrayWriter,
    SharedFiles,
    SharedValue,
    load_shared,
    share,
    shared_files,
)
from pdavis_cv.fusion.states import (
    ArrivalState,
    Call,
    CallRecorder,
    InOrderState,
    StateTransfer,
    make_state,
)
from pdavis_cv.fusion.window import Roi, Window, window_of
from pdavis_cv.polarimetry import PolarFrame
from pdavis_cv.reconstruct.base import WHOLE_SENSOR, Reconstructor
from pdavis_cv.recording.base import Source

__all__ = ["fuse_tiles", "tiles"]

_IMAGES_PER_TASK = 64
"""A task ends with the transfer of its state to the next one.  With fewer images that
costs more than a few percent; more images need more memory, as those of all stripes are
kept until they are joined."""

_READ = "read"
"""Name of the recorded call that asks for an image."""


def tiles(shape: tuple[int, int], n: int) -> tuple[Roi, ...]:
    """Divide a sensor into stripes of whole polarizer cells.

    Parameters
    ----------
    shape : (int, int)
        (height, width) of the sensor.
    n : int
        Number of stripes; there are fewer if there are fewer rows of cells.

    Returns
    -------
    tuple of (int, int, int, int)
        The ``roi`` of each stripe, (x, y, width, height), from top to bottom.  `fuse`
        with this `roi` gives that part of the whole image; it also computes as many
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
class _Calls:
    """Calls to a state, the events of all of them in one array.

    A call that adds events costs time in each stripe, however few they are; what the
    state becomes does not depend on how they are cut.

    Parameters
    ----------
    events : ndarray of EVENT_DTYPE
    cuts : sequence of int
        How many of the events are added before each of the other calls, which take
        them as they lie between two cuts.
    others : sequence of Call
        All other calls, with a call `_READ` for each image.
    """

    events: NDArray[Any]
    cuts: Sequence[int]
    others: Sequence[Call]

    @classmethod
    def of(cls, calls: Sequence[Call]) -> _Calls:
        """Return recorded calls in this form."""
        parts: list[NDArray[Any]] = []
        cuts: list[int] = []
        others: list[Call] = []
        count = 0
        for call in calls:
            if call[0] == "add_events":
                parts.append(np.ascontiguousarray(call[1][0]))
                count += len(parts[-1])
            else:
                others.append(call)
                cuts.append(count)
        # Concatenating structured arrays would compare their fields each time.
        joined = b"".join(part.data for part in parts)
        return cls(np.frombuffer(joined, EVENT_DTYPE), cuts, others)

    def __iter__(self) -> Iterator[Call]:
        """Yield the calls in order."""
        start = 0
        for stop, other in zip(self.cuts, self.others, strict=True):
            if stop > start:
                yield "add_events", (self.events[start:stop],)
                start = stop
            yield other


@dataclass(frozen=True, eq=False)
class _Stripe:
    """A part of the sensor, or all of it, that one worker computes.

    Parameters
    ----------
    window : Window
        The part, with the pixels around it that it depends on.
    part : (slice, slice)
        Rows and columns of the window that make up the image.
    make : callable
        Makes the method for the window.
    causal : bool
        As the option of `fuse`.
    """

    window: Window
    part: tuple[slice, slice]
    make: Callable[[], Reconstructor]
    causal: bool

    def cropped(self, calls: _Calls) -> _Calls:
        """Return calls for the whole sensor, cropped to the window."""
        events, cuts = self.window.cut_events(calls.events, calls.cuts)
        found: list[Call] = []
        for name, args in calls.others:
            if name == "add_frame":
                found.append((name, (self.window.frame(args[0]),)))
            elif name == "retune":
                found.append((name, (args[0], self.window.planes(args[1]))))
            else:
                found.append((name, args))
        return _Calls(events, cuts, found)

    def make_state(self) -> InOrderState | ArrivalState:
        """Make the state that the calls from `cropped` feed."""
        height, width = self.window.shape
        whole = Window(slice(0, height), slice(0, width), (height, width))
        return make_state(self.make, whole, None, causal=self.causal)


@dataclass(frozen=True, eq=False)
class _Task:
    """The computation of some consecutive images of a stripe.

    Parameters
    ----------
    stripe : _Stripe
    calls : _Calls
        To its state.
    before : SharedValue, StateTransfer or None
        The state to start from; None = the initial one.
    returns_state : bool
        Whether the next task needs the state at the end.
    """

    stripe: _Stripe
    calls: _Calls
    before: SharedValue | StateTransfer | None
    returns_state: bool


_Sent = int | NDArray[Any] | None
"""A plane as `ArrayWriter.put` returned it; None if there is none."""

_SentSamples = tuple[_Sent, _Sent, _Sent, _Sent]
"""The planes of `Samples`; `valid` is None where it equals that of the image before."""


class _Pending(NamedTuple):
    """A task that a worker computes, and what it writes to."""

    future: Future[tuple[list[_SentSamples | None], Any]]
    writer: ArrayWriter


class _Results(NamedTuple):
    """The samples of a task's images, and what they were written to."""

    samples: list[_SentSamples | None]
    writer: ArrayWriter


_FREED = 16 << 20
"""Bytes: the most that tasks free at a time.  A batch holds about as much."""


def _keep_freed_memory() -> None:
    """Let this process use memory that it has freed again.

    The C library returns large blocks to the system when they are freed, and takes new
    pages for the next ones, unless it has seen blocks that are as large come and go
    (glibc: mallopt(3), M_MMAP_THRESHOLD).  No page of this one is touched.
    """
    np.empty(_FREED, np.uint8)


def _run(
    sent: SharedValue | _Task, place: tuple[str | None, int]
) -> tuple[list[_SentSamples | None], Any]:
    """Compute a task in a worker; write its results to a place in shared memory.

    Returns the samples of each image, None where they equal those of the image before,
    and the state at the end, if it is wanted.
    """
    _keep_freed_memory()
    writer = ArrayWriter.at(*place)
    task: _Task = load_shared(sent)
    state = task.stripe.make_state()
    before = load_shared(task.before)
    if before is not None:
        state.import_state(before)
    found: list[_SentSamples | None] = []
    last: object | None = None
    last_valid: NDArray[np.bool_] | None = None
    put = writer.put
    for name, args in task.calls:
        if name != _READ:
            getattr(state, name)(*args)
            continue
        shown = state.method.shows(*args)
        if shown is not None and shown is last:
            found.append(None)
            continue
        last = shown
        intensity, variance, valid, quality = samples_of(
            state.method, *args).part(*task.stripe.part)
        changed = last_valid is None or not np.array_equal(valid, last_valid)
        last_valid = valid
        found.append((
            put(intensity), None if variance is None else put(variance),
            put(valid) if changed else None, None if quality is None else put(quality)))
    return found, share(state.export_state(), writer) if task.returns_state else None


class _Coordinator(Fusion):
    """A Fusion that reads the recording and records the calls to its state.

    Its own state is fed only where it is needed in this process.

    Attributes
    ----------
    by_time : bool
        Whether time is divided instead of the sensor.
    """

    def __init__(
        self, recording: Source, options: FusionOptions, by_time: bool
    ) -> None:
        super().__init__(recording, options)
        self.by_time = by_time

    def _make_state(self) -> None:
        super()._make_state()
        assert isinstance(self._state, InOrderState | ArrivalState)
        self._state = self.recorder = CallRecorder(
            self._state, forward=self._needs_own_state)
        self._set_clock(self._clock_us)     # recorded: the workers' states begin at 0

    @property
    def _needs_own_state(self) -> bool:
        """Whether its state is fed: to start tasks from, or for online learning."""
        return self.by_time or self._online is not None

    def export_state(self) -> StateTransfer | None:
        """Return its state, None before anything was fed."""
        return None if self._state is None else self.recorder.state.export_state()

    def next_batch(self) -> _Batch:
        """Read the recording up to the end of the next batch of images."""
        images: list[tuple[int, int | None, Mapping[str, Any]]] = []
        calls: list[Call] = []
        while len(images) < _IMAGES_PER_TASK and self.advance():
            assert self.t_us is not None
            calls += [*self.recorder.calls, (_READ, (self.t_us,))]
            self.recorder.calls.clear()
            images.append((self.t_us, self.frame_us(), self.provenance))
        return _Batch(images, _Calls.of(calls))

    def stripe(self, roi: Roi) -> _Stripe:
        """Return the stripe that computes a region."""
        window = self.window if self.by_time else window_of(
            roi, self.window.size, self.margin)
        # One thread each: the stripes already occupy the workers.
        make = self.method_factory(window, Workers())
        return _Stripe(window, window.part(roi), make, self.options.causal)


class _Batch(NamedTuple):
    """The images of one round of tasks, and the calls that lead to them.

    Parameters
    ----------
    images : list of (int, int or None, mapping)
        Time, mid-exposure of the last frame and provenance of each image.
    calls : _Calls
        For the whole sensor.
    """

    images: list[tuple[int, int | None, Mapping[str, Any]]]
    calls: _Calls


def fuse_tiles(
    recording: Source, options: FusionOptions, executor: Executor, n: int,
    by_time: bool,
) -> Iterator[PolarFrame]:
    """Yield the images that `fuse` yields, computed by an executor in n stripes.

    This process reads the recording once, and learns from it what the method needs.  If
    each pixel of the method depends on all others, there is one stripe and one worker.
    That still gains time: the worker computes the next batch while this process makes
    images of the last one.

    Parameters
    ----------
    recording : Recording or Source
    options : FusionOptions
    executor : Executor
    n : int
        Number of stripes, or of intervals at a time.
    by_time : bool
        Divide time instead: each task starts from the state that this process computes.
    """
    coordinator = _Coordinator(recording, options, by_time)
    rows, columns = coordinator.window.rows, coordinator.window.columns
    height, width = coordinator.window.shape
    regions = _stripes(
        (columns.start, rows.start, width, height),
        1 if coordinator.margin >= WHOLE_SENSOR and not by_time else n)
    return _fused(coordinator, executor, regions)


def _fused(
    coordinator: _Coordinator, executor: Executor, regions: Sequence[Roi]
) -> Iterator[PolarFrame]:
    pending = deque[_Pending]()
    _keep_freed_memory()
    make = _by_time if coordinator.by_time else _by_stripes
    with shared_files(executor) as files:
        try:
            yield from make(coordinator, regions, _Submitter(
                executor, files, pending, 2 * len(regions)))
        finally:
            for task in pending:
                task.future.cancel()


@dataclass(frozen=True, eq=False)
class _Submitter:
    """Submits tasks and waits for them, in the same order.

    Parameters
    ----------
    executor : Executor
    files : SharedFiles
    pending : deque of _Pending
        Those submitted that were not waited for.
    rounds : int
        A file is used again after so many tasks.  While a round of tasks runs, the
        results of the one before may still be in use: so two rounds.
    """

    executor: Executor
    files: SharedFiles
    pending: deque[_Pending]
    rounds: int
    _count: Iterator[int] = field(default_factory=itertools.count)

    def submit(
        self, stripe: _Stripe, calls: _Calls,
        before: SharedValue | StateTransfer | None, *, returns_state: bool,
    ) -> None:
        """Submit a task, its calls given for the whole sensor."""
        writer = self.files.writer(next(self._count) % self.rounds)
        sent = share(
            _Task(stripe, stripe.cropped(calls), before, returns_state), writer)
        future = self.executor.submit(_run, sent, writer.place)
        self.files.used_by(future)
        self.pending.append(_Pending(future, writer))

    def wait(self) -> tuple[_Results, Any]:
        """Return the images of the next task, and its state."""
        task = self.pending.popleft()
        samples, state = task.future.result()
        return _Results(samples, task.writer), state


def _by_stripes(
    coordinator: _Coordinator, regions: Sequence[Roi], tasks: _Submitter
) -> Iterator[PolarFrame]:
    stripes = [coordinator.stripe(region) for region in regions]

    def submit_all(
        batch: _Batch, states: Sequence[SharedValue | StateTransfer | None]
    ) -> None:
        for stripe, before in zip(stripes, states, strict=True):
            tasks.submit(stripe, batch.calls, before, returns_state=True)

    join = _Joiner(coordinator, regions)
    batch = coordinator.next_batch()
    if batch.images:
        submit_all(batch, [None] * len(stripes))
    while batch.images:
        following = coordinator.next_batch()    # is read while the workers compute
        results = [tasks.wait() for _ in stripes]
        if following.images:    # the workers go on while images are made and used here
            submit_all(following, [state for _, state in results])
        yield from join(batch, [samples for samples, _ in results])
        batch = following


def _by_time(
    coordinator: _Coordinator, regions: Sequence[Roi], tasks: _Submitter
) -> Iterator[PolarFrame]:
    rows, columns = coordinator.window.rows, coordinator.window.columns
    whole = (columns.start, rows.start,
             columns.stop - columns.start, rows.stop - rows.start)
    stripe = coordinator.stripe(whole)
    join, batches = _Joiner(coordinator, [whole]), deque[_Batch]()
    while True:
        while len(tasks.pending) < len(regions):
            before = coordinator.export_state()
            batch = coordinator.next_batch()
            if not batch.images:
                break
            batches.append(batch)
            tasks.submit(stripe, batch.calls, before, returns_state=False)
        if not tasks.pending:
            return
        yield from join(batches.popleft(), [tasks.wait()[0]])


class _Joiner:
    """Join the samples of stripes and make images of them.

    Parameters
    ----------
    fusion : Fusion
        Makes the images.
    regions : sequence of (int, int, int, int)
        The stripes, from top to bottom, which make up the window of `fusion`.
    """

    def __init__(self, fusion: Fusion, regions: Sequence[Roi]) -> None:
        self._fusion = fusion
        edges = itertools.accumulate((height for *_, height in regions), initial=0)
        self._rows = [slice(*edge) for edge in pairwise(edges)]
        self._valid = np.empty(fusion.window.shape, np.bool_)
        self._image: PolarFrame | None = None

    def __call__(
        self, batch: _Batch, stripes: Sequence[_Results]
    ) -> Iterator[PolarFrame]:
        """Yield the images of a batch."""
        writers = [stripe.writer for stripe in stripes]
        for about, *sent in zip(
                batch.images, *(stripe.samples for stripe in stripes), strict=True):
            if None not in sent:
                intensity, variance, valid, quality = zip(*sent, strict=True)
                for writer, rows, part in zip(writers, self._rows, valid, strict=True):
                    if part is not None:
                        writer.read_into(self._valid[rows], part)
                self._image = self._fusion.made(Samples(
                    self._joined(writers, intensity), self._joined(writers, variance),
                    self._valid, self._joined(writers, quality)), *about)
            else:
                assert self._image is not None
                self._image = self._image.retimed(*about)
            yield self._image

    def _joined(
        self, writers: Sequence[ArrayWriter], parts: Sequence[_Sent]
    ) -> Any:
        """Return the plane that consists of the given stripes."""
        if parts[0] is None:
            return None
        plane = np.empty(self._valid.shape, np.float32)
        for writer, rows, part in zip(writers, self._rows, parts, strict=True):
            assert part is not None
            writer.read_into(plane[rows], part)
        return plane
