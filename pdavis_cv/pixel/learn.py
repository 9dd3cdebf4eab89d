"""Learning of a camera from its own frames and events: one robust MAP fit."""
from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from pdavis_cv.pixel import features
from pdavis_cv.pixel.frame_noise import learned_frame_noise
from pdavis_cv.pixel.model import SHORT_US, PixelModel, lags_of
from pdavis_cv.pixel.rows import (
    Floats,
    Pairs,
    Rows,
    fitted_noise,
    linearized,
    losses,
    pairs_of,
    robust,
    thinned,
)
from pdavis_cv.pixel.sample import PixelSample, Sampled
from pdavis_cv.pixel.silences import dead_time, learned_silences, table_of, turn_of

STARTS_US = range(-10_000, 14_000, 2000)
"""Clock offsets from which the fit starts, us: the likeliest two are followed."""

CLOCK_STEP_US = 1000.0
"""Half of the difference of times over which the derivative by the clock is taken, us:
counts step where a rest ends, and their derivative over less is that of the steps."""

STEP, ROUNDS = 0.1, 5
"""Half of the difference over which other derivatives are taken, sigmas of the prior;
and Gauss-Newton steps, of at most one of these (lab.studies.constants)."""

COMMON_ERROR, COMMON_PAIRS = 30.0, 3.0
"""Prior of the design effect, and its weight in pairs (lab.studies.constants)."""

COUNT_NOISE = 1 / 6
"""Largest variance of the error of a difference of counts, thresholds^2: at both ends
light may be anywhere within a threshold, whose variance is 1/12."""

BETTER_REST = 0.02
"""Fall of -2 ln L per row that another rest time takes (lab.studies.constants)."""

LAG = 0.01, 0.037
"""Lag of interpolated counts, in mean gaps between events of a pixel, and its spread:
of 48 simulated cameras (waves, texture, edges) whose clock and bandwidth were told."""

EVIDENCE, LOSS_OF_BLACK, SIGMAS, SURE = 4.0, 3.0, 4.0, 0.95
"""Fall of -2 ln posterior for which a number is taken that was not told: two standard
errors.  A black level must lower the loss of pairs by three, and be worth four of its
own (where none was, 2 to 3 DN/ms were 3.1 to 3.6 of them); by so many sigmas of the
prior photoreceptors may be slower or faster (lab.studies.constants).  A clock offset,
or none, of this probability is no longer averaged with the other."""

MOST_LEFT = 0.5
"""Part of the loss that a black level leaves, so that it needs no pixels that pass less
than a threshold in an exposure: .04 to .37 before a polarizer of DoLP 1 with 30 DN, .82
and more where the pixels' circuit, which the model lacks, made up 23 to 140 DN."""

MOST_LACKING = 1.7
"""A choice: usual lags that pixels without any lack at most, as the fit sees them."""

LEAST_WHOLE = 0.25
"""Share of whole rows from which on others are left out (lab.studies.constants)."""

MODEL_ERROR = 0.02
"""Relative error of thresholds that a perfect fit leaves (lab.studies.constants)."""

RESTS_S = (1.0, 0.25)

SPREAD = 0.15
"""Spread of the pixels' thresholds from which the fit starts, relative: sensors that
were measured pixel by pixel have .1 (OFF) to .19 (ON) (lab.studies.constants)."""

EVER_US = 1 << 40
"""Look-ahead of the fit: a change is known best once the next event is."""

MOST_SEARCHED, MOST_TRIED, MOST_FURTHER = (6000, 3000), 2000, 12_000
"""Rows in which numbers beside the thresholds are looked for, of short exposures and of
long ones; to try each clock offset; of further weights (lab.studies.constants)."""

BLACK, LEAST_BLACK = (40.0, 40.0), 15.0
"""Black level from which the fit starts, and its prior standard deviation, DN; and the
least that is taken: real frames lack 20 to 80 DN, errors of events look like 10."""


