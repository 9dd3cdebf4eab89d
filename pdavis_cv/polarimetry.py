"""PolarFrame, an image of polarization, and `polarization`, which makes one."""
from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cache, partial
from types import MappingProxyType
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

import pdavis_cv
from pdavis_cv import _kernels
from pdavis_cv._advice import Advises
from pdavis_cv._types import Facts, Image
from pdavis_cv.analyser import Analyser, stokes_gain
from pdavis_cv.colour_mosaic import COLOURS, colour_channels, joint
from pdavis_cv.mosaic import (
    ALL_CLEAN,
    GREY,
    check_method,
    checked_mosaic,
    demosaic as demosaic_mosaic,
)
from pdavis_cv.sensor import Layout
from pdavis_cv.stokes_vector import (
    aop,
    debias_dolp,
    dolp,
    flat,
    frozen,
    propagated,
    real,
    sampling_variance,
    solution_of,
    stokes,
)

_Sigmas = tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]


class PolarFrame(Advises):
    """Four polarization channels at one time, with the quantities derived from them.

    It owns its memory: later images never change an earlier one.  All arrays are
    read-only.  Stokes parameters, angle and degree are computed at first use and
    cached; threads may share a PolarFrame.

    Parameters
    ----------
    quad : array_like, shape (4, H, W)
        I0, I45, I90, I135 in ``CHANNELS`` order, linear intensity (DN per ms of
        exposure if the exposure is known); copied to float32.
    valid : ndarray of bool, shape (H, W), optional
        True = usable; default: all.
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
        Software, options and parameters that made the image.
    quality : array_like of shape (H, W), optional
        Violation of the method's assumptions, 0 (none) to 1.
    reconciled : bool
        Whether ``quad`` was adjusted by weighted least squares to be consistent with
        three Stokes parameters.  ``variance`` is that before the adjustment; sigmas
        account for it.

    Raises
    ------
    TypeError
        If ``quad`` does not hold real numbers or ``valid`` is not bool.
    ValueError
        If shapes do not match, ``extinction_ratio`` is not greater than 1 or is given
        together with ``analyser``.

    Examples
    --------
    >>> frame = PolarFrame(np.array([1, 0.5, 0, 0.5]).reshape(4, 1, 1))
    >>> float(frame.s0[0, 0]), float(frame.aop[0, 0]), float(frame.dolp[0, 0])
    (1.0, 0.0, 1.0)
    """

    __slots__ = (
        "_analyser", "_aop_dolp", "_colours", "_light", "_made", "_origin",
        "_places_differ", "_provenance", "_quad", "_quality", "_reconciled", "_shape",
        "_sigmas", "_stokes", "_usable", "_valid", "_variance", "extinction_ratio",
        "frame_us", "t_us")

    t_us: int | None
    frame_us: int | None
    extinction_ratio: float | None
    _quad: NDArray[np.float32] | None
    _made: Callable[[int], NDArray[np.float32]] | None  # four channels; S0, AoP, DoLP
    _light: NDArray[np.float32] | None
    _colours: Mapping[str, Self]
    _quality: NDArray[np.float32] | None
    _reconciled: bool
    _places_differ: bool    # whether channels are taken at different places
    _origin: PolarFrame | None
    _aop_dolp: tuple[NDArray[np.float32], NDArray[np.float32]] | None
    _sigmas: _Sigmas | NDArray[np.float32] | Callable[[], NDArray[np.float32]] | None
    _stokes: tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]] | None
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
        provenance: Facts | None = None,
        quality: ArrayLike | None = None,
        reconciled: bool = False,
    ) -> None:
        if quad is None:
            raise TypeError("quad must be four planes, got None")
        copies = {name: np.array(real(name, value), order="C") for name, value in (
            ("quad", quad), ("variance", variance), ("quality", quality))
            if value is not None}
        self._set(copies["quad"], None if valid is None else np.array(valid), t_us,
                  frame_us, extinction_ratio, analyser, copies.get("variance"),
                  provenance, quality=copies.get("quality"), reconciled=reconciled)

    def _set(
        self,
        quad: NDArray[np.float32],
        valid: NDArray[np.bool_] | None = None,
        t_us: int | None = None,
        frame_us: int | None = None,
        extinction_ratio: float | None = None,
        analyser: ArrayLike | Analyser | None = None,
        variance: NDArray[np.float32] | None = None,
        provenance: Facts | None = None,
        quality: NDArray[np.float32] | None = None,
        reconciled: bool = False,
    ) -> None:
        self._quad, self._reconciled = quad, reconciled
        self._colours = {}
        self._origin = None     # the image whose cached quantities this one uses
        self._aop_dolp = self._light = self._sigmas = self._stokes = None
        self._made, self._usable, self._places_differ = None, None, False
        if quad.ndim != 3 or quad.shape[0] != 4:
            raise ValueError(f"quad must have shape (4, H, W), got {quad.shape}")
        if valid is not None and valid.dtype != np.bool_:
            raise TypeError(f"valid must be bool, got {valid.dtype}")
        size = self._shape = quad.shape[1], quad.shape[2]
        for name, array, shape in (("valid", valid, size),
                                   ("variance", variance, (4, *size)),
                                   ("quality", quality, size)):
            if array is not None and array.shape != shape:
                raise ValueError(f"{name} must have shape {shape}, got {array.shape}")
        solution_of(analyser, extinction_ratio, size)
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
        return self._shape

    @property
    def quad(self) -> NDArray[np.float32]:
        """I0, I45, I90, I135; float32, shape (4, H, W)."""
        if self._quad is None:      # of colours
            self._quad = frozen(self._made(4) if self._made else joint(
                [self._colours[name].quad for name in COLOURS]))
        return self._quad

    @property
    def analyser(self) -> Analyser | None:
        """Responses of the channels, None for ideal polarizers."""
        return self._analyser

    @property
    def colours(self) -> Mapping[str, Self]:
        """Images of red, green and blue light by name; none of a monochrome sensor."""
        return self._colours

    @property
    def provenance(self) -> Facts:
        """Software, options and parameters that made the image; read-only."""
        return MappingProxyType(self._provenance)

    @property
    def variance(self) -> NDArray[np.float32] | None:
        """Variance of the log of each intensity, shape (4, H, W); None if unknown."""
        return self._variance

    @property
    def quality(self) -> NDArray[np.float32] | None:
        """Violation of the method's assumptions, 0 (none) to 1, shape (H, W).

        For ``events`` with ``offsets="redundancy"``, it is the ratio of the two
        smallest eigenvalues, 1 where they are unknown.  None for other methods.
        """
        return self._quality

    @property
    def s0(self) -> NDArray[np.float32]:
        """Intensity in front of the polarizers; float32, shape (H, W)."""
        return self._planes()[0] if self._light is None else self._light

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
        """True = usable: the given `valid`, and S0 > 0; shape (H, W)."""
        if self._usable is None:
            positive = self.s0 > 0
            usable = positive if self._valid is None else positive & self._valid
            self._usable = frozen(usable)
        return self._usable

    @property
    def sigma_aop(self) -> NDArray[np.float32] | None:
        """Standard deviation of AoP in radians, shape (H, W); None without variance.

        First-order propagation of four independent errors, which in images of a mosaic
        include that channels are taken at different places.  It is too small where DoLP
        itself is uncertain, and at most pi / sqrt(12), the value for a random angle.
        """
        sigmas = self._propagated()
        return None if sigmas is None else sigmas[0]

    @property
    def sigma_dolp(self) -> NDArray[np.float32] | None:
        """Standard deviation of DoLP, shape (H, W); None without variance.

        Propagated as `sigma_aop` is; infinite where S0 is not positive.  A DoLP near 0
        is biased upwards by about one sigma; `dolp_debiased` corrects that.
        """
        sigmas = self._propagated()
        return None if sigmas is None else sigmas[1]

    @property
    def dolp_debiased(self) -> NDArray[np.float32] | None:
        """DoLP corrected for the bias by noise, shape (H, W); None without variance.

        See `debias_dolp`.  It is half of DoLP where DoLP is much below its noise.
        """
        sigmas = self._propagated()
        return None if sigmas is None else frozen(debias_dolp(self.dolp, sigmas[2]))

    def _planes(
        self,
    ) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
        if self._stokes is None and self._origin is not None:
            self._stokes = self._origin._planes()
        if self._stokes is None:
            s0, s1, s2 = frozen(stokes(
                self.quad, self._analyser, extinction_ratio=self.extinction_ratio))
            self._stokes = s0, s1, s2
        return self._stokes

    def _angle_and_degree(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        if self._aop_dolp is None and self._origin is not None:
            self._aop_dolp = self._origin._angle_and_degree()
        if self._aop_dolp is not None:
            return self._aop_dolp
        light, angle, degree = np.empty((3, *self.shape), np.float32)
        if self._analyser is not None or self._stokes is not None:
            s0, s1, s2 = self._planes()
            aop(s1, s2, angle)
            dolp(s0, s1, s2, degree)
        elif self._quad is None and self._made:
            light, angle, degree = self._made(3)
            self._light = frozen(light)
        else:
            _kernels.s0_aop_dolp(
                flat(self.quad), stokes_gain(self.extinction_ratio), light.reshape(-1),
                angle.reshape(-1), degree.reshape(-1))
            self._light = frozen(light)
        self._aop_dolp = frozen(angle), frozen(degree)
        return self._aop_dolp

    def _propagated(self) -> _Sigmas | None:
        given = self._sigmas() if callable(self._sigmas) else self._sigmas
        if given is not None:
            self._sigmas = frozen(given[0]), frozen(given[1]), frozen(given[2])
        elif self._variance is not None:
            analyser = self._analyser or Analyser.ideal(self.extinction_ratio)
            variance = self._variance * self.quad**2
            if self._places_differ:
                variance += sampling_variance(self.quad, variance)
            self._sigmas = propagated(
                self._planes(), analyser.solution, variance,
                analyser.null() if self._reconciled else None)
        return self._sigmas if isinstance(self._sigmas, tuple) else None

    def __reduce__(self) -> tuple[Any, ...]:
        return _restored_frame, (
            self.quad, self._valid, self.t_us, self.frame_us, self.extinction_ratio,
            self._analyser, self._variance, self._provenance, self._quality,
            self._reconciled), (None, {
                "_places_differ": self._places_differ,
                "_sigmas": None if self._sigmas is None else self._propagated(),
                "_colours": dict(self._colours)})

    def __array__(
        self, dtype: DTypeLike | None = None, copy: bool | None = None
    ) -> NDArray[Any]:
        """Return `quad`, so that ``np.asarray(frame)`` copies nothing."""
        if copy is None:    # NumPy 1 has no such value
            return np.asarray(self.quad, dtype)
        return np.array(self.quad, dtype, copy=copy)

    def __repr__(self) -> str:
        height, width = self.shape
        parts = [f"{width}x{height}"]
        parts += [] if self.t_us is None else [f"t_us={self.t_us}"]
        parts += [f"{name}={self._provenance[name]!r}"
                  for name in ("method", "mode") if name in self._provenance]
        return f"PolarFrame({', '.join(parts)})"

    @classmethod
    def _advice(cls, name: str) -> str:
        from pdavis_cv.quantities import quantity  # it takes images

        try:
            known = quantity(name).name
        except ValueError:
            return super()._advice(name)
        if known in ("i0", "i45", "i90", "i135"):
            return "; I0, I45, I90 and I135 are the planes of quad"
        return f"; it is {known}" if hasattr(cls, known) else ""

    def _repr_png_(self) -> bytes | None:
        """Return a picture of S0, AoP and DoLP for notebooks; None without OpenCV."""
        # Through the package's lazy attribute, as `render` is above this module.
        try:
            return pdavis_cv.render.png_of(pdavis_cv.render.summary(self))
        except ImportError:
            return None


def _restored_frame(*arguments: Any, **about: Any) -> PolarFrame:
    frame = PolarFrame.__new__(PolarFrame)
    frame._set(*arguments, **about)
    return frame


def adopted(
    quad: NDArray[np.float32], *,
    aop_dolp: tuple[NDArray[np.float32], NDArray[np.float32]] | None = None,
    sigmas: NDArray[np.float32] | Callable[[], NDArray[np.float32]] | None = None,
    places_differ: bool = False, **about: Any,
) -> PolarFrame:
    """Return a PolarFrame that takes ownership of arrays without copying them.

    They must be C-contiguous, float32 or bool; they become read-only, and no other code
    may keep references to their memory.  `about` are the parameters of the class.
    Angle and degree may be given if they are known already, and errors: of AoP, of
    DoLP, and of (S1, S2)/S0 across its direction, or what makes them at first use;
    places_differ: errors that follow from the variances include `sampling_variance`.
    """
    for name, array, dtype in (("quad", quad, np.float32),
                               ("valid", about.get("valid"), np.bool_),
                               ("variance", about.get("variance"), np.float32),
                               ("quality", about.get("quality"), np.float32)):
        if array is not None and (array.dtype != dtype or not array.flags.c_contiguous):
            raise TypeError(
                f"{name} must be C-contiguous {np.dtype(dtype)} to be adopted, "
                f"got {array.dtype} with strides {array.strides}")
    frame = _restored_frame(quad, **about)
    if aop_dolp is not None:
        frame._aop_dolp = frozen(aop_dolp[0]), frozen(aop_dolp[1])
    frame._sigmas, frame._places_differ = sigmas, places_differ
    return frame


def adopted_colours(quads: NDArray[np.float32], **about: Any) -> PolarFrame:
    """Return the PolarFrame of the channels of red, green and blue light, (3, 4, H, W).

    It is that of all light, `joint`; its `colours` are those of the three.
    """
    frame = adopted(quads[1], **about)
    frame._quad = None      # made at first use
    frame._colours = MappingProxyType({
        name: adopted(quad, **about)
        for name, quad in zip(COLOURS, quads, strict=True)})
    return frame


def retimed(
    image: PolarFrame, t_us: int, frame_us: int | None, provenance: Facts
) -> PolarFrame:
    """Return the same image for another time; both share cached quantities."""
    other = PolarFrame.__new__(PolarFrame)
    for name in PolarFrame.__slots__:
        setattr(other, name, getattr(image, name))
    other._origin = image._origin or image
    other.t_us, other.frame_us = t_us, frame_us
    other._provenance = dict(provenance)
    return other


def polarization(
    mosaic: Image,
    layout: Layout | str,
    demosaic: str = "bilinear",
    extinction_ratio: float | None = None,
) -> PolarFrame:
    """Make a PolarFrame from a mosaic.

    Parameters
    ----------
    mosaic : ndarray of uint8, uint16 or float32, shape (H, W)
        Linear intensity, row 0 at the top.
    layout : Layout or str
        Polarizer in front of each pixel, and its colour filter if it has one, or their
        name, as ``"sony-rggb"``; see `Layout.of`.
    demosaic : {"bilinear", "superpixel", "binned", "guided"}
        As in `pdavis_cv.demosaic`; ``"superpixel"`` and ``"binned"`` halve the size.
    extinction_ratio : float, optional
        S1 and S2 are multiplied by (ER + 1) / (ER - 1).

    Returns
    -------
    PolarFrame
        Without ``t_us``; with `PolarFrame.colours` if there are colour filters.

    Raises
    ------
    TypeError, ValueError
        As for `pdavis_cv.demosaic` and `stokes`.
    """
    mosaic, layout = checked_mosaic(mosaic), Layout.of(layout)
    if not layout.colours or demosaic != "guided" or not mosaic.size:
        quad = demosaic_mosaic(mosaic, layout, demosaic)
        made = adopted if quad.ndim == 3 else adopted_colours
        return made(quad, extinction_ratio=extinction_ratio)
    check_method(demosaic, mosaic.shape, layout)
    mosaic, gain = mosaic.copy(), stokes_gain(extinction_ratio)
    planes = cache(lambda n: colour_channels(   # four, or S0, AoP, DoLP
        mosaic, layout, demosaic, ALL_CLEAN, GREY,
        np.empty((3, n, *mosaic.shape), np.float32), gain))
    image = adopted_colours(np.empty((3, 4, *mosaic.shape), np.float32),
                            extinction_ratio=extinction_ratio)
    for c, one in enumerate(image.colours.values()):
        one._quad, one._made = None, partial(lambda c, n: planes(n)[c], c)
    return image
