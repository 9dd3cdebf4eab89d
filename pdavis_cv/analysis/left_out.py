"""Score methods by predicting left-out frames, which needs no ground truth.

Every second frame is left out: the odd or the even ones.  A method, given the rest,
predicts the light of each, whose mean over the exposure is compared with the frame.
"""
from __future__ import annotations

import dataclasses
import functools
import itertools
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdavis_cv._types import Events, Image
from pdavis_cv.events import accumulate
from pdavis_cv.reconstruct.base import Estimate, Factory, Reconstructor
from pdavis_cv.reconstruct.methods import factory_of
from pdavis_cv.recording.base import ApsFrame, Packet, Problem, Recording, RecordingInfo

FloatArray = NDArray[np.float64]

CLASSES = ("moving", "moving, bright", "moving, dark", "static, bright", "static, dark",
           "moving, in cell")
"""Classes of pixels; the first contains those of the next two.

The last contains all four pixels of each 2x2 cell in which one moves.  Its error is
that less the cell's mean error: the error of the ratios of the four channels, which
determine polarization.
"""

HALVES = ("odd", "even")
"""Which frames are left out; together all but the first and the last one or two."""

NEAR_US = 40_000   # us: the paper's cameras take a frame in 40 to 50 ms
MOVING = 3         # events within NEAR_US of the frame: less may be noise
BRIGHT_DN = 200    # a fifth of full scale
LEAST_DN = 8       # below it, the logarithm of 10-bit DN is mostly noise
_NOISE_BINS = 8    # of equal numbers of pixels; noise of frames depends on DN
_SAMPLES = 5       # of the light in an exposure, by the midpoint rule
_SHORT_MS = 1.5    # an exposure that one sample describes: 9 degrees at 1000 RPM


@dataclass(frozen=True)
class PredictionScore:
    """Errors of predictions of left-out frames, for one class of pixels.

    Parameters
    ----------
    kind : str
        One of ``CLASSES``.
    pixels : int
        Number of pixels of all frames together.
    rmse : float
        Root of the mean squared error of natural-log intensity; a prediction that is
        not finite counts as 1.  NaN without pixels.
    bias : float
        Mean error, same unit; 0 in cells, as the mean is taken out.
    coverage : float
        Fraction of the errors within one sigma; 0.68 if sigmas are correct.  Sigma
        combines that of the prediction and the frame's own noise, which is measured
        where nothing moves.  In cells, it is that of the difference from the mean of
        four independent errors.  NaN if the method states no variance.
    """

    kind: str
    pixels: int
    rmse: float
    bias: float
    coverage: float


@dataclass(frozen=True, eq=False)
class _Place:
    """A left-out frame, its neighbours, and the events around it."""

    frame: ApsFrame
    before: ApsFrame
    after: ApsFrame
    near: NDArray[np.int32]     # (H, W), events of both signs within NEAR_US

    @property
    def weight(self) -> float:
        """Relative time of the frame between its neighbours, 0 to 1."""
        start, stop = self.before.mid_us, self.after.mid_us
        return (self.frame.mid_us - start) / (stop - start)


