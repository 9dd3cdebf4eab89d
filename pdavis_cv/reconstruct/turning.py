"""Polarization per pixel from the events behind a turning analyser."""
from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pdavis_cv import _kernels
from pdavis_cv._checks import checked_threshold, positive, sensor_shape
from pdavis_cv._types import Events, Records
from pdavis_cv.events import checked_time, timed_events
from pdavis_cv.reconstruct.frames import log_samples
from pdavis_cv.reconstruct.stream_clock import StreamClock
from pdavis_cv.recording.base import ApsFrame
from pdavis_cv.turning import PulseClock, turned

Plane = NDArray[np.float32]

_CELL = np.dtype([("t", "f8"), *((name, "f4") for name in (
    "s1 s2 a11 a12 a22 b1 b2 yy n scale on off sign rest").split())])
_LASTING = np.dtype([(name, "f4") for name in (
    "c s l11 l12 l22 m1 m2 zz n1 g1 h1 y1 n0 g0 h0 y0").split()])
"""As ``turning_cell_t`` and ``turning_lasting_t`` of the kernel."""

_FIRST_SPREAD, _OWN_SPREAD = 0.3, 0.06
"""Errors of ln threshold of a pixel before and after the mean of all pixels is known:
thresholds of sensors that were measured spread by .03 to .05."""
_BOTH = math.sqrt(0.5)      # error of the mean of two thresholds, ON and OFF, relative
_COMMON = 0.03
"""Error of ln of the mean threshold where strongly polarized pixels told it."""
_STILL_PIXELS = 16
"""Least pixels that tell what all have in common."""
_LOOKS = 4, 64
"""Half turns after which thresholds are first estimated, and at most between two."""
_LATE = 0.5, 1.0
"""Part of the drift of q over the rows' mean age that is its error, centred and not."""
_LEAST_LEARNT = 8.0     # rows of a pixel whose thresholds are learned
_STILL = 0.08           # most error of a row where only the analyser turns
_SPOILT = 64            # rows after which one where it is more begins anew
_STRONG = 0.3           # degree at which the curve's shape tells thresholds
_LONGEST_STEP = 0.2     # of ln threshold at once
_AGAIN = 5              # most estimates at one time, until their mean stays

_ROW_FLOOR = 0.02       # least error of an event's row, thresholds
_WIDE = 0.5             # of q where nothing is known of it
_LEAST_DET = 1e-20


class Polarization(NamedTuple):
    """What a `TurningRegression` knows at one time.

    `quad` is I0, I45, I90, I135, float32 (4, H, W), relative unless frames tell S0;
    `sigmas`, (3, H, W), are the errors of AoP (radians), of DoLP, and of (S1, S2)/S0
    across its direction; `valid` is bool, (H, W).
    """

    quad: Plane
    sigmas: Plane
    valid: NDArray[np.bool_]


