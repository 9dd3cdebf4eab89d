"""Thresholds that pixels learned, put together: their spread and how well known.

A recording tells the ratio of a pixel's thresholds by the drift of its events against
its frames, and their scale by the contrast of its frames.  What frames and events have
wrong in common, always in the same way, no innovation shows; it is counted here.
"""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pdavis_cv.sensor import Sensor

__all__ = ["LEAK_HZ", "Doubts", "Seen", "Unseen", "settled", "shrunk",
           "unseen", "vertex"]

LEAK_HZ = (0.2, 0.08)
"""Leak events of a pixel per second at usual biases, mean and standard deviation.

ON events without a change of the light pass for a lower ON threshold.  What they add
up to is the same in every period, so a recording at one speed hardly tells them from
the ratio of the thresholds.  0.1 per second at room temperature (Nozaki and Delbruck,
IEEE Trans. Electron Devices 64, 2017), more in bright light and at low thresholds
(the paper's specifications: 0.7 at the lowest, under 26 DN/ms).
"""

_Symmetric = tuple[
    NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]

# Of the sensor's `offset_dn`, a pixel's own part (what dims dim samples lets them count
# for less) and the common one; in DN, where a dark frame was taken off.
_OFFSET_SHARES, _DARK_DN = (0.7, 0.2), (0.2, 0.1)
# However well frames fit, this part of the variance that they were assumed to have is
# alike from frame to frame, and stays in the scale of the thresholds; the latter, where
# a dark frame was taken off.
_ALIKE, _DARK_ALIKE = 0.45, 0.25
_USUAL_MISMATCH = 0.035
# What scatter of the pixels' estimates is theirs: no more than is left if samples err
# by so much more, in variance, than they were assumed to; no less than this part of
# what is usual.
_CAUTION, _LEAST_SPREAD = 2.0, 0.5
# Where samples err alike, small variances make a spread out of it so much larger.
_MISLED = 4.0
# So many pixels tell what scatter they have.
_TELLING = 12
# A pixel with fewer ON events per second tells nothing of its thresholds' ratio.
_LEAST_PER_S = 3.0


@dataclass(frozen=True, eq=False)
class Seen:
    """What every pixel of the sensor did.

    Events per second, those between frames counting as often as there are; least and
    most DN of its frames.
    """

    per_s: NDArray[np.float64]
    least: NDArray[np.float32]
    most: NDArray[np.float32]


@dataclass(frozen=True)
class Unseen:
    """What frames have wrong in the same way all the time.

    Parameters
    ----------
    offset_dn : (float, float)
        Standard deviation of the offset of frames, a pixel's own and the common one.
    alike : float
        Part of the assumed variance of frames that is alike from frame to frame.
    """

    offset_dn: tuple[float, float]
    alike: float


def unseen(sensor: Sensor | None, dark: bool) -> Unseen:
    """Return what is wrong in frames that double sampling leaves.

    Or in those that a dark frame was taken off, if `dark`.
    """
    if dark:
        return Unseen(_DARK_DN, _DARK_ALIKE)
    left = (sensor or Sensor.PDAVIS).offset_dn
    return Unseen((left * _OFFSET_SHARES[0], left * _OFFSET_SHARES[1]), _ALIKE)


@dataclass(frozen=True, eq=False)
class Doubts:
    """What a recording's own innovations do not show.

    Parameters
    ----------
    on_per_s : ndarray of float64, shape (H, W)
        ON events per second.
    per_dn : ndarray of float64, shape (H, W)
        Relative change of both thresholds if every frame is a DN brighter.
    frames : Unseen
    model : float
        Relative error of the scale by what the models of photoreceptor and
        interpolation lack.
    leak_hz : (float, float)
        Leak events of a pixel per second, mean and standard deviation.
    """

    on_per_s: NDArray[np.float64]
    per_dn: NDArray[np.float64]
    frames: Unseen
    model: float
    leak_hz: tuple[float, float]

    @property
    def common(self) -> float:
        """Relative error of the scale that all pixels share."""
        return float(np.hypot(
            self.model, self.frames.offset_dn[1] * np.sqrt(np.mean(self.per_dn**2))))

    @property
    def per_leak(self) -> NDArray[np.float64]:
        """What a leak event per second adds to ln(off / on), shape (H, W)."""
        return 1 / np.maximum(self.on_per_s, _LEAST_PER_S)


