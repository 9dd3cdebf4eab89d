"""The numbers of a camera that turn events and frames into log intensity."""
from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from functools import cached_property, partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

GAP_CLASSES, CONTEXTS, RATIOS = 5, 4, 5
"""Classes of the gap before an event; contexts and lengths of a silence after one."""

PAST_S = -0.04, -0.02, -0.01, -0.005, -0.002
AROUND_S = -0.04, -0.01, -0.002, 0.0045, 0.018
"""Times at which events are compared with now, s, where nothing later is known, and
where it is; those of weight 0 cost nothing.  Engineering choice: left-out frames of a
real recording are told best by eleven of -40 to 32 ms, but each one costs time."""

_LAGS = len(PAST_S)

SHORT_US, SAMPLES = 1500, 7
"""Exposure whose middle is looked at, us (lab.studies.constants), or how many times:
the mean of a wave of 33 Hz, 1000 RPM, over 20 ms errs by 1.5 % of its amplitude."""

_LEAST_VARIANCE = 1e-4
"""ln^2: a sample errs by one per cent at least (lab.studies.constants)."""


def lags_of(lookahead_us: int) -> NDArray[np.float64]:
    """Return the times at which events are compared with now, s."""
    return np.array(AROUND_S if lookahead_us else PAST_S)


def _zeros(*shape: int) -> NDArray[np.float64]:
    return np.zeros(shape)


_BY_CLASS = partial(_zeros, 2, GAP_CLASSES)
_LAGS_S = partial(np.array, PAST_S)
_BY_LAG, _NOW = partial(_zeros, _LAGS, 2), partial(_zeros, 2)
_END = partial(_zeros, CONTEXTS, RATIOS)
_BOW = partial(np.full, (CONTEXTS, RATIOS), 0.5)
_OPEN = partial(np.full, (CONTEXTS, RATIOS), 1 / 12)    # anywhere in a threshold


