"""Light with a period: mean, amplitude and phase from frames that blur it.

A frame shows the mean over its exposure T, which multiplies harmonic k of frequency f
by sinc(k f T).  Least squares over all frames of mean, slow drift and blurred harmonics
gives those of the light, at any frequency whose phases the frames do not repeat:
docs/theory/harmonics.md.
"""
from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pdavis_cv._checks import planes, whole_number
from pdavis_cv.analyser import Analyser
from pdavis_cv.analysis.cycles import PhaseLaw, design, noise_of
from pdavis_cv.mosaic import demosaic
from pdavis_cv.sensor import Layout

FloatArray = NDArray[np.float64]
Function = Callable[[FloatArray], FloatArray]

_PHASES = 32
"""Of a cycle at which a quantity is evaluated: four harmonics of it are exact to its
28th."""
_STEP = 1e-5    # of S0, for derivatives
_SAMPLED = 12   # phases of a cycle that are demosaiced again, for four harmonics
_LEAST_S0 = 1e-30


@dataclass(frozen=True, eq=False)
class Wave:
    """A periodic quantity, ``mean + sum_k amplitude[k] cos(k theta + phase[k])``.

    theta is 2 pi times `PhaseLaw.cycles`.  Errors are standard errors.

    Parameters
    ----------
    mean, mean_se : ndarray of float64, shape (...)
        NaN where it is not known, as all others.
    amplitude, phase : ndarray of float64, shape (K, ...)
        Phases in radians, -pi..pi.
    amplitude_se, phase_se : ndarray of float64, shape (...)
        Those of the fundamental.
    """

    mean: FloatArray
    mean_se: FloatArray
    amplitude: FloatArray
    amplitude_se: FloatArray
    phase: FloatArray
    phase_se: FloatArray


def of_dolp(stokes: FloatArray) -> FloatArray:
    """Return the degree of linear polarization of S0, S1, S2, shape (3, ...)."""
    s0, s1, s2 = planes("stokes", stokes, 3)
    return np.asarray(np.hypot(s1, s2) / np.maximum(s0, _LEAST_S0))


def of_aop(stokes: FloatArray) -> FloatArray:
    """Return the angle of polarization in radians, continuous along the first axis.

    Parameters
    ----------
    stokes : ndarray of float64, shape (3, M, ...)
    """
    _, s1, s2 = planes("stokes", stokes, 3)
    polarized = np.atleast_1d(s1 + 1j * s2)
    middle = polarized.mean(0)
    return np.asarray((np.angle(polarized * middle.conj()) + np.mod(
        np.angle(middle), 2 * np.pi)) / 2)