@dataclass(frozen=True, kw_only=True)
class Priors:
    """What is known of a camera beforehand.

    Parameters
    ----------
    theta : (float, float)
        Thresholds, OFF and ON, ln.
    theta_sigma : float
        Their relative error.
    clock_us : (float, float)
        Offset of the frames' clock and its standard deviation, us; 0: it is known.
    bandwidth : (float, float)
        Corner frequency, Hz, and its increase by light, Hz per DN/ms.
    bandwidth_sigma : (float, float)
        Standard deviations of their logarithms; zeros: they are known.
    black : (float, float) or None
        Black level, DN, and its standard deviation; None: learned, if it is there.
    model : PixelModel or None
        What was learned of the camera before: its weights and silences are those that
        a recording's are shrunk to.
    """

    theta: tuple[float, float]
    theta_sigma: float = 0.5
    clock_us: tuple[float, float] = (0.0, 5000.0)
    bandwidth: tuple[float, float] = (300.0, 2.0)
    bandwidth_sigma: tuple[float, float] = (0.5, 1.0)
    black: tuple[float, float] | None = None
    model: PixelModel | None = None


@dataclass(frozen=True, eq=False, kw_only=True)
class LearnedPixels:
    """A camera as learned.

    Parameters
    ----------
    model : PixelModel
    clock_offset_us : float
        To add to the frames' stamps.
    sigmas : mapping of str to float
        Standard deviations: ``shift`` (us) of the clock offset, ``f0`` and ``slope``
        (of the logarithms), ``black`` (DN/ms), ``off`` and ``on`` (relative), and
        ``lag`` (in gaps) of the interpolation.
    gains : ndarray of float64, shape (2, K)
        Deviations of the sampled pixels' thresholds.
    exposure_ms : float
        Of the frames, 1 where it is not known.
    told : bool
        Whether thresholds are those of the priors, as frames say nothing of them.
    """

    model: PixelModel
    clock_offset_us: float = 0.0
    sigmas: Mapping[str, float] = field(default_factory=dict)
    gains: Floats
    exposure_ms: float = 1.0
    told: bool = False

    def scaled(self, factor: float, sigma: float) -> LearnedPixels:
        """Return the camera with thresholds times a factor of this relative error."""
        theta = factor * self.model.theta
        return replace(self, told=False, model=self.model.replace(
            theta=theta, thresholds=theta,
            theta_cov=sigma**2 * np.outer(theta, theta) + np.diag(
                (MODEL_ERROR * theta) ** 2)))


@dataclass(frozen=True, eq=False)
class _Fit:
    """A state of the fit: the numbers, and how likely they are."""

    model: PixelModel
    shift_us: float
    lag: float                      # of interpolated counts, in gaps
    gains: Floats
    sigmas: Mapping[str, float]
    effect: float | None = None     # design effect, of the simplest model
    of_gains: float = 0.0           # what gains add to -2 ln likelihood
    cost: float = math.inf          # -2 ln posterior
    per_row: float = math.inf       # -2 ln likelihood of a row


@dataclass(frozen=True)
class _Number:
    """A number that is fitted beside the thresholds."""

    mean: float
    sigma: float
    step: float
    get: Callable[[_Fit], float]
    put: Callable[[_Fit, float], _Fit]


def _with(fit: _Fit, **changes: object) -> _Fit:
    return replace(fit, model=fit.model.replace(**changes))


def prior_model(priors: Priors, lookahead_us: int, ms: float = math.inf) -> PixelModel:
    """Return the camera that the priors describe, for frames of an exposure, ms."""
    theta, table = np.array(priors.theta, np.float64), table_of(lookahead_us)
    model = PixelModel(
        theta=theta, theta_cov=np.diag((priors.theta_sigma * theta) ** 2),
        spread=SPREAD, bandwidth=priors.bandwidth, rest_s=RESTS_S[0],
        end=table[0], bow=table[1], lags_s=lags_of(lookahead_us),
        black=0.0 if priors.black is None else priors.black[0] / ms)
    if priors.model is None or not np.array_equal(priors.model.lags_s, model.lags_s):
        return model
    return model.like(priors.model)


