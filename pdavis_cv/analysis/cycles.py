"""The phase of a load that is nearly periodic: known, or found and followed."""
from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

FloatArray = NDArray[np.float64]

_MOST_HARMONICS = 4
_MOST_DEGREE = 5
_MOST_INFLATED = 30.0
"""Largest factor on the variance of a coefficient by the others.  A choice: beyond it,
frames hardly tell one from another."""
LEAST_SEEN = 0.15
"""Least part of an amplitude that the exposure must leave.  A choice: a relative error
of the exposure is some six times as large in the amplitude."""
_SAME = 1e-3
"""Singular value, relative to the largest, below which columns are the same."""
_FIRST_CYCLES = 10
_FIRST_FRAMES = 40
"""The phase is followed from the middle of the record, from at least so many cycles and
frames on; each time the interval is doubled, the phase at its ends is known to a part
of a cycle."""
_UNSURE = 0.02
"""How far a frequency may be off at first, relative."""
_SEEN = 25.0
"""Chi square of a harmonic that is followed."""
_BETTER = 12.0
"""Reduction of chi square that each further term of the phase must bring."""


@dataclass(frozen=True, eq=False)
class PhaseLaw:
    """Phase of a load over time, a polynomial.

    Parameters
    ----------
    reference_us : int
        Time at which the phase is 0.
    span_us : (int, int)
        Interval in which it holds.
    coefficients : ndarray of float64, shape (O,)
        Cycles: factors of the Legendre polynomials of order 1, 2, ... over the
        interval.
    covariance : ndarray of float64, shape (O, O), optional
        Of the coefficients; default 0.
    """

    reference_us: int
    span_us: tuple[int, int]
    coefficients: FloatArray
    covariance: FloatArray | None = None

    @classmethod
    def steady(cls, hz: float, reference_us: int) -> PhaseLaw:
        """Return the phase of a constant frequency."""
        start = int(reference_us)
        return cls(start, (start, start + 2_000_000), np.array([float(hz)]))

    @property
    def hz(self) -> float:
        """Mean frequency over the interval."""
        return float(self._ends() @ self.coefficients)

    @property
    def hz_se(self) -> float:
        """Standard error of the mean frequency."""
        return self._error(self._ends())

    @property
    def phase_se(self) -> float:
        """Standard error of phase 0, radians: that of the frequency, at the reference.

        It is independent of the error of a phase that is fitted with this law.
        """
        return 2 * np.pi * self._error(self._basis(np.array([self.reference_us]))[0])

    def cycles(self, t_us: ArrayLike) -> FloatArray:
        """Return the phase at times, in cycles since the reference."""
        basis = self._basis(np.r_[self.reference_us, np.ravel(t_us)])
        phase = (basis[1:] - basis[0]) @ self.coefficients
        return np.asarray(phase.reshape(np.shape(t_us)))

    def rate(self, t_us: ArrayLike) -> FloatArray:
        """Return the frequency at times, Hz."""
        series = np.polynomial.Legendre(np.r_[0, self.coefficients]).deriv()
        return np.asarray(series(self._place(t_us)) * 2 / self._seconds)

    @property
    def _seconds(self) -> float:
        return (self.span_us[1] - self.span_us[0]) / 1e6

    def _place(self, t_us: ArrayLike) -> FloatArray:
        first, last = self.span_us
        return np.asarray(2 * (np.asarray(t_us) - first) / (last - first) - 1)

    def _basis(self, t_us: NDArray[np.int64]) -> FloatArray:
        order = len(self.coefficients)
        basis = np.polynomial.legendre.legvander(self._place(t_us), order)
        return np.asarray(basis[:, 1:], np.float64)

    def _ends(self) -> FloatArray:
        basis = self._basis(np.array(self.span_us))
        return np.asarray((basis[1] - basis[0]) / self._seconds, np.float64)

    def _error(self, gradient: FloatArray) -> float:
        if self.covariance is None:
            return 0.0
        variance = float(gradient @ self.covariance @ gradient)
        return float(np.sqrt(max(variance, 0.0)))


def inflation(residual: FloatArray) -> FloatArray:
    """Return the variance inflation by correlated residuals, (1 + r) / (1 - r).

    Residuals of shape (T,) or (T, N) give a factor, or one for each signal.
    """
    energy = np.maximum((residual ** 2).sum(0), 1e-300)
    r = np.clip((residual[1:] * residual[:-1]).sum(0) / energy, 0, 0.99)
    return np.asarray((1 + r) / (1 - r))