class LeftOutFrames:
    """The left-out frames of a recording (every second one), to be predicted.

    Parameters
    ----------
    recording : Recording
        With frames and events.
    stop_us : int, optional
        Only frames before this time are left out.
    half : str
        One of ``HALVES``: leaves out the second, fourth, ... frame, or the third,
        fifth, ...; always frames between two that are kept.

    Attributes
    ----------
    kept : Recording
        The recording without these frames.
    times_us : ndarray of int64, shape (M,)
        Mid-exposures of the frames that were left out.
    sample_times_us : ndarray of int64, shape (M, N)
        Times within each exposure at which the light is to be predicted: one if it is
        shorter than 1.5 ms, else five at equal distances.

    Raises
    ------
    ValueError
        If the recording has fewer than five frames, or no event, or `half` is none of
        ``HALVES``.
    """

    def __init__(
        self, recording: Recording, *, stop_us: int | None = None, half: str = "odd",
    ) -> None:
        if half not in HALVES:
            raise ValueError(f"half must be one of {HALVES}, got {half!r}")
        frames = [frame for packet in recording.packets(stop_us=stop_us)
                  for frame in packet.frames]
        frames.sort(key=lambda frame: frame.mid_us)
        if len(frames) < 5:
            raise ValueError(
                f"the recording must hold at least 5 frames, got {len(frames)}")
        events = recording.events(frames[0].mid_us - NEAR_US, frames[-1].mid_us)
        if not len(events):
            raise ValueError("the recording must hold events between its frames")
        self._places = [_place(events, *frames[i - 1:i + 2])
                        for i in range(1 + HALVES.index(half), len(frames) - 1, 2)]
        self.times_us = np.array([each.frame.mid_us for each in self._places])
        self.sample_times_us = self.times_us[:, None] + _within(
            [each.frame.exposure_ms or 0 for each in self._places])
        self.kept: Recording = _Kept(recording, frozenset(self.times_us.tolist()))
        self._classes = [_classes(each) for each in self._places]
        self._noise = self._frame_noise()

    def _frame_noise(self) -> tuple[FloatArray, FloatArray]:
        """Return ln DN and the variance of ln of one frame where nothing moves."""
        errors, level = [], []
        for place, classes in zip(self._places, self._classes, strict=True):
            still = classes["static, bright"] | classes["static, dark"]
            w = place.weight
            # The noise of three frames, two of them with a weight.
            off = (_linear(place) - _log(place.frame))[still]
            errors.append(off / np.sqrt(1 + w * w + (1 - w) ** 2))
            level.append(np.log(place.frame.dn[still], dtype=np.float64))
        off, at = np.concatenate(errors), np.concatenate(level)
        if len(at) < 100 * _NOISE_BINS:
            return np.zeros(1), np.zeros(1)
        parts = np.array_split(np.argsort(at), _NOISE_BINS)
        # The median is robust against motion without events.
        sigma = [1.4826 * np.median(np.abs(off[part])) for part in parts]
        return np.array([at[part].mean() for part in parts]), np.square(sigma)

    def simple(self) -> Mapping[str, list[FloatArray]]:
        """Return predictions of natural-log intensity without events.

        Returns
        -------
        mapping of str to list of ndarray of float64, shape (H, W)
            ``"held"``: the frame before; ``"linear"``: interpolation between the frames
            before and after.
        """
        return {"held": [_log(place.before) for place in self._places],
                "linear": [_linear(place) for place in self._places]}

    def score(
        self, predictions: Iterable[FloatArray | Estimate], *, relative: bool = False,
        truth: Sequence[FloatArray] | None = None,
    ) -> tuple[PredictionScore, ...]:
        """Score one prediction per left-out frame, in order.

        Parameters
        ----------
        predictions : iterable of ndarray, shape (H, W), or Estimate
            Natural log of the mean light of each exposure, DN per ms (see `averaged`).
        relative : bool
            Whether predictions have an arbitrary offset in each 2x2 cell, as those of
            `EventRedundancy`: only the last class has a score then, others are NaN.
        truth : sequence of ndarray of float64, shape (H, W), optional
            Known light to compare with instead of each frame, natural log of DN per ms:
            errors then include neither the frame's noise nor its blur.

        Returns
        -------
        tuple of PredictionScore
            One per class.
        """
        sums = {kind: np.zeros(5) for kind in CLASSES}
        frames = [_log(place.frame) for place in self._places]
        for place, classes, given, right in zip(
                self._places, self._classes, predictions,
                frames if truth is None else truth, strict=True):
            log, variance = (
                (given.log_intensity, given.variance) if isinstance(given, Estimate)
                else (given, None))
            off = log.astype(np.float64) - right
            off[~np.isfinite(off)] = 1
            stated = None if variance is None else variance + (
                0 if truth is not None else
                np.interp(np.log(np.maximum(place.frame.dn, 1)), *self._noise))
            parts = {True: (_without_cell_mean(off), _variance_in_cell(stated)),
                     False: (off, stated)}
            for kind, where in classes.items():
                in_cell = kind == CLASSES[-1]
                if relative and not in_cell:
                    continue
                error, square = parts[in_cell]
                mine = error[where]
                sums[kind][:3] += len(mine), np.sum(mine**2), np.sum(mine)
                if square is not None:
                    sums[kind][3:] += float(np.sum(mine**2 <= square[where])), len(mine)
        with np.errstate(invalid="ignore"):
            return tuple(PredictionScore(
                kind, int(n), float(np.sqrt(squares / n)), float(total / n),
                float(within / stated))
                for kind, (n, squares, total, within, stated) in sums.items())

    def averaged(self, estimates: Iterable[Estimate]) -> Iterator[Estimate]:
        """Average estimates over each exposure.

        Parameters
        ----------
        estimates : iterable of Estimate
            One per element of ``sample_times_us``, in order.

        Yields
        ------
        Estimate
            One per left-out frame: the log of the mean intensity.  The variance is the
            mean of those in the exposure, as their errors are nearly the same.
        """
        estimates = iter(estimates)
        for times in self.sample_times_us:
            seen = list(itertools.islice(estimates, len(times)))
            light = np.mean([np.exp(each.log_intensity) for each in seen], axis=0)
            squares = [each.variance for each in seen if each.variance is not None]
            with np.errstate(divide="ignore"):
                log = np.log(light).astype(np.float32)
            yield Estimate(
                log, np.mean(squares, axis=0) if len(squares) == len(seen) else None,
                np.logical_and.reduce([each.valid for each in seen]))

    def images(self, i: int) -> tuple[FloatArray, NDArray[np.bool_], NDArray[np.bool_]]:
        """Return a left-out frame's log intensity, and its usable and moving pixels."""
        classes = self._classes[i]
        counts = np.logical_or.reduce(list(classes.values()))
        return _log(self._places[i].frame), counts, classes["moving"]