def learn(
    sample: PixelSample, priors: Priors, lookahead_us: int,
    before: LearnedPixels | None = None,
) -> LearnedPixels:
    """Learn a camera from a window of its stream.

    Parameters
    ----------
    sample : PixelSample
    priors : Priors
    lookahead_us : int
        How much is known beyond the time of an image.
    before : LearnedPixels, optional
        What less of it told: a black level needs evidence to go.

    Returns
    -------
    LearnedPixels
        As the priors say what the data do not tell.
    """
    data = sample.sampled()
    told, _ = priors.clock_us
    gains = np.zeros((2, len(data.start) - 1))
    pairs = pairs_of(data, told)
    ms = math.inf if pairs is None else float(np.median(pairs.ms))
    prior = learned_frame_noise(data, prior_model(priors, lookahead_us, ms))
    fit = _Fit(learned_frame_noise(data, prior_model(
        replace(priors, model=None), lookahead_us, ms)), told, 0.0, gains, {})
    if pairs is None:
        return LearnedPixels(model=prior, clock_offset_us=told, gains=gains, told=True)
    every, whole = pairs, pairs.missing == 0
    if whole.mean() > LEAST_WHOLE:
        pairs = pairs.part(whole)
    fit = _with(fit, dead_s=dead_time(data), turn=turn_of(data))
    data = data.with_past(fit.model.numbers)
    fit = _fitted(data, pairs, priors, fit, before)
    fit = _with(fit, thresholds=fit.model.theta)
    model = learned_silences(data, fit.model.like(prior), lookahead_us)
    known = max(fit.sigmas["off"], fit.sigmas["on"])**-2 - priors.theta_sigma**-2
    if known < 1:
        # By frames alone thresholds err by more than themselves: what was told stays.
        model = model.replace(black=prior.black, bandwidth=prior.bandwidth)
        return LearnedPixels(model=model, clock_offset_us=told, gains=gains,
                             sigmas=fit.sigmas, told=True, exposure_ms=ms)
    short = thinned(pairs.part(pairs.short), MOST_FURTHER)
    model = features.further_weights(data, short, model, fit.gains, fit.shift_us,
                            lookahead_us)
    if not whole.all():
        # Light moves on where events are missing.
        rows = _rows(data, every, _with(fit, noise=model.noise))
        excess = np.minimum(rows.residual(fit.model)**2, 1) - rows.variance(model)
        model = model.replace(missing=max(
            float(excess[~whole].sum() / every.missing.sum()), 0.0))
    return LearnedPixels(model=model, clock_offset_us=fit.shift_us, gains=fit.gains,
                         sigmas=fit.sigmas, exposure_ms=ms)


