"""The event pixel (DVS): log photoreceptor, low-pass, comparator, and its faults."""
from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdavis_cv._kernels import pixel_events, sort_events
from pdavis_cv._types import Events
from pdavis_cv.events import EVENT_DTYPE, FAR
from pdavis_cv.simulation import noise
from pdavis_cv.simulation.checks import (
    FRACTION,
    LIGHT,
    MOST_HZ,
    Checked,
    positive,
    require,
    ruled,
    within,
)

# Longest interval in time constants of the second pole: the cubic of `_follow` is then
# off by at most 4e-6 of a step of log light.
_POLE_PHASE = 0.2
_LAG_TERMS = 12     # of the series in `lag_weights`: the last is below 1e-16 there

FloatArray = NDArray[np.float64]

_MOST_THETA = 100.0     # more than the range of light
_THETA = within(1e-3, _MOST_THETA)      # from 0.1 % of light
_CUTOFF = within(1e-12, MOST_HZ)    # a period is at most the range of times, 2**61 us
_HZ = within(0, MOST_HZ)


@dataclass(frozen=True, kw_only=True)
class DvsPixel(Checked):
    """Parameters of the event pixel; the defaults are an ideal one.

    Rates and frequencies are at most 500,000, half the rate of the clock, which counts
    microseconds; those per DN/ms and amounts of light at most 1e9.

    Parameters
    ----------
    theta_on, theta_off : float
        Thresholds, natural-log units, .001 to 100; the paper's camera reaches 0.14
        (table S1).
    mismatch : float
        Standard deviation of the thresholds over pixels, ON and OFF independent,
        relative to the threshold; 0.035 (Brandli et al. 2014).
    mismatch_ln : float
        The same in natural-log units; the variances of the two add.
    cutoff_hz : float, optional
        -3 dB frequency of the photoreceptor in any light, at least 1e-12; None and no
        ``cutoff_hz_per_dn_ms``: unlimited.
    cutoff_hz_per_dn_ms : float
        -3 dB frequency per DN/ms of light on the pixel, added to ``cutoff_hz``: the
        photoreceptor's time constant is that of its photocurrent.
    second_pole_hz : float, optional
        -3 dB frequency of the source follower behind the photoreceptor, a second
        first-order low-pass, at least 1e-12; None: none, as in v2e.
    dark_dn_ms : float
        Dark current of the photodiode as an equivalent light, DN per ms.
    refractory_us : float
        Time after an event during which the comparator is held in reset, at most
        2**61 us.
    leak_hz : float
        Rate of ON events of a pixel in the dark and at rest that the reset switch's
        junction leak makes (Nozaki & Delbruck 2017: 0.1 Hz at room temperature).
    leak_sigma : float
        Relative spread of the leak over pixels, at most 1.
    leak_hz_per_dn_ms : float
        Leak events per second and DN/ms of light on the pixel, by the parasitic
        photocurrent of the same switch (Nozaki & Delbruck 2017).
    shot_noise_hz : float
        Rate of noise events of both polarities in the dark, per pixel.  A noise
        event moves the comparator's reference, as in v2e; half of them are ON.
    shot_noise_bright_factor : float
        Fraction of that rate left in bright light; 0.25 (v2e).
    bright_dn_ms : float
        Light at which the fraction is reached; linear from the dark to there.
    hot_fraction, hot_hz : float
        Fraction of hot pixels, and the rate of ON events of each.
    burst_chance : float
        Probability that a pixel makes an event when a frame's exposure starts, and
        again when it ends, by coupling from the frame read-out.
    burst_us : float
        Duration of such a burst, at most a second: its events are uniform in it.
    """

    theta_on: float = ruled(0.15, _THETA)
    theta_off: float = ruled(0.15, _THETA)
    mismatch: float = ruled(0.0, FRACTION)
    mismatch_ln: float = ruled(0.0, within(0, _MOST_THETA))
    cutoff_hz: float | None = ruled(None, _CUTOFF)
    cutoff_hz_per_dn_ms: float = ruled(0.0, LIGHT)
    second_pole_hz: float | None = ruled(None, _CUTOFF)
    dark_dn_ms: float = ruled(0.0, LIGHT)
    refractory_us: float = ruled(0.0, within(0, FAR))
    leak_hz: float = ruled(0.0, _HZ)
    leak_sigma: float = ruled(0.0, FRACTION)
    leak_hz_per_dn_ms: float = ruled(0.0, LIGHT)
    shot_noise_hz: float = ruled(0.0, _HZ)
    shot_noise_bright_factor: float = ruled(0.25, FRACTION)
    bright_dn_ms: float = ruled(51.0, positive, LIGHT)
    hot_fraction: float = ruled(0.0, FRACTION)
    hot_hz: float = ruled(100.0, _HZ)
    burst_chance: float = ruled(0.0, FRACTION)
    burst_us: float = ruled(200.0, positive, within(0, 1e6))

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("theta_on", "theta_off"):
            sigma = math.hypot(self.mismatch * getattr(self, name), self.mismatch_ln)
            which = "mismatch_ln" if self.mismatch_ln else "mismatch"
            require(which, getattr(self, which), sigma < getattr(self, name) / 3,
                    f"keep the spread below a third of {name}")

    @property
    def step_us(self) -> float:
        """Longest sampling interval at which the second pole is exact to 4e-6, us."""
        if self.second_pole_hz is None:
            return math.inf
        return _POLE_PHASE / (2e-6 * math.pi * self.second_pole_hz)

    @property
    def filtered(self) -> bool:
        """Whether the photoreceptor has a finite bandwidth."""
        return self.cutoff_hz is not None or self.cutoff_hz_per_dn_ms > 0

    def maps(
        self, seed: int, size: tuple[int, int], origin: tuple[int, int]
    ) -> dict[str, FloatArray]:
        """Return a specimen's maps, each of shape (H, W).

        Returns
        -------
        dict of ndarray of float64
            ``theta_on`` and ``theta_off`` in natural-log units, kept above a tenth
            of the nominal ones, and ``leak_hz``.
        """
        index = noise.pixel_index(size, origin)
        maps = {}
        for name in ("theta_on", "theta_off"):
            nominal = getattr(self, name)
            sigma = math.hypot(self.mismatch * nominal, self.mismatch_ln)
            drawn = nominal + sigma * noise.normal(seed, name, index)
            maps[name] = np.maximum(drawn, nominal / 10)
        spread = 1 + self.leak_sigma * noise.normal(seed, "leak", index)
        leak = self.leak_hz * np.maximum(spread, 0)
        hot = noise.uniform(seed, "hot", index) < self.hot_fraction
        maps["leak_hz"] = np.where(hot, self.hot_hz, leak)
        return maps


