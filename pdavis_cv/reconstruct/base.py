"""The base class of all reconstruction methods, and what they return."""
from __future__ import annotations

from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, is_dataclass
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pdavis_cv import _kernels
from pdavis_cv._types import Events, Parameters, State
from pdavis_cv._workers import Workers
from pdavis_cv.reconstruct.denoise import EventDenoiser
from pdavis_cv.reconstruct.lamp import Wave
from pdavis_cv.recording.base import ApsFrame

_EXP_NS = 0.2
"""Time that the exponential of a pixel takes, ns (measured)."""

WHOLE_SENSOR = 1 << 20
"""`Reconstructor.margin` of a method in which each pixel depends on all others: more
pixels than any sensor is wide."""


class Estimate(NamedTuple):
    """Log intensity of every pixel at one time.

    Parameters
    ----------
    log_intensity : ndarray of float32, shape (H, W)
        Natural log of DN per ms of exposure (of DN where no exposure is known).
    variance : ndarray of float32, shape (H, W), or None
        Variance of ``log_intensity``; None if the method does not estimate it.
    valid : ndarray of bool, shape (H, W)
        True = usable.
    """

    log_intensity: NDArray[np.float32]
    variance: NDArray[np.float32] | None
    valid: NDArray[np.bool_]


Shown = tuple[NDArray[np.float32], NDArray[np.float32] | None, NDArray[np.bool_]]
"""Intensity, as a new array, and what else an `Estimate` has."""


@dataclass(frozen=True, kw_only=True)
class Needs:
    """The inputs that a method needs, so that no caller depends on its name.

    Thresholds and the pixels' response need no entry: a method that takes
    ``theta_on`` and ``theta_off``, or ``response``, gets them.

    Parameters
    ----------
    events, frames : bool
        Whether the method is fed events, and frames, at all.
    lamp : bool
        Whether the method uses `Reconstructor.add_wave`.
    learned : frozenset of str
        Parameters to estimate from the recording if the caller states none:
        ``"model"``, as `KalmanFilter` takes it, and ``"ratio_sigma"``, as
        `EventRedundancy` does.
    crossed_diagonal : bool
        Whether the 0 and 90 degree polarizers must lie diagonally in the cell.
    """

    events: bool = True
    frames: bool = True
    lamp: bool = False
    learned: frozenset[str] = frozenset()
    crossed_diagonal: bool = False


@dataclass(frozen=True, eq=False)
class Snapshot:
    """The whole state of a Reconstructor at one time; deep and picklable.

    Parameters
    ----------
    method : str
        Name of the method.
    shape : (int, int)
        (height, width).
    parameters : mapping of str to object
        Parameters that the Reconstructor was made with.
    state : mapping of str to object
        Arrays and numbers, none of them shared with the Reconstructor.
    """

    method: str
    shape: tuple[int, int]
    parameters: Parameters
    state: State

    @property
    def nbytes(self) -> int:
        """Bytes of all arrays in it, however deep they lie."""
        return nbytes((self.parameters, self.state))


def nbytes(value: Any) -> int:
    """Return the bytes of all arrays and byte strings in a nested value.

    It looks into mappings, sequences, dataclasses and objects with ``__slots__`` or
    attributes.  An array that occurs twice, or as several views, counts once.

    >>> nbytes({"a": (np.zeros(3), [b"four"])})
    28
    """
    return _nbytes(value, set())