def _fitted(
    data: Sampled, pairs: Pairs, priors: Priors, fit: _Fit,
    before: LearnedPixels | None,
) -> _Fit:
    """Return the likeliest state of the fit, of several starts and models.

    A number moves from what was told only if the posterior is clearly better, and a
    black level back from what was found before only if that is clearly worse.  The
    offset of the clock is the mean over having one and having none.
    """
    told = fit.shift_us
    black, clock_us = (0.0, told) if before is None else (
        before.model.black, before.clock_offset_us)
    every, long = pairs, 1e3 * float(pairs.ms.max()) > SHORT_US
    pairs = thinned(pairs, MOST_SEARCHED[long])
    few = thinned(pairs, MOST_TRIED)
    numbers: dict[str, _Number] = {}
    held: dict[str, _Number] = {}

    def tried(start: _Fit, names: Sequence[str], rounds: int = ROUNDS,
              among: Pairs | None = None) -> _Fit:
        free = {name: one for name, one in numbers.items() if name in names}
        prior = {name: one for name, one in numbers.items() if name != "black"}
        return _descended(data, pairs if among is None else among, priors, start, free,
                          rounds, {**prior, **held})

    first = tried(fit, (), 3)
    numbers = _numbers(priors, pairs)
    starts = [tried(replace(fit, shift_us=float(start)), (), 2, few)
              for start in {*STARTS_US, clock_us}] if "shift" in numbers else []
    starts.sort(key=lambda one: one.per_row)
    apart = [one for one in starts              # of another minimum
             if abs(one.shift_us - starts[0].shift_us) > 3000]
    starts = [tried(one, (), 2) for one in [*starts[:1], *apart[:1]]]
    likeliest = min([first, *starts], key=lambda one: one.per_row)
    effect = _design_effect(_rows(
        data, pairs, likeliest), likeliest.model)
    first, *starts = (tried(replace(one, effect=effect), (), 0)
                      for one in (first, *starts))
    best, law, lag, clock = first, ["f0", "slope"], ["lag"], ["shift", "lag"]
    f0, slope = priors.bandwidth
    slowest = f0 * math.exp(-SIGMAS * priors.bandwidth_sigma[0]), slope
    slow = min((tried(one, [*lag, *law]) for one in (
        first, _with(first, bandwidth=slowest))), key=lambda one: one.cost)
    light = float(np.median(pairs.dn / pairs.ms))
    if slow.cost < best.cost - EVIDENCE and _usual(priors, slow.model, light, 0):
        best = slow
    else:
        best = tried(first, lag)
    # Frames see the sum of the clock's offset and the photoreceptors' lag.  Pixels may
    # have none, or one longer than usual by three sigmas: no offset that is explained
    # so is taken, unless one is known.
    usual = 0.0 if told else _lag_us(priors.bandwidth, light)
    least, most = told - MOST_LACKING * usual, told + usual * math.expm1(
        3 * priors.bandwidth_sigma[0])
    others = [one for one in (tried(start, clock) for start in starts)
              if "shift" in one.sigmas and not least <= one.shift_us <= most]
    between = 0.0
    if others:
        # As likely beforehand as none: the mean over both by Laplace's evidence.
        other = min(others, key=lambda one: one.cost)
        narrow = 2 * math.log(priors.clock_us[1] / other.sigmas["shift"])
        share = 0.5 + 0.5 * math.tanh((best.cost - other.cost - narrow) / 4)
        off = other.shift_us - told
        between = math.sqrt(share * (1 - share)) * abs(off)
        if share > SURE:
            best = other
        elif share > 1 - SURE:
            best, clock = tried(replace(other, shift_us=told + share * off), lag), lag
    used = clock if best.shift_us else lag
    other = tried(best, [*used, *law])
    if other.cost < best.cost - EVIDENCE and _usual(priors, other.model, light):
        best = other
    if "black" in numbers:
        held = {"black": numbers["black"]}
        ms = float(np.median(pairs.ms))
        other = tried(_with(best, black=black or best.model.black or BLACK[0] / ms),
                      [*used, "black"])
        rows = [(_rows(data, pairs, one), one.model) for one in (best, other)]
        without, within = (losses(one, one.residual(model)) for one, model in rows)
        slow = 1e3 * pairs.ms.mean(0) < pairs.gap_us
        gain = np.bincount(pairs.pair, np.where(slow, without - within, 0))
        enough = -1 if black else 1         # evidence against what was found before
        clearly = gain.sum() > enough * LOSS_OF_BLACK * np.sqrt(len(gain)) * gain.std()
        clearly |= within.sum() < MOST_LEFT * without.sum()
        usual = other.model.black * ms > LEAST_BLACK
        if usual and clearly and other.cost < best.cost - enough * EVIDENCE:
            # With all numbers free: a small contrast does not tell it from them.
            sigma = _descended(data, pairs, priors, other, numbers, 1).sigmas["black"]
            if black or other.model.black > SIGMAS * sigma:
                best = other
    other = tried(_with(best, rest_s=RESTS_S[1]), (), 2)
    if other.per_row < best.per_row - BETTER_REST:
        best = other
    if least <= best.shift_us <= most:
        best, used = replace(best, shift_us=told), lag
    best = tried(best, used, among=every)
    sigmas = dict(_descended(data, pairs, priors, best, numbers, 1).sigmas)
    if "shift" in sigmas:
        # How the sum is split is the prior's.
        sigmas["shift"] = math.hypot(sigmas["shift"], between, (
            priors.bandwidth_sigma[0] * _lag_us(best.model.bandwidth, light)))
    # The lag belongs to the interpolation: the thresholds are fitted again without it.
    best = _descended(data, every, priors, replace(best, lag=0.0), {}, 3)
    best = replace(best, sigmas={**sigmas, **best.sigmas})
    return _honest(data, every, priors, best)


