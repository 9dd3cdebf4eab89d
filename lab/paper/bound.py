"""The least errors that a camera's noise and unknown optics leave; theory/limits.md."""
from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pdavis_cv.simulation import ApsPixel, Camera, Optics, Scene

FloatArray = NDArray[np.float64]

# Of errors e ~ N(0, sigma^2): mean |e| = sigma sqrt(2 / pi).
_MEAN_OF_SIGMA = math.sqrt(2 / math.pi)
_NODES = 720  # of a turn: AoP of the fastest scene makes 4 cycles in them
_RANK = 1e-6  # singular values below this part of the largest one are rounding
_DRAWS = 1000  # of super-pixels: their spread to 2 %
_EXPOSURE_NODES = 33  # Simpson's rule: exact to 1e-6 for two cycles per exposure
_LAGS = 64  # between a frame's middle and when it is looked at


@dataclass(frozen=True)
class Bound:
    """Least mean absolute errors, and what a region of finite size may deviate by.

    Parameters
    ----------
    aop_deg, dolp : float
        Means over a turn; of AoP where the light's DoLP exceeds ``least_dolp``.
    aop_spread_deg, dolp_spread : float
        Standard deviation, over super-pixels, of a super-pixel's mean over a turn.
    """

    aop_deg: float
    dolp: float
    aop_spread_deg: float
    dolp_spread: float

    def aop_error_deg(self, pixels: int) -> float:
        """Return the standard error of the mean of so many super-pixels, degrees."""
        return self.aop_spread_deg / math.sqrt(pixels)

    def dolp_error(self, pixels: int) -> float:
        """Return the same of DoLP."""
        return self.dolp_spread / math.sqrt(pixels)

    def of_region(self, pixels: int) -> Bound:
        """Return the bound of the mean of so many super-pixels in uniform light.

        Their pixels differ independently of each other, and each tells as much of the
        light that all of them see: errors fall with the root of their number.
        """
        root = math.sqrt(pixels)
        return Bound(self.aop_deg / root, self.dolp / root, self.aop_spread_deg / root,
                     self.dolp_spread / root)


@dataclass(frozen=True)
class Limits:
    """What physics says of a camera before a scene that turns.

    Parameters
    ----------
    camera : str
        Preset.
    rpm : float
    optics, frame : Bound
        Of `optics_bound` and `frame_bound`.
    held : (float, float)
        Of `held_errors`.
    mean_dolp : float
        Of the light.
    pixels : int
        Super-pixels of the region.
    """

    camera: str
    rpm: float
    optics: Bound
    frame: Bound
    held: tuple[float, float]
    mean_dolp: float
    pixels: int


