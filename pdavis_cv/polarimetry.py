"""Stokes parameters, angle and degree of linear polarization; PolarFrame."""
from __future__ import annotations

import math
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, Self, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pdavis_cv import _kernels
from pdavis_cv._checks import output, outputs
from pdavis_cv.analyser import Analyser, stokes_gain
from pdavis_cv.mosaic import check_method, checked_mosaic, places_of, scratch_rows
from pdavis_cv.mosaic import demosaic as demosaic_mosaic
from pdavis_cv.sensor import Layout

__all__ = ["PolarFrame", "aop", "dolp", "polarization", "stokes"]

_Array = TypeVar("_Array", bound=NDArray[Any])

UNIFORM_SIGMA_RAD = math.pi / math.sqrt(12)
"""Standard deviation of an angle about which nothing is known."""


def stokes(
    quad: ArrayLike,
    analyser: ArrayLike | Analyser | None = None,
    out: NDArray[np.float32] | None = None,
    *,
    extinction_ratio: float | None = None,
) -> NDArray[np.float32]:
    """Return S0, S1 and S2 of four intensities.

    Parameters
    ----------
    quad : array_like, shape (4, ...)
        I0, I45, I90, I135, linear intensity; converted to float32.
    analyser : Analyser, or array_like of shape (4, 3) or (4, 3, H, W), optional
        Responses of the channels to S0, S1, S2, solved by least squares.  Default:
        S0 = (I0 + I45 + I90 + I135) / 2, S1 = I0 - I90, S2 = I45 - I135.
    out : ndarray of float32, shape (3, ...), optional
        Overwritten and returned.
    extinction_ratio : float, optional
        S1 and S2 are multiplied by (ER + 1) / (ER - 1); not together with
        ``analyser``, which says it more exactly.

    Returns
    -------
    ndarray of float32, shape (3, ...)
        In the unit of ``quad``; S0 is the light in front of the polarizers.

    Raises
    ------
    TypeError
        If ``quad`` does not hold real numbers.
    ValueError
        If shapes do not fit, ``extinction_ratio`` is not greater than 1 or is given
        together with ``analyser``.
    """
    planes = _real("quad", quad)
    if planes.ndim < 1 or planes.shape[0] != 4:
        raise ValueError(f"quad must have shape (4, ...), got {planes.shape}")
    solution = _solution(analyser, extinction_ratio, planes.shape[1:])
    gain = stokes_gain(extinction_ratio)
    out = output(out, (3, *planes.shape[1:]), np.float32, planes, solution)
    if solution is None:
        _kernels.stokes(_flat(planes), gain, _flat(out))
    else:
        _kernels.mix(_flat(planes), solution.reshape(12, -1), _flat(out))
    return out


def aop(
    s1: ArrayLike, s2: ArrayLike, out: NDArray[np.float32] | None = None
) -> NDArray[np.float32]:
    """Return the angle of polarization, atan2(S2, S1) / 2 in [0, pi).

    Parameters
    ----------
    s1, s2 : array_like, equal shapes
        Converted to float32.
    out : ndarray of float32, the same shape, optional
        Overwritten and returned.

    Returns
    -------
    ndarray of float32
        Radians, counter-clockwise as displayed with row 0 at the top, 0 along a row;
        within 2.1e-7 of the exact value.  A value that rounds to float32 pi is 0, and
        so is the angle of S1 = S2 = 0.  NaN gives NaN.

    Raises
    ------
    TypeError
        If an input does not hold real numbers.
    ValueError
        If shapes differ or ``out`` does not fit.

    Examples
    --------
    >>> float(aop(0, 1)), float(aop(1, 0))
    (0.7853981852531433, 0.0)
    """
    first, second = _alike(s1=s1, s2=s2)
    out = output(out, first.shape, np.float32, first, second)
    _kernels.aop(first.reshape(-1), second.reshape(-1), out.reshape(-1))
    return out


def dolp(
    s0: ArrayLike,
    s1: ArrayLike,
    s2: ArrayLike,
    out: NDArray[np.float32] | None = None,
) -> NDArray[np.float32]:
    """Return the degree of linear polarization, sqrt(S1^2 + S2^2) / S0.

    Parameters
    ----------
    s0, s1, s2 : array_like, equal shapes
        Converted to float32.
    out : ndarray of float32, the same shape, optional
        Overwritten and returned.

    Returns
    -------
    ndarray of float32
        Not clipped: noise can carry it over 1.  0 where S0 is not positive.

    Raises
    ------
    TypeError
        If an input does not hold real numbers.
    ValueError
        If shapes differ or ``out`` does not fit.
    """
    total, first, second = _alike(s0=s0, s1=s1, s2=s2)
    out = output(out, total.shape, np.float32, total, first, second)
    _kernels.dolp(total.reshape(-1), first.reshape(-1), second.reshape(-1),
                  out.reshape(-1))
    return out


