"""What a user's optics does to AoP and DoLP, with a calibration and without."""
from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdavis_cv import Calibration, fuse
from pdavis_cv.calibration.frames import dark_frame
from pdavis_cv.calibration.sweep import fit_sweep, read_sweep
from pdavis_cv.sensor import Sensor
from pdavis_cv.simulation import (
    LENSES,
    PRESETS,
    Behind,
    Camera,
    FlatLight,
    Lens,
    Temperature,
    Waveplate,
)

from .page import table
from .run import Settings

FloatArray = NDArray[np.float64]

_SIDE, _SECONDS, _DARK_SECONDS = 16, 0.2, 2.0
_DOLP = 0.5
_STEP_DEG = 30.0            # of the light's angles
_BENCH_STEP_DEG = 20.0      # of the calibration's
_CIRCULAR = 0.8             # with `_DOLP` nearly all of the light is polarized
_PLATE_NM = 450.0           # of a plate for 550
_WARM_C = 45.0
_CORNERS = {"middle": None, "corner": (0, 0)}


@dataclass(frozen=True, kw_only=True)
class _Case:
    """Parts of a camera, and what is circular of the light or turns it."""

    optics: Mapping[str, Any] = field(default_factory=dict)
    docp: float = 0.0
    plate: Waveplate | None = None
    warm: bool = False


_LENS = LENSES["f2.8"]["lens"]
_CASES = {
    "no lens": _Case(),
    "incidence, f/8": _Case(optics={"lens": dataclasses.replace(
        LENSES["f8"]["lens"], diattenuation=0.0, retardance=0.0)}),
    "incidence, f/2.8": _Case(optics={"lens": dataclasses.replace(
        _LENS, diattenuation=0.0, retardance=0.0)}),
    "glass of the lens": _Case(optics={"lens": Lens(
        diattenuation=_LENS.diattenuation, retardance=_LENS.retardance)}),
    "crosstalk": _Case(optics={"crosstalk": LENSES["f2.8"]["crosstalk"]}),
    "`f2.8`, all of these": _Case(optics=LENSES["f2.8"]),
    "`f2.8`, circular light": _Case(optics=LENSES["f2.8"], docp=_CIRCULAR),
    "quarter-wave plate at 450 nm": _Case(docp=1.0, plate=Waveplate()),
    "dark values 20 K warmer": _Case(warm=True)}
"""What differs from a `nominal` camera before linear light."""


@dataclass(frozen=True)
class Effect:
    """Errors of the mean of a region, over the light's angles.

    Parameters
    ----------
    what, where : str
        The case, and "middle" or "corner" of the sensor.
    aop_deg, dolp : float
        Mean absolute error of AoP, and mean error of DoLP, nothing being calibrated.
    calibrated_aop_deg, calibrated_dolp : float
        The same with the calibration of a bench before the same optics.
    theory_aop_deg, theory_dolp : float
        What the equations of docs/theory/optics.md give for an uncalibrated camera
        whose pixels do not differ; NaN where they have no closed form.
    """

    what: str
    where: str
    aop_deg: float
    dolp: float
    calibrated_aop_deg: float
    calibrated_dolp: float
    theory_aop_deg: float
    theory_dolp: float


def expected(case: str, where: str, ratio: float) -> tuple[float, float]:
    """Return the errors of a polarimeter that reckons with the extinction ratio alone.

    Parameters
    ----------
    case : str
    where : {"middle", "corner"}
    ratio : float
        Extinction ratio of the polarizers.

    Returns
    -------
    aop_deg, dolp : float
        Mean absolute error, and mean error; NaN where there is no closed form.
    """
    one = _CASES[case]
    stated = contrast = (ratio - 1) / (ratio + 1)
    if one.plate is not None:       # S3 becomes linear as the sine of the retardance
        return 0.0, math.sin(one.plate.retardance_at(_PLATE_NM)) - 1
    if one.warm:
        return math.nan, math.nan
    lens, kernel = one.optics.get("lens"), one.optics.get("crosstalk")
    aop = 0.0
    if lens is not None:
        glass = where == "corner" and lens.retardance > 0
        if glass and not one.docp:
            return math.nan, math.nan
        if glass:
            # S3 sin(delta) lies 45 degrees from the glass's axis: the mean over all
            # angles of the light of |sin| is 2 / pi, and AoP is half an angle.
            delta = lens.retardance * _squared_distance()
            aop = math.degrees(one.docp * math.sin(delta) / _DOLP / math.pi)
        cone = math.asin(0.5 / lens.f_number)
        squares = cone**2 / 2 + (
            lens.chief_ray**2 * _squared_distance() if where == "corner" else 0.0)
        ratio /= 1 + squares / lens.half_ratio**2
        contrast = (ratio - 1) / (ratio + 1)
    if kernel is not None:          # neighbours at the sides cancel, corners oppose
        contrast *= 1 - 4 * kernel[0][1] - 8 * kernel[0][0]
    return aop, _DOLP * (contrast / stated - 1) if not (one.docp and aop) else math.nan