def pooled(scores: Iterable[Sequence[PredictionScore]]) -> tuple[PredictionScore, ...]:
    """Join the scores of several sets of frames, as if they had been one.

    Parameters
    ----------
    scores : iterable of sequence of PredictionScore
        As `LeftOutFrames.score` returns them, e.g. of both halves.

    Returns
    -------
    tuple of PredictionScore
        One per class.
    """
    out = []
    for parts in zip(*scores, strict=True):
        weight = np.array([part.pixels for part in parts], np.float64)
        n = weight.sum()

        def mean(values: list[float], weight: FloatArray = weight) -> float:
            of = weight > 0
            return float(np.average(np.array(values)[of], weights=weight[of])
                         ) if of.any() else np.nan

        out.append(PredictionScore(
            parts[0].kind, int(n), math.sqrt(mean([part.rmse**2 for part in parts])),
            mean([part.bias for part in parts]),
            mean([part.coverage for part in parts])))
    return tuple(out)


def observed(method: str | Factory, seen: list[Estimate]) -> Factory:
    """Return a method for ``fuse`` that also stores its estimate of every pixel.

    This estimate is the one before demosaicing and before the channels are reconciled.

    Parameters
    ----------
    method : str or Factory
    seen : list
        Receives the last `Estimate` as its only element.

    Returns
    -------
    callable
        A factory with the method's parameters.
    """
    made = factory_of(method)

    @functools.wraps(made)
    def watched(*arguments: Any, **parameters: Any) -> Reconstructor:
        one = made(*arguments, **parameters)
        read = one.read

        def seen_read(t_us: int, out: NDArray[np.float32] | None = None) -> Estimate:
            seen[:] = [read(t_us, out)]
            return seen[0]

        one.read = seen_read  # type: ignore[method-assign]
        # What a method does to share an image with a second thread passes by `read`.
        one.begin_read = functools.partial(  # type: ignore[method-assign]
            Reconstructor.begin_read, one)
        return one

    return watched


