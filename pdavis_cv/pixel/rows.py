"""The regression of a recording's increments: frames against what events say."""
from __future__ import annotations

from dataclasses import dataclass, fields, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from pdavis_cv import _kernels
from pdavis_cv.pixel.frame_noise import nonnegative
from pdavis_cv.pixel.model import GAP_CLASSES, SAMPLES, SHORT_US, PixelModel
from pdavis_cv.pixel.sample import Sampled

Floats = NDArray[np.float64]

SPANS = (1, 3, 9)
"""Frames of a pair: 1 alone has 1.3 times the error of AoP at DoLP .1 and 20 RPM."""

LEAST_PASSED, MOST_PASSED = 0.5, 3.0
"""Least events of a pair, most of a third of a long one (lab.studies.constants)."""

EDGE_US = 40_000
"""Beyond exposures, us, events count as motion too (lab.studies.constants)."""

MOST_ROWS, MOST_PER_PAIR = 36_000, 1_200
"""Upper bounds of rows, by pair as well: the time it takes (lab.studies.constants)."""

MISSING, OF_INTERVAL = 30.0, 0.2
"""Events that would come in a silence of all pixels at their mean rate, from which on
they count as missing: so many do not fail to come by chance.  And its least length in
intervals between frames, for it to matter.  Choices (lab.studies.constants)."""

LEAST_DN = 8
"""Least DN of a sample that is used (lab.studies.constants)."""

LEAST_NOISE, LEAST_VARIANCE = (1e-3, 1e-4, 1e-5), 0.01
"""Least alpha, beta and gamma of (8); and what is added to the variance of a squared
residual, whose weight it bounds (lab.studies.constants)."""

LOSS = 0.5
"""Error of ln DN from which the loss of a pair is robust (lab.studies.constants)."""


@dataclass(frozen=True, eq=False)
class Pairs:
    """Rows of the regression: a pixel in two frames.

    Parameters
    ----------
    pixel, pair : ndarray of int, shape (N,)
        Sampled pixel; number of the pair of frames.
    dn : ndarray of float64, shape (2, N)
    ms : ndarray of float64, shape (2, N)
        Exposures, ms; 1 where they are not known.
    exposure : ndarray of int64, shape (2, 2, N)
        (frame, begin and end), us.
    short : ndarray of bool, shape (N,)
        Whether the frames follow each other.
    missing : ndarray of float64, shape (N,)
        Time between them in which events are missing, s.
    gap_us : ndarray of float64, shape (N,)
        Mean time between events of the pixel, of rows without such; 0: it has none.
    """

    pixel: NDArray[np.int32]
    pair: NDArray[np.int64]
    dn: Floats
    ms: Floats
    exposure: NDArray[np.int64]
    short: NDArray[np.bool_]
    missing: Floats
    gap_us: Floats

    def part(self, keep: NDArray[np.bool_]) -> Pairs:
        """Return some of the rows."""
        every = {one.name: getattr(self, one.name)[..., keep] for one in fields(self)}
        every["pair"] = np.unique(every["pair"], return_inverse=True)[1]
        return Pairs(**every)

    @cached_property
    def seconds(self) -> Floats:
        """Time between both middles."""
        seconds: Floats = 5e-7 * (self.exposure[1] - self.exposure[0]).sum(0)
        return seconds

    @cached_property
    def by_pixel(self) -> tuple[NDArray[np.int32], NDArray[np.intp]]:
        """Pixels that have rows, and which of them each row is of."""
        return np.unique(self.pixel, return_inverse=True)


