"""Choose the contrast thresholds of the event pixels."""
from __future__ import annotations

import contextlib
import math
from collections.abc import Mapping

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pdavis_cv._checks import floats
from pdavis_cv.calibration.model import Calibration
from pdavis_cv.recording.base import Source
from pdavis_cv.recording.facts import ASSUMED, CALIBRATION, CALLER, FILE
from pdavis_cv.sensor import NOMINAL_THRESHOLDS

# kappa_n / (kappa_p^2 C1/C2) with kappa_n = kappa_p = 0.7 and C1/C2 = 20: Nozaki and
# Delbruck, "Temperature and parasitic photocurrent effects in dynamic vision
# sensors", IEEE Trans. Electron Devices 64 (2017), equations 4 and 5.
_BIAS_FACTOR = 0.7 / (0.7**2 * 20)

_CHOICES = ("calibration", "bias", "in-situ", "nominal")

Theta = NDArray[np.float32] | float


def thresholds_from_biases(biases: Mapping[str, float]) -> tuple[float, float]:
    """Return the thresholds (theta_on, theta_off) expected from the bias currents.

    Parameters
    ----------
    biases : mapping of str to float
        Currents of ``DiffBn``, ``OnBn`` and ``OffBn``, in any common unit.

    Returns
    -------
    (float, float)
        Positive magnitudes in natural-log units.

    Raises
    ------
    ValueError
        If a current is missing or the three are not in the order Off < Diff < On.
    """
    try:
        diff, on, off = (float(biases[name]) for name in ("DiffBn", "OnBn", "OffBn"))
    except KeyError as missing:
        raise ValueError("biases must hold DiffBn, OnBn and OffBn, but "
                         f"{missing} is missing") from None
    if not 0 < off < diff < on:
        raise ValueError(
            "bias currents must satisfy 0 < OffBn < DiffBn < OnBn, got "
            f"OffBn={off:g}, DiffBn={diff:g}, OnBn={on:g}")
    return _BIAS_FACTOR * math.log(on / diff), _BIAS_FACTOR * math.log(diff / off)


def checked_choice(thresholds: str | tuple[ArrayLike, ArrayLike] | None) -> None:
    """Raise ValueError if thresholds are an unknown word."""
    if isinstance(thresholds, str) and thresholds not in _CHOICES:
        raise ValueError(
            f"thresholds must be {', '.join(map(repr, _CHOICES))} or (on, off), got "
            f"{thresholds!r}")


def threshold_origin(
    recording: Source, thresholds: str | tuple[ArrayLike, ArrayLike] | None,
    nominal: tuple[ArrayLike, ArrayLike], calibration: Calibration | None,
) -> str:
    """Return where the thresholds of `resolve_thresholds` come from (see `Fact`)."""
    if thresholds is not None and thresholds not in ("in-situ", "bias", "calibration"):
        return CALLER
    if thresholds != "bias" and calibration is not None and (
            calibration.theta_on is not None):
        return CALIBRATION
    with contextlib.suppress(ValueError):
        thresholds_from_biases(recording.info.biases)
        return FILE
    same = all(np.ndim(one) == 0 for one in nominal) and (
        tuple(nominal) == NOMINAL_THRESHOLDS)
    return ASSUMED if same else CALLER


def resolve_thresholds(
    recording: Source,
    thresholds: str | tuple[ArrayLike, ArrayLike] | None,
    nominal: tuple[ArrayLike, ArrayLike],
    calibration: Calibration | None,
) -> tuple[Theta, Theta]:
    """Return the thresholds ON and OFF to use, as documented in ``fuse``.

    Each is a float or float32 (H, W).  For "in-situ" these are the values from which
    the estimation starts.
    """
    size = recording.info.sensor_size
    if isinstance(thresholds, str) and thresholds == "in-situ":
        thresholds = None
    checked_choice(thresholds)
    if thresholds is not None and not isinstance(thresholds, str):
        return _checked_pair("thresholds", thresholds, size)
    if thresholds in (None, "calibration"):
        if calibration is not None and calibration.theta_on is not None:
            return _checked_pair(
                "calibration", (calibration.theta_on, calibration.theta_off), size)
        if thresholds is not None:
            raise ValueError(
                "thresholds='calibration' needs a calibration that has thresholds")
    if thresholds in (None, "bias"):
        try:
            return thresholds_from_biases(recording.info.biases)
        except ValueError:
            if thresholds is not None:
                raise
    return _checked_pair("nominal_thresholds", nominal, size)


def _checked_pair(
    name: str, pair: object, size: tuple[int, int]
) -> tuple[Theta, Theta]:
    if not isinstance(pair, (tuple, list)) or len(pair) != 2:
        raise TypeError(f"{name} must be a pair (on, off), got {pair!r}")
    on, off = (_checked(name, side, value, size)
               for side, value in zip(("on", "off"), pair, strict=True))
    return on, off


def _checked(name: str, side: str, value: ArrayLike, size: tuple[int, int]) -> Theta:
    array = floats(f"{name} ({side})", value, np.float32)
    if array.ndim and array.shape != size:
        raise ValueError(
            f"{name} ({side}) must be a number or have shape {size}, got {array.shape}")
    if not np.all((array > 0) & (array < 10)):
        bad = array[~((array > 0) & (array < 10))].flat[0]
        raise ValueError(
            f"{name} ({side}) must be positive magnitudes in natural-log units, got "
            f"{bad:g}")
    return float(array) if array.ndim == 0 else array
