"""One cell of the table: a recording is simulated or read, and every method scored."""
from __future__ import annotations

import dataclasses
import itertools
import math
import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lab.paper.run import TAIL_US
from lab.scoring import Scorer
from pdavis_cv import Recording, fuse, open_recording
from pdavis_cv.analysis import CLASSES, LeftOutFrames, observed, pooled
from pdavis_cv.batch import both_halves, predicted
from pdavis_cv.errors import PdavisWarning
from pdavis_cv.reconstruct.base import Estimate
from pdavis_cv.reconstruct.methods import DEFAULT_METHOD, METHODS, make_reconstructor
from pdavis_cv.recording.base import IMU_DTYPE, TRIGGER_DTYPE, ApsFrame
from pdavis_cv.recording.memory import MemoryRecording
from pdavis_cv.simulation import PRESETS, Camera
from pdavis_cv.tools.score import Trial, trials

from .cases import CASES, REAL
from .peers import PEERS, Stack, line, polarization

AHEAD = ("causal", "buffered", "offline")
"""What a method knows of what follows: nothing, some 50 ms, all."""

DEFAULTS = dict(zip(AHEAD, (f"{DEFAULT_METHOD} causal", DEFAULT_METHOD,
                            f"{DEFAULT_METHOD} offline"), strict=True))
"""The default method by what it knows of what follows."""

_BUFFERED_US = 200_000  # a choice: more look-ahead than this is no use live
_EVERY = 6              # frames between the beginnings of pieces; a choice
_IN_CELL = CLASSES[-1]
_NAN = math.nan


@dataclass(frozen=True, kw_only=True)
class Row:
    """Errors of a method on a recording, and the part of them within one sigma.

    Parameters
    ----------
    case, preset, method, ahead : str
        The cell, the method, and which of `AHEAD` it knows.
    seed : int
        Of camera and light; 0 for a real recording.
    aop_deg, dolp : float
        Mean absolute errors of super-pixels.
    ln : float
        Root mean squared error of ln intensity of valid pixels.
    moving, in_cell : float
        Root mean squared error of ln DN of left-out frames (`PredictionScore`).
    valid : float
        Fraction of valid super-pixels.
    aop_covered, dolp_covered, ln_covered, moving_covered, in_cell_covered : float
        Fractions of errors within one stated sigma.
    """

    case: str
    preset: str
    seed: int
    method: str
    ahead: str
    aop_deg: float = _NAN
    dolp: float = _NAN
    ln: float = _NAN
    moving: float = _NAN
    in_cell: float = _NAN
    valid: float = _NAN
    aop_covered: float = _NAN
    dolp_covered: float = _NAN
    ln_covered: float = _NAN
    moving_covered: float = _NAN
    in_cell_covered: float = _NAN


def known(*, slow: bool = False) -> dict[str, str]:
    """Return the methods and peers by name, with what each knows of what follows.

    Parameters
    ----------
    slow : bool
        Also those that are scored only if they are named.
    """
    found = {name: ahead for name, (_, ahead) in PEERS.items()}
    for name, trial in trials().items():
        if trial.usual or slow:
            found[name] = "causal" if trial.causal else _ahead(trial)
    return found


def _ahead(trial: Trial) -> str:
    options = dict(trial.options)
    made = make_reconstructor(
        METHODS[options.pop("method")], (2, 2), 0.2, 0.2, options)
    ahead_us = made.lookahead_us
    return "offline" if ahead_us is None or ahead_us > _BUFFERED_US else "buffered"


