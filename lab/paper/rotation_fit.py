"""Find speed, direction and angle of a polarizer that turns before the camera."""
from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pdavis_cv.analyser import stokes_gain
from pdavis_cv.recording.base import ApsFrame, Recording
from pdavis_cv.sensor import CHANNELS, Layout

_LEAST_FRAMES = 6
# Smallest contrast left by the exposure's blur, relative; largest residual, rad.
_LEAST_CONTRAST, _MOST_RESIDUAL = 0.1, 0.2
# Events in bins of this length: speeds to 15,000 RPM.
_BIN_US = 1000
# Two complex waves count as different if they correlate less than this.
_DISTINCT = 0.5

Complex = NDArray[np.complex128]
FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class RotationFit:
    """The light behind a polarizer that turns at a constant speed.

    Parameters
    ----------
    rpm, rpm_sigma : float
        Turns per minute of the polarizer, positive = counter-clockwise as
        displayed, and its standard error.
    angle, angle_sigma : float
        AoP at ``origin_us``, radians in [0, pi), and its standard error, without errors
        that are common to all pixels of the region.
    origin_us : int
        Mean time of the frames, where both errors are independent.
    degree : float
        Degree of polarization, corrected for the blur of the exposure.
    residual : float
        Root mean square deviation of the frames' AoP from the fit, radians, from noise,
        fixed pattern and changes of speed.
    frames : int
        Number of frames used.
    """

    rpm: float
    rpm_sigma: float
    angle: float
    angle_sigma: float
    origin_us: int
    degree: float
    residual: float
    frames: int

    def aop(self, t_us: ArrayLike, x: ArrayLike = 0, y: ArrayLike = 0) -> FloatArray:
        """Return the AoP in radians, [0, pi), the same at every position."""
        t = np.broadcast_arrays(np.asarray(t_us, np.float64), x, y)[0]
        turned = 2 * np.pi * self.rpm / 60e6 * (t - self.origin_us)
        half = np.mod(self.angle + turned, np.pi)
        return np.where(half >= np.pi, 0.0, half)

    def dolp(self, t_us: ArrayLike, x: ArrayLike = 0, y: ArrayLike = 0) -> FloatArray:
        """Return the degree of polarization, the same at every time and position."""
        return np.full(np.broadcast_shapes(
            np.shape(t_us), np.shape(x), np.shape(y)), self.degree)


def fit_rotation(
    recording: Recording, *, layout: Layout | None = None,
    roi: tuple[int, int, int, int] | None = None,
    extinction_ratio: float | None = None,
) -> RotationFit:
    """Fit the rotation of a polarizer to frames and events.

    Events give speed and direction without ambiguity, frames make them precise: the
    polarization of a region's mean at each frame's mid-exposure is z = (S1 + i S2)/S0
    = a exp(2i angle), and speed and a are fitted by least squares.

    Parameters
    ----------
    recording : Recording
        Frames and events of a polarizer that turns at a constant speed.
    layout : Layout, optional
        Polarizers of the whole sensor; default the recording's.
    roi : (int, int, int, int), optional
        (x, y, width, height) in sensor pixels, filled by the polarizer; default all.
    extinction_ratio : float, optional
        Extinction ratio of the pixels' polarizers, for which S1 and S2 are corrected.

    Returns
    -------
    RotationFit

    Raises
    ------
    ValueError
        If there is no layout, no event, or too few usable frames; if nothing turns at a
        constant speed; or if the exposure blurs all polarization.

    Notes
    -----
    For N frames over a time T, each with an AoP error s, the standard error of the
    speed is s sqrt(12/N)/T, and that of the angle at ``origin_us`` is s/sqrt(N).  s is
    estimated from the residuals.
    """
    layout = recording.info.layout if layout is None else layout
    if layout is None:
        raise ValueError("layout must be given, as the recording does not say it")
    height, width = recording.info.sensor_size
    x, y, w, h = roi or (0, 0, width, height)
    rows, columns = slice(y, y + h), slice(x, x + w)
    angles = np.asarray(layout.angles_deg)[np.arange(height)[:, None] % 2,
                                           np.arange(width) % 2]
    t, z, exposure_us, count = _frames(recording, rows, columns, angles[rows, columns])
    if len(t) < _LEAST_FRAMES:
        raise ValueError(
            f"recording must have {_LEAST_FRAMES} frames or more that are usable in "
            f"the region, got {len(t)} of {count}"
            + "; the others are saturated or dark" * (count > len(t)))
    origin = round(float(t.mean()))
    t -= origin
    z *= stokes_gain(extinction_ratio)
    hz = _of_events(recording, rows, columns, angles)
    contrast = float(np.sinc(hz * exposure_us / 1e6))
    if abs(contrast) < _LEAST_CONTRAST:
        raise ValueError(
            f"recording must be exposed for less or more than {exposure_us / 1000:g} ms"
            f": at {30 * abs(hz):.0f} turns per minute that blurs all polarization")
    near = hz + 1e6 / np.ptp(t) * np.linspace(-1.5, 1.5, 61)
    others = _nuisances(t, near)
    hz = _refined(t, z, near, others)
    model = _basis(t, hz, others)
    weights = np.linalg.lstsq(model, z, rcond=None)[0]
    if not abs(weights[0]) > 0:
        raise ValueError("recording must show a polarizer that turns; what its frames "
                         "show is not polarized")
    contrast = float(np.sinc(hz * exposure_us / 1e6))
    # An exposure longer than a cycle inverts the wave, so the sign matters.
    wave = weights[0] / contrast
    rest = z - model @ weights
    # Half of the residual's power is an error of phase; AoP is half the phase.
    freedom = max(2 * len(t) - 2 * model.shape[1] - 1, 1)
    noise = np.sqrt((np.abs(rest) ** 2).sum() / freedom) / abs(weights[0]) / 2
    if noise > _MOST_RESIDUAL:
        raise ValueError(
            "recording must show a polarizer that turns at a constant speed; frames "
            f"differ from {30 * hz:.2f} turns per minute by {np.rad2deg(noise):.0f} "
            "degrees")
    spread = np.sqrt((t**2).sum())
    angle = float(np.angle(wave) / 2 % np.pi)
    return RotationFit(
        rpm=30 * hz, rpm_sigma=float(noise / spread / (2 * np.pi) * 60e6),
        angle=0.0 if angle >= np.pi else angle,
        angle_sigma=float(noise / np.sqrt(len(t))), origin_us=origin,
        degree=float(abs(wave)),
        residual=float(noise), frames=len(t))


