"""Regions in periodic light: what frames say of a load's frequency and effect."""
from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pdavis_cv._checks import floats, real_number
from pdavis_cv.analysis.cycles import LEAST_SEEN, PhaseLaw, follow, resolved, suited
from pdavis_cv.analysis.harmonics import (
    Function,
    Harmonics,
    Wave,
    fit_harmonics,
    of_dolp,
)

FloatArray = NDArray[np.float64]

_MOST_HZ = 500_000.0
"""Largest frequency: half the rate of a clock of microseconds."""
_LEAST_FRAMES = 12
_LEAST_CYCLES = 2.0
_SIGNIFICANT = 4.0
"""Amplitude over its standard error from which a load is seen.  A choice."""
_STEADY = 0.5
"""Part of the amplitude that each half of the record must show.  A choice: a step,
which is no period, shows it in one half or none."""
_MOST_OFF = 0.03
"""Relative distance from the stated frequency beyond which none was found."""


@dataclass(frozen=True, eq=False)
class Periodic:
    """The periodic light of regions.

    Parameters
    ----------
    law : PhaseLaw
        Phase of the load; steady at the stated frequency if it could not be followed.
    harmonics, degree : int
        Those that the frames resolve, 0 if none, and degree of the drift beside them.
    regions : tuple of Harmonics
        Of S0, S1, S2, one per region; empty without a resolved harmonic.
    reasons : tuple of str
        Why the amplitude of each region cannot be told; empty where it can.
    doubt : str
        What the stated errors do not contain; empty if nothing is known of it.
    """

    law: PhaseLaw
    harmonics: int
    degree: int
    regions: tuple[Harmonics, ...]
    reasons: tuple[str, ...]
    doubt: str = ""


def fit_periodic(
    t_us: NDArray[np.int64], stokes: FloatArray, exposure_us: FloatArray, hz: float,
    reference_us: int, *, quantity: Function = of_dolp,
) -> Periodic:
    """Follow a load through frames, and fit its harmonics to regions.

    Parameters
    ----------
    t_us : ndarray of int64, shape (T,)
        Middles of the exposures.
    stokes : ndarray of float64, shape (R, T, 3)
        S0, S1, S2 of the regions.
    exposure_us : ndarray of float64, shape (T,)
        Length of the exposures.
    hz : float
        Frequency of the load, to 2 %.
    reference_us : int
        Time of phase 0.
    quantity : callable
        What must swing with the period, as in `Harmonics.wave`: `of_dolp`; for a
        turning polarizer ``lambda s: s[1]``, for a lamp ``lambda s: s[0]``.

    Returns
    -------
    Periodic

    Raises
    ------
    ValueError
        If ``hz`` is not a frequency.
    """
    if not 0 < (hz := real_number(hz)) <= _MOST_HZ:
        raise ValueError(f"hz must be positive and at most {_MOST_HZ:g}, got {hz!r}")

    t_us = floats("t_us", t_us, np.int64).reshape(-1)

    def refused(reason: str) -> Periodic:
        return Periodic(PhaseLaw.steady(hz, reference_us), 0, 0, (),
                        (reason,) * len(stokes))

    seconds = (t_us[-1] - t_us[0]) / 1e6 if len(t_us) else 0.0
    if len(t_us) < _LEAST_FRAMES:
        return refused(f"{len(t_us)} frames, {_LEAST_FRAMES} are needed")
    if hz * seconds < _LEAST_CYCLES:
        return refused(f"{hz * seconds:.1f} cycles of {hz:.4g} Hz, {_LEAST_CYCLES:g} "
                       "are needed")
    rate = 1e6 / float(np.median(np.diff(t_us)))
    seen = float(np.abs(np.sinc(hz * np.mean(exposure_us) / 1e6)))
    locked = (
        f"{rate:.4g} frames per second see {hz:.4g} Hz always at the same phases, so "
        "amplitude and mean cannot be told: change the load or the frame rate by 1 %, "
        "or state the frequency more exactly"
    ) if seen > LEAST_SEEN else (
        f"exposures of {np.mean(exposure_us) / 1e3:.3g} ms blur {hz:.4g} Hz to "
        f"{seen:.0%} of its amplitude: shorten them")
    steady = PhaseLaw.steady(hz, reference_us)
    if not suited(steady, t_us, exposure_us)[0]:
        return refused(locked)
    relative = stokes / stokes[:, :, :1].mean(1, keepdims=True)
    signals = relative.transpose(1, 0, 2).reshape(len(t_us), -1)
    law = follow(t_us, signals, hz, reference_us, exposure_us)
    harmonics, degree = suited(law, t_us, exposure_us)
    if abs(law.hz / hz - 1) > _MOST_OFF:
        return refused(f"no steady period near {hz:.4g} Hz was found in the frames")
    if not harmonics:
        return refused(locked)
    regions, reasons = [], []
    for one in stokes:
        fit = fit_harmonics(law, t_us, one, harmonics=harmonics, degree=degree,
                            exposure_us=exposure_us)
        regions.append(fit)
        wave = fit.wave(quantity)
        if wave.amplitude[0] < _SIGNIFICANT * wave.amplitude_se:
            reasons.append(
                f"no periodic light stands out at {law.hz:.4g} Hz (amplitude "
                f"{wave.amplitude[0]:.2g} +- {wave.amplitude_se:.2g})")
        else:
            reasons.append(_unsteady(law, t_us, one, exposure_us, wave, quantity))
    doubt = ""
    for name, multiple in (("third", 4 * law.hz), ("second", 3 * law.hz)):
        if abs(multiple - rate * round(multiple / rate)) * seconds < 1:
            doubt = (
                f"{rate:.4g} frames per second cannot tell the {name} harmonic of "
                f"{law.hz:.4g} Hz from the fundamental, which it falsifies: change the "
                "load or the frame rate by 1 %")
    return Periodic(law, harmonics, degree, tuple(regions), tuple(reasons), doubt)


def _unsteady(
    law: PhaseLaw, t_us: NDArray[np.int64], stokes: FloatArray,
    exposure_us: FloatArray, whole: Wave, quantity: Function,
) -> str:
    """Return why a change of light is not periodic, if the halves of the record differ.

    Halves of which the frames do not resolve a cycle say nothing.
    """
    middle = len(t_us) // 2
    for half in (slice(0, middle), slice(middle, None)):
        t, exposure = t_us[half], exposure_us[half]
        if len(t) < _LEAST_FRAMES or not resolved(law, t, exposure, 1):
            return ""
        part = fit_harmonics(law, t, stokes[half], harmonics=1, degree=1,
                             exposure_us=exposure).wave(quantity)
        share = part.amplitude[0] / whole.amplitude[0] * np.cos(
            part.phase[0] - whole.phase[0])
        if share < _STEADY:
            return (f"the light changes, but not with a period of {1 / law.hz:.3g} s: "
                    f"one half of the recording has {share:.0%} of its amplitude")
    return ""
