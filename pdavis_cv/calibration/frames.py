"""Dark and flat frames, and detection of unusable pixels."""
from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pdavis_cv._checks import fitting, floats
from pdavis_cv.recording.base import ApsFrame, Recording

_MAD = 1.4826
"""Standard deviation of a normal distribution per median absolute deviation."""
SIGMAS = 6.0
"""Robust standard deviations of a hot or noisy pixel: one good pixel in 10^9 is."""
_PLAUSIBLE = 0.5, 2.0
"""Least and largest response of a pixel relative to the median: published arrays vary
by up to 20 % [Powell 2013]."""


class Mean(NamedTuple):
    """Mean and scatter of frames of a constant scene.

    Attributes
    ----------
    mean : ndarray of float64, shape (H, W)
        DN; NaN where no sample was valid.
    noise : ndarray of float64, shape (H, W)
        Standard deviation of one frame, DN; NaN where fewer than two samples.
    samples : ndarray of int32, shape (H, W)
        Number of valid samples.
    zeros : ndarray of int32, shape (H, W)
        Number of samples that were 0, if none was negative.
    step : float
        Smallest sample above 0, DN: the converter's step if samples are integers.
    """

    mean: NDArray[np.float64]
    noise: NDArray[np.float64]
    samples: NDArray[np.int32]
    zeros: NDArray[np.int32]
    step: float


class Dark(NamedTuple):
    """Dark offset of the pixels.

    Attributes
    ----------
    dark : ndarray of float32, shape (H, W)
        Mean of the dark frames, DN.
    noise : ndarray of float32, shape (H, W)
        Standard deviation of one frame, DN.
    usable : ndarray of bool, shape (H, W)
        False for hot and noisy pixels.
    frames : int
        Number of frames used.
    clamped : float
        Fraction of samples that are 0 in a file without negative values; `dark_frame`
        infers what these samples were before they were clamped.
    """

    dark: NDArray[np.float32]
    noise: NDArray[np.float32]
    usable: NDArray[np.bool_]
    frames: int
    clamped: float = 0.0


class Flat(NamedTuple):
    """Gain that equalizes the pixels under uniform, unpolarized light.

    Attributes
    ----------
    gain : ndarray of float32, shape (H, W)
        Factor for dark-subtracted DN; 1 where it could not be measured.
    usable : ndarray of bool, shape (H, W)
        False for dead and strongly deviating pixels.
    frames : int
        Number of frames used.
    """

    gain: NDArray[np.float32]
    usable: NDArray[np.bool_]
    frames: int


def frames_of(
    source: Recording | Iterable[ApsFrame],
    start_us: int | None = None,
    stop_us: int | None = None,
) -> Iterator[ApsFrame]:
    """Iterate over the frames whose exposure lies in [start_us, stop_us)."""
    frames = (frame for packet in source.packets(start_us) for frame in packet.frames
              ) if isinstance(source, Recording) else iter(source)
    for frame in frames:
        if stop_us is not None and np.min(frame.exposure_start_us) >= stop_us:
            return
        if (start_us is None or np.min(frame.exposure_start_us) >= start_us) and (
                stop_us is None or np.max(frame.exposure_end_us) <= stop_us):
            yield frame


def mean_frame(frames: Iterable[ApsFrame]) -> tuple[Mean, int]:
    """Average frames of a constant scene, in bounded memory.

    Returns
    -------
    mean : Mean
    frames : int
        Number of frames.

    Raises
    ------
    ValueError
        If there is no frame, or their shapes differ.
    """
    n, sums = 0, None
    for frame in frames:
        if sums is None:
            # Sum differences from the first frame, to keep precision.
            sums = _Sums(frame.dn.astype(np.float64))
        elif frame.shape != sums.origin.shape:
            raise ValueError(
                f"frames must have one shape, got {sums.origin.shape} and "
                f"{frame.shape}")
        sums.add(frame)
        n += 1
    if sums is None:
        raise ValueError("frames must hold at least one frame, got none")
    return sums.mean(), n


class _Sums:
    def __init__(self, origin: NDArray[np.float64]) -> None:
        self.origin = origin
        self.total, self.square = np.zeros_like(origin), np.zeros_like(origin)
        self.count = np.zeros(origin.shape, np.int32)
        self.zeros = np.zeros(origin.shape, np.int32)
        self.signed, self.step = False, np.inf

    def add(self, frame: ApsFrame) -> None:
        difference = frame.dn - self.origin
        valid = True if frame.valid is None else frame.valid
        np.add(self.total, difference, out=self.total, where=valid)
        np.add(self.square, difference * difference, out=self.square, where=valid)
        self.count += valid
        self.zeros += (frame.dn == 0) & valid
        self.signed |= bool(np.any(frame.dn < 0, where=valid))
        self.step = min(self.step, float(np.min(
            frame.dn, where=(frame.dn > 0) & valid, initial=np.inf)))

    def mean(self) -> Mean:
        with np.errstate(invalid="ignore", divide="ignore"):
            mean = self.total / self.count
            variance = (self.square - self.count * mean**2) / (self.count - 1)
        return Mean(mean + self.origin, np.sqrt(np.maximum(variance, 0)), self.count,
                    np.zeros_like(self.zeros) if self.signed else self.zeros,
                    self.step)


