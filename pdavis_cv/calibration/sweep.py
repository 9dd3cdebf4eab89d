"""Measure the analyser matrix: the response of each pixel to a turned polarizer."""
from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pdavis_cv.calibration.frames import SIGMAS, Mean, frames_of, mean_frame
from pdavis_cv.recording.base import ApsFrame, Recording

_ROUNDS = 30
"""Most iterations of a fit; some five are needed."""
_FULL_TURN = np.deg2rad(300)
"""Range of angles, in steps up to 60 degrees, that tells the wander of the beam."""


@dataclass(frozen=True, eq=False)
class Sweep:
    """Mean frames at each angle of a linear polarizer in uniform light.

    Parameters
    ----------
    angles : ndarray of float64, shape (N,)
        Angle of the transmitted polarization, radians, counter-clockwise as displayed.
    dn : ndarray of float32, shape (N, H, W)
        Mean DN after dark and gain; NaN where nothing was valid.
    variance : ndarray of float32, shape (N, H, W)
        Variance of those means.
    offset_sigma : ndarray of float32, shape (H, W), or float
        Standard deviation of a pixel's offset that all means share, DN.
    """

    angles: NDArray[np.float64]
    dn: NDArray[np.float32]
    variance: NDArray[np.float32]
    offset_sigma: NDArray[np.float32] | float = 0.0