def slow_degree(hz: float, t_us: NDArray[np.int64]) -> int:
    """Return the degree of a drift that is slower than the load looks in the frames."""
    rate = 1e6 / float(np.median(np.diff(t_us)))
    apparent = abs(hz - rate * round(hz / rate))
    return int(np.clip(apparent * (t_us[-1] - t_us[0]) / 2e6, 1, _MOST_DEGREE))


def resolved(
    law: PhaseLaw, t_us: NDArray[np.int64], exposure_us: float | FloatArray, degree: int
) -> int:
    """Return how many harmonics frames can tell apart; 0 if not even the fundamental.

    Parameters are those of `design`.
    """
    for count in range(_MOST_HARMONICS, 0, -1):
        columns = design(law, t_us, exposure_us, count, degree)
        size = np.sqrt((columns ** 2).sum(0))
        if (len(columns) < 1.5 * columns.shape[1]
                or size.min() <= LEAST_SEEN * size.max() / np.sqrt(2)):
            continue
        low, turn = np.linalg.eigh((columns / size).T @ (columns / size))
        if (turn ** 2 / np.maximum(low, 1e-12)).sum(1).max() < _MOST_INFLATED:
            return count
    return 0


def suited(
    law: PhaseLaw, t_us: NDArray[np.int64], exposure_us: float | FloatArray
) -> tuple[int, int]:
    """Return how many harmonics frames tell apart, and the degree of the drift beside.

    It is lower than it might be if that shows a second harmonic, which aliases to a
    slow change at frequencies near half the frame rate.
    """
    degrees = range(slow_degree(law.hz, t_us), 0, -1)
    counts = [resolved(law, t_us, exposure_us, degree) for degree in degrees]
    return next((count, degree) for count, degree in zip(counts, degrees, strict=True)
                if count >= min(2, max(counts)))


def design(
    law: PhaseLaw, t_us: NDArray[np.int64], exposure_us: float | FloatArray,
    harmonics: int, degree: int, span_us: tuple[int, int] | None = None,
) -> FloatArray:
    """Return what frames show of mean, harmonics and drift.

    The columns of float64 (T, 1 + 2 harmonics + degree) are a constant; cosine and sine
    of each harmonic of `law`, blurred by the exposures; and Legendre polynomials of
    time between the ends of `span_us`, by default the first and the last of ``t_us``,
    the middles of the exposures, int64 (T,).
    """
    turn = 2 * np.pi * law.cycles(t_us)
    blur = law.rate(t_us) * np.asarray(exposure_us) * 1e-6
    columns = [np.ones(len(t_us))]
    for k in range(1, harmonics + 1):
        seen = np.sinc(k * blur)
        columns += [seen * np.cos(k * turn), seen * np.sin(k * turn)]
    first, last = (int(t_us[0]), int(t_us[-1])) if span_us is None else span_us
    x = 2 * (t_us - first) / max(last - first, 1) - 1
    columns += list(np.polynomial.legendre.legvander(x, degree).T[1:])
    return np.stack(columns, axis=1)


def noise_of(
    law: PhaseLaw, t_us: NDArray[np.int64], exposure_us: float | FloatArray,
    values: FloatArray, degree: int,
) -> FloatArray:
    """Return the covariance of the noise of signals (T, N) as if it were white, (N, N).

    Noise is what neither drift nor any harmonic explains, also of those that the frames
    cannot tell apart: these change always alike, so they are no noise.  It includes
    `inflation`; the other arguments are those of `design`.
    """
    most = int(np.clip((len(t_us) / 2 - 1 - degree) / 2, 1, _MOST_HARMONICS))
    columns = design(law, t_us, exposure_us, most, degree)
    size = np.maximum(np.sqrt((columns ** 2).sum(0)), 1e-9)
    basis, strength, _ = np.linalg.svd(columns / size, full_matrices=False)
    basis = basis[:, strength > _SAME * strength[0]]
    rest = values - basis @ (basis.T @ values)
    inflated = np.sqrt(inflation(rest))
    return np.asarray(rest.T @ rest / max(len(t_us) - basis.shape[1], 1)
                      * np.outer(inflated, inflated))


def follow(
    t_us: NDArray[np.int64], values: FloatArray, hz: float, reference_us: int,
    exposure_us: FloatArray,
) -> PhaseLaw:
    """Find the phase of a load whose frequency is nearly known and may drift slowly.

    Signals are float64 (T, N), of at least 8 exposures with these middles, increasing,
    and lengths, (T,), us.  `hz` is the frequency to 2 %, `reference_us` the time of
    phase 0.  The law has the lowest order, up to 3, that explains the signals.
    """
    per_cycle = 1e6 / hz / float(np.median(np.diff(t_us)))
    middle, size = len(t_us) // 2, max(_FIRST_FRAMES, int(_FIRST_CYCLES * per_cycle))
    law: PhaseLaw | None = None
    while True:
        whole = size >= len(t_us)
        half = (size + 1) // 2
        part = slice(None) if whole else slice(max(0, middle - half), middle + half)
        step = _Step(t_us[part], values[part], exposure_us[part], reference_us)
        law = step.fitted(step.searched(hz) if law is None else step.continued(law),
                          most=3 if whole else 2)
        if whole:
            return law
        size *= 2