class TurningRegression:
    """Regress each pixel's events on the angle of a turning analyser.

    Behind it the light is S0/2 (1 + q1 cos 2a + q2 sin 2a), with q = (S1, S2)/S0.  From
    one event of a pixel to the next its log changes by a threshold: an equation that is
    linear in q and needs no level.  They are solved by weighted least squares, older
    ones with less weight.  Pixels need no neighbours, and no layout.

    Parameters
    ----------
    shape : (int, int)
        (height, width).
    theta_on, theta_off : float, or array_like of shape (H, W)
        Contrast thresholds, positive, in natural-log units.
    segments : array_like of shape (M, 3), or PulseClock
        Twice the angle of the analyser; see `TurningAnalyser.segments`.
    half_turns : float
        Window in half turns.  Rows fade with half of it as their time constant, which
        is as noisy and as old as a window with edges.
    centred : bool
        Use as much after the time of an image as before it; not with a clock.
    learn : bool
        Estimate each pixel's thresholds: their ratio, and from strongly polarized light
        their size, which the shape of the curve tells.
    threshold_sigma : float
        Relative error of the stated thresholds that all pixels have in common.
    own_sigma : float, or array_like of shape (H, W)
        Relative error of the mean of a pixel's own thresholds.

    `half_us` is the median time of half a turn, with a clock that after its last pulse,
    `lookahead_us` the time after an image whose events it uses; `segments` are known so
    far, as are the relative errors `common_sigma` of all thresholds, and `own_sigma`,
    (H, W), of the mean of each pixel's.
    """

    def __init__(
        self, shape: Sequence[int], *, theta_on: ArrayLike, theta_off: ArrayLike,
        segments: ArrayLike | PulseClock, half_turns: float = 1.0, centred: bool = True,
        learn: bool = True, threshold_sigma: float = 0.5,
        own_sigma: ArrayLike = _BOTH * _OWN_SPREAD,
    ) -> None:
        self.shape = sensor_shape(shape)
        thetas = [checked_threshold(name, given, self.shape) for name, given in (
            ("theta_on", theta_on), ("theta_off", theta_off))]
        self._half_turns = positive("half_turns", half_turns)
        self._sigma = positive("threshold_sigma", threshold_sigma)
        self._learn = bool(learn)
        self._pulses = segments if isinstance(segments, PulseClock) else None
        self.segments = np.array(segments, np.float64).reshape(
            -1, 3) if self._pulses is None else self._pulses.segments()
        self._turn_at(self.segments[:, 2])
        if self._pulses is None and not math.isfinite(self.half_us):
            raise ValueError("segments must hold rates that are not 0")
        centred = centred and self._pulses is None
        self.lookahead_us = round(self._tau) if centred else 0
        self._late = _LATE[not centred]
        self._clock = StreamClock(self.shape)
        self._cells = _aligned(self.shape, _CELL)
        self._lasting = _aligned(self.shape, _LASTING)
        self._seen = np.zeros(self.shape, np.uint8)     # pixels that had an event
        self.own_sigma = self._cells["scale"]
        self.own_sigma[:] = own_sigma
        self._log_theta = np.empty((2, *self.shape), np.float32)
        for plane, name, theta in zip(self._log_theta, ("on", "off"), thetas,
                                      strict=True):
            plane[:], self._cells[name] = np.log(theta), np.exp(theta / 2)
        # ln of the mean threshold, ON and OFF.
        self._mean = self._log_theta.mean((1, 2), np.float64)
        self.common_sigma, self._counts = self._sigma, np.zeros(2, np.int64)
        # Time of the next estimate of the thresholds, and half turns before it.
        self._look_us, self._wait = -math.inf, _LOOKS[0]
        self._dc = np.zeros(self.shape, np.float32)

    def _turn_at(self, rates: NDArray[np.float64]) -> None:
        rate = float(np.median(np.abs(rates)))
        self.half_us = 2 * math.pi / rate if rate > 0 else math.inf
        self._tau = self.half_us * self._half_turns / 2

    @property
    def thresholds(self) -> Plane:
        """Thresholds of each pixel, ON and OFF, as they are known; (2, H, W)."""
        return np.stack([_exp(plane) for plane in self._log_theta])

    # ---- feeding -------------------------------------------------------------

    def add_events(self, events: Events) -> None:
        """Add rows to the pixels' sums, of events not before those added earlier."""
        events = timed_events(events)
        if self._pulses is not None:
            self.segments = self._pulses.segments()
            self._turn_at(self.segments[-1:, 2])
            if math.isinf(self.half_us):    # events at a wrong angle tell wrong light
                self._clock.check_events(events)
                return
        if self._look_us < 0 and len(events):
            self._look_us = float(events["t"][0]) + self._wait * self.half_us
        while self._learn and len(events) and events["t"][-1] >= self._look_us:
            look = self._look_us
            first = int(np.searchsorted(events["t"], look))
            self._take(events[:first])
            events = events[first:]
            # Times at which there is nothing new, perhaps of years, are passed.
            silence = max(float(events["t"][0]) - look, 0) / self.half_us
            self._look_us += (1 + silence // self._wait) * self._wait * self.half_us
            self._wait = min(2 * self._wait, _LOOKS[1])
            for _ in range(_AGAIN):     # as steps are bounded, and mean and pixels one
                if self._look() < _COMMON:
                    break
        self._take(events)

    def _take(self, events: Events) -> None:
        if not len(events):
            return
        taken = _kernels.turning_events(
            events, self._clock.last_us, self._cells, self._lasting, self._seen,
            self.segments, self._tau, 1 / self._half_turns)
        risen = int(np.count_nonzero(events["p"][:taken]))
        self._counts += risen, taken - risen
        self._clock.took(events, taken)

    def _look(self) -> float:
        """Estimate all thresholds from what the pixels have seen.

        Returns the largest change of ln of the two means.
        """
        known = self.common_sigma <= _COMMON or self._sigma < _FIRST_SPREAD
        # NumPy would copy fields one by one.
        whole = self._lasting.view(f"V{_LASTING.itemsize}").ravel()
        cells, log_theta = self._cells.ravel(), self._log_theta.reshape(2, -1)
        at = np.flatnonzero(self._seen > 0)
        rows = whole.take(at)
        n1, n0 = (rows.view(_LASTING)[name] for name in ("n1", "n0"))
        enough = n1 + n0 >= _LEAST_LEARNT
        at, lasting = at[enough], rows[enough].view(_LASTING)
        learned, scale, told = _learned(lasting, log_theta.take(at, 1), self._mean,
                                        _OWN_SPREAD if known else _FIRST_SPREAD)
        whole[at] = lasting.view(whole.dtype)
        log_theta[:, at] = learned
        cells["on"][at], cells["off"][at] = _exp(_exp(learned) / 2)
        cells["scale"][at] = scale
        still, strong = (learned.take(np.flatnonzero(which), 1)
                         for which in (told > 0, told == 2))
        size, ratio = float(self._mean.mean()), None
        if still.shape[1] >= _STILL_PIXELS:
            ratio = float(np.median(still[0] - still[1]))
        elif min(self._counts) > 0:     # a pixel that ends where it began has as many
            ratio = math.log(self._counts[1] / self._counts[0])
        sized = strong.shape[1] >= _STILL_PIXELS
        if sized:
            size = float(np.median(strong.sum(0))) / 2
        if ratio is None:
            return 0.0
        before, self._mean = self._mean, np.array([size + ratio / 2, size - ratio / 2])
        change = float(np.abs(self._mean - before).max())
        if change > _ROW_FLOOR:     # pixels that know nothing follow the mean
            log_theta += (self._mean - before).astype(np.float32)[:, None]
            log_theta[:, at] = learned
            cells["on"], cells["off"] = _exp(_exp(log_theta) / 2)
        if sized:
            self.common_sigma = min(self.common_sigma, max(_COMMON, change))
        return change

    def add_frame(self, frame: ApsFrame) -> None:
        """Take the level of S0 from a frame."""
        mid = self._clock.check_frame(frame)
        log, valid = log_samples(frame)
        begin, angle, end = turned(self.segments, np.array(
            [frame.exposure_start_us, mid, frame.exposure_end_us]))
        seen = float(np.sinc((end - begin) / math.tau))
        now = self._read(mid)
        s0 = now.quad[0] + now.quad[2]
        q1 = (now.quad[0] - now.quad[2]) / s0
        q2 = (now.quad[1] - now.quad[3]) / s0
        light = 1 + seen * (q1 * math.cos(angle) + q2 * math.sin(angle))
        level = log + math.log(2) - np.log(np.maximum(light, 0.02)) - np.log(s0)
        np.copyto(self._dc, (level + self._dc).astype(np.float32), where=valid)

    # ---- reading -------------------------------------------------------------

    def polarization(self, t_us: int) -> Polarization:
        """Return the polarization at t_us; the state stays as it is.

        The time is not before the last one fed, less `lookahead_us`.
        """
        t = checked_time("t_us", t_us) + self.lookahead_us
        if t < self._clock.last_us:
            raise ValueError(
                "t_us must not lie before the last time seen less the look-ahead, "
                f"{self._clock.last_us - self.lookahead_us}, got {t_us}")
        return self._read(t)

    def _read(self, t: int) -> Polarization:
        planes = np.empty((7, *self.shape), np.float32)
        valid = np.empty(self.shape, np.bool_)
        _kernels.turning_images(
            self._cells, self._seen, t, self._tau, self.half_us, self._late,
            self.common_sigma, self._dc, planes, valid.view(np.uint8))
        return Polarization(planes[:4], planes[4:], valid)


def _learned(
    lasting: Records, log_theta: Plane, mean: NDArray[np.float64], spread: float,
) -> tuple[Plane, Plane, NDArray[np.uint8]]:
    """Estimate thresholds from pixels' lasting sums, and add the change to these.

    The pixels, (N,), have enough rows; `log_theta`, float32 (2, N), are ln of their
    thresholds, ON and OFF, `mean` those of the mean thresholds, and `spread` the error
    of a single pixel around it.  Returns ln of the new ones; the error of their mean;
    and uint8 (N,): 1 where the light did not change but for the modulation, 2 where
    that is also strong enough to tell the thresholds' mean, else 0.
    """
    n, y, g, h = (np.stack([lasting[f"{name}1"], lasting[f"{name}0"]])
                  for name in "nygh")
    m1, m2, zz, l11, l12, l22 = (
        lasting[name].copy() for name in ("m1", "m2", "zz", "l11", "l12", "l22"))
    u = _exp(log_theta)                                 # steps of ln I
    u[1] *= -1
    off_mean = log_theta - mean[:, None].astype(np.float32)

    def left(q1: Plane, q2: Plane) -> Plane:
        return np.asarray(zz - 2 * (q1 * m1 + q2 * m2) + q1 * q1 * l11
                          + 2 * q1 * q2 * l12 + q2 * q2 * l22)

    floor = (_ROW_FLOOR * 0.5 * (u[0] - u[1])) ** 2
    q1, q2 = _solved(l11 + floor / _WIDE**2, l12, l22 + floor / _WIDE**2, m1, m2)
    variance = np.maximum(left(q1, q2) / n.sum(0), floor)
    # Unknown are q and changes of both ln thresholds; the latter are eliminated.
    ridge, prior = variance / _WIDE**2, variance / spread**2
    p = u * u * n + prior
    k, o = u * u / p, u * (u * y + prior * off_mean) / p
    q1, q2 = _solved(
        l11 + ridge - (k * g * g).sum(0), l12 - (k * g * h).sum(0),
        l22 + ridge - (k * h * h).sum(0), m1 - (o * g).sum(0), m2 - (o * h).sum(0))
    rest = y - q1 * g - q2 * h
    step = -(u * rest + prior * off_mean) / p
    error = left(q1, q2) + (u * u * step * step * n + 2 * u * step * rest).sum(0)
    step = step.clip(-_LONGEST_STEP, _LONGEST_STEP)
    # Information on both thresholds when q is unknown, inverted for their mean.
    i11, i22 = l22 + ridge, l11 + ridge
    det = np.maximum(i11 * i22 - l12 * l12, _LEAST_DET)
    f1, f0 = p - u * u * (g * g * i11 + h * h * i22 - 2 * g * h * l12) / det
    both = -u[0] * u[1] * (g[0] * g[1] * i11 + h[0] * h[1] * i22
                           - (g[0] * h[1] + h[0] * g[1]) * l12) / det
    det = np.maximum(f1 * f0 - both * both, _LEAST_DET)
    scale = np.sqrt(np.maximum(0.25 * variance * (f1 + f0 - 2 * both) / det, 0))
    still = error <= n.sum(0) * _STILL**2 * u[0] * -u[1]
    strong = still & (q1 * q1 + q2 * q2 >= _STRONG**2) & (scale < 0.5 * spread)
    scale = np.where(strong, scale, np.float32(_BOTH * spread))
    # Weak light tells their ratio only; their mean is that of all.
    shared = np.where(strong, 0, (0.5 * (step + off_mean)).sum(0))
    # Light that changed otherwise tells nothing.
    step = np.where(still, step - shared, -off_mean.clip(-_LONGEST_STEP, _LONGEST_STEP))
    add = u * step
    lasting["m1"] += (add * g).sum(0)
    lasting["m2"] += (add * h).sum(0)
    lasting["zz"] += (2 * add * y + add * add * n).sum(0)
    lasting["y1"], lasting["y0"] = y + add * n
    lasting.view(np.float32).reshape(-1, 16)[~still & (n.sum(0) > _SPOILT), 2:] = 0
    return log_theta + step, scale, still.astype(np.uint8) + strong


def _solved(
    a11: Plane, a12: Plane, a22: Plane, b1: Plane, b2: Plane
) -> tuple[Plane, Plane]:
    """Solve for q, at most fully polarized."""
    det = np.reciprocal(np.maximum(a11 * a22 - a12 * a12, _LEAST_DET))
    q1, q2 = (a22 * b1 - a12 * b2) * det, (a11 * b2 - a12 * b1) * det
    shorter = np.reciprocal(np.sqrt(np.maximum(q1 * q1 + q2 * q2, 1)))
    return q1 * shorter, q2 * shorter


def _exp(x: NDArray[np.floating]) -> Plane:
    """e^x of an image, the same bits on every CPU."""
    out = np.empty(x.shape, np.float32)
    _kernels.exp(np.ascontiguousarray(x, np.float32), out)
    return out


def _aligned(shape: tuple[int, int], dtype: np.dtype[np.void]) -> Records:
    """Return an array of zeros, each element in a cache line."""
    memory = np.zeros(math.prod(shape) * dtype.itemsize + 63, np.uint8)
    first = -memory.ctypes.data % 64
    return memory[first:first + len(memory) - 63].view(dtype).reshape(shape)
