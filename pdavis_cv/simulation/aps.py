"""The frame pixel (APS): exposure integral, reset and signal reads, converter."""
from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from pdavis_cv.events import FAR
from pdavis_cv.recording.base import ApsFrame
from pdavis_cv.simulation import noise
from pdavis_cv.simulation.checks import (
    MOST_DN,
    Checked,
    positive,
    require,
    ruled,
    that,
    whole,
    within,
)

FloatArray = NDArray[np.float64]

_DN = within(0, MOST_DN)
# A frame takes at most the range of times; in a piece of 10 ms there are at most 1000.
_MOST_READOUT_US = 10_000_000


@dataclass(frozen=True, kw_only=True)
class ApsPixel(Checked):
    """Parameters of the frame pixel and its clock; the defaults are an ideal one.

    Levels, noise and rates are at most 2**24: float32 resolves 1 DN up to there.

    Parameters
    ----------
    fps : float
        Frames per second, 1e-12 to 100,000; frame k is exposed from k / fps on.
    exposure_us, readout_us : int
        Exposure, and time from its end until the frame is available, at most 10 s.
    shutter : {"global", "rolling"}
        Rolling: columns are exposed one after the other, over ``readout_us``.
    adc_bits : int, optional
        Bits of the converter; None keeps floats, without reads and limits.
    full_well_dn : float
        Signal at which a pixel saturates, before the converter does.
    reset_dn : float, optional
        Mean level of the reset read; the paper's camera reads 800 +- 24 DN.  None:
        a sensor that delivers the difference only (Sony).
    reset_fpn_dn, offset_fpn_dn : float
        Standard deviation over pixels of the reset level, which correlated double
        sampling removes, and of the offset that remains after it.
    ktc_dn : float
        Reset (kTC) noise, common to the reset and the signal read.
    read_noise_dn : float
        Noise of each read; 200 electrons (Haessig, table S1).
    electrons_per_dn : float, optional
        Gives photon shot noise; None: none.
    dark_dn_s : float
        Dark current in DN per second of exposure; 1200 electrons/s (table S1).
    black_level_dn : float
        What a frame reads too little, DN; below it, it reads 0.  Events follow the log
        of all the light, so frames and events disagree where it is dim.
    """

    fps: float = ruled(20.0, within(1e-12, 1e5))
    exposure_us: int = ruled(20_000, whole(1, FAR))
    readout_us: int = ruled(12_000, whole(0, _MOST_READOUT_US))
    shutter: Literal["global", "rolling"] = ruled("global", that(
        lambda name: isinstance(name, str) and name in ("global", "rolling"),
        "be 'global' or 'rolling'"))
    adc_bits: int | None = ruled(None, whole(1, 16))
    full_well_dn: float = ruled(
        math.inf, within(0, math.inf), that(lambda dn: dn > 0, "be positive"))
    reset_dn: float | None = ruled(None, positive, _DN)
    reset_fpn_dn: float = ruled(0.0, _DN)
    offset_fpn_dn: float = ruled(0.0, _DN)
    ktc_dn: float = ruled(0.0, _DN)
    read_noise_dn: float = ruled(0.0, _DN)
    electrons_per_dn: float | None = ruled(None, positive, _DN)
    dark_dn_s: float = ruled(0.0, _DN)
    black_level_dn: float = ruled(0.0, _DN)

    def __post_init__(self) -> None:
        super().__post_init__()
        require("exposure_us", self.exposure_us, self.exposure_us * self.fps <= 1e6,
                f"be at most the frame interval at {self.fps:g} fps")

    @property
    def full_scale_dn(self) -> int:
        """Largest code of the converter, DN."""
        return 1023 if self.adc_bits is None else 2**self.adc_bits - 1

    def maps(
        self, seed: int, size: tuple[int, int], origin: tuple[int, int]
    ) -> dict[str, FloatArray]:
        """Return a specimen's maps: ``reset_dn`` and ``dark_dn``, shape (H, W).

        ``dark_dn`` is the mean of dark frames after correlated double sampling,
        without a black level.
        """
        index = noise.pixel_index(size, origin)
        reset = (self.reset_dn or 0.0) + self.reset_fpn_dn * noise.normal(
            seed, "reset level", index)
        dark = self.offset_fpn_dn * noise.normal(seed, "offset", index)
        return {"reset_dn": reset,
                "dark_dn": dark + self.dark_dn_s * self.exposure_us / 1e6}

    def digitise(
        self, signal_dn: FloatArray, maps: dict[str, FloatArray], seed: int,
        frame: int, origin: tuple[int, int],
    ) -> dict[str, NDArray[np.generic] | None]:
        """Convert an exposure integral to the converter's output.

        Parameters
        ----------
        signal_dn : ndarray of float64, shape (H, W)
            Light integrated over the exposure, DN.
        maps : mapping of str to ndarray
            Result of `maps`.
        seed : int
            Seed of the noise.
        frame : int
            Number of the frame since the recording's start.
        origin : (int, int)
            (row, column) of the first pixel on the sensor.

        Returns
        -------
        dict
            ``dn`` float (H, W), ``valid`` bool or None, ``reset`` and ``signal``
            uint16 or None: arguments of `ApsFrame`.
        """
        size = (signal_dn.shape[0], signal_dn.shape[1])
        index = noise.pixel_index(size, origin)

        def draw(purpose: str, sigma: float) -> FloatArray | float:
            return sigma * noise.normal(seed, purpose, index, frame) if sigma else 0.0

        dark = self.dark_dn_s * self.exposure_us / 1e6
        collected = signal_dn
        if self.electrons_per_dn is not None:
            electrons = (signal_dn + dark) * self.electrons_per_dn
            shot = np.sqrt(np.maximum(electrons, 0)) / self.electrons_per_dn
            collected = signal_dn + shot * noise.normal(
                seed, "photon shot noise", index, frame)
        # A float, as NumPy 1 makes objects of a large int.
        collected = np.minimum(collected + maps["dark_dn"], float(self.full_well_dn))
        full_well_dn = self.full_well_dn - self.black_level_dn
        if self.black_level_dn:
            collected = np.maximum(collected - self.black_level_dn, 0)
        if self.adc_bits is None:
            dn = collected + draw("signal read", self.read_noise_dn)
            return {"dn": dn, "valid": None, "reset": None, "signal": None}
        top = self.full_scale_dn
        if self.reset_dn is None:
            dn = collected + draw("signal read", self.read_noise_dn)
            dn = np.clip(np.rint(dn), 0, top)
            return {"dn": dn, "valid": dn < min(top, full_well_dn),
                    "reset": None, "signal": None}
        level = maps["reset_dn"] + draw("reset noise", self.ktc_dn)
        reset = np.clip(np.rint(level + draw("reset read", self.read_noise_dn)), 0, top)
        signal = np.clip(np.rint(level - collected + draw(
            "signal read", self.read_noise_dn)), 0, top)
        dn = reset - signal
        # A pixel's clip level is known only up to its noise.
        clip = full_well_dn - 4 * self.read_noise_dn
        valid = (signal > 2) & (reset >= 384) & (dn < clip)
        return {"dn": dn, "valid": valid, "reset": reset.astype(np.uint16),
                "signal": signal.astype(np.uint16)}


