"""Frames of the active pixel sensor (APS): double sampling, dark, gain, saturation."""
from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pdavis_cv._checks import floats

LEAST_RESET_DN = 384
"""Smallest valid reset, as in libcaer: below it, the column has not recovered."""

_LEAST_PEAK = 64
"""Least number of samples in the peak of saturated pixels."""

LEAST_SIGNAL_DN = 3
"""Smallest valid signal: below it, the converter is saturated."""


def cds(
    reset: NDArray[np.uint16],
    signal: NDArray[np.uint16],
    dark: ArrayLike | None = None,
    gain: ArrayLike | None = None,
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Correlated double sampling: (reset - signal - dark) * gain.

    Negative values are kept, so that the noise of dark pixels averages to zero.

    Parameters
    ----------
    reset, signal : ndarray of uint16, shape (H, W)
        The two reads in DN; the signal decreases with light.
    dark : array_like, shape (H, W) or scalar, optional
        Offset without light, DN.
    gain : array_like, shape (H, W) or scalar, optional
        Factor that equalizes the pixels.

    Returns
    -------
    dn : ndarray of float32, shape (H, W)
        DN, larger = brighter; may be negative.
    valid : ndarray of bool, shape (H, W)
        False where signal <= 2 or reset < 384: the value is a lower bound.  A pixel may
        saturate before the converter; see `clip_level`.

    Raises
    ------
    TypeError
        If a read is not uint16.
    ValueError
        If shapes differ.

    Examples
    --------
    >>> dn, valid = cds(np.array([[700, 700]], np.uint16), np.array([[710, 2]], "u2"))
    >>> dn.tolist(), valid.tolist()
    ([[-10.0, 698.0]], [[True, False]])
    """
    for name, read in (("reset", reset), ("signal", signal)):
        if not isinstance(read, np.ndarray) or read.dtype != np.uint16:
            kind = getattr(read, "dtype", type(read).__name__)
            raise TypeError(f"{name} must be uint16, got {kind}")
        if read.ndim != 2:
            raise ValueError(f"{name} must be (H, W), got shape {read.shape}")
    if signal.shape != reset.shape:
        raise ValueError(f"signal must have the shape of reset, {reset.shape}, got "
                         f"{signal.shape}")
    dn = np.subtract(reset, signal, dtype=np.float32)
    valid = (reset >= LEAST_RESET_DN) & (signal >= LEAST_SIGNAL_DN)
    return _equalized(dn, dark, gain), valid


def correct(
    dn: NDArray[np.float32],
    dark: ArrayLike | None = None,
    gain: ArrayLike | None = None,
    clip_dn: float | None = None,
    valid: NDArray[np.bool_] | None = None,
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Correct a frame for dark offset and gain, and mark its saturated pixels.

    Parameters
    ----------
    dn : ndarray of float32, shape (H, W)
        Reset minus signal, as read.
    dark, gain : array_like, shape (H, W) or scalar, optional
        Subtracted without clamping, and multiplied after that.
    clip_dn : float, optional
        Pixels whose ``dn``, as read, is at or above this are saturated.
    valid : ndarray of bool, shape (H, W), optional
        True = usable; default: all.

    Returns
    -------
    dn : ndarray of float32, shape (H, W)
        ``(dn - dark) * gain``; may be negative.
    valid : ndarray of bool, shape (H, W)
        False where the argument is, and where ``dn`` is saturated or NaN.
    """
    if not isinstance(dn, np.ndarray) or dn.dtype != np.float32:
        kind = getattr(dn, "dtype", type(dn).__name__)
        raise TypeError(f"dn must be float32, got {kind}")
    if dn.ndim != 2:
        raise ValueError(f"dn must be (H, W), got shape {dn.shape}")
    if valid is not None and valid.dtype != np.bool_:
        raise TypeError(f"valid must be bool, got {valid.dtype}")
    if valid is not None and valid.shape != dn.shape:
        raise ValueError(f"valid must have shape {dn.shape}, got {valid.shape}")
    # A limit of +inf marks no finite value, only +inf itself.
    usable = dn < np.float32(np.inf if clip_dn is None else clip_dn)
    return _equalized(dn.copy(), dark, gain), usable if valid is None else (
        usable & valid)


def clip_level(dn: NDArray[Any], full_scale_dn: int = 1023) -> float | None:
    """Find the DN at which pixels saturate, from the peak at the histogram's end.

    The value of a saturated pixel does not depend on the light, so the brightest values
    of a saturated frame form a narrow peak with nothing above it.  A scene whose
    brightest part is a uniform patch looks the same; several frames at once, (N, H, W),
    or a calibration are more reliable.

    ``dn`` is reset minus signal, as read, without dark and gain.  The result is the
    lower edge of the peak, or None if there is none in the upper quarter of the
    converter's range.
    """
    return pile_up(dn, full_scale_dn)[1]


def pile_up(dn: NDArray[Any], full_scale_dn: int) -> tuple[int | None, float | None]:
    """Return the brightest value, and the lower edge of the peak; see `clip_level`.

    The brightest 1 in 10,000 pixels are left out, as they may be hot.  None if the
    value is below the upper quarter of the converter's range, or if there is no peak.
    """
    values = np.asarray(dn, np.float32)
    band, quarter = peak_width(full_scale_dn) // 2, 3 * full_scale_dn // 4
    # Leave out the brightest 1 in 10,000: isolated hot pixels lie above the peak.
    hot = np.count_nonzero(np.isfinite(values)) // 10_000
    # The upper quarter, and the range below it that is needed for peak and scene.
    high = np.rint(values[(values > quarter - 4 * band - 1) & (values < np.inf)])
    if np.count_nonzero(high >= quarter) <= hot:
        return None, None
    counts = np.bincount(np.minimum(high, full_scale_dn).astype(np.intp),
                         minlength=full_scale_dn + 1)
    top = int(np.flatnonzero(np.cumsum(counts[::-1])[::-1] > hot)[-1])
    # The peak is at most two bands wide; the scene lies below it.
    low = max(top - 2 * band + 1, 0)
    peak = int(counts[low:top + 1].sum())
    scene = int(counts[max(low - 2 * band, 0):low].sum())
    if peak < _LEAST_PEAK or peak < 4 * scene + 4 * np.sqrt(scene):
        return top, None
    # The edge is where the density exceeds that of the scene.  It is summed over five
    # values, as 8-bit frames have only every fourth value.
    density = np.convolve(counts, np.ones(5), "same")[low:top + 1]
    usual = 5 * scene / (2 * band)
    return top, float(low + int(np.argmax(density > 2 * usual + 3 * np.sqrt(usual))))


def peak_width(full_scale_dn: int) -> int:
    """Return the largest width of the peak of saturated pixels, DN."""
    return 2 * max(full_scale_dn // 64, 1)


def _equalized(
    dn: NDArray[np.float32], dark: ArrayLike | None, gain: ArrayLike | None
) -> NDArray[np.float32]:
    """Subtract dark from new values and multiply them by gain, in place."""
    for name, value, apply in (
            ("dark", dark, np.subtract), ("gain", gain, np.multiply)):
        if value is None:
            continue
        plane = floats(name, value, np.float32)
        if plane.ndim and plane.shape != dn.shape:
            raise ValueError(f"{name} must be one number or have shape {dn.shape}, "
                             f"got {plane.shape}")
        apply(dn, plane, out=dn)
    return dn