def _usual(priors: Priors, model: PixelModel, light: float, up: float = SIGMAS) -> bool:
    """Whether photoreceptors are slower, or faster, than usual by few sigmas."""
    usual, found = (law[0] + law[1] * light for law in (
        priors.bandwidth, model.bandwidth))
    sigma = priors.bandwidth_sigma[0]
    return found > 0 and -SIGMAS * sigma <= math.log(found / usual) <= up * sigma


def _lag_us(law: tuple[float, float], light: float) -> float:
    """Return the lag of photoreceptors of a bandwidth in this light, us."""
    corner = law[0] + law[1] * light
    return 1e6 / (2 * math.pi * corner) if corner > 0 else 0.0


def _honest(data: Sampled, pairs: Pairs, priors: Priors, fit: _Fit) -> _Fit:
    """Return the fit with thresholds moved only as far as light moved.

    Errors of counts attenuate thresholds by up to their share in the changes; what (9)
    restores is not known better than that.
    """
    rows = _rows(data, pairs, fit)
    counted = float(np.mean(rows.feature[:2].sum(0) ** 2))
    seen = float(np.mean(rows.change**2 - rows.frame_noise)) / float(
        np.mean(priors.theta)) ** 2
    common = (COUNT_NOISE / max(min(counted, seen), 1e-6)) ** 2 + MODEL_ERROR**2
    told = priors.theta_sigma**2
    old = np.minimum(np.array([fit.sigmas["off"], fit.sigmas["on"]]) ** 2, 0.999 * told)
    by_data = 1 / (1 / old - 1 / told) + common
    new = 1 / (1 / by_data + 1 / told)
    share = np.clip((1 - new / told) / (1 - old / told), 0, 1)
    theta = np.array(priors.theta)
    theta = theta * (fit.model.theta / theta) ** share
    sigma = np.sqrt(new) * theta
    shared = common / by_data.max() * float(sigma.prod())
    cov = np.array([[sigma[0]**2, shared], [shared, sigma[1]**2]])
    return replace(_with(fit, theta=theta, theta_cov=cov), sigmas={
        **fit.sigmas, "off": math.sqrt(new[0]), "on": math.sqrt(new[1])})


def _numbers(priors: Priors, pairs: Pairs) -> dict[str, _Number]:
    every: dict[str, _Number] = {}
    if priors.clock_us[1] > 0:
        every["shift"] = _Number(
            *priors.clock_us, CLOCK_STEP_US, lambda f: f.shift_us,
            lambda f, x: replace(f, shift_us=x))
    every["lag"] = _Number(
        *LAG, CLOCK_STEP_US / max(float(np.mean(pairs.gap_us)), 1.0),
        lambda f: f.lag, lambda f, x: replace(f, lag=x))
    ms = float(np.median(pairs.ms))
    mean, sigma = (dn / ms for dn in priors.black or (0.0, BLACK[1]))
    if sigma > 0 and not pairs.missing.any():
        every["black"] = _Number(
            mean, sigma, STEP * sigma, lambda f: f.model.black,
            lambda f, x: _with(f, black=max(x, 0.0)))
    for i, name in enumerate(("f0", "slope")):
        if priors.bandwidth[i] > 0 and priors.bandwidth_sigma[i] > 0:
            every[name] = _of_bandwidth(priors, i)
    return every