@dataclass(frozen=True, eq=False)
class Harmonics:
    """Mean and harmonics of several signals, e.g. S0, S1, S2, of pixels or regions.

    Parameters
    ----------
    law : PhaseLaw
        Phase of the load.
    coefficients : ndarray of float64, shape (N, 1 + 2 K, ...)
        Of each signal mean, cosine and sine of the fundamental, of the second harmonic
        and so on, of the light itself; NaN where they are not known.
    shape_covariance : ndarray of float64, shape (1 + 2 K, 1 + 2 K, ...)
        Covariance of a signal's coefficients for noise of variance 1.
    noise : ndarray of float64, shape (N, N, ...)
        Covariance of the signals' noise; times ``shape_covariance`` it is that of
        the coefficients.
    slope : ndarray of float64, shape (N, ...)
        Drift of the mean from the first to the last image.
    slope_se : ndarray of float64, shape (N, ...)
        Its standard error.
    count : ndarray of int64, shape (...)
        Images in which a pixel was usable.
    """

    law: PhaseLaw
    coefficients: FloatArray
    shape_covariance: FloatArray
    noise: FloatArray
    slope: FloatArray
    slope_se: FloatArray
    count: NDArray[np.int64]

    def cycle(self, phases: int = _PHASES) -> FloatArray:
        """Return the signals over a cycle, shape (N, phases, ...)."""
        return np.asarray(
            np.einsum("mj,nj...->nm...", self._basis(phases), self.coefficients))

    def wave(
        self, function: Function | None = None, errors: FloatArray | None = None
    ) -> Wave:
        """Return mean, amplitudes and phases of a function of the signals.

        Parameters
        ----------
        function : callable, optional
            Takes signals of shape (N, M, ...), one per phase, and returns (M, ...):
            `of_dolp`, `of_aop` or another.  Default: the first signal.
        errors : ndarray of float64, shape (E, N, 1 + 2 K), optional
            Independent errors of the coefficients, one standard deviation each: see
            `specimen_errors` and `mosaic_errors`.

        Returns
        -------
        Wave
        """
        of = (lambda signals: signals[0]) if function is None else function
        count = (self.coefficients.shape[1] - 1) // 2
        signals, basis = self.cycle(), self._basis(_PHASES)
        turns = 2 * np.pi * np.outer(np.arange(count + 1), np.arange(_PHASES)) / _PHASES
        # (K + 1, M): sums over phases that give the mean and the harmonics.
        project = np.exp(-1j * turns) * np.r_[1, np.full(count, 2)][:, None] / _PHASES
        value = of(signals)
        size = np.abs(signals[0]).mean(0) * _STEP + _LEAST_S0
        gradient = np.empty_like(signals)
        for n in range(len(signals)):
            moved = signals.copy()
            moved[n] += size
            gradient[n] = (of(moved) - value) / size
        found = np.einsum("km,m...->k...", project, value)
        # Derivatives of mean and fundamental by the coefficients: (2, N, J, ...).
        by = np.einsum("km,nm...,mj->knj...", project[:2], gradient, basis)
        turn = np.exp(-1j * np.angle(found[1]))
        along = np.stack((by[0].real, (by[1] * turn).real, (by[1] * turn).imag))
        variance = np.einsum("enj...,nl...,jk...,elk...->e...", along, self.noise,
                             self.shape_covariance, along, optimize=True)
        if errors is not None:
            variance = variance + (np.einsum("knj,enj->ek", along, errors) ** 2).sum(0)
        se = np.sqrt(np.maximum(variance, 0))
        amplitude = np.abs(found[1:])
        phase_se = np.full(amplitude[0].shape, np.inf)
        np.divide(se[2], amplitude[0], out=phase_se, where=amplitude[0] > 0)
        return Wave(found[0].real, se[0], amplitude, se[1], np.angle(found[1:]),
                    np.where(np.isnan(amplitude[0]), np.nan, phase_se))

    def delayed(self, seconds: ArrayLike) -> Harmonics:
        """Return the harmonics of pixels whose exposures are later than was stated.

        Parameters
        ----------
        seconds : array_like, broadcast to (...)
            E.g. of the columns of a rolling shutter.
        """
        turn = 2 * np.pi * self.law.hz * np.asarray(seconds, np.float64)
        out = self.coefficients.copy()
        for k in range(1, (out.shape[1] + 1) // 2):
            a, b = self.coefficients[:, 2 * k - 1], self.coefficients[:, 2 * k]
            cos, sin = np.cos(k * turn), np.sin(k * turn)
            out[:, 2 * k - 1], out[:, 2 * k] = a * cos - b * sin, a * sin + b * cos
        return replace(self, coefficients=out)

    def smoothed(self, size: int) -> Harmonics:
        """Average images (H, W) over squares of pixels.

        A pixel of a demosaiced image is not an independent measurement: it shares the
        samples of each channel with its neighbours, and the errors of the polarizers
        differ from sample to sample.

        Parameters
        ----------
        size : int
            Side of the square, odd; 1 changes nothing.  At the border, and next to
            pixels without a result, those that have one are averaged.

        Returns
        -------
        Harmonics
            With noise as of size^2 / 4 independent samples.

        Raises
        ------
        ValueError
            If `size` is not odd and positive.
        """
        if size < 1 or size % 2 != 1:
            raise ValueError(f"size must be odd and positive, got {size!r}")
        if size == 1:
            return self
        from scipy.ndimage import uniform_filter
        known = np.isfinite(self.coefficients[0, 0])
        weight = np.maximum(
            uniform_filter(known.astype(np.float64), size, mode="constant"),
            0.5 / size ** 2)

        def averaged(planes: FloatArray) -> FloatArray:
            total = uniform_filter(
                np.where(known, planes, 0.0), size, mode="constant",
                axes=(planes.ndim - 2, planes.ndim - 1))
            return np.asarray(np.where(known, total / weight, np.nan))

        samples = np.maximum(weight * size ** 2 / 4, 1)
        return replace(
            self, coefficients=averaged(self.coefficients),
            noise=averaged(self.noise) / samples, slope=averaged(self.slope),
            slope_se=np.sqrt(averaged(self.slope_se ** 2) / samples))

    def _basis(self, phases: int) -> FloatArray:
        turn = 2 * np.pi * np.arange(phases) / phases
        columns = [np.ones(phases)]
        for k in range(1, (self.coefficients.shape[1] + 1) // 2):
            columns += [np.cos(k * turn), np.sin(k * turn)]
        return np.stack(columns, axis=1)


def specimen_errors(
    fit: Harmonics, gain: float, angle_rad: float, contrast: float, offset: float, *,
    samples: float, common_contrast: float = 0.0, common_offset: float = 0.0,
) -> FloatArray:
    """Return what the spread of pixels and polarizers does to S0, S1, S2 of a region.

    Parameters
    ----------
    fit : Harmonics
        Of S0, S1, S2 of the region.
    gain, angle_rad, contrast, offset : float
        Standard deviations from pixel to pixel: relative, radians, absolute, and a part
        of the mean S0.
    samples : float
        Pixels of the region behind each of the four orientations.
    common_contrast, common_offset : float
        Standard deviations of what all pixels share.

    Returns
    -------
    ndarray of float64, shape (18, 3, 1 + 2 K)
        Errors of the coefficients, for `Harmonics.wave`: each of four orientations has
        four, and all have the two common ones.
    """
    found = [np.diag((0.0, common_contrast, common_contrast)),
             np.diag((2 * common_offset, 0.0, 0.0))]
    for angle in np.deg2rad((0, 45, 90, 135)):
        cos, sin = np.cos(2 * angle), np.sin(2 * angle)
        back = np.array((0.5, cos, sin))    # S0, S1, S2 of one more in this channel
        for sigma, seen in ((gain, (0.5, cos / 2, sin / 2)),
                            (angle_rad, (0.0, -sin, cos)),
                            (contrast, (0.0, cos / 2, sin / 2)),
                            (offset, (1.0, 0.0, 0.0))):
            found.append(sigma / np.sqrt(samples) * np.outer(back, seen))
    return np.asarray(np.stack(found) @ fit.coefficients)


def mosaic_errors(
    maps: Harmonics, masks: Sequence[NDArray[np.bool_]], layout: Layout, method: str
) -> list[FloatArray]:
    """Return what demosaicing does to S0, S1, S2 of regions with structure.

    Each orientation is sampled at a quarter of the pixels, so that edges count more in
    one than in another.  The light that was found is sampled and demosaiced again, at
    the places of the mosaic and a column beside, where the error is the same.

    Parameters
    ----------
    maps : Harmonics
        S0, S1, S2 of each pixel, shape (H, W), not smoothed.
    masks : sequence of ndarray of bool, shape (H, W)
        Regions.
    layout : Layout
        Polarizer in front of each pixel.
    method : str
        How the images were demosaiced, ``"bilinear"`` or ``"guided"``.

    Returns
    -------
    list of ndarray of float64, shape (2, 3, 1 + 2 K)
        For each region errors of the coefficients, for `Harmonics.wave`; together one
        standard deviation.
    """
    light, basis = maps.cycle(_SAMPLED), maps._basis(_SAMPLED)
    known = np.asarray(np.isfinite(light).all((0, 1)), np.bool_)
    inside = [mask & known for mask in masks]
    back = basis / (basis ** 2).sum(0)
    found = np.zeros((len(masks), 2, 3, basis.shape[1]))
    for m, stokes in enumerate(np.where(known, light, 0.0).swapaxes(0, 1)):
        quad = np.tensordot(Analyser.ideal().response, stokes, 1)
        for beside in (0, 1):
            moved = layout.crop(beside, 0)
            mosaic = np.empty(known.shape, np.float32)
            for channel, place in zip(quad, moved.places, strict=True):
                part = slice(place // 2, None, 2), slice(place % 2, None, 2)
                mosaic[part] = channel[part]
            i0, i45, i90, i135 = again = demosaic(mosaic, moved, method, valid=known)
            off = np.stack((again.sum(0) / 2, i0 - i90, i45 - i135)) - stokes
            for total, mask in zip(found, inside, strict=True):
                mean = off[:, mask].sum(1) / max(np.count_nonzero(mask), 1)
                total[beside] += np.outer(mean, back[m]) / math.sqrt(2)
    return list(found)


def fit_harmonics(
    law: PhaseLaw, t_us: NDArray[np.int64], values: FloatArray, *, harmonics: int,
    degree: int, exposure_us: float | FloatArray = 0.0,
) -> Harmonics:
    """Fit mean, drift and harmonics to traces, e.g. those of a region.

    Parameters
    ----------
    law : PhaseLaw
        Phase of the load.
    t_us : ndarray of int64, shape (T,)
        Times, for frames the middles of their exposures.
    values : ndarray of float64, shape (T, N)
        Signals.
    harmonics, degree : int
        As in `HarmonicFit`.
    exposure_us : float or ndarray of float64, shape (T,)
        Length of the exposure.

    Returns
    -------
    Harmonics
        Of shape (); errors allow for noise that is correlated from one sample to the
        next.
    """
    columns = design(law, t_us, exposure_us, harmonics, degree,
                     (int(t_us[0]), int(t_us[-1])))
    inverse = np.asarray(
        np.linalg.pinv(columns.T @ columns, hermitian=True), np.float64)
    found = inverse @ (columns.T @ values)
    noise = noise_of(law, t_us, exposure_us, values, degree)
    keep = 1 + 2 * harmonics
    slope = found[keep] if degree else np.zeros(values.shape[1])
    slope_se = np.sqrt(np.diag(noise) * (inverse[keep, keep] if degree else 0.0))
    return Harmonics(law, found[:keep].T, inverse[:keep, :keep], noise, 2 * slope,
                     2 * slope_se, np.array(len(t_us)))


def loop_area(x: Wave, y: Wave, delay_se: float = 0.0) -> tuple[float, float]:
    """Return the area of the loop of y over x per cycle, and its standard error.

    Parameters
    ----------
    x, y : Wave
        Of shape (), with the same law.
    delay_se : float
        Standard error of the phase of one clock relative to the other, radians.

    Returns
    -------
    area, area_se : float
        Positive for a clockwise loop; for force over displacement it is the work lost.
    """
    count = min(len(x.amplitude), len(y.amplitude))
    size = np.pi * x.amplitude[:count] * y.amplitude[:count]
    ahead = y.phase[:count] - x.phase[:count]
    area = float(np.sum(np.arange(1, count + 1) * size * np.sin(ahead)))
    parts = (size[0] * np.cos(ahead[0]) * np.sqrt(
        x.phase_se ** 2 + y.phase_se ** 2 + delay_se ** 2),
        np.pi * np.sin(ahead[0]) * x.amplitude_se * y.amplitude[0],
        np.pi * np.sin(ahead[0]) * x.amplitude[0] * y.amplitude_se)
    return area, float(np.linalg.norm(parts))


class HarmonicFit:
    """Fit mean, drift and harmonics to every pixel, image by image.

    It keeps sums, not images, so memory is bounded.  Pixels may be invalid in some
    images.

    Parameters
    ----------
    shape : tuple of int
        (height, width) of a signal's image.
    law : PhaseLaw
        Phase of the load.
    harmonics : int
        Fundamental and harmonics, 0 to 20; 0 gives means.
    degree : int
        Of the polynomial in time that is fitted beside them, 0 to 20.
    span_us : (int, int)
        Times of the first and the last image.
    signals : int
        Signals in each image.
    """

    def __init__(
        self, shape: tuple[int, ...], law: PhaseLaw, *, harmonics: int, degree: int,
        span_us: tuple[int, int], signals: int = 3,
    ) -> None:
        self.law, self.shape = law, tuple(shape)
        self.harmonics = whole_number("harmonics", harmonics, 0, 20)
        self.degree = whole_number("degree", degree, 0, 20)
        self._span = span_us
        size = 1 + self.harmonics * 2 + self.degree
        self._pairs = [(a, b) for a in range(size) for b in range(a, size)]
        self._gram, self._count = np.zeros((size, size)), 0
        self._missing: FloatArray | None = None     # sums over invalid pixels
        self._right = np.zeros((signals, size, *self.shape))
        self._square = np.zeros((signals, signals, *self.shape))

    def add(
        self, t_us: int, image: ArrayLike, exposure_us: float = 0.0,
        valid: NDArray[np.bool_] | None = None,
    ) -> None:
        """Add an image.

        Parameters
        ----------
        t_us : int
            Middle of its exposure.
        image : array_like, shape ``(signals, *shape)``
            Values; a pixel with one that is not finite is left out.
        exposure_us : float
            Length of the exposure.
        valid : ndarray of bool, shape `shape`, optional
            True = usable.

        Raises
        ------
        ValueError
            If the image has another shape.
        """
        v = np.asarray(image, np.float64)
        if v.shape != (len(self._right), *self.shape):
            raise ValueError(
                f"image must have shape {(len(self._right), *self.shape)}, got "
                f"{v.shape}")
        row = design(self.law, np.array([t_us]), exposure_us, self.harmonics,
                     self.degree, self._span)[0]
        product = np.outer(row, row)
        usable = np.isfinite(v).all(0)
        if valid is not None:
            usable &= valid
        if not usable.all():
            v = np.where(usable, v, 0.0)
            if self._missing is None:
                self._missing = np.zeros((len(self._pairs), *self.shape))
            for plane, pair in zip(self._missing, self._pairs, strict=True):
                plane[~usable] += product[pair]
        self._gram += product
        self._count += 1
        for right, plane in zip(self._right, v, strict=True):
            for total, weight in zip(right, row, strict=True):
                total += weight * plane
        self._square += v[:, None] * v[None]

    def result(self) -> Harmonics:
        """Return the fit to the images so far."""
        size = len(self._gram)
        right = self._right.reshape(*self._right.shape[:2], -1)
        pixels = right.shape[-1]
        inverse = np.broadcast_to(
            np.linalg.pinv(self._gram, hermitian=True)[..., None], (size, size, pixels))
        count = np.full(pixels, self._count)
        known = np.full(pixels, self._count > size + 1)
        if self._missing is not None:
            missing = self._missing.reshape(len(self._pairs), pixels)
            few = np.flatnonzero(missing[0])
            gram = np.empty((len(few), size, size))
            for (a, b), plane in zip(self._pairs, missing, strict=True):
                gram[:, a, b] = gram[:, b, a] = self._gram[a, b] - plane[few]
            count[few] = np.rint(gram[:, 0, 0])
            known[few] = (count[few] > size + 1) & (
                np.linalg.eigvalsh(gram)[:, 0] > 1e-6 * count[few])
            gram[~known[few]] = np.eye(size)
            inverse = inverse.copy()
            inverse[:, :, few] = np.moveaxis(np.linalg.inv(gram), 0, -1)
        found = np.einsum("jkp,nkp->njp", inverse, right)
        square = self._square.reshape(*self._square.shape[:2], -1)
        noise = (square - np.einsum("njp,mjp->nmp", found, right)) / np.maximum(
            count - size, 1)
        found[:, :, ~known] = np.nan
        noise[:, :, ~known] = np.nan
        keep = 1 + 2 * self.harmonics
        drift = found[:, keep] if self.degree else np.zeros_like(found[:, 0])
        drift_se = np.sqrt(np.maximum(np.einsum("nnp->np", noise), 0) * (
            inverse[keep, keep] if self.degree else 0.0))
        parts = (found[:, :keep], inverse[:keep, :keep], noise, 2 * drift,
                 2 * drift_se, count)
        return Harmonics(self.law, *(
            part.reshape(*part.shape[:-1], *self.shape) for part in parts))