def _frames(
    recording: Recording, rows: slice, columns: slice, angles: NDArray[np.int64]
) -> tuple[FloatArray, Complex, float, int]:
    """Return times, polarization, exposure of usable frames; the number of frames."""
    t, z, exposures, count = [], [], [], 0
    for packet in recording.packets():
        for frame in packet.frames:
            count += 1
            means = _channels(frame.cropped(rows, columns), angles)
            if means is None:
                continue
            i0, i45, i90, i135 = means
            s0 = (i0 + i45 + i90 + i135) / 2
            if s0 > 0:
                t.append(float(np.mean(frame.column_mid_us[columns])))
                z.append((i0 - i90 + 1j * (i45 - i135)) / s0)
                exposures.append(frame.exposure_ms * 1000)
    return np.array(t), np.array(z), float(np.mean(exposures)) if t else 0.0, count


def _channels(frame: ApsFrame, angles: NDArray[np.int64]) -> list[float] | None:
    """Return the mean of each channel, None if half of one is not valid."""
    means = []
    for channel in CHANNELS:
        here = angles == channel
        usable = here if frame.valid is None else here & frame.valid
        if not 2 * usable.sum() > here.sum():
            return None
        means.append(float(frame.dn[usable].mean(dtype=np.float64)))
    return means


def _of_events(
    recording: Recording, rows: slice, columns: slice, angles: NDArray[np.int64]
) -> float:
    """Return the signed frequency of AoP cycles from the events, Hz.

    Each event contributes p exp(2i a), where a is the angle of its polarizer.  The sum
    follows exp(2i AoP), with harmonics at -3, 5, ... times its frequency that are
    weaker by these factors.
    """
    events = recording.events()
    events = events[(events["x"] >= columns.start) & (events["x"] < columns.stop)
                    & (events["y"] >= rows.start) & (events["y"] < rows.stop)]
    if len(events) < 100:
        raise ValueError(
            f"recording must have events in the region, got {len(events)}")
    t = (events["t"] - events["t"][0]) // _BIN_US
    n = int(t[-1]) + 1
    step = np.where(events["p"] > 0, 1, -1) * np.exp(
        2j * np.deg2rad(angles[events["y"], events["x"]]))
    rate = (np.bincount(t, step.real, n) + 1j * np.bincount(t, step.imag, n))
    # Zero-padded, so that a peak between two frequencies is found.
    size = 1 << (2 * n - 1).bit_length()
    spectrum = np.fft.fft((rate - rate.mean()) * np.hanning(n), size)
    hz = np.fft.fftfreq(size, _BIN_US / 1e6)
    known = np.abs(hz) * n * _BIN_US / 1e6 >= 2
    if not known.any():
        raise ValueError("recording must be longer, got two bins of events")
    power = np.zeros(size)
    power[known] = np.abs(spectrum[known]) / np.abs(hz[known])
    best = int(np.argmax(power))
    if power[best] < 8 * np.median(power[known]):
        raise ValueError("recording must show something that turns; no speed stands "
                         "out in its events")
    return float(hz[best])


def _refined(
    t: FloatArray, z: Complex, near: FloatArray, others: tuple[int, ...]
) -> float:
    """Return the frequency that fits the frames best, among those near."""
    from scipy.optimize import minimize_scalar  # slow to load

    def misfit(hz: float) -> float:
        model = _basis(t, hz, others)
        weights = np.linalg.lstsq(model, z, rcond=None)[0]
        return float((np.abs(z - model @ weights) ** 2).sum())

    step = near[1] - near[0]
    middle = near[int(np.argmin([misfit(hz) for hz in near]))]
    found = minimize_scalar(misfit, bounds=(middle - step, middle + step),
                            method="bounded", options={"xatol": step * 1e-6})
    return float(found.x)


def _basis(t: FloatArray, hz: float, others: tuple[int, ...]) -> Complex:
    """Return the wave and its powers ``others``."""
    phase = 2e-6 * np.pi * hz * t
    return np.stack([np.exp(1j * k * phase) for k in (1, *others)], 1)


def _nuisances(t: FloatArray, near: FloatArray) -> tuple[int, ...]:
    """Return the terms that unequal channels cause: an offset, the conjugate wave.

    Terms that the frames' times do not separate from the wave or from each other are
    left out.
    """
    kept: list[int] = []
    for k in (0, -1):
        apart = [abs(np.exp(2e-6j * np.pi * np.outer(near, t) * (k - other)).mean(1))
                 for other in (1, *kept)]
        if np.max(apart) < _DISTINCT:
            kept.append(k)
    return tuple(kept)