def _of_bandwidth(priors: Priors, i: int) -> _Number:
    """Return the logarithm of one of the two numbers of the bandwidth."""
    sigma = priors.bandwidth_sigma[i]
    return _Number(
        math.log(priors.bandwidth[i]), sigma, STEP * sigma,
        lambda f: math.log(f.model.bandwidth[i]),
        lambda f, x: _with(f, bandwidth=(
            *f.model.bandwidth[:i], math.exp(x), *f.model.bandwidth[i + 1:])))


def _descended(
    data: Sampled, pairs: Pairs, priors: Priors, fit: _Fit,
    free: Mapping[str, _Number], rounds: int = ROUNDS,
    prior: Mapping[str, _Number] | None = None,
) -> _Fit:
    """Return the fit after Gauss-Newton steps in the thresholds and `free` numbers."""
    fit = replace(fit, cost=math.inf)
    best, before = fit, math.inf
    for turn in range(rounds + 1):
        rows = _rows(data, pairs, fit)
        if turn:
            old = fit = _with(fit, noise=fitted_noise(
                rows, fit.model, rows.residual(fit.model)))
            fit = _with_gains(rows, fit)
            rows = rows.rescaled((1 + fit.gains) / (1 + old.gains),
                                 fit.model.theta / old.model.theta)
        fit = _likelihood(rows, fit, priors, free if prior is None else prior)
        if (turn or not rounds) and fit.cost < best.cost:
            best = fit
        if turn == rounds or (turn > 1 and abs(before - fit.cost) < 0.1):
            break
        before = fit.cost
        if turn % 2 == 0:       # they change little
            slopes = _slopes(data, pairs, rows, fit, free)
        fit = _step(rows, slopes, fit, priors, free)
    return best


def _rows(data: Sampled, pairs: Pairs, fit: _Fit) -> Rows:
    return linearized(data, pairs, fit.model, fit.gains,
                      fit.shift_us + fit.lag * pairs.gap_us, EVER_US)


def _likelihood(
    rows: Rows, fit: _Fit, priors: Priors, free: Mapping[str, _Number],
) -> _Fit:
    """Return the fit with its costs."""
    variance = rows.variance(fit.model)
    residual = rows.residual(fit.model)
    _, cost = robust(residual, variance)
    # Of ln DN: a larger black level makes all changes of ln(I + black) smaller.
    cost = cost + np.log(variance * rows.jacobian**2)
    effect = fit.effect or _design_effect(rows, fit.model)
    theta = np.array(priors.theta)
    total = (float(cost.sum()) + fit.of_gains) / effect + float(
        (((fit.model.theta - theta) / (priors.theta_sigma * theta)) ** 2).sum())
    total += sum(((one.get(fit) - one.mean) / one.sigma) ** 2 for one in free.values())
    return replace(fit, cost=total, per_row=(
        float(cost.sum()) + fit.of_gains) / len(cost))


def _design_effect(rows: Rows, model: PixelModel) -> float:
    """Return by how much errors that rows of a pair share exceed independent ones."""
    f, pair, residual = rows.feature[:2], rows.pairs.pair, rows.residual(model)
    k, _ = robust(residual, rows.variance(model))
    number, information = int(pair.max()) + 1, (f * k) @ f.T
    total = np.stack([
        np.bincount(pair, k * residual * each, number) for each in f], 1)
    ridge = max(1e-9 * np.trace(information), 1e-12) * np.eye(len(information))
    ratio = np.trace(np.linalg.solve(information + ridge, total.T @ total)) / len(
        information)
    return float(max((COMMON_ERROR * COMMON_PAIRS + ratio * number) / (
        COMMON_PAIRS + number), 1.0))