class FrameClock:
    """Exposures on the recording's clock, and integrals of light over them.

    `width` is the number of columns of the sensor.
    """

    def __init__(self, pixel: ApsPixel, width: int) -> None:
        self.pixel, self.width = pixel, width

    def start_us(self, frame: int) -> int:
        """Start of the exposure of a frame (of column 0)."""
        return round(frame * 1e6 / self.pixel.fps)

    def available_us(self, frame: int) -> int:
        """Time at which a frame has been read out, us."""
        pixel = self.pixel
        return self.start_us(frame) + pixel.exposure_us + pixel.readout_us

    def frames(self, start_us: float, stop_us: float) -> range:
        """Frames that collect light or wait for read-out within [start, stop)."""
        period = 1e6 / self.pixel.fps
        span = self.pixel.exposure_us + self.pixel.readout_us
        first = max(0, math.floor((start_us - span) / period))
        found = [k for k in range(first, math.ceil(stop_us / period) + 1)
                 if self.start_us(k) < stop_us and self.available_us(k) > start_us]
        return range(found[0], found[-1] + 1) if found else range(0)

    def edges(self, start_us: float, stop_us: float, width_us: float
              ) -> tuple[FloatArray, int]:
        """Find exposure starts and ends whose bursts reach into [start, stop).

        A burst of events lasts `width_us`, `DvsPixel.burst_us`.  Returns the times in
        (start - width, stop), us, and the index of the first, 2 k for the start of
        frame k, 2 k + 1 for its end: the random numbers of a burst depend on it.
        """
        frames = self.frames(start_us - width_us, stop_us)
        times = [(2 * k + i, self.start_us(k) + i * self.pixel.exposure_us)
                 for k in frames for i in (0, 1)]
        kept = [(n, t) for n, t in times if start_us - width_us < t < stop_us]
        return (np.array([t for _, t in kept], np.float64), kept[0][0] if kept else 0)

    def exposure(self, frame: int) -> tuple[FloatArray, FloatArray]:
        """Start and end of each column's exposure, us; shape (1,) if all are equal."""
        start = np.array([float(self.start_us(frame))])
        if self.pixel.shutter == "rolling":
            start = np.rint(start + np.arange(self.width) * (
                self.pixel.readout_us / self.width))
        return start, start + self.pixel.exposure_us

    def weights(
        self, frame: int, start_us: float, step_us: float, intervals: int,
    ) -> FloatArray:
        """Quadrature weights of light at the nodes for a frame's exposure integral.

        Nodes lie at start_us + k step_us, k = 0..intervals.  Returns float64 (intervals
        + 5, 1), or (intervals + 5, W) where columns differ; DN = sum of weights times
        DN per ms.  Light is a cubic Hermite spline with the slopes of `node_slopes`,
        for which two more nodes at each end get weights.
        """
        start, end = self.exposure(frame)
        return integral_weights(start, end, start_us, step_us, intervals)