def simulated_rows(
    name: str, preset: str, seed: int, methods: Mapping[str, str],
) -> list[Row]:
    """Simulate a case and score methods on it.

    Parameters
    ----------
    name, preset : str
        Of `CASES` and of `pdavis_cv.simulation.PRESETS`.
    seed : int
        Of camera and light.
    methods : mapping of str to str
        Some of `known`.

    Returns
    -------
    list of Row
    """
    case = CASES[name]
    camera = Camera.preset(
        preset, seed=seed, size=case.size, origin=case.origin, **case.changes)
    recording, truth = camera.record(case.light(seed), case.seconds)
    frames = _frames(recording)
    if case.keep is not None:
        events = recording.events()
        recording = _with(recording, events[case.keep(
            events, frames, camera.faults.frame_offset_us)], frames)
    dvs = PRESETS[preset]["dvs"]
    told = {"nominal_thresholds": (dvs.theta_on, dvs.theta_off)}
    times = np.arange(case.start_us, truth.stop_us - TAIL_US, case.step_us)
    y, x = np.mgrid[:case.size[0], :case.size[1]]

    def light(t_us: int) -> NDArray[np.float64]:
        """Return the true ln intensity of the pixels."""
        stokes = np.stack(truth.stokes(t_us, x, y), axis=-1)
        with np.errstate(divide="ignore"):
            return np.log(np.sum(camera.maps["analyser"] * stokes, axis=-1))

    rows = []
    for method, ahead in methods.items():
        mask = None if case.mask is None else case.mask(camera)
        scale = 2 if case.demosaic == "superpixel" else 1
        scorer = Scorer(
            truth, (case.size[0] // scale, case.size[1] // scale), scale=scale,
            mask=mask, least_dolp=case.least_dolp, margin=case.margin)
        of_ln = _LogErrors(mask)
        for image, estimate in _images(
                recording, frames, method, times_us=times, demosaic=case.demosaic,
                **told):
            scorer.add(image)
            if estimate is not None:
                of_ln.add(estimate, light(image.t_us))
        score = scorer.score
        rows.append(Row(
            case=name, preset=preset, seed=seed, method=method, ahead=ahead,
            aop_deg=math.degrees(score.aop_error), dolp=score.dolp_error,
            ln=of_ln.rmse, valid=score.valid, aop_covered=score.aop_coverage,
            dolp_covered=score.dolp_coverage, ln_covered=of_ln.covered))
    return rows


class _LogErrors:
    """Errors of ln intensity of valid pixels, and how many lie within their sigma."""

    def __init__(self, mask: NDArray[np.bool_] | None) -> None:
        self._mask = None if mask is None else np.kron(mask, np.ones((2, 2), np.bool_))
        self._squares, self._count, self._within, self._stated = 0.0, 0, 0, 0

    def add(self, estimate: Estimate, truth: NDArray[np.float64]) -> None:
        """Add the pixels of one time."""
        where = estimate.valid & np.isfinite(truth)
        if self._mask is not None:
            where &= self._mask
        off = (estimate.log_intensity - truth)[where]
        self._squares += float(np.sum(off**2))
        self._count += len(off)
        if estimate.variance is not None:
            self._within += int(np.sum(off**2 <= estimate.variance[where]))
            self._stated += len(off)

    @property
    def rmse(self) -> float:
        """Root mean square."""
        return math.sqrt(self._squares / self._count) if self._count else _NAN

    @property
    def covered(self) -> float:
        """Fraction within one sigma."""
        return self._within / self._stated if self._stated else _NAN


def _images(
    recording: Recording, frames: Sequence[ApsFrame], method: str, *,
    times_us: NDArray[np.int64], demosaic: str,
    nominal_thresholds: tuple[float, float],
) -> Iterator[tuple[Any, Estimate | None]]:
    """Yield a method's images, and its estimates of ln intensity if it makes any."""
    if method in PEERS:
        stack, layout = Stack.of(frames), recording.info.layout
        assert layout is not None
        angles = [angle for row in layout.angles_deg for angle in row]
        for t in times_us.tolist():
            ln = PEERS[method][0](stack, t)
            yield polarization(ln, angles, t, demosaic), Estimate(
                ln.astype(np.float32), None, np.isfinite(ln))
        return
    trial = trials()[method]
    seen: list[Estimate] = []
    options = {**trial.options, "method": observed(trial.options["method"], seen)}
    if trial.thresholds:
        options["nominal_thresholds"] = nominal_thresholds
    for image in fuse(recording, times_us=times_us, demosaic=demosaic, **options):
        yield image, None if trial.relative else seen[0]


def _frames(recording: Recording) -> list[ApsFrame]:
    return [frame for packet in recording.packets() for frame in packet.frames]


def _with(
    recording: Recording, events: NDArray[Any], frames: Sequence[ApsFrame],
) -> Recording:
    """Return a recording of the same camera with these samples."""
    info = dataclasses.replace(
        recording.info, event_count=len(events), frame_count=len(frames),
        imu_count=0, trigger_count=0)
    return MemoryRecording(info, events, tuple(frames), np.empty(0, IMU_DTYPE),
                           np.empty(0, TRIGGER_DTYPE))


def real_rows(path: Path, name: str, methods: Mapping[str, str]) -> list[Row]:
    """Score methods on left-out frames of a real recording.

    Parameters
    ----------
    path : Path
        The recording.
    name : str
        Of `REAL`.
    methods : mapping of str to str
        Some of `known`.

    Returns
    -------
    list of Row
        Those methods that the recording supports.
    """
    with open_recording(path) as recording:
        polarized = recording.info.layout is not None
        parts = list(_left_out(recording, name))
        rows = []
        for method, ahead in methods.items():
            relative = method not in PEERS and trials()[method].relative
            if relative and not polarized:
                continue
            scores = {each.kind: each for each in pooled(
                part.score(_predicted(part, method), relative=relative)
                for part in parts)}
            moving, cell = scores["moving"], scores[_IN_CELL]
            rows.append(Row(
                case=f"{name}-{path.stem}", preset="real", seed=0, method=method,
                ahead=ahead, moving=moving.rmse, in_cell=cell.rmse,
                moving_covered=moving.coverage, in_cell_covered=cell.coverage))
    return rows


def _left_out(recording: Recording, name: str) -> Iterator[LeftOutFrames]:
    """Yield the recording, or pieces of it, with every second frame left out."""
    events, frames = recording.events(), _frames(recording)
    if name == "left-out-missing":
        recording = _with(recording, events[_gaps(events, frames)], frames)
    length = REAL[name]
    if length is None:
        yield from both_halves(recording, frames[-1].available_us + 1)
        return
    for first in range(0, len(frames) - length + 1, _EVERY):
        some = frames[first:first + length]
        start, stop = np.searchsorted(events["t"], (
            int(np.min(some[0].exposure_start_us)), some[-1].available_us + 1))
        yield LeftOutFrames(_with(recording, events[start:stop], some))


def _gaps(events: NDArray[Any], frames: Sequence[ApsFrame]) -> NDArray[np.bool_]:
    """Return what is kept if the middle half of every second interval is lost."""
    kept = np.ones(len(events), np.bool_)
    for one, following in list(itertools.pairwise(frames))[::2]:
        gap = following.mid_us - one.mid_us
        first, last = np.searchsorted(
            events["t"], (one.mid_us + gap // 4, following.mid_us - gap // 4))
        kept[first:last] = False
    return kept


def _predicted(left_out: LeftOutFrames, method: str) -> Iterable[Any]:
    if method not in PEERS:
        return predicted(left_out, **trials()[method].options)
    kept = Stack.of(_frames(left_out.kept))
    # A frame is compared at its mid-exposure, where the one before may be unread yet.
    at = line if method == "line" else PEERS[method][0]
    return [at(kept, t) for t in left_out.times_us.tolist()]


def quiet() -> None:
    """Show no warnings of the library: cases are meant to be unusual."""
    warnings.simplefilter("ignore", PdavisWarning)