def limits(name: str, camera: Camera, rpm: float, scene: Scene, turn_us: float
           ) -> Limits:
    """Return the limits of a camera before a scene that repeats after ``turn_us``."""
    s0, s1, s2 = _turn(scene, turn_us)
    return Limits(name, rpm, optics_bound(camera.optics, scene, turn_us),
                  frame_bound(camera, scene, turn_us),
                  held_errors(camera, scene, turn_us),
                  float((np.hypot(s1, s2) / s0).mean()),
                  camera.size[0] * camera.size[1] // 4)


def optics_bound(
    optics: Optics, scene: Scene, turn_us: float, least_dolp: float = 0.2
) -> Bound:
    """Bound for a camera that is not calibrated, whatever its frames and events tell.

    Gain, angle and contrast of a pixel are known by their distribution only.  The
    intensities of its four pixels are taken to be known exactly at any time, which is
    more than frames and events tell; nothing is assumed of how the light changes.

    Parameters
    ----------
    optics : Optics
        Mean values and spreads.
    scene : Scene
        Light that repeats after ``turn_us``.
    turn_us : float
        Time of a turn.
    least_dolp : float
        AoP counts where the true DoLP exceeds this.

    Returns
    -------
    Bound
    """
    stokes = _turn(scene, turn_us)
    nominal, tangent = _analysers(optics)
    sigma = _posterior(optics, nominal, tangent, stokes)
    # Errors of S by those of A: I = (A + dA) S is solved with A.
    solve = -np.linalg.pinv(nominal)
    d_stokes = np.einsum("sk,kjp,jt->tsp", solve, tangent, stokes)
    aop, dolp = _gradients(stokes)
    counted = np.hypot(stokes[1], stokes[2]) > least_dolp * stokes[0]
    values, vectors = np.linalg.eigh(sigma)
    root = vectors * np.sqrt(np.maximum(values, 0))
    by_aop = np.einsum("ts,tsp->tp", aop, d_stokes)[counted] @ root
    by_dolp = np.einsum("ts,tsp->tp", dolp, d_stokes) @ root
    # A fixed draw stands for the population, so that the same bound comes each time.
    draw = np.random.default_rng(0).standard_normal((root.shape[1], _DRAWS))
    return Bound(
        math.degrees(_MEAN_OF_SIGMA * float(np.linalg.norm(by_aop, axis=1).mean())),
        _MEAN_OF_SIGMA * float(np.linalg.norm(by_dolp, axis=1).mean()),
        math.degrees(float(np.abs(by_aop @ draw).mean(0).std())),
        float(np.abs(by_dolp @ draw).mean(0).std()))


def frame_bound(
    camera: Camera, scene: Scene, turn_us: float, least_dolp: float = 0.2
) -> Bound:
    """Cramer-Rao bound of the mean light of one exposure, all of the camera known.

    Its three Stokes parameters are estimated from four samples with the noise of
    photons, of the reads and of rounding.

    Parameters
    ----------
    camera : Camera
        Its frames and nominal optics.
    scene, turn_us, least_dolp
        As for `optics_bound`.

    Returns
    -------
    Bound
        Its spreads are 0: noise differs from frame to frame, not from pixel to pixel.
    """
    aps = camera.aps
    if aps is None:
        raise ValueError("camera must have frames, got one of events only")
    sharp = _turn(scene, turn_us)
    blurred = _turn(scene, turn_us, aps.exposure_us)
    nominal, _ = _analysers(camera.optics)
    exposure_ms = aps.exposure_us / 1000
    signal = nominal @ blurred * exposure_ms
    weight = exposure_ms**2 / noise_variance(aps, signal)
    information = np.einsum("ks,kt,kr->tsr", nominal, weight, nominal)
    covariance = np.linalg.inv(information)
    variances = [np.einsum("ts,tsr,tr->t", row, covariance, row)
                 for row in _gradients(blurred)]
    counted = np.hypot(sharp[1], sharp[2]) > least_dolp * sharp[0]
    return Bound(
        math.degrees(_MEAN_OF_SIGMA * float(np.sqrt(variances[0][counted]).mean())),
        _MEAN_OF_SIGMA * float(np.sqrt(variances[1]).mean()), 0.0, 0.0)


def held_errors(
    camera: Camera, scene: Scene, turn_us: float, least_dolp: float = 0.2
) -> tuple[float, float]:
    """Return what delay and blur alone make held frames err by.

    An ideal camera's frame is the mean light of its exposure, and is shown from the end
    of its readout to the end of the next one's; no speed is locked to its clock.

    Parameters
    ----------
    camera : Camera
        Its frames.
    scene, turn_us, least_dolp
        As for `optics_bound`.

    Returns
    -------
    aop_deg, dolp : float
        Mean absolute errors.
    """
    aps = camera.aps
    if aps is None:
        raise ValueError("camera must have frames, got one of events only")
    first = aps.exposure_us / 2 + aps.readout_us
    lags = first + (np.arange(_LAGS) + 0.5) / _LAGS * 1e6 / aps.fps
    middle = np.arange(_NODES) * turn_us / _NODES
    s0, s1, s2 = (plane[:, None] for plane in _turn(scene, turn_us, aps.exposure_us))
    now = np.array(scene.stokes(middle[:, None] + lags, 0, 0))
    dolp = np.hypot(now[1], now[2]) / now[0]
    off = np.arctan2(s2 * now[1] - s1 * now[2], s1 * now[1] + s2 * now[2]) / 2
    return (math.degrees(float(np.abs(off[dolp > least_dolp]).mean())),
            float(np.abs(np.hypot(s1, s2) / s0 - dolp).mean()))


def noise_variance(aps: ApsPixel, signal_dn: FloatArray) -> FloatArray:
    """Return the variance of a sample in DN^2: reads, photons, rounding of each read.

    Source: docs/theory/pixels.md.
    """
    reads = 1 if aps.reset_dn is None else 2
    electrons = aps.electrons_per_dn
    shot = 0.0 if electrons is None else (
        signal_dn + aps.dark_dn_s * aps.exposure_us / 1e6) / electrons
    rounding = 0.0 if aps.adc_bits is None else reads / 12
    return np.asarray(reads * aps.read_noise_dn**2 + shot + rounding, np.float64)


def _turn(scene: Scene, turn_us: float, exposure_us: float = 0.0) -> FloatArray:
    """Return S0, S1, S2 over a turn, means over an exposure, shape (3, T)."""
    middle = np.arange(_NODES) * turn_us / _NODES
    if not exposure_us:
        return np.array(scene.stokes(middle, 0, 0))
    within = np.linspace(-0.5, 0.5, _EXPOSURE_NODES) * exposure_us
    weights = np.where(np.arange(_EXPOSURE_NODES) % 2, 4.0, 2.0)
    weights[[0, -1]] = 1
    light = np.array(scene.stokes(middle[:, None] + within, 0, 0))
    return np.asarray(light @ (weights / weights.sum()), np.float64)


def _analysers(optics: Optics) -> tuple[FloatArray, FloatArray]:
    """Return the four nominal rows, and their derivatives by what pixels differ in.

    Returns
    -------
    rows : ndarray, shape (4, 3)
    tangent : ndarray, shape (4, 3, 12)
        By relative gain, angle (radians) and contrast of each of the four.
    """
    a = 2 * np.deg2rad(np.array(optics.layout.angles_deg, np.float64).reshape(-1))
    one, zero = np.ones(4), np.zeros(4)
    kappa = (optics.extinction_ratio - 1) / (optics.extinction_ratio + 1)
    along = np.stack((zero, np.cos(a), np.sin(a)), -1)
    across = np.stack((zero, -np.sin(a), np.cos(a)), -1)
    rows = 0.5 * (np.stack((one, zero, zero), -1) + kappa * along)
    tangent = np.zeros((4, 3, 12))
    for k in range(4):
        tangent[k, :, k] = rows[k]
        tangent[k, :, 4 + k] = kappa * across[k]
        tangent[k, :, 8 + k] = 0.5 * along[k]
    return rows, tangent


def _posterior(
    optics: Optics, nominal: FloatArray, tangent: FloatArray, stokes: FloatArray
) -> FloatArray:
    """Return the covariance of gains, angles and contrasts once a turn has been seen.

    Four intensities of light with three parameters obey one equation, n I = 0, at all
    times; what pixels differ in shows where it does not.
    """
    to_kappa = 2 / (optics.extinction_ratio + 1)**2
    prior = np.repeat((optics.gain_sigma, optics.angle_sigma,
                       to_kappa * optics.extinction_ratio_sigma), 4)**2
    null = np.linalg.svd(nominal.T)[2][3]
    axes, sizes, _ = np.linalg.svd(stokes, full_matrices=False)
    seen = axes[:, sizes > _RANK * sizes[0]]
    tells = np.einsum("k,kjp,jm->mp", null, tangent, seen)
    gain = prior[:, None] * tells.T @ np.linalg.pinv((tells * prior) @ tells.T)
    return np.asarray(np.diag(prior) - gain @ (tells * prior), np.float64)


def _gradients(stokes: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the derivatives of AoP (radians) and DoLP by S0, S1, S2, shape (T, 3)."""
    s0, s1, s2 = stokes
    square = np.maximum(s1**2 + s2**2, np.finfo(np.float64).tiny)
    length = np.sqrt(square)
    aop = np.stack((np.zeros_like(s0), -s2 / (2 * square), s1 / (2 * square)), -1)
    dolp = np.stack((-length / s0**2, s1 / (length * s0), s2 / (length * s0)), -1)
    return aop, dolp