def pairs_of(data: Sampled, shift_us: float) -> Pairs | None:
    """Choose pixels that moved between frames; None: there are too few."""
    size, frames = len(data.start) - 1, data.frames
    mids = np.array([frame.middle_us for frame in frames]) + shift_us
    counts: dict[float, NDArray[np.int64]] = {}
    edges = [frame.middle_us + shift_us + sign * (
        EDGE_US + 0.5 * float(frame.exposure[1].mean() - frame.exposure[0].mean()))
        for frame in frames for sign in (-1, 1)]
    now, before = np.zeros(size, np.int64), 0
    for t in sorted({*mids.tolist(), *edges}):
        at = int(np.searchsorted(data.t, t, "right"))
        now = now + np.bincount(data.pixel[before:at], minlength=size)
        counts[t], before = now, at
    rng = np.random.default_rng(1)
    found: list[tuple[int, int, bool, NDArray[np.intp]]] = []
    for span in SPANS:
        for a in range(0, len(frames) - span, span):
            b = a + span
            ok = frames[a].usable & frames[b].usable & (
                np.minimum(frames[a].dn, frames[b].dn) >= LEAST_DN)
            ok &= counts[edges[2 * b + 1]] - counts[edges[2 * a]] >= LEAST_PASSED
            if span > 1:
                ok &= counts[mids[b]] - counts[mids[a]] < 3 * MOST_PASSED
                ok &= counts[mids[a + span // 3]] - counts[mids[a]] < MOST_PASSED
            chosen = np.flatnonzero(ok)
            if chosen.size:
                found.append((a, b, span == 1, chosen))
    if not found:
        return None
    holes = holes_of(data.t, (mids[-1] - mids[0]) / (len(frames) - 1))
    most = min(MOST_PER_PAIR, MOST_ROWS // len(found))
    rows = []
    for number, (a, b, short, chosen) in enumerate(found):
        if len(chosen) > most:
            chosen = np.sort(rng.choice(chosen, most, replace=False))
        exposure = np.stack([frames[k].exposure[:, chosen] for k in (a, b)])
        ms = np.maximum(1e-3 * (exposure[:, 1] - exposure[:, 0]), 0)
        rows.append((chosen.astype(np.int32), np.full(len(chosen), number),
                     np.stack([frames[k].dn[chosen] for k in (a, b)]),
                     np.where(ms > 0, ms, 1), exposure, np.full(len(chosen), short),
                     np.full(len(chosen), 1e-6 * (np.diff(
                         np.clip(holes, mids[a], mids[b]), axis=0).sum())),
                     (counts[mids[b]] - counts[mids[a]])[chosen]))
    pairs = Pairs(*(np.concatenate(each, -1) for each in zip(*rows, strict=True)))
    events, time = (np.bincount(pairs.pixel, (pairs.missing == 0) * each) for each in (
        pairs.gap_us, np.diff(pairs.exposure.mean(1), axis=0)[0]))
    return replace(pairs, gap_us=(time / np.maximum(events, 1))[pairs.pixel])


def holes_of(t_us: NDArray[np.int64], interval_us: float) -> list[NDArray[np.int64]]:
    """Return begins and ends of where events are missing, for an interval of frames."""
    silence = np.diff(t_us)
    hole = (silence * len(t_us) > MISSING * silence.sum()) & (
        silence > OF_INTERVAL * interval_us)
    return [t_us[:-1][hole], t_us[1:][hole]]


def thinned(pairs: Pairs, most: int) -> Pairs:
    """Return at most so many of the rows."""
    number = len(pairs.pair)
    return pairs if number <= most else pairs.part(
        np.arange(number) % -(-number // most) == 0)


@dataclass(frozen=True, eq=False)
class Rows:
    """The regression at a model: change = weights @ feature + noise.

    Parameters
    ----------
    feature : ndarray of float64, shape (12, N)
        M-, M+ and counts by class, times 1 + gain.
    change : ndarray of float64, shape (N,)
        Change of ln(I + black), less what depends on the weights beyond that.
    jacobian : ndarray of float64, shape (N,)
        d ln DN / dJ.
    frame_noise : ndarray of float64, shape (N,)
        Variance of both samples.
    parts : ndarray of float64, shape (2, N)
        Change by OFF and ON events.
    """

    feature: Floats
    change: Floats
    jacobian: Floats
    frame_noise: Floats
    parts: Floats
    pairs: Pairs

    @cached_property
    def passed(self) -> Floats:
        """Change by all events, whichever sign each has."""
        passed: Floats = np.abs(self.parts[0]) + np.abs(self.parts[1])
        return passed

    def residual(self, model: PixelModel) -> Floats:
        """Return what a model's weights leave of the changes."""
        return self.change - weights_of(model) @ self.feature

    def noise_features(self, model: PixelModel) -> Floats:
        """Return the regressors of the variance (8): time, whether and how many."""
        passed = self.passed / float(model.theta.mean())
        return np.stack([self.pairs.seconds, np.minimum(passed, 1), passed])

    def variance(self, model: PixelModel) -> Floats:
        """Return the variance of each row (8)."""
        variance: Floats = self.frame_noise + model.missing * self.pairs.missing
        return variance + np.array(model.noise) @ self.noise_features(model)

    def rescaled(self, of_pixels: Floats, of_all: Floats) -> Rows:
        """Return the regression at other gains and thresholds, to first order.

        They are those factors times what they were, (2, pixels) of 1 + gain and (2,).
        """
        return replace(
            self, feature=self.feature * of_pixels[:, self.pairs.pixel][OF_SIGN],
            parts=self.parts * of_all[:, None])


OF_SIGN = np.array([0, 1, *[0] * GAP_CLASSES, *[1] * GAP_CLASSES])
"""Whether a feature counts OFF (0) or ON events."""


def weights_of(model: PixelModel) -> Floats:
    """Return the weights of the features."""
    return np.concatenate([model.theta, model.by_class.ravel()])


def linearized(
    data: Sampled, pairs: Pairs, model: PixelModel,
    gains: Floats, shift_us: float | Floats, ahead_us: int = 0,
) -> Rows:
    """Return the regression at a model; frames are moved by shift_us, () or (N,)."""
    exposure = pairs.exposure + np.rint(shift_us).astype(np.int64)
    long = int((exposure[:, 1] - exposure[:, 0]).max()) > SHORT_US
    logs = np.log(np.maximum(pairs.dn / pairs.ms + model.black, 1e-3))
    out = _of_exposures(data, pairs, exposure, logs, model, gains, ahead_us,
                        SAMPLES if long else 1)
    mean_dn, mean_ms = np.sqrt(pairs.dn[0] * pairs.dn[1]), pairs.ms.mean(0)
    return Rows(out[:12], logs[1] - logs[0] - out[12] + weights_of(model) @ out[:12],
                (mean_dn + model.black * mean_ms) / mean_dn,
                model.frame_variance(pairs.dn, pairs.ms).sum(0), out[13:], pairs)


def _of_exposures(
    data: Sampled, pairs: Pairs, exposure: NDArray[np.int64],
    logs: Floats, model: PixelModel, gains: Floats, ahead_us: int, samples: int,
) -> Floats:
    out = np.empty((len(OF_SIGN) + 3, len(pairs.pixel)))
    _kernels.learning_rows(
        data.events, data.start, pairs.pixel, np.ascontiguousarray(exposure), ahead_us,
        np.ascontiguousarray(logs), samples, model.numbers, gains, out)
    return out


def counts_at(
    data: Sampled, pairs: Pairs, model: PixelModel,
    gains: Floats, shift_us: float, ahead_us: int, at: float,
) -> Floats:
    """Return M-, M+ and counts by class, times 1 + gain, in the second exposures.

    at is the part of them that has passed; shape (12, N).
    """
    begin, end = pairs.exposure[1] + np.int64(round(shift_us))
    t = (begin + at * (end - begin)).astype(np.int64)
    before = np.full_like(t, data.t[0] - 1)     # the first event
    return _of_exposures(
        data, pairs, np.stack([[before, before], [t, t]]), np.zeros((2, len(t))),
        model.replace(bandwidth=(0.0, 0.0)), gains, ahead_us, 1)[:12]


def around_rows(
    data: Sampled, pairs: Pairs, model: PixelModel,
    shift_us: float, ahead_us: int, at: float = 0.5, of_first: bool = True,
) -> Floats:
    """Return the features of other times and pixels, shape (N, 6 lags + 4).

    at is the part of the exposures that has passed; of_first: less those of the first
    frame.
    """
    lags = model.lags_s
    outs = []
    for k in (1, 0) if of_first else (1,):
        begin, end = pairs.exposure[k] + np.int64(round(shift_us))
        times = (begin + at * (end - begin)).astype(np.int64)
        known = times + ahead_us if k == 1 else np.maximum(
            times + ahead_us, pairs.exposure[1, 1] + np.int64(round(shift_us))
            + ahead_us)
        out = np.empty((len(times), 6 * len(lags) + 4), np.float32)
        _kernels.learning_around(
            data.events, data.start, np.ascontiguousarray(data.places[pairs.pixel]),
            times, known, lags, model.numbers, out)
        outs.append(out.astype(np.float64))
    return outs[0] - outs[1] if of_first else outs[0]


def robust(residual: Floats, variance: Floats) -> tuple[Floats, Floats]:
    """Return weights of pseudo-Huber residuals, and their cost."""
    root = np.sqrt(1 + residual * residual / variance)
    return 1 / variance / root, 2 * (root - 1)


def losses(rows: Rows, residual: Floats) -> Floats:
    """Return the loss of each row in ln DN, robust from LOSS on."""
    return robust(residual * rows.jacobian,
                  rows.frame_noise * rows.jacobian**2 + LOSS**2)[1]


def fitted_noise(
    rows: Rows, model: PixelModel, residual: Floats
) -> tuple[float, float, float]:
    """Return alpha, beta, gamma of (8) from squared residuals."""
    x = rows.noise_features(model)
    excess = np.minimum(residual**2, 1) - rows.frame_noise
    weight, noise = np.ones(len(residual)), np.zeros(3)
    for _ in range(4):
        square = (x * weight**2) @ x.T
        noise = nonnegative(square + 1e-9 * np.trace(square) * np.eye(3),
                            x @ (weight**2 * excess))
        weight = 1 / (noise @ x + LEAST_VARIANCE + rows.frame_noise)
    alpha, beta, gamma = np.maximum(noise, LEAST_NOISE)
    return float(alpha), float(beta), float(gamma)