@dataclass(frozen=True, eq=False)
class SweepFit:
    """Responses of the pixels, and the variation of the light.

    Parameters
    ----------
    analyser : ndarray of float32, shape (H, W, 3)
        Responses to S0, S1, S2, scaled so that the median response to S0 is 1/2.
    covariance : ndarray of float32, shape (H, W, 3, 3)
        Covariance of the three responses of a pixel.
    usable : ndarray of bool, shape (H, W)
        False where the fit is impossible or its residual is an outlier.
    scale_dn : float
        Twice the DN per unit of S0 by which ``analyser`` was divided.
    source : (float, float)
        Relative modulation of the light with cos 2a and sin 2a, from polarization of
        the lamp.
    wander : (float, float)
        Relative modulation with cos a and sin a, from a beam that moves with the
        polarizer.  Zero for sweeps of less than 300 degrees, which cannot show it.
    residual : ndarray of float32, shape (H, W)
        Square root of the reduced chi square.
    """

    analyser: NDArray[np.float32]
    covariance: NDArray[np.float32]
    usable: NDArray[np.bool_]
    scale_dn: float
    source: tuple[float, float]
    wander: tuple[float, float]
    residual: NDArray[np.float32]

    @property
    def sigma(self) -> NDArray[np.float32]:
        """Standard errors of the responses, (H, W, 3)."""
        return np.asarray(
            np.sqrt(np.einsum("...ii->...i", self.covariance)), np.float32)

    @property
    def extinction_ratio(self) -> NDArray[np.float64]:
        """Largest over smallest response to linearly polarized light, (H, W)."""
        a = self.analyser.astype(np.float64)
        swing = np.hypot(a[..., 1], a[..., 2])
        return np.asarray((a[..., 0] + swing) / np.maximum(a[..., 0] - swing, 1e-9))

    @property
    def angle(self) -> NDArray[np.float64]:
        """Angle of each polarizer, radians in [0, pi), (H, W)."""
        a = self.analyser.astype(np.float64)
        return np.asarray(np.arctan2(a[..., 2], a[..., 1]) / 2 % np.pi)

    @property
    def angle_sigma(self) -> NDArray[np.float64]:
        """Standard error of ``angle``, radians, (H, W)."""
        a = self.analyser.astype(np.float64)
        double = 2 * np.maximum(a[..., 1]**2 + a[..., 2]**2, 1e-12)
        return self._sigma_along(
            np.stack([0 * double, -a[..., 2] / double, a[..., 1] / double], -1))

    @property
    def extinction_ratio_sigma(self) -> NDArray[np.float64]:
        """Standard error of ``extinction_ratio``, (H, W)."""
        a = self.analyser.astype(np.float64)
        swing = np.maximum(np.hypot(a[..., 1], a[..., 2]), 1e-12)
        least = np.maximum(a[..., 0] - swing, 1e-9)
        along = 2 * a[..., 0] / swing / least**2
        return self._sigma_along(np.stack(
            [-2 * swing / least**2, along * a[..., 1], along * a[..., 2]], -1))

    def _sigma_along(self, slope: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the error of a quantity from its derivatives by the responses."""
        return np.asarray(np.sqrt(np.einsum(
            "...i,...ij,...j->...", slope, self.covariance.astype(np.float64), slope)))


def read_sweep(
    steps: Iterable[tuple[float, Recording | Iterable[ApsFrame]]],
    *,
    dark: NDArray[np.float32] | None = None,
    gain: NDArray[np.float32] | None = None,
    dark_sigma: ArrayLike = 0.0,
) -> Sweep:
    """Average the frames at each angle of a sweep.

    Parameters
    ----------
    steps : iterable of (float, Recording or iterable of ApsFrame)
        Angle in radians, and the recording or frames at that angle.
    dark, gain : ndarray of float32, shape (H, W), optional
        Dark offset and gain of the camera.
    dark_sigma : float or array_like of shape (H, W)
        Standard error of `dark`, DN.  It is common to all angles, and with many frames
        the largest part of the error of an extinction ratio.

    Raises
    ------
    ValueError
        If an angle has no frame, or fewer than five different angles are given.
    """
    angles: list[float] = []
    means: list[NDArray[np.float32]] = []
    variances: list[NDArray[np.float32]] = []
    for angle, frames in steps:
        try:
            mean, _ = mean_frame(frames_of(frames))
        except ValueError as error:
            raise ValueError(f"step at {np.rad2deg(angle):.1f} deg: {error}") from None
        dn = mean.mean if dark is None else mean.mean - dark
        factor = 1.0 if gain is None else gain
        angles.append(float(angle))
        means.append(np.asarray(dn * factor, np.float32))
        variances.append(np.asarray(_error(mean) * factor**2, np.float32))
    distinct = len(np.unique(np.round(np.asarray(angles) % np.pi, 6)))
    if distinct < 5:    # three numbers of each pixel and two of the lamp
        raise ValueError(
            f"a sweep needs at least five different angles, got {distinct}")
    offset = np.asarray(
        np.asarray(dark_sigma) * (1.0 if gain is None else gain), np.float32)
    return Sweep(np.array(angles), np.stack(means), np.stack(variances), offset)


def _error(mean: Mean) -> NDArray[np.float64]:
    """Return the variance of the mean, from shot noise fitted to all pixels.

    Quantisation noise is added.
    """
    good = (mean.samples > 1) & np.isfinite(mean.noise)
    count = np.maximum(mean.samples, 1)
    if not good.any():
        return np.full(mean.mean.shape, 1 / 12)
    # A pixel's own scatter over few frames is too uncertain for a weight.
    level, scatter = mean.mean[good], mean.noise[good] ** 2
    if level.size < 100 or np.ptp(level) < 1:   # else to a tenth
        square = np.full(mean.mean.shape, float(np.mean(scatter)))
    else:
        slope, base = np.polyfit(level, scatter, 1)
        least = max(float(np.median(scatter)) * 1e-2, 1e-6)
        square = np.maximum(base + slope * np.nan_to_num(mean.mean), least)
    return np.asarray(square / count + 1e-3)


def fit_sweep(sweep: Sweep) -> SweepFit:
    """Fit Malus's law to every pixel: I(a) = L(a) (c0 + c1 cos 2a + c2 sin 2a).

    L is the light, common to all pixels: the sum of 1, the polarization of the lamp
    (cos 2a, sin 2a) and, over a full turn, the wander of the beam (cos a, sin a).
    Pixels and light are solved alternately, each by weighted linear least squares.  The
    two are separable because the pixels have four different angles.

    Parameters
    ----------
    sweep : Sweep
        From `read_sweep`.

    Raises
    ------
    ValueError
        If hardly any pixel responds to the light.
    """
    angles = sweep.angles
    dn = sweep.dn.reshape(len(angles), -1)
    weight = np.where(np.isfinite(dn), 1 / sweep.variance.reshape(dn.shape), 0)
    dn = np.nan_to_num(dn)
    basis = np.stack([np.ones_like(angles), np.cos(2 * angles), np.sin(2 * angles)], 1)
    terms = [basis[:, 1], basis[:, 2]]
    if np.ptp(angles) > _FULL_TURN:
        terms += [np.cos(angles), np.sin(angles)]
    modes = np.stack(terms, 1)

    # The light is common to all pixels, so a few thousand determine it well enough.
    every = max(dn.shape[1] // 4001, 1) | 1       # odd, to sample all four channels
    some, some_weight = dn[:, ::every].astype(float), weight[:, ::every].astype(float)
    light = np.zeros(modes.shape[1])
    for _ in range(_ROUNDS):
        response, _ = _solve(basis * (1 + modes @ light)[:, None], some, some_weight)
        plain = basis @ response
        # I - plain = plain * (modes @ light), which is linear in the light.
        design = np.einsum("ap,ak->apk", plain, modes)
        normal = np.einsum("apk,ap,apl->kl", design, some_weight, design)
        right = np.einsum("apk,ap->k", design, some_weight * (some - plain))
        new = np.linalg.solve(normal, right)
        done = np.max(np.abs(new - light)) < 1e-7     # rounding of DN
        light = new
        if done:
            break
    level = 1 + modes @ light
    design = basis * level[:, None]
    response, covariance = _solve(design, dn, weight)
    chi2 = (weight * (dn - design @ response) ** 2).sum(0)
    free = np.maximum((weight > 0).sum(0) - 3, 1)
    residual = np.sqrt(chi2 / free)
    usable = (response[0] > 0) & ((weight > 0).sum(0) >= 5)
    if usable.sum() < 4:    # as many as a macropixel has
        raise ValueError("a sweep needs light: hardly any pixel responds to it")
    typical = float(np.median(residual[usable]))
    usable &= residual < SIGMAS * typical
    scale = 2 * float(np.median(response[0][usable]))
    covariance *= max(typical, 1e-9) ** 2
    # An offset has the effect of a response to unpolarized light.
    covariance[:, 0, 0] += np.ravel(sweep.offset_sigma) ** 2
    covariance /= scale**2
    shape = sweep.dn.shape[1:]

    def plane(values: NDArray[Any]) -> NDArray[np.float32]:
        return np.asarray((values / scale).T.reshape(*shape, 3), np.float32)

    padded = [*light, 0.0, 0.0]
    return SweepFit(
        plane(response), covariance.reshape(*shape, 3, 3).astype(np.float32),
        usable.reshape(shape), scale,
        (float(padded[0]), float(padded[1])), (float(padded[2]), float(padded[3])),
        residual.reshape(shape).astype(np.float32))


def _solve(
    design: NDArray[np.float64], dn: NDArray[Any], weight: NDArray[Any]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Solve weighted least squares for every column.

    Returns the solution, shape (3, P), and its covariance, shape (P, 3, 3).
    """
    products = design[:, :, None] * design[:, None, :]
    normal = np.tensordot(weight, products, ([0], [0])).astype(float)
    normal[:, range(3), range(3)] += 1e-12
    right = np.tensordot(weight * dn, design, ([0], [0])).astype(float)
    inverse = np.linalg.inv(normal)
    solution = np.einsum("pij,pj->ip", inverse, right)
    return solution, inverse


def steps_in_time(
    recording: Recording, angles: ArrayLike, starts_us: Sequence[int], dwell_us: int
) -> Iterator[tuple[float, Iterator[ApsFrame]]]:
    """Divide a recording of a stepped polarizer into the steps for `read_sweep`.

    Yields each angle, radians, with the frames that were exposed while the polarizer
    stood still there, for `dwell_us` from its time in `starts_us` on.  The recording is
    read when `read_sweep` iterates over them.
    """
    for angle, start in zip(np.asarray(angles), starts_us, strict=True):
        yield float(angle), frames_of(recording, start, start + dwell_us)