class PixelArray:
    """Event pixels with their state: `advance` turns light into events.

    `maps` are those from `DvsPixel.maps`; `origin` is (row, column) of the first pixel
    on the sensor.
    """

    def __init__(
        self, pixel: DvsPixel, maps: dict[str, FloatArray], seed: int,
        origin: tuple[int, int] = (0, 0),
    ) -> None:
        self.pixel = pixel
        self.size = (maps["theta_on"].shape[0], maps["theta_on"].shape[1])
        n = self.size[0] * self.size[1]
        # Per pixel: ON and OFF threshold (ln), and leak of the reference (ln per us).
        self._pixels = np.empty((n, 3))
        self._pixels[:, 0] = maps["theta_on"].ravel()
        self._pixels[:, 1] = maps["theta_off"].ravel()
        self._pixels[:, 2] = (maps["leak_hz"] * maps["theta_on"]).ravel() / 1e6
        self._nominal = self._pixels[:, :2].copy()
        index = noise.pixel_index(self.size, origin).ravel()
        self._keys = noise.keys(seed, "events", index)
        y, x = np.divmod(np.arange(n), self.size[1])
        self._places = np.stack((x, y), axis=-1).astype(np.uint16)
        # Columns: see `pixel_events` in _simulate.pyx.
        self._state = np.zeros((n, 6))
        self._state[:, 2] = -np.inf
        self._counters = np.zeros(n, np.uint64)
        self._followed = np.zeros(n)  # log light after the second pole
        self._settings = np.array([
            1.0, 0.0, not pixel.filtered,
            2e-6 * np.pi * (pixel.cutoff_hz or 0.0),
            2e-6 * np.pi * pixel.cutoff_hz_per_dn_ms, pixel.refractory_us,
            pixel.shot_noise_bright_factor, pixel.bright_dn_ms, pixel.burst_chance,
            pixel.burst_us, pixel.shot_noise_hz / 1e6, pixel.dark_dn_ms,
            pixel.leak_hz_per_dn_ms / 1e6])

    def scale_thresholds(self, on: float, off: float) -> None:
        """Multiply the nominal thresholds by these factors."""
        self._pixels[:, :2] = self._nominal * (on, off)

    def settle(self, light: FloatArray, rows: slice = slice(None)) -> None:
        """Put pixels into steady state under light, shape (rows, W), DN per ms."""
        part = self._part(rows)
        total = np.maximum(light.ravel() + self.pixel.dark_dn_ms, 1e-9)
        self._state[part, 4] = total
        for column in (0, 1, 5):
            self._state[part, column] = np.log(total)
        self._followed[part] = np.log(total)

    def advance(
        self, start_us: float, step_us: float, light: FloatArray, slope: FloatArray,
        analyser: FloatArray | None = None, *, rows: slice = slice(None),
        edges: FloatArray | None = None, first_edge: int = 0,
    ) -> list[Events]:
        """Return the events of K intervals, pixel by pixel, time-ordered within each.

        The first node is at `start_us`, an interval takes `step_us`.  `light` is that
        on each pixel of these rows at the nodes in DN per ms, float64 (K + 1, rows *
        W), and `slope` its change per interval; or with the pixels' responses to S0,
        S1, S2, `analyser`, (rows * W, 3), the same of S0, S1, S2 for all pixels, (K +
        1, 3).  `edges` are times in us of frame edges whose bursts reach into these
        intervals, the first of which has the index `first_edge` since the recording's
        start.
        """
        part = self._part(rows)
        if self.pixel.second_pole_hz is not None:
            light, slope = self._follow(step_us, light, slope, analyser, part)
            analyser = None
        settings = self._settings.copy()
        settings[0], settings[1] = step_us, start_us
        edges = np.empty(0) if edges is None else edges
        pixels, keys = self._pixels[part], self._keys[part]
        places, state = self._places[part], self._state[part]
        counters = self._counters[part]

        buffer = np.empty(65_536, EVENT_DTYPE)
        parts, done = [], 0
        while done < len(pixels):
            before = done
            done, n = pixel_events(
                light, slope, analyser, pixels, keys, edges, first_edge, settings,
                places, state, counters, done, len(pixels), buffer)
            parts.append(buffer[:n].copy())
            if done == before:
                buffer = np.empty(2 * len(buffer), EVENT_DTYPE)
        return parts

    def _follow(
        self, step_us: float, light: FloatArray, slope: FloatArray,
        analyser: FloatArray | None, part: slice,
    ) -> tuple[FloatArray, FloatArray]:
        """Return light and slopes of each pixel after the second pole's low-pass.

        In a pixel the second pole follows the photoreceptor's; here it comes first:
        linear filters of log light with constant cutoffs commute.  Log light is the
        cubic through its values and slopes at an interval's ends.
        """
        if analyser is not None:
            light, slope = light @ analyser.T, slope @ analyser.T
        dark = self.pixel.dark_dn_ms
        total = np.maximum(light + dark, 1e-9)
        log = np.log(total)
        rise = np.diff(log, axis=0)
        ends = slope / total
        first, last = ends[:-1], ends[1:]
        phi = 2e-6 * math.pi * (self.pixel.second_pole_hz or 0.0) * step_us
        weights = lag_weights(phi)
        cubic = np.stack((log[:-1], first, 3 * rise - 2 * first - last,
                          first + last - 2 * rise))
        followed = np.empty_like(log)
        followed[0] = self._followed[part]
        driven = np.tensordot(weights, cubic, axes=1)
        for k, drive in enumerate(driven):
            followed[k + 1] = math.exp(-phi) * followed[k] + drive
        self._followed[part] = followed[-1]
        seen = np.exp(followed)
        return np.ascontiguousarray(seen - dark), seen * phi * (log - followed)

    def _part(self, rows: slice) -> slice:
        first, last, _ = rows.indices(self.size[0])
        return slice(first * self.size[1], last * self.size[1])


def lag_weights(phi: float) -> FloatArray:
    """Return the response of a first-order low-pass to 1, x, x^2, x^3 at x = 1.

    ``w_n = phi int_0^1 exp(-phi (1 - x)) x^n dx``, where phi is the interval over the
    time constant.  By a series, since the closed form cancels for small phi.
    """
    n = np.arange(4)[:, None]
    # Terms phi^(k+1) n! (-1)^k / (n+k+1)!, the ratio of one to the one before:
    k = np.arange(1, _LAG_TERMS)
    ratios = -phi / (n + k + 1)
    terms = np.cumprod(np.concatenate((phi / (n + 1), ratios), axis=1), axis=1)
    return np.asarray(terms.sum(axis=1))


def in_time_order(parts: list[NDArray[Any]], start_us: int, stop_us: int,
                  ) -> Events:
    """Merge events with start_us <= t <= stop_us; ties stay in pixel order."""
    events = parts[0] if len(parts) == 1 else np.concatenate(
        [np.empty(0, EVENT_DTYPE), *parts])
    out = np.empty_like(events)
    if sort_events(events, start_us, np.empty(stop_us - start_us + 1, np.int32),
                   out) != len(events):
        raise AssertionError("an event lies outside its chunk")
    return out