def vertex(x: NDArray[np.float64], y: Sequence[float]) -> float:
    """Return where the parabola through the least y and its neighbours is least."""
    at = int(np.clip(np.argmin(y), 1, len(y) - 2))
    near = slice(at - 1, at + 2)
    bend, slope, _ = np.polyfit(x[near] - x[at], y[near], 2)
    by = -slope / (2 * bend) if bend > 0 else 0.0
    return float(x[at] + np.clip(by, x[at - 1] - x[at], x[at + 1] - x[at]))


def shrunk(
    theta: NDArray[np.float64], covariance: NDArray[np.float64],
    nominal: tuple[ArrayLike, ArrayLike], sigma: float, scales: tuple[float, float],
    doubts: Doubts | None,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Replace the prior spread `sigma` by the spread that the pixels have.

    Empirical Bayes by expectation-maximisation: what each pixel's own samples say
    is the filter's result less its prior.  Behind a plate that turns slowly, or in dim
    light, frames err alike from one half of a recording to the other.  Such errors pass
    for a spread of the thresholds, which is therefore never taken to be more than is
    left if samples err by twice the assumed variance; and scales that make it far
    larger than that do not count.

    Parameters
    ----------
    theta, covariance : ndarray of float64, shapes (2, H, W) and (H, W, 2, 2)
        What a filter says whose prior is `nominal` with the standard deviation `sigma`.
    nominal : (on, off)
        Scalars or (H, W).
    sigma : float
    scales : (float, float)
        What the variance of the ratio of both thresholds, and that of their scale, is
        multiplied by: how far it was overrated (see `settled`), and the mean of e^2 / v
        over the innovations.  Drift of the events shows in them; what de-blurring
        leaves does not wholly, since it is alike from frame to frame: to the scale of
        the thresholds a part of it always counts.
    doubts : Doubts or None
        What is added to the covariance.  The mean leak is taken out of the ratio.

    Returns
    -------
    theta, covariance : ndarray of float64, the same shapes
    """
    on, off = (np.asarray(value, np.float64) for value in nominal)
    total = _inverse(covariance[..., 0, 0], covariance[..., 0, 1],
                     covariance[..., 1, 1])
    # What the samples say: precision, and precision times shift from the center.
    own = (total[0] - 1 / sigma**2, total[1], total[2] - 1 / sigma**2)
    pull = _times(total, (theta[0] - on, theta[1] - off))
    alike = _ALIKE
    if doubts is not None:
        alike = doubts.frames.alike
        leaked = doubts.leak_hz[0] / 2 * doubts.per_leak
        more = _times(own, (theta[0] * leaked, -theta[1] * leaked))
        pull = pull[0] + more[0], pull[1] + more[1]
    means = np.array([on.mean(), off.mean()])
    careful = (max(scales[0], _CAUTION), max(scales[1], _CAUTION))
    # A sample of the pixels tells the spread.
    some = slice(None, None, max(theta[0].size // 4000, 1))
    a, b, c, first, second = (part.ravel()[some] for part in (*own, *pull))
    at = theta.reshape(2, -1)[:, some]
    trusted, spread = (
        _spread(*_rated((a, b, c), (first, second), at, each, alike), means, sigma)
        for each in (scales, careful))
    if np.sum(trusted / means**2) > _MISLED * np.sum(spread / means**2):
        scales = (1.0, 1.0)
    own, pull = _rated(own, pull, theta, scales, alike)
    whole = _inverse(own[0] + 1 / spread[0], own[1], own[2] + 1 / spread[1])
    shift = _times(whole, pull)
    out = np.stack([np.clip(center + by, 0.3 * center, 3 * center)
                    for center, by in zip((on, off), shift, strict=True)])
    ratio, size, mixed = _relative(whole, out)
    mixed /= np.sqrt(ratio)
    if doubts is not None:
        # As far as the recording, not the prior, says what the ratio is.
        at_first = float(np.sum(spread / means**2))
        told = np.clip(1 - ratio / at_first, 0, 1)
        leak = doubts.leak_hz[1] * told * doubts.per_leak
        ratio = ratio + np.minimum(leak**2, at_first)
        size += (doubts.frames.offset_dn[0] * doubts.per_dn) ** 2 + doubts.common**2
    mixed *= np.sqrt(ratio)
    ratio /= 4
    together = np.empty((*theta.shape[1:], 2, 2))
    together[..., 0, 0] = out[0]**2 * (size + ratio + mixed)
    together[..., 1, 1] = out[1]**2 * (size + ratio - mixed)
    together[..., 0, 1] = together[..., 1, 0] = out[0] * out[1] * (size - ratio)
    return out, together


def settled(
    early: tuple[NDArray[np.float64], NDArray[np.float64]],
    late: tuple[NDArray[np.float64], NDArray[np.float64]],
) -> float | None:
    """Return how far the variance of ln(on / off) was overrated, by how it settles.

    What half of a recording said differs from what all of it says, over the pixels, by
    as much as the variances differ, if they are right.  Innovations tell less: they
    hold what does not add up from frame to frame.

    Parameters
    ----------
    early, late : (theta, covariance)
        After half of the recording and after all of it, shapes (2, H, W) and
        (H, W, 2, 2), of one filter.

    Returns
    -------
    float or None
        The factor that makes them right; None where too few pixels tell.
    """
    # A sample of the pixels tells.
    some = slice(None, None, max(late[0][0].size // 20_000, 1))
    (then, before), (now, after) = (
        (np.log(on / off), _relative(
            (matrix[:, 0, 0], matrix[:, 0, 1], matrix[:, 1, 1]), (on, off))[0])
        for (on, off), matrix in (
            (theta.reshape(2, -1)[:, some], covariance.reshape(-1, 2, 2)[some])
            for theta, covariance in (early, late)))
    told = (after < 0.7 * before) & (after > 0)
    if np.count_nonzero(told) < _TELLING:
        return None
    z = (then[told] - now[told]) / np.sqrt(before[told] - after[told])
    # What all pixels have in common is leak, which is counted by itself.
    z = np.abs(z - np.median(z))
    return float(np.mean(np.minimum(z, 3 * np.median(z) / 0.6745) ** 2))


def _spread(
    own: _Symmetric, pull: tuple[NDArray[np.float64], NDArray[np.float64]],
    means: NDArray[np.float64], sigma: float,
) -> NDArray[np.float64]:
    """Return the variance of either threshold over the chip, by what samples say."""
    # It grows from what is usual.
    spread = usual = (_USUAL_MISMATCH * means) ** 2
    least = np.maximum((0.01 * sigma) ** 2, _LEAST_SPREAD * usual)
    for _ in range(30):
        after = _inverse(own[0] + 1 / spread[0], own[1], own[2] + 1 / spread[1])
        first, second = _times(after, pull)
        spread = np.clip([np.mean(first**2 + after[0]),
                          np.mean(second**2 + after[2])], least, sigma**2)
    return spread


def _rated(
    own: _Symmetric, pull: tuple[NDArray[np.float64], NDArray[np.float64]],
    theta: NDArray[np.float64], scales: tuple[float, float], alike: float,
) -> tuple[_Symmetric, tuple[NDArray[np.float64], NDArray[np.float64]]]:
    """Return what samples say with the weight that their scatter gives them.

    In relative terms the variances of on - off and of on + off are multiplied, that of
    the latter by no less than `alike`; where samples say nothing that stays so.
    """
    for_ratio, for_size = scales[0]**-0.5, max(scales[1], alike)**-0.5
    same, other = (for_size + for_ratio) / 2, (for_size - for_ratio) / 2
    on, off = theta
    least = 1e-9 * (own[0] + own[2]) + 1e-30
    shift = _times(_inverse(own[0] + least, own[1], own[2] + least), pull)
    a, b, d = own[0] * on**2, own[1] * on * off, own[2] * off**2
    # (same, other; other, same) on both sides of the precision.
    rated = ((same * same * a + 2 * same * other * b + other * other * d) / on**2,
             ((same * same + other * other) * b + same * other * (a + d)) / (on * off),
             (other * other * a + 2 * same * other * b + same * same * d) / off**2)
    return rated, _times(rated, (shift[0], shift[1]))


def _relative(
    covariance: _Symmetric, theta: Sequence[NDArray[np.float64]] | NDArray[np.float64]
) -> _Symmetric:
    """Return the variances of ln(on / off) and of ln(on off) / 2, their covariance."""
    first, last = covariance[0] / theta[0]**2, covariance[2] / theta[1]**2
    cross = 2 * covariance[1] / (theta[0] * theta[1])
    both = first + last
    return both - cross, (both + cross) / 4, (first - last) / 2


def _times(
    matrix: _Symmetric, vector: tuple[NDArray[np.float64], NDArray[np.float64]]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    a, b, d = matrix
    return a * vector[0] + b * vector[1], b * vector[0] + d * vector[1]


def _inverse(
    a: NDArray[np.float64], b: NDArray[np.float64], d: NDArray[np.float64]
) -> _Symmetric:
    """Invert symmetric 2 x 2 matrices; much faster than a general solver."""
    scale = 1 / (a * d - b * b)
    return d * scale, -b * scale, a * scale