def _with_gains(rows: Rows, fit: _Fit) -> _Fit:
    """Return the fit with the pixels' gains, and their spread by a step of EM."""
    used, pixel = rows.pairs.by_pixel
    n, (off, on) = len(used), rows.parts
    residual = rows.residual(fit.model)
    k, _ = robust(residual, rows.variance(fit.model))
    residual += (fit.gains[:, rows.pairs.pixel] * rows.parts).sum(0)
    a, b, c, x, y = (np.bincount(pixel, k * each, n) for each in (
        off * off, off * on, on * on, off * residual, on * residual))
    inverse = 1 / fit.model.spread**2
    det = (a + inverse) * (c + inverse) - b * b
    of_used = np.stack([(c + inverse) * x - b * y, (a + inverse) * y - b * x]) / det
    spread = math.sqrt(np.mean(
        (of_used - of_used.mean(1, keepdims=True)) ** 2
        + np.stack([c + inverse, a + inverse]) / det))
    # Integrated over the gains: what they fit of the noise is no likelihood.
    of_gains = float(inverse * (of_used**2).sum() + np.log(det / inverse**2).sum())
    # What all pixels have in common belongs to the thresholds.  No weights: those that
    # have most events have the lowest thresholds.
    mean = of_used.mean(1)
    of_used = (1 + of_used) / (1 + mean[:, None]) - 1
    gains = np.zeros_like(fit.gains)
    gains[:, used] = of_used
    return replace(_with(fit, spread=spread, theta=fit.model.theta * (1 + mean)),
                    gains=gains, of_gains=of_gains)


def _slopes(
    data: Sampled, pairs: Pairs, rows: Rows, fit: _Fit,
    free: Mapping[str, _Number],
) -> list[Floats]:
    """Return the derivatives of the changes by each number."""
    slopes: list[Floats] = []
    for name, one in free.items():
        if name == "lag" and "shift" in free:
            slopes.append(slopes[-1] * pairs.gap_us)    # frames see the sum of both
            continue
        # In ln DN, and back: a larger black level makes all residuals smaller.
        ends = []
        for way in (-1, 1):
            other = one.put(fit, one.get(fit) + way * one.step)
            there = _rows(data, pairs, other)
            ends.append(there.residual(other.model) * there.jacobian)
        slopes.append((ends[0] - ends[1]) / rows.jacobian / (2 * one.step))
    return slopes


def _step(
    rows: Rows, slopes: list[Floats], fit: _Fit, priors: Priors,
    free: Mapping[str, _Number],
) -> _Fit:
    """Return the fit after one Gauss-Newton step."""
    model, theta = fit.model, np.array(priors.theta)
    residual = rows.residual(model)
    k, _ = robust(residual, rows.variance(model))
    # Counts have errors, which would attenuate the thresholds: their expectation given
    # the residual is taken off on one side of the normal equations.           (9)
    share = np.abs(rows.parts) / np.maximum(rows.passed, 1e-9)
    noise = min(model.noise[1] / float(model.theta.mean()) ** 2, COUNT_NOISE)
    true = rows.feature[:2] + noise * model.theta[:, None] * share * (residual * k)
    effect = fit.effect or _design_effect(rows, fit.model)
    a = np.stack([*rows.feature[:2], *slopes])
    left = np.stack([*true, *slopes]) * k
    values = [one.get(fit) for one in free.values()]
    to_prior = np.concatenate([theta - model.theta, [
        one.mean - value for one, value in zip(free.values(), values, strict=True)]])
    inverse = 1 / np.concatenate([
        priors.theta_sigma * theta, [one.sigma for one in free.values()]]) ** 2
    step = np.linalg.solve(left @ a.T / effect + np.diag(inverse),
                           left @ residual / effect + inverse * to_prior)
    step /= max(1.0, float(np.max(np.abs(step) * np.sqrt(inverse))))
    cov = np.linalg.inv((a * k) @ a.T / effect + np.diag(inverse))
    sigma = np.sqrt(np.diag(cov))
    for one, value, change in zip(free.values(), values, step[2:], strict=True):
        fit = one.put(fit, float(value + change))
    fit = _with(fit, theta=np.maximum(model.theta + step[:2], 0.1 * theta),
                theta_cov=cov[:2, :2])
    sigma[:2] /= fit.model.theta
    return replace(fit, sigmas=dict(zip(
        ("off", "on", *free), sigma.tolist(), strict=True)))