def _squared_distance() -> float:
    """Return that of the region in the corner from the middle, 1 at the corner."""
    half = np.array(Sensor.PDAVIS.size) / 2
    return float(((half - _SIDE / 2) @ (half - _SIDE / 2)) / (half @ half))


def effects(settings: Settings) -> Iterator[Effect]:
    """Measure each case, in the middle of the sensor and in a corner."""
    seed = settings.seeds[0]
    for what, case in _CASES.items():
        for where, origin in _CORNERS.items():
            camera = _camera(case, seed, origin)
            bench = _calibrated(camera)
            if case.warm:
                camera = _camera(case, seed, origin, _WARM_C)
            found = [_errors(camera, case, calibration)
                     for calibration in (None, bench)]
            ratio = PRESETS["nominal"]["optics"].extinction_ratio
            yield Effect(what, where, *found[0], *found[1],
                         *expected(what, where, ratio))


def _camera(case: _Case, seed: int, origin: tuple[int, int] | None,
            celsius: float | None = None) -> Camera:
    optics = dataclasses.replace(PRESETS["nominal"]["optics"], **case.optics)
    warm = {} if celsius is None else {"temperature": Temperature(start_c=celsius)}
    return Camera.preset("nominal", seed=seed, size=(_SIDE, _SIDE), origin=origin,
                         optics=optics, dvs=None, **warm)


def _calibrated(camera: Camera) -> Calibration:
    """Return what a bench tells: the dark, and a polarizer before the same optics."""
    dark = dark_frame(camera.record(FlatLight(s0=0.0), _DARK_SECONDS)[0])
    angles = np.deg2rad(np.arange(0.0, 180.0, _BENCH_STEP_DEG))
    fit = fit_sweep(read_sweep(
        [(float(angle), camera.record(FlatLight(dolp=1.0, aop=float(angle)), _SECONDS,
                                      run=run)[0])
         for run, angle in enumerate(angles)], dark=dark.dark))
    return Calibration(sensor_size=camera.size, layout=camera.layout, dark=dark.dark,
                       analyser=fit.analyser, usable=fit.usable)


def _light(case: _Case, aop: float) -> Any:
    if case.plate is None:
        return FlatLight(dolp=_DOLP, aop=aop, docp=case.docp)
    # Circular light, made linear at 45 degrees to the plate's axis.
    plate = dataclasses.replace(case.plate, axis=aop - math.pi / 4)
    return Behind(FlatLight(docp=case.docp), plate.mueller(_PLATE_NM))


def _errors(camera: Camera, case: _Case, calibration: Calibration | None
            ) -> tuple[float, float]:
    """Return the mean absolute error of AoP (degrees), and the mean one of DoLP."""
    turned, dolp = [], []
    for run, degrees in enumerate(np.arange(0.0, 180.0, _STEP_DEG)):
        recording, truth = camera.record(
            _light(case, math.radians(degrees)), _SECONDS, run=run)
        stokes = np.mean([[image.s0.mean(), image.s1.mean(), image.s2.mean()]
                          for image in fuse(recording, method="frames",
                                            demosaic="superpixel",
                                            calibration=calibration)
                          if image.valid.all()], axis=0)      # not before the first
        s0, s1, s2 = (float(np.mean(each)) for each in truth.stokes(0))
        if case.plate is not None:      # the user takes the plate for an ideal one
            s1, s2 = s0 * math.cos(2 * math.radians(degrees)), s0 * math.sin(
                2 * math.radians(degrees))
        error = math.atan2(stokes[2], stokes[1]) - math.atan2(s2, s1)
        turned.append(abs(math.remainder(error, 2 * math.pi)) / 2)
        dolp.append(math.hypot(*stokes[1:]) / stokes[0] - math.hypot(s1, s2) / s0)
    return math.degrees(np.mean(turned)), float(np.mean(dolp))


def effects_page(found: Sequence[Effect]) -> list[str]:
    """Return the Markdown of the table."""
    def both(aop_deg: float, dolp: float) -> str:
        return " / ".join("-" if math.isnan(value) else format(value, form)
                          for value, form in ((aop_deg, ".2f"), (dolp, "+.4f")))

    rows = [(one.what, one.where, both(one.aop_deg, one.dolp),
             both(one.theory_aop_deg, one.theory_dolp),
             both(one.calibrated_aop_deg, one.calibrated_dolp)) for one in found]
    return ["## What a lens, a plate and warmth do", "",
            f"Frames of uniform light of DoLP {_DOLP:g} at six angles, `nominal` "
            f"pixels, the mean of {_SIDE} x {_SIDE}: mean absolute error of AoP in "
            "degrees / mean error of DoLP. Uncalibrated, the data sheet's extinction "
            "ratio is corrected for, and theory is that of pixels that do not differ; "
            "the calibration has dark values and each pixel's response to "
            "a polarizer that turned before the same optics.", "",
            *table(("what", "where", "uncalibrated", "theory", "calibrated"), rows), ""]
