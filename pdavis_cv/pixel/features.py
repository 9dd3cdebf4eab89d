"""Further weights of events: by the gap before, at other times, of other pixels."""
from __future__ import annotations

import numpy as np

from pdavis_cv.pixel.model import GAP_CLASSES, SHORT_US, PixelModel
from pdavis_cv.pixel.rows import (
    Floats,
    Pairs,
    around_rows,
    counts_at,
    fitted_noise,
    linearized,
    losses,
    robust,
)
from pdavis_cv.pixel.sample import Sampled

SHRINKS = (0.0, 0.02, 0.05, 0.1, 0.2)
"""Prior sigmas of weights, thresholds: one is chosen (lab.studies.constants)."""

FOLDS = 4
"""Blocks of pairs that are left out in turn (lab.studies.constants)."""

WITHIN = 0.1, 0.9
"""Parts of exposures where changes by weights are seen (lab.studies.constants)."""

SAME_SCALE = 1e3
"""Weight of the penalty on what further weights change in proportion to all events:
the thresholds', which errors of counts attenuate (lab.studies.constants)."""


def further_weights(
    data: Sampled, pairs: Pairs, model: PixelModel,
    gains: Floats, shift_us: float, lookahead_us: int,
) -> PixelModel:
    """Return the model with further weights, if they predict pairs left out better.

    They are shrunk to the model's by as much as cross-validation says; those nearest to
    them are taken that are not worse than the best by a standard error over pairs.
    """
    number = int(pairs.pair.max(initial=-1)) + 1
    if number < FOLDS:
        return model
    rows = linearized(data, pairs, model, gains, shift_us, lookahead_us)
    around = around_rows(data, pairs, model, shift_us, lookahead_us)
    x = np.concatenate([rows.feature.T, around], 1)
    used = np.any(x != 0, 0)
    first = np.concatenate([each.ravel() for each in (
        model.theta, model.by_class, np.stack([model.own, model.cell, model.near], 1),
        model.cell_now, model.near_now)])
    penalty = _unseen(
        data, pairs, model, gains, shift_us, lookahead_us,
        1 / rows.variance(model))
    theta = float(model.theta.mean())
    scale = (x[:, :2] / rows.variance(model)[:, None]).T @ x
    penalty += SAME_SCALE * scale.T @ np.linalg.solve(
        scale[:, :2] + max(1e-9 * np.trace(scale[:, :2]), 1e-12) * np.eye(2), scale)
    fold = pairs.pair * FOLDS // number
    residual = rows.change - x @ first
    k, _ = robust(residual, rows.variance(model))
    blocks = []
    for i in range(FOLDS):
        part = x[fold == i] * k[fold == i][:, None]
        blocks.append((part.T @ x[fold == i], part.T @ residual[fold == i]))
    square, right = (sum(each) for each in zip(*blocks, strict=True))

    def solved(shrink: float, without: int | None) -> Floats:
        a, b = square, right
        if without is not None:
            a, b = a - blocks[without][0], b - blocks[without][1]
        sigma = np.where(used, max(shrink, 1e-6) * theta, 1e-9)
        return first + np.linalg.solve(a + np.diag(1 / sigma**2) + penalty, b)

    lost, outsides = [], []
    for shrink in SHRINKS:
        outside = residual.copy()
        if shrink:
            for i in range(FOLDS):
                here = fold == i
                outside[here] = rows.change[here] - x[here] @ solved(shrink, i)
        lost.append(np.bincount(
            pairs.pair, losses(rows, outside), number).astype(np.float64))
        outsides.append(outside)
    best = int(np.argmin([loss.sum() for loss in lost]))
    chosen = next(i for i in range(best + 1) if i == best or not _better(
        lost[best], lost[i]))
    if SHRINKS[chosen]:
        passed, classes, rest = np.split(
            solved(SHRINKS[chosen], None), [2, 2 + 2 * GAP_CLASSES])
        lags, last = rest[:-4].reshape(-1, 3, 2), rest[-4:]
        model = model.replace(
            theta=np.maximum(passed, 0.1 * model.theta),
            by_class=classes.reshape(2, GAP_CLASSES),
            own=lags[:, 0], cell=lags[:, 1], near=lags[:, 2], cell_now=last[:2],
            near_now=last[2:])
    return model.replace(noise=fitted_noise(rows, model, outsides[chosen]))


def _better(loss: Floats, other: Floats) -> bool:
    """Whether losses per pair are less than others by more than a standard error."""
    gain = other - loss
    return bool(gain.sum() > np.sqrt(len(gain)) * gain.std())


def _unseen(
    data: Sampled, pairs: Pairs, model: PixelModel,
    gains: Floats, shift_us: float, lookahead_us: int, weight: Floats,
) -> Floats:
    """Return the penalty (10) on what weights change within exposures.

    It is as if rows had shown that this is 0.
    """
    if 1e3 * float(pairs.ms.max()) <= SHORT_US:
        return np.zeros((2 + 2 * GAP_CLASSES + 6 * len(model.lags_s) + 4,) * 2)

    def there(at: float) -> Floats:
        return np.concatenate([
            counts_at(data, pairs, model, gains, shift_us, lookahead_us, at).T,
            around_rows(data, pairs, model, shift_us, lookahead_us, at, False),
        ], 1)

    total: Floats = 0.0  # type: ignore[assignment]
    middle = there(0.5)
    for at in WITHIN:
        within = there(at) - middle
        total = total + (within * weight[:, None]).T @ within / 2
    return total