class PolarFrame:
    """Four polarization channels at one time, and what follows from them.

    It owns its memory for ever: later images never change an earlier one.  All
    arrays are read-only.  Stokes parameters, angle and degree are computed at first
    use and kept; threads may share a PolarFrame.

    Parameters
    ----------
    quad : array_like, shape (4, H, W)
        I0, I45, I90, I135 in ``CHANNELS`` order, linear intensity (DN per ms of
        exposure where the exposure is known); copied to float32.
    valid : ndarray of bool, shape (H, W), optional
        True = usable; default: everything.
    t_us : int, optional
        Time of the image on the recording's clock.
    frame_us : int, optional
        Mid-exposure of the last frame that was used.
    extinction_ratio : float, optional
        S1 and S2 are multiplied by (ER + 1) / (ER - 1).
    analyser : Analyser, or array_like of shape (4, 3) or (4, 3, H, W), optional
        Responses of the channels, instead of ``extinction_ratio``.
    variance : array_like, shape (4, H, W), optional
        Variance of the natural log of each of the four intensities.
    provenance : mapping of str to object, optional
        How the image came about.
    quality : array_like of shape (H, W), optional
        How well the method's assumptions hold, 0 (well) to 1.

    Raises
    ------
    TypeError
        If ``quad`` does not hold real numbers or ``valid`` is not bool.
    ValueError
        If shapes do not fit, ``extinction_ratio`` is not greater than 1 or is given
        together with ``analyser``.

    Examples
    --------
    >>> frame = PolarFrame(np.array([1, 0.5, 0, 0.5]).reshape(4, 1, 1))
    >>> float(frame.s0[0, 0]), float(frame.aop[0, 0]), float(frame.dolp[0, 0])
    (1.0, 0.0, 1.0)
    """

    __slots__ = (
        "_analyser", "_aop_dolp", "_mosaic", "_provenance", "_quad", "_quality",
        "_sigmas", "_stokes", "_usable", "_valid", "_variance", "extinction_ratio",
        "frame_us", "t_us")

    t_us: int | None
    frame_us: int | None
    extinction_ratio: float | None
    _quad: NDArray[np.float32] | None
    _quality: NDArray[np.float32] | None
    _mosaic: tuple[NDArray[Any], Layout] | None
    _aop_dolp: tuple[NDArray[np.float32], NDArray[np.float32]] | None
    _sigmas: tuple[NDArray[np.float32], NDArray[np.float32]] | None
    _stokes: tuple[
        NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]] | None
    _usable: NDArray[np.bool_] | None
    _valid: NDArray[np.bool_] | None
    _variance: NDArray[np.float32] | None

    def __init__(
        self,
        quad: ArrayLike,
        *,
        valid: NDArray[np.bool_] | None = None,
        t_us: int | None = None,
        frame_us: int | None = None,
        extinction_ratio: float | None = None,
        analyser: ArrayLike | Analyser | None = None,
        variance: ArrayLike | None = None,
        provenance: Mapping[str, Any] | None = None,
        quality: ArrayLike | None = None,
    ) -> None:
        copies = {name: np.array(_real(name, value), order="C") for name, value in (
            ("quad", quad), ("variance", variance), ("quality", quality))
            if value is not None}
        self._set(copies["quad"], None if valid is None else np.array(valid), t_us,
                  frame_us, extinction_ratio, analyser, copies.get("variance"),
                  provenance, quality=copies.get("quality"))

    @classmethod
    def adopt(
        cls,
        quad: NDArray[np.float32],
        *,
        valid: NDArray[np.bool_] | None = None,
        t_us: int | None = None,
        frame_us: int | None = None,
        extinction_ratio: float | None = None,
        analyser: ArrayLike | Analyser | None = None,
        variance: NDArray[np.float32] | None = None,
        provenance: Mapping[str, Any] | None = None,
        quality: NDArray[np.float32] | None = None,
    ) -> Self:
        """Make a PolarFrame that takes the arrays over instead of copying them.

        Parameters are those of the class.  ``quad``, ``variance`` and ``quality`` must
        be C-contiguous float32, ``valid`` C-contiguous bool; they become read-only,
        and nobody else may hold on to their memory.
        """
        for name, array, dtype in (("quad", quad, np.float32),
                                   ("valid", valid, np.bool_),
                                   ("variance", variance, np.float32),
                                   ("quality", quality, np.float32)):
            if array is not None and (array.dtype != dtype
                                      or not array.flags.c_contiguous):
                raise TypeError(
                    f"{name} must be C-contiguous {np.dtype(dtype)} to be adopted, "
                    f"got {array.dtype} with strides {array.strides}")
        frame = cls.__new__(cls)
        frame._set(quad, valid, t_us, frame_us, extinction_ratio, analyser, variance,
                   provenance, quality=quality)
        return frame

    def _set(
        self,
        quad: NDArray[np.float32] | None,
        valid: NDArray[np.bool_] | None,
        t_us: int | None,
        frame_us: int | None,
        extinction_ratio: float | None,
        analyser: ArrayLike | Analyser | None,
        variance: NDArray[np.float32] | None,
        provenance: Mapping[str, Any] | None,
        mosaic: tuple[NDArray[Any], Layout] | None = None,
        quality: NDArray[np.float32] | None = None,
    ) -> None:
        self._quad, self._mosaic = quad, mosaic
        self._aop_dolp = self._sigmas = self._stokes = self._usable = None
        if quad is not None and (quad.ndim != 3 or quad.shape[0] != 4):
            raise ValueError(f"quad must have shape (4, H, W), got {quad.shape}")
        if valid is not None and valid.dtype != np.bool_:
            raise TypeError(f"valid must be bool, got {valid.dtype}")
        size = self.shape
        for name, array, shape in (("valid", valid, size),
                                   ("variance", variance, (4, *size)),
                                   ("quality", quality, size)):
            if array is not None and array.shape != shape:
                raise ValueError(f"{name} must have shape {shape}, got {array.shape}")
        _solution(analyser, extinction_ratio, size)
        stokes_gain(extinction_ratio)
        if analyser is not None and not isinstance(analyser, Analyser):
            analyser = Analyser(analyser)
        self._analyser: Analyser | None = analyser
        self.extinction_ratio = extinction_ratio
        self.t_us = None if t_us is None else int(t_us)
        self.frame_us = None if frame_us is None else int(frame_us)
        self._valid, self._variance, self._quality = valid, variance, quality
        self._provenance = dict(provenance or {})
        for array in (quad, valid, variance, quality):
            if array is not None:
                array.flags.writeable = False

    @property
    def shape(self) -> tuple[int, int]:
        """(height, width)."""
        planes = self._quad if self._mosaic is None else self._mosaic[0]
        assert planes is not None
        height, width = planes.shape[-2:]
        return height, width

    @property
    def quad(self) -> NDArray[np.float32]:
        """I0, I45, I90, I135; float32, shape (4, H, W)."""
        if self._quad is None:
            assert self._mosaic is not None
            self._quad = _frozen(demosaic_mosaic(*self._mosaic))
        return self._quad

    @property
    def analyser(self) -> Analyser | None:
        """Responses of the channels, None for ideal polarizers."""
        return self._analyser

    @property
    def provenance(self) -> Mapping[str, Any]:
        """How the image came about; read-only."""
        return MappingProxyType(self._provenance)

    @property
    def variance(self) -> NDArray[np.float32] | None:
        """Variance of the log of each intensity, shape (4, H, W), where it is known."""
        return self._variance

    @property
    def quality(self) -> NDArray[np.float32] | None:
        """How well the method's assumptions hold, 0 (well) to 1, shape (H, W).

        With ``events`` and ``offsets="redundancy"``: the ratio of the two smallest
        eigenvalues, 1 where nothing is known.  None for methods that cannot tell.
        """
        return self._quality

    @property
    def s0(self) -> NDArray[np.float32]:
        """Intensity in front of the polarizers; float32, shape (H, W)."""
        return self._planes()[0]

    @property
    def s1(self) -> NDArray[np.float32]:
        """I0 - I90 in front of the polarizers; float32, shape (H, W)."""
        return self._planes()[1]

    @property
    def s2(self) -> NDArray[np.float32]:
        """I45 - I135 in front of the polarizers; float32, shape (H, W)."""
        return self._planes()[2]

    @property
    def aop(self) -> NDArray[np.float32]:
        """Angle of polarization in radians, [0, pi); float32, shape (H, W)."""
        return self._angle_and_degree()[0]

    @property
    def dolp(self) -> NDArray[np.float32]:
        """Degree of linear polarization, not clipped; float32, shape (H, W)."""
        return self._angle_and_degree()[1]

    @property
    def valid(self) -> NDArray[np.bool_]:
        """True = usable: what was given, and S0 > 0; shape (H, W)."""
        if self._usable is None:
            positive = self.s0 > 0
            usable = positive if self._valid is None else positive & self._valid
            self._usable = _frozen(usable)
        return self._usable

    @property
    def sigma_aop(self) -> NDArray[np.float32] | None:
        """Standard deviation of AoP in radians, shape (H, W); None without variance.

        First-order propagation of four independent errors; too small where DoLP is
        itself uncertain, and never above pi / sqrt(12), that of an unknown angle.
        """
        sigmas = self._propagated()
        return None if sigmas is None else sigmas[0]

    @property
    def sigma_dolp(self) -> NDArray[np.float32] | None:
        """Standard deviation of DoLP, shape (H, W); None without variance.

        First-order propagation of four independent errors; infinite where S0 is not
        positive.  A DoLP near 0 is biased upwards by about as much.
        """
        sigmas = self._propagated()
        return None if sigmas is None else sigmas[1]

    def _planes(
        self,
    ) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
        if self._stokes is None:
            s0, s1, s2 = _frozen(stokes(
                self.quad, self._analyser, extinction_ratio=self.extinction_ratio))
            self._stokes = s0, s1, s2
        return self._stokes

    def _angle_and_degree(
        self, out: tuple[NDArray[np.float32] | None, ...] | None = None
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        if self._aop_dolp is not None:
            return self._aop_dolp
        shape = self.shape
        angle, degree = outputs(
            out, (("aop", shape, np.float32), ("dolp", shape, np.float32)))
        gain = stokes_gain(self.extinction_ratio)
        if self._analyser is not None or self._stokes is not None:
            s0, s1, s2 = self._planes()
            aop(s1, s2, angle)
            dolp(s0, s1, s2, degree)
        elif self._quad is None and self._mosaic is not None:
            mosaic, layout = self._mosaic
            if mosaic.size:
                scratch = scratch_rows(6, mosaic.shape[1])
                _kernels.polarize(
                    mosaic, places_of(layout), gain, scratch, angle, degree)
        else:
            _kernels.aop_dolp(
                _flat(self.quad), gain, angle.reshape(-1), degree.reshape(-1))
        self._aop_dolp = _frozen(angle.view()), _frozen(degree.view())
        return self._aop_dolp

    def _propagated(self) -> tuple[NDArray[np.float32], NDArray[np.float32]] | None:
        if self._variance is None:
            return None
        if self._sigmas is None:
            analyser = self._analyser or Analyser.ideal(self.extinction_ratio)
            self._sigmas = _sigmas(
                self._planes(), analyser.solution, self._variance * self.quad**2)
        return self._sigmas

    def __reduce__(self) -> tuple[Any, ...]:
        return _restored_frame, (
            self._quad, self._valid, self.t_us, self.frame_us, self.extinction_ratio,
            self._analyser, self._variance, self._provenance, self._mosaic,
            self._quality)

    def __repr__(self) -> str:
        height, width = self.shape
        parts = [f"{width}x{height}"]
        parts += [f"{name}={value}" for name, value in (
            ("t_us", self.t_us), ("frame_us", self.frame_us),
            ("extinction_ratio", self.extinction_ratio),
            ("analyser", self._analyser)) if value is not None]
        parts += [f"{name}={value!r}" for name, value in self._provenance.items()]
        return f"PolarFrame({', '.join(parts)})"


def _restored_frame(*arguments: Any) -> PolarFrame:
    frame = PolarFrame.__new__(PolarFrame)
    frame._set(*arguments)
    return frame


def polarization(
    mosaic: NDArray[Any],
    layout: Layout,
    demosaic: str = "bilinear",
    extinction_ratio: float | None = None,
    out: tuple[NDArray[np.float32] | None, NDArray[np.float32] | None] | None = None,
) -> PolarFrame:
    """Turn a mosaic into a PolarFrame, in one pass from pixels to angle and degree.

    Parameters
    ----------
    mosaic : ndarray of uint8, uint16 or float32, shape (H, W)
        Linear intensity, row 0 at the top; copied.
    layout : Layout
        Polarizer in front of each pixel.
    demosaic : {"bilinear", "superpixel"}
        As in `pdavis_cv.demosaic`; ``"superpixel"`` halves the size.
    extinction_ratio : float, optional
        S1 and S2 are multiplied by (ER + 1) / (ER - 1).
    out : tuple of two float32 arrays, shape of the result, optional
        Receive AoP and DoLP at once; an entry may be None.  These two the frame
        shares with the caller instead of owning them.

    Returns
    -------
    PolarFrame
        Without ``t_us``; computes what it is asked for.

    Raises
    ------
    TypeError, ValueError
        As `pdavis_cv.demosaic` and `stokes` do.
    """
    pixels = checked_mosaic(mosaic)
    check_method(demosaic, pixels.shape)
    places_of(layout)
    if demosaic == "superpixel":
        quad = demosaic_mosaic(pixels, layout, demosaic)
        frame = PolarFrame.adopt(quad, extinction_ratio=extinction_ratio)
    else:
        own = pixels.copy()
        own.flags.writeable = False
        frame = PolarFrame.__new__(PolarFrame)
        frame._set(None, None, None, None, extinction_ratio, None, None, None,
                   (own, layout))
    if out is not None:
        frame._angle_and_degree(out)
    return frame


def _sigmas(
    planes: tuple[NDArray[np.float32], ...],
    solution: NDArray[np.float32],
    variance: NDArray[np.float32],
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Propagate the variance of the intensities, (4, H, W), to AoP and DoLP."""
    s0, s1, s2 = (plane.astype(np.float64) for plane in planes)
    square = s1**2 + s2**2
    size = np.sqrt(square)
    var_aop, var_dolp, var_dark = (np.zeros_like(s0) for _ in range(3))
    with np.errstate(divide="ignore", invalid="ignore"):
        for k in range(4):
            m0, m1, m2 = solution[0, k], solution[1, k], solution[2, k]
            var_aop += ((s1 * m2 - s2 * m1) / (2 * square))**2 * variance[k]
            slope = (s1 * m1 + s2 * m2) / (size * s0) - size * m0 / s0**2
            var_dolp += slope**2 * variance[k]
            # Without polarization the slope depends on the direction: its mean square.
            var_dark += (m1**2 + m2**2) / 2 / s0**2 * variance[k]
        sigma_aop = np.fmin(np.sqrt(var_aop), UNIFORM_SIGMA_RAD)
        sigma_dolp = np.sqrt(np.where(square > 0, var_dolp, var_dark))
    sigma_dolp[~(s0 > 0)] = np.inf
    return (_frozen(sigma_aop.astype(np.float32)),
            _frozen(sigma_dolp.astype(np.float32)))


def _solution(
    analyser: ArrayLike | Analyser | None,
    extinction_ratio: float | None,
    shape: tuple[int, ...],
) -> NDArray[np.float32] | None:
    if analyser is None:
        return None
    if extinction_ratio is not None:
        raise ValueError(
            "extinction_ratio must be None when analyser is given, got "
            f"{extinction_ratio}")
    if not isinstance(analyser, Analyser):
        analyser = Analyser(analyser)
    solution = analyser.solution
    if solution.ndim == 4 and solution.shape[2:] != shape:
        raise ValueError(
            f"analyser must have shape (4, 3) or {(4, 3, *shape)}, got "
            f"{analyser.response.shape}")
    return solution


def _real(name: str, value: ArrayLike) -> NDArray[np.float32]:
    """Return value as C-contiguous float32, a view where possible."""
    array = np.asarray(value)
    if array.dtype.kind not in "fiub":
        raise TypeError(f"{name} must hold real numbers, got {array.dtype}")
    return np.asarray(array, np.float32, order="C")


def _alike(**values: ArrayLike) -> list[NDArray[np.float32]]:
    arrays = {name: _real(name, value) for name, value in values.items()}
    if len({array.shape for array in arrays.values()}) != 1:
        shapes = ", ".join(f"{name} {a.shape}" for name, a in arrays.items())
        raise ValueError(f"{' and '.join(arrays)} must have one shape, got {shapes}")
    return list(arrays.values())


def _flat(planes: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return (C, ...) as (C, n) without copying."""
    return planes.reshape(len(planes), math.prod(planes.shape[1:]))


def _frozen(array: _Array) -> _Array:
    array.flags.writeable = False
    return array