class _Kept(Recording):
    """A recording without some of its frames."""

    def __init__(self, recording: Recording, left_out: frozenset[int]) -> None:
        self._recording, self._left_out = recording, left_out

    @property
    def info(self) -> RecordingInfo:
        info = self._recording.info
        if info.frame_count is None:
            return info
        return dataclasses.replace(
            info, frame_count=info.frame_count - len(self._left_out))

    @property
    def problems(self) -> Sequence[Problem]:
        return self._recording.problems

    @property
    def path(self) -> Path | None:
        return self._recording.path

    def packets(
        self, start_us: int | None = None, stop_us: int | None = None,
    ) -> Iterator[Packet]:
        for packet in self._recording.packets(start_us, stop_us):
            if any(frame.mid_us in self._left_out for frame in packet.frames):
                packet = dataclasses.replace(packet, frames=())
            yield packet

    def close(self) -> None:
        self._recording.close()


def _place(
    events: Events, before: ApsFrame, frame: ApsFrame, after: ApsFrame,
) -> _Place:
    t = frame.mid_us
    first, last = np.searchsorted(events["t"], (t - NEAR_US, t + NEAR_US))
    return _Place(frame, before, after, accumulate(
        events[first:last], frame.shape).sum(axis=0, dtype=np.int32))


def _classes(place: _Place) -> dict[str, NDArray[np.bool_]]:
    usable = np.ones(place.frame.shape, np.bool_)
    for frame in (place.before, place.frame, place.after):
        usable &= frame.dn >= LEAST_DN
        usable &= frame.dn < 0.98 * frame.full_scale_dn
        if frame.valid is not None:
            usable &= frame.valid
    moving, bright = place.near >= MOVING, place.frame.dn >= BRIGHT_DN
    return dict(zip(CLASSES, (
        usable & moving, usable & moving & bright, usable & moving & ~bright,
        usable & ~moving & bright, usable & ~moving & ~bright,
        _per_cell(usable, np.all) & _per_cell(moving, np.any)), strict=True))


def _cells(image: Image) -> NDArray[Any]:
    """Return a view of the whole 2x2 cells, shape (rows, 2, columns, 2)."""
    rows, columns = (side // 2 for side in image.shape)
    return image[:2 * rows, :2 * columns].reshape(rows, 2, columns, 2)


def _per_cell(
    image: NDArray[np.bool_], join: Callable[..., NDArray[np.bool_]],
) -> NDArray[np.bool_]:
    """Apply `join` (all or any) to each 2x2 cell; return it for each pixel, (H, W)."""
    out = np.zeros(image.shape, np.bool_)
    _cells(out)[:] = join(_cells(image), axis=(1, 3), keepdims=True)
    return out


def _without_cell_mean(error: FloatArray) -> FloatArray:
    """Return errors minus the mean of their 2x2 cell, for complete cells."""
    out = error.copy()
    _cells(out)[:] -= _cells(error).mean(axis=(1, 3), keepdims=True)
    return out


def _variance_in_cell(variance: NDArray[Any] | None) -> FloatArray | None:
    """Return the variance of independent errors less the mean of their 2x2 cell."""
    if variance is None:
        return None
    out = np.array(variance, np.float64)
    cells = _cells(out)
    cells[:] = cells / 2 + cells.mean(axis=(1, 3), keepdims=True) / 4
    return out


def _within(exposures_ms: Sequence[float]) -> NDArray[np.int64]:
    """Return times in exposures relative to their middle, us, shape (M, N)."""
    exposure_us = 1e3 * np.array(exposures_ms)[:, None]
    if exposure_us.max() < 1e3 * _SHORT_MS:
        return np.zeros(exposure_us.shape, np.int64)
    parts = (np.arange(_SAMPLES) + 0.5) / _SAMPLES - 0.5
    return np.rint(exposure_us * parts).astype(np.int64)


def _log(frame: ApsFrame) -> FloatArray:
    return np.log(np.maximum(frame.dn, 1) / (frame.exposure_ms or 1), dtype=np.float64)


def _linear(place: _Place) -> FloatArray:
    return (1 - place.weight) * _log(place.before) + place.weight * _log(place.after)