def node_slopes(light: FloatArray) -> FloatArray:
    """Slopes per interval at all nodes but two at each end (five-point formula)."""
    return (light[:-4] - light[4:] + 8 * (light[3:-1] - light[1:-3])) / 12


def integral_weights(
    start: FloatArray, end: FloatArray, origin_us: float, step_us: float,
    intervals: int,
) -> FloatArray:
    """Weights of node values in the integral from start to end; see `FrameClock`."""
    if np.all(end <= origin_us) or np.all(start >= origin_us + step_us * intervals):
        return np.zeros((intervals + 5, len(start)))
    left = np.clip((start - origin_us) / step_us - np.arange(intervals)[:, None], 0, 1)
    right = np.clip((end - origin_us) / step_us - np.arange(intervals)[:, None], 0, 1)

    def basis(s: FloatArray) -> tuple[FloatArray, ...]:
        return (s - s**3 + s**4 / 2, s**3 - s**4 / 2,
                s**2 / 2 - s**3 * (2 / 3) + s**4 / 4, s**4 / 4 - s**3 / 3)

    part = [b - a for a, b in zip(basis(left), basis(right), strict=True)]
    columns = part[0].shape[1]
    values = np.zeros((intervals + 1, columns))
    values[:-1] += part[0]
    values[1:] += part[1]
    slopes = np.zeros((intervals + 1, columns))
    slopes[:-1] += part[2]
    slopes[1:] += part[3]
    weights = np.zeros((intervals + 5, columns))
    weights[2:-2] = values
    for offset, factor in ((0, 1), (1, -8), (3, 8), (4, -1)):
        weights[offset:offset + intervals + 1] += slopes * (factor / 12)
    return weights * (step_us / 1000)


def make_frame(
    clock: FrameClock, frame: int, digitised: dict[str, NDArray[np.generic] | None],
    offset_us: int = 0,
) -> ApsFrame:
    """Build the `ApsFrame` of one exposure, its stamps shifted by offset_us."""
    start, end = (t + offset_us for t in clock.exposure(frame))
    rolling = clock.pixel.shutter == "rolling"
    end_us = int(end[-1])
    return ApsFrame(
        digitised["dn"],  # type: ignore[arg-type]
        start.astype(np.int64) if rolling else int(start[0]),
        end.astype(np.int64) if rolling else end_us,
        valid=digitised["valid"],  # type: ignore[arg-type]
        available_us=max(clock.available_us(frame), end_us),
        full_scale_dn=clock.pixel.full_scale_dn,
        reset=digitised["reset"],  # type: ignore[arg-type]
        signal=digitised["signal"])  # type: ignore[arg-type]