def dark_frame(frames: Recording | Iterable[ApsFrame]) -> Dark:
    """Measure the dark offset from frames of a covered camera (100 in the paper).

    A pixel is hot when its mean lies more than six robust standard deviations
    (of the means of all pixels, and of its own error) above the median, and noisy
    when the log of its noise does the same.

    AEDAT-4 and other formats of unsigned numbers store negative samples as 0, which
    raises the mean of a dark pixel.  If there is no negative sample, the samples are
    taken as a normal distribution censored at 0 (Tobin 1958), whose mean is found from
    the mean of the samples and the number of zeros.

    Parameters
    ----------
    frames : Recording or iterable of ApsFrame
        At least two frames.

    Raises
    ------
    ValueError
        If there are fewer than two frames.
    """
    mean, n = mean_frame(frames_of(frames))
    if n < 2:
        raise ValueError(f"a dark frame needs at least two frames, got {n}")
    clamped = float(np.sum(mean.zeros)) / max(int(np.sum(mean.samples)), 1)
    mean = _uncensored(mean)
    dark = np.where(mean.samples > 0, mean.mean, np.nanmedian(mean.mean))
    center, spread = _robust(mean.mean)
    noise = np.where(mean.samples > 1, mean.noise, np.nanmedian(mean.noise))
    own = noise / np.sqrt(np.maximum(mean.samples, 1))
    hot = dark - center > SIGMAS * np.hypot(spread, own)
    # The added DN of quantisation gives a scale to a sensor without any noise.
    log_noise = np.log(noise + 1)
    middle, scale = _robust(log_noise)
    noisy = log_noise - middle > SIGMAS * max(scale, 1 / np.sqrt(2 * n))
    return Dark(dark.astype(np.float32), noise.astype(np.float32),
                ~(hot | noisy) & (mean.samples > 0), n, clamped)


_DEPTH = np.linspace(-2.5, 8, 211)
"""Grid of mean / sigma before censoring; below it, all of 100 samples would be 0."""
_MOST_STEPS = 200   # of the converter, at least 3 sigma of the noisiest (64 steps)
_HALVINGS = 40      # of a range of 2^9: far below rounding


def _uncensored(mean: Mean) -> Mean:
    """Return mean and noise of the samples before negative ones were stored as 0.

    A normal distribution (mu, sigma), rounded to steps of h and censored at 0, has the
    mean sum over k >= 1 of h Q((k h - h / 2 - mu) / sigma), where Q = 1 - Phi, and the
    probability Phi((h / 2 - mu) / sigma) of a zero.  The mean of each pixel determines
    its mu; the common sigma is the one that predicts the number of zeros.
    """
    cut = (mean.zeros > 0) & (mean.mean > 0)
    if not cut.any():
        return mean
    from scipy.special import ndtr  # slow to load

    step = mean.step
    above = (np.arange(1, _MOST_STEPS) - 0.5)[:, None] * step
    share = float(np.sum(mean.zeros[cut] / mean.samples[cut]))

    def left(sigma: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        mu = sigma * _DEPTH
        return mu, step * ndtr((mu - above) / sigma).sum(axis=0)

    low, high = step / 8, 64 * step
    for _ in range(_HALVINGS):  # bisection: at the same mean, more noise is more zeros
        sigma = float(np.sqrt(low * high))
        mu, rest = left(sigma)
        zeros = ndtr((step / 2 - np.interp(mean.mean[cut], rest, mu)) / sigma).sum()
        low, high = (sigma, high) if zeros < share else (low, sigma)
    lost = mean.zeros > 0
    middle, noise = mean.mean.copy(), mean.noise.copy()
    middle[lost] = np.interp(mean.mean[lost], rest, mu)
    # Censoring only reduces the noise, so a larger measured value is kept.
    noise[lost] = np.maximum(noise[lost], sigma)
    return mean._replace(mean=middle, noise=noise)


def flat_frame(
    frames: Recording | Iterable[ApsFrame],
    dark: NDArray[np.float32] | None = None,
) -> Flat:
    """Measure each pixel's gain under uniform, unpolarized light.

    A pixel is dead or deviating if its response lies outside .5 to 2 times the median.
    All four channels share one median, as all polarizers transmit unpolarized
    light equally.

    Parameters
    ----------
    frames : Recording or iterable of ApsFrame
    dark : ndarray of float32, shape (H, W), optional
        Subtracted from the mean.

    Raises
    ------
    ValueError
        If there is no frame, or the light is too dim for a measurement.
    """
    mean, n = mean_frame(frames_of(frames))
    response = mean.mean if dark is None else mean.mean - fitting(
        "dark", floats("dark", dark), mean.mean.shape)
    center = float(np.nanmedian(response))
    if not center > 1:
        raise ValueError(
            f"a flat frame needs light: its median response is {center:.3g} DN")
    with np.errstate(invalid="ignore"):
        usable = (response > _PLAUSIBLE[0] * center) & (
            response < _PLAUSIBLE[1] * center)
    gain = np.divide(center, response, out=np.ones_like(response), where=usable)
    return Flat(gain.astype(np.float32), usable, n)


def _robust(values: NDArray[np.float64]) -> tuple[float, float]:
    """Return the median and a standard deviation that is robust against outliers."""
    center = float(np.nanmedian(values))
    return center, _MAD * float(np.nanmedian(np.abs(values - center)))