def _nbytes(value: Any, seen: set[int]) -> int:
    if value is None or isinstance(value, (bool, int, float, complex, str, np.generic)):
        return 0
    if isinstance(value, np.ndarray):
        while isinstance(value.base, np.ndarray):
            value = value.base
    if id(value) in seen:
        return 0
    seen.add(id(value))
    if isinstance(value, np.ndarray):
        return value.nbytes
    if isinstance(value, (bytes, bytearray)):
        return len(value)
    if isinstance(value, Mapping):
        return sum(_nbytes(part, seen) for part in value.values())
    if isinstance(value, (list, tuple, set, frozenset, deque)):
        return sum(_nbytes(part, seen) for part in value)
    if is_dataclass(value):
        return sum(_nbytes(getattr(value, one.name), seen) for one in fields(value))
    slots = [name for kind in type(value).__mro__
             for name in getattr(kind, "__slots__", ()) if name != "__dict__"]
    held = [getattr(value, name, None) for name in slots]
    held += getattr(value, "__dict__", {}).values()
    return sum(_nbytes(part, seen) for part in held)


class Reconstructor(ABC):
    """Turns a time-ordered stream of events and frames into log intensity.

    It is fed in time order and never reorders; an object belongs to one thread.
    A frame is fed at its mid-exposure: ``fuse`` sees to that.
    """

    method: str
    """Name of the method, as in ``METHODS``."""

    lookahead_us: int | None = 0
    """How much after t must be fed before ``read(t)``, us; 0 = causal, None = all."""

    margin: int = 0
    """Distance in pixels up to which a pixel's result depends on other pixels."""

    needs: Needs = Needs()
    """The inputs that the method needs."""

    causal_parameters: Parameters = MappingProxyType({})
    """Parameters that make the method causal (`lookahead_us` of 0) if it is not so."""

    shows_at_readout: bool = False
    """Whether a frame shows from the end of its readout, not from mid-exposure, on."""

    cheaper: str | None = None
    """Method that needs less processor time, with which `Session` continues if this one
    cannot keep up with a live source."""

    trials: Mapping[str, Parameters] | None = None
    """Parameters of the variants that ``pdavis score`` compares, by their names; None:
    the method with its default parameters, under its own name."""

    takes_late_frames: bool = False
    """Whether a frame may also be fed when it arrives, after events that follow its
    mid-exposure: `settle` then gives the state that feeding in order gives."""

    shape: tuple[int, int]
    """(height, width)."""

    workers: Workers = Workers()
    """Threads that share the rows of the image; `fuse` sets them."""

    denoiser: EventDenoiser | None = None
    """What events pass first, if `fuse` sets one."""

    @property
    @abstractmethod
    def parameters(self) -> Parameters:
        """Constructor parameters that make an equal Reconstructor."""

    @abstractmethod
    def add_events(self, events: Events) -> None:
        """Feed events (EVENT_DTYPE, time-ordered, not before anything fed earlier).

        Raises
        ------
        ValueError
            If an event lies outside ``shape`` or before the last time fed; the message
            names it, and the events that precede it have been taken.
        """

    @abstractmethod
    def add_frame(self, frame: ApsFrame) -> None:
        """Feed a frame; its time is ``frame.mid_us``.

        Raises
        ------
        ValueError
            If the frame has another shape or lies before the last time fed.
        """

    def add_wave(self, wave: Wave) -> None:  # noqa: B027
        """Feed the lamp's flicker in a block, before any event or frame of that block.

        It comes from a `LampTracker` that sees the whole sensor, block after block.
        """

    def retune(self, **learned: Any) -> None:
        """Continue with other values of the parameters that ``needs.learned`` names.

        Thresholds may also be given.  Earlier events and frames are not processed
        again.

        Parameters
        ----------
        **learned
            New values by name, as the constructor takes them.  A method that needs
            frames also takes ``frames_moved_us``: by how much later frames are stamped
            from now on, because the stamps so far turned out to be wrong.
        """
        raise TypeError(
            f"method {self.method!r} has no parameters that can be learned, got "
            f"{', '.join(learned)}")

    def settle(self, t_us: int) -> None:  # noqa: B027
        """Do pending work, so that no read has to do it on a copy of the state.

        The caller promises that everything fed later lies after t_us, and that no
        later read is of a time before t_us less `lookahead_us`.  The call saves time
        only: it does not change what is read.

        Parameters
        ----------
        t_us : int
            Not before the last time fed.
        """

    @abstractmethod
    def read(self, t_us: int, out: NDArray[np.float32] | None = None) -> Estimate:
        """Return the estimate at t_us without changing the state.

        Parameters
        ----------
        t_us : int
            Not before the last time fed, less ``lookahead_us``.
        out : ndarray of float32, shape (H, W), optional
            Receives ``log_intensity``.
        """

    def begin_read(self, t_us: int) -> Callable[[], Shown]:
        """Begin a `read`; return a function that returns what it shows.

        The function does what needs the state no more.  It may be called in another
        thread while the state goes on, and more than once.
        """
        estimate = self.read(t_us)
        return lambda: (self.intensity(estimate.log_intensity), *estimate[1:])

    def shows(self, t_us: int) -> object | None:
        """Return an object that identifies the estimate at t_us, if it is held.

        As long as the same object is returned, `read` returns the same estimate.  None
        means that the estimate may differ at each time.
        """
        return None

    @property
    def quality(self) -> NDArray[np.float32] | None:
        """How well the method's assumptions held at the last read; None: unknown.

        0 (well) to 1; float32, shape (H, W).
        """
        return None

    def intensity(self, log_intensity: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return exp(log_intensity) as a new array."""
        out = np.empty_like(log_intensity)
        self.workers.rows(len(out), lambda first, last: _kernels.exp(
            log_intensity[first:last], out[first:last]),
            row_ns=_EXP_NS * out.shape[-1])
        return out

    def snapshot(self) -> Snapshot:
        """Return a deep, picklable copy of the state."""
        state = self._state()
        if self.denoiser is not None:
            state = {**state, "denoiser": self.denoiser.state()}
        return Snapshot(self.method, self.shape, parameters_of(self), state)

    def assign(self, other: Reconstructor) -> None:
        """Copy the state of an equal Reconstructor.

        Parameters
        ----------
        other : Reconstructor
            Of the same method, shape and parameters.
        """
        self._restore(other._state())

    def restore(self, snapshot: Snapshot) -> None:
        """Return to the state of a snapshot of an equal Reconstructor.

        Raises
        ------
        ValueError
            If the snapshot is of another method, shape or parameters.
        """
        for name in ("method", "shape"):
            mine, other = getattr(self, name), getattr(snapshot, name)
            if mine != other:
                raise ValueError(f"snapshot is of {name} {other!r}, not {mine!r}")
        mine, other = parameters_of(self), dict(snapshot.parameters)
        differing = [name for name in mine.keys() | other.keys()
                     if not np.array_equal(np.asarray(mine.get(name)),
                                           np.asarray(other.get(name)))]
        if differing:
            raise ValueError(
                f"snapshot was made with other parameters: {', '.join(differing)}")
        self._restore(snapshot.state)
        if self.denoiser is not None:
            self.denoiser.restore(snapshot.state["denoiser"])

    @abstractmethod
    def _state(self) -> State:
        """Return copies of everything that feeding changes."""

    @abstractmethod
    def _restore(self, state: State) -> None:
        """Return to what `_state` returned, which is copied."""


def feed_events(method: Reconstructor, events: Events) -> None:
    """Feed a method the events that its denoiser keeps."""
    method.add_events(
        events if method.denoiser is None else method.denoiser.filter(events))


def parameters_of(method: Reconstructor) -> dict[str, Any]:
    """Return a method's parameters, and those of its denoiser as ``denoise``."""
    return dict(method.parameters) if method.denoiser is None else {
        **method.parameters, "denoise": dict(method.denoiser.parameters)}


Factory = Callable[..., Reconstructor]
"""Makes a Reconstructor: ``factory(shape, *, theta_on, theta_off, **parameters)``.

It is a class derived from `Reconstructor`, or a function.  Of ``theta_on``,
``theta_off`` and ``response`` it is given those that its signature names."""