class _Step:
    """The fit of a phase to a part of the record.

    The search has the fundamental only, as harmonics of another frequency may alias to
    the load's; the fit those that are seen, as others would fit noise, whose phase then
    seems well known.
    """

    def __init__(
        self, t_us: NDArray[np.int64], values: FloatArray, exposure_us: FloatArray,
        reference_us: int,
    ) -> None:
        self._t, self._values, self._exposure = t_us, values, exposure_us
        self._reference, self._span = reference_us, (int(t_us[0]), int(t_us[-1]))
        self._harmonics = self._degree = 1

    def searched(self, hz: float) -> FloatArray:
        """Return the best of constant frequencies near one."""
        middle = hz * (self._span[1] - self._span[0]) / 2e6     # half of the cycles
        self._suit(np.array([middle]))
        off = min(_UNSURE * middle, 0.5)
        tried = np.linspace(middle - off, middle + off, 41)[:, None]
        return min(tried, key=lambda c: float((self._rest(c) ** 2).sum()))

    def continued(self, law: PhaseLaw) -> FloatArray:
        """Return the coefficients of a law of a shorter part."""
        series = np.polynomial.Legendre.fit(
            np.linspace(-1, 1, 9), law.cycles(np.linspace(*self._span, 9)),
            len(law.coefficients))
        coefficients = np.asarray(series.coef[1:], np.float64)
        self._suit(coefficients)
        return coefficients

    def fitted(self, start: FloatArray, most: int) -> PhaseLaw:
        """Return the law of the lowest order that explains the signals."""
        from scipy.optimize import least_squares
        self._harmonics = self._seen(PhaseLaw(self._reference, self._span, start))
        sd = np.maximum(self._noise(start), 1e-9 * np.abs(self._values).max(0) + 1e-30)

        def rest(coefficients: FloatArray) -> FloatArray:
            return np.asarray((self._rest(coefficients) / sd).ravel())

        best: Any = None
        chance = 1.0
        for order in range(1, most + 1):
            found = least_squares(
                rest,
                np.r_[start[:order], np.zeros(max(0, order - len(start)))],
                method="lm", x_scale=np.full(order, 0.1))
            if best is None or 2 * (best.cost - found.cost) > (
                    _BETTER * chance * (order - len(best.x))):
                best = found
                chance = float(np.mean((self._noise(best.x) / sd) ** 2))
        return PhaseLaw(self._reference, self._span, np.asarray(best.x),
                        np.linalg.pinv(best.jac.T @ best.jac) * chance)

    def _noise(self, coefficients: FloatArray) -> FloatArray:
        """Return the standard deviation of each signal's noise."""
        law = PhaseLaw(self._reference, self._span, coefficients)
        return np.asarray(np.sqrt(np.diag(noise_of(
            law, self._t, self._exposure, self._values, self._degree))))

    def _suit(self, coefficients: FloatArray) -> None:
        law = PhaseLaw(self._reference, self._span, coefficients)
        self._degree = suited(law, self._t, self._exposure)[1]

    def _seen(self, law: PhaseLaw) -> int:
        """Return the number of harmonics up to the last that exceeds the noise."""
        count = resolved(law, self._t, self._exposure, self._degree)
        if count < 2:
            return 1
        columns = design(law, self._t, self._exposure, count, self._degree)
        inverse = np.linalg.pinv(columns.T @ columns, hermitian=True)
        found = inverse @ (columns.T @ self._values)
        noise = (self._values - columns @ found).var(0) + 1e-300
        chi = found ** 2 / (np.diag(inverse)[:, None] * noise)
        pairs = chi[1:2 * count + 1].reshape(count, 2, -1).sum(1).max(1)
        return int(np.flatnonzero(np.r_[np.inf, pairs[1:]] > _SEEN).max() + 1)

    def _rest(self, coefficients: FloatArray) -> FloatArray:
        law = PhaseLaw(self._reference, self._span, coefficients)
        q, _ = np.linalg.qr(design(law, self._t, self._exposure, self._harmonics,
                                 self._degree))
        return np.asarray(self._values - q @ (q.T @ self._values))