@dataclass(frozen=True, eq=False, kw_only=True)
class PixelModel:
    """A camera as the estimator of log intensity takes it.

    Equations are those of docs/theory/kalman.md.  Polarities are in the order OFF,
    ON; log intensity is natural, light in DN per ms of exposure.

    Parameters
    ----------
    theta : ndarray of float64, shape (2,)
        Change of light by an event, positive; `by_class` may add to it.
    thresholds : ndarray of float64, shape (2,), optional
        Contrast thresholds; default `theta`.
    theta_cov : ndarray of float64, shape (2, 2)
        Their covariance.
    spread : float
        Standard deviation of the pixels' relative deviations from them (gains).
    black : float
        Light that frames lack, DN/ms: events follow, and images show, I + black.
    bandwidth : (float, float)
        Corner frequency of the photoreceptor, Hz, and its increase by light, Hz per
        DN/ms; zeros: no lag.
    rest_s, dead_s : float
        Gap (s) in which light is as likely still as moving (3), and dead time (4).
    turn : float
        q of (2b) after a gap of unknown pace; default: on by half a threshold.
    noise : (float, float, float)
        alpha (per s), beta (per change) and gamma (per threshold) of (8), ln^2.
    missing : float
        Variance of (8) per s in which events are missing, ln^2.
    read_variance, shot : float
        Variance of a frame, DN^2, and its increase per DN.
    by_class : ndarray of float64, shape (2, GAP_CLASSES)
        Further change of light by an event after a gap of a class.
    end, bow, open_variance : ndarray of float64, shape (CONTEXTS, RATIOS)
        E, B and var(phi) of silences whose end is not known (2c).
    lags_s : ndarray of float64, shape (5,)
        Times at which events are compared with now, s.
    own, cell, near : ndarray of float64, shape (5, 2)
        Weights of counts at a lag less those now: of the pixel, of its macropixel's
        mean, and of the mean of the four nearest pixels with the same polarizer.
    cell_now, near_now : ndarray of float64, shape (2,)
        Weights of those means now, less the pixel's own count.
    """

    theta: NDArray[np.float64]
    thresholds: NDArray[np.float64] = field(default_factory=_NOW)
    theta_cov: NDArray[np.float64] = field(default_factory=partial(_zeros, 2, 2))
    spread: float = 0.05
    black: float = 0.0
    bandwidth: tuple[float, float] = (0.0, 0.0)
    rest_s: float = 0.25
    dead_s: float = 0.0
    turn: float = 2 - math.sqrt(3)
    noise: tuple[float, float, float] = (0.02, 0.004, 0.001)
    missing: float = 0.0
    read_variance: float = 25.0
    shot: float = 0.1
    by_class: NDArray[np.float64] = field(default_factory=_BY_CLASS)
    end: NDArray[np.float64] = field(default_factory=_END)
    bow: NDArray[np.float64] = field(default_factory=_BOW)
    open_variance: NDArray[np.float64] = field(default_factory=_OPEN)
    lags_s: NDArray[np.float64] = field(default_factory=_LAGS_S)
    own: NDArray[np.float64] = field(default_factory=_BY_LAG)
    cell: NDArray[np.float64] = field(default_factory=_BY_LAG)
    near: NDArray[np.float64] = field(default_factory=_BY_LAG)
    cell_now: NDArray[np.float64] = field(default_factory=_NOW)
    near_now: NDArray[np.float64] = field(default_factory=_NOW)

    def __post_init__(self) -> None:
        if not np.any(self.thresholds):
            object.__setattr__(self, "thresholds", self.theta)

    def in_frames(
        self, log_intensity: NDArray[np.float32], variance: NDArray[np.float32],
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Return ln of what frames show of light, less the black level; its variance.

        Parameters
        ----------
        log_intensity, variance : ndarray of float32, shape (H, W)
            Natural log of DN/ms, as images show it, and its variance.
        """
        if self.black <= 0:
            return log_intensity, variance
        from scipy.special import log_ndtr  # slow to load

        # Light is normal about what is estimated, and frames show none below 0: the
        # mean and the variance of the normal distribution that is cut off there.
        light = np.exp(log_intensity, dtype=np.float64)
        sigma = light * np.sqrt(np.maximum(variance, 1e-12))
        z = np.maximum((light - self.black) / sigma, -1e2)
        cut = np.exp(-0.5 * z * z - log_ndtr(z)) / math.sqrt(2 * math.pi)
        relative = (1 - cut * (z + cut)) / (z + cut) ** 2
        return (np.log(sigma * (z + cut)).astype(np.float32),
                np.clip(relative, 0, 1).astype(np.float32))

    def frame_variance(
        self, dn: NDArray[np.floating], ms: NDArray[np.floating],
    ) -> NDArray[np.floating]:
        """Return R of (8): variance of ln(I + black) that a frame's sample has.

        Parameters
        ----------
        dn, ms : ndarray of float, of shapes that go together
            Values of the frame, and exposure, ms.
        """
        full = np.maximum(dn + self.black * ms, 1)
        noise = self.read_variance + self.shot * np.maximum(dn, 1)
        variance: NDArray[np.floating] = np.minimum(
            noise / full**2 + _LEAST_VARIANCE, 1)
        return variance

    @cached_property
    def looks_around(self) -> bool:
        """Whether other times or pixels have a weight."""
        return any(np.any(each) for each in (
            self.own, self.cell, self.near, self.cell_now, self.near_now))

    @property
    def numbers(self) -> NDArray[np.float64]:
        """The numbers in the order of `camera_t` in _increments.h."""
        lags = np.where(np.any(self.own, 1) | np.any(self.cell, 1) | np.any(
            self.near, 1), self.lags_s, 0.0)
        return np.concatenate([np.ravel(each) for each in (
            self.rest_s, self.dead_s, self.turn, self.bandwidth, self.black, self.noise,
            self.theta, self.theta_cov[0, 0], self.theta_cov[0, 1],
            self.theta_cov[1, 1], self.spread**2, self.by_class, self.end, self.bow,
            self.open_variance, lags, self.own, self.cell, self.near,
            -self.cell_now - self.near_now, self.cell_now, self.near_now)]).astype(
                np.float64)

    def replace(self, **changes: Any) -> PixelModel:
        """Return a model in which some fields are others."""
        return replace(self, **changes)

    def like(self, other: PixelModel) -> PixelModel:
        """Return the model with the weights and silences of another one.

        Weights are kept relative to the thresholds.
        """
        factor = self.thresholds / other.thresholds
        return replace(
            self, theta=factor * other.theta, end=other.end, bow=other.bow,
            by_class=factor[:, np.newaxis] * other.by_class, own=factor * other.own,
            cell=factor * other.cell, near=factor * other.near,
            cell_now=factor * other.cell_now, near_now=factor * other.near_now)

    def as_lists(self) -> dict[str, Any]:
        """Return all fields as JSON has them."""
        return {one.name: np.asarray(getattr(self, one.name)).tolist()
                for one in fields(self)}

    @classmethod
    def of_lists(cls, values: Mapping[str, Any]) -> PixelModel:
        """Return the model that `as_lists` told.

        Raises
        ------
        KeyError
            If a field is missing, but those that older files have not.
        ValueError
            If a field is not finite or of another shape.
        """
        like = cls(theta=np.ones(2))
        values = {"turn": like.turn, "missing": 0.0, **values}
        found: dict[str, Any] = {}
        for one in fields(cls):
            usual = getattr(like, one.name)
            value = np.array(values[one.name], float)
            if value.shape != np.shape(usual) or not np.isfinite(value).all():
                raise ValueError(f"model: {one.name} must be finite and have shape "
                                 f"{np.shape(usual)}, got {value.shape}")
            found[one.name] = value if isinstance(usual, np.ndarray) else (
                tuple(value.tolist()) if value.ndim else type(usual)(value))
        return cls(**found)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, PixelModel) and all(
            np.array_equal(getattr(self, one.name), getattr(other, one.name))
            for one in fields(self))

    def __hash__(self) -> int:
        return hash(self.numbers.tobytes())
