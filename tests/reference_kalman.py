"""The Kalman method in plain float64 NumPy, a pixel at a time."""
import itertools
from dataclasses import dataclass
from unittest import mock

import numpy as np
from reference_noise import Noise
from reference_tracks import (
    UNKNOWN,
    US,
    after,
    ahead,
    ahead_of_sample,
    between,
    lead,
    lead_variance,
    lost,
    moving,
    quiet,
    ripple_of,
    silence,
    steady,
)

from pdavis_cv.reconstruct.kalman.lasting_degree import LastingDegree

FINE = 1_500
REST = 1_000_000
LEAK = 0.02


def alone(method, t):
    """Read a filter as if pixels had no neighbours: reference_degree.py is its twin."""
    with mock.patch.object(LastingDegree, "weigh"):
        return method.read(t)


@dataclass
class Node:
    """A sample: base + h . theta = level, and what lies between it and the last."""

    t: int
    next: int
    level: float
    h: np.ndarray
    noise: float
    drift: float


class Pixel:
    """One pixel's events (t, p) and the state (base, on, off) with covariance."""

    def __init__(self, on, off, sigma, bandwidth, ripple, noise, offset_dn, deaf=0.0):
        self.deaf = deaf
        self.learned, self.offset_dn = noise, offset_dn
        self.events, self.bandwidth = [], bandwidth
        self.ripple = ripple or steady
        self.x = np.array([0.0, on, off])
        self.P = np.diag([100.0, sigma**2, sigma**2])
        self.prior, self.since, self.reference = np.array([on, off]), 0, None
        self.nodes, self.past, self.pull = [], None, 0.0
        self.odds, self.moves, self.seen = -6.91, 0.0, None
        self.holds, self.held = False, 0.0      # the part at rest, in mode causal
        self.apart = 0.0    # standard deviation of the difference of two stamps
        self.quiet = []     # ln of the samples from the last that follows an event

    def part(self, i, t, known, log):
        """Thresholds crossed since event i - 1, which left log, at t; i is the next."""
        last = self.events[i - 1] if i else (None, 0)
        before = self.events[i - 2] if i > 1 else None
        steps = self.x[1], -self.x[2]
        hz = self.bandwidth[0] + self.bandwidth[1] * np.exp(log)

        def ripple(t):
            return self.ripple(t, hz)

        held = self.kept(i)
        if i < len(self.events) and self.events[i][0] <= known:
            held = None
            part = between(before, *last, *self.events[i], steps, ripple,
                           hasattr(self.ripple, "lit"), self.deaf, t)
            gap = self.events[i][0] - last[0] if i else np.inf
        elif last[0] is None or t - last[0] >= REST:
            kept = held if held and self.ripple is steady else 0.0
            return (last[1], kept, 0.0, UNKNOWN, 0.0, 0.0,
                    *(after(last[0], ripple, t) if i else (0.0, 0.0)))
        elif held is not None and known <= t and self.ripple is steady:
            gap = max(known - last[0], last[0] - before[0]) if before else np.inf
            return ahead_of_sample(
                before, *last, self.deaf, t, max(200, self.apart), silence(gap), held,
                self.P[0, 0] / self.x[1:].mean()**2, self.reference)
        else:
            part = (quiet(before, *last, known, ripple, self.deaf, t) if known > t
                    else ahead(before, *last, steps, ripple, self.deaf, t,
                               max(200, self.apart)))
            gap = max(known - last[0], last[0] - before[0]) if before else np.inf
        if self.ripple is not steady:
            return part
        rest = silence(gap)
        p, fraction, rate, var, rate_var, fall, *rest_of = part
        moves, kept = 1 - rest, 0.0
        if held is not None and before:
            moves *= moving(before, *last, known, self.deaf, max(200, self.apart))
            kept = (1 - moves) * held
        elif held is not None:
            kept = held
        return (p, moves * fraction + kept, moves * rate,
                (1 - rest) * (var + rest * fraction**2),
                (1 - rest) * (rate_var + rest * rate**2), fall, *rest_of)

    def kept(self, i):
        """Part at rest after event i - 1, None where no sample has come since."""
        if self.holds and self.reference is not None and i and (
                self.events[i - 1][0] <= self.reference):
            return self.held
        return None

    def p_noise(self, i, known):
        """Probability that the event before i is noise."""
        if not i or self.events[i - 1][0] <= self.sampled:
            return 0.0
        t = self.events[i - 1][0]
        p_noise = self.learned.p_noise
        if i > 1:
            p_noise *= silence(t - self.events[i - 2][0])
        if i < len(self.events) and self.events[i][0] <= known:
            p_noise *= silence(self.events[i][0] - t)
        return p_noise

    @property
    def sampled(self):
        return 0 if self.reference is None else self.reference

    def motion(self, i, known, sampled):
        """Variance that motion leaves, thresholds^2."""
        came = i > 0 and self.events[i - 1][0] > sampled
        comes = i < len(self.events) and self.events[i][0] <= known
        return self.learned.motion * (2 if came else 1 if comes else 0)

    def next(self, t):
        return sum(time <= t for time, _ in self.events)

    def counts(self, start, stop):
        """ON and OFF events, and what was lost from one to the next, in thresholds."""
        n = np.zeros(2)
        for i in range(start, stop):
            n[0 if self.events[i][1] else 1] += 1
            if self.deaf and i:
                (t0, p0), (t1, p1) = self.events[i - 1:i + 1]
                before = self.events[i - 2][0] if i > 1 else None
                for p, part in zip((p0, p1), lost(before, t0, t1, self.deaf),
                                   strict=True):
                    n[0 if p else 1] += part
        return n

    def value(self, t, known, since, level, p_noise=0.0, mean=False):
        i = self.next(t)
        n = (self.counts(since, i) if i >= since else -self.counts(i, since))
        _, on, off = self.x
        p, fraction, rate, *spread, ripple, slope = self.part(
            i, t, known, level + on * n[0] - off * n[1])
        n[0 if p else 1] += fraction
        if p_noise:
            n[0 if self.events[i - 1][1] else 1] -= p_noise
        y = on * n[0] - off * n[1] + ripple
        slope += (on if p else -off) * rate
        if mean:
            slope = self.mean_slope(i, t, known, level + y, slope)
        return n, y, *self.lag(slope, spread, level + y)

    def mean_slope(self, i, t, known, log, slope):
        """Slope of the output: a mean between known events over its time constant.

        It is longer where stamps jitter by more than that.
        """
        hz = self.bandwidth[0] + self.bandwidth[1] * np.exp(log)
        if (self.ripple is not steady or hz == 0 or not 0 < i < len(self.events)
                or self.events[i][0] > known):
            return slope
        half = np.hypot(1e6 / (2 * np.pi * hz) / 2, self.apart)
        first = self.events[i - 2 if i > 1 and not self.deaf else i - 1][0]
        begin, end = max(t - half, first), min(t + half, known)
        if begin >= end:
            return slope
        return (self.change(i, end, known) - self.change(i, begin, known)) / (
            US * (end - begin))

    def change(self, i, t, known):
        """Change of the output from event i - 1 to t, linear before it."""
        _, on, off = self.x
        last, p = self.events[i - 1]
        if t < last:
            return (on if p else -off) * (t - last) / (last - self.events[i - 2][0])
        at = self.next(t)
        p, fraction, *_ = self.part(at, t, known, 0.0)
        return self.path(i, at) @ self.x[1:] + (on if p else -off) * fraction

    def lag(self, slope, spread, log):
        """What the photoreceptor's lag adds; the variance of it and of the part."""
        off, theta2 = self.x[2], self.x[1:].mean() ** 2
        hz, per_level, sigma = self.bandwidth
        u = lead(slope, np.exp(log), hz, per_level)
        return u, theta2 * spread[0], lead_variance(
            u, theta2 * spread[1], off * spread[2], np.exp(log), hz, per_level, sigma)

    @property
    def hot(self):
        return self.odds > 0

    def weigh(self, sample, n, variance):
        """Odds of a hot pixel after a sample, n events since the last one."""
        rose, fell = self.x[1:] * n
        claim, path, shown = rose - fell, rose + fell, sample - self.seen
        short = 0.25 * abs(claim) - shown * np.sign(claim)
        contradicted = (n.sum() >= 3 and abs(claim) > 0.5 * path
                        and short > 4 * np.sqrt(2 * variance))
        before = self.hot
        self.odds = np.clip(self.odds + (4.5 if contradicted else -2.29), -6.91, 6.91)
        if self.hot and not before:
            self.moves = 1.0

    def alone(self, sample, mid, at, per_dn):
        """Use a sample of a hot pixel, whose events have no weight."""
        self.held, self.quiet = 0.0, [sample]
        theta2, error = self.x[1:].mean()**2, sample - self.x[0]
        added = self.moves + theta2 * LEAK * US * (mid - self.reference)
        self.P[0, 0] += added
        change, v = error**2, self.P[0, 0] + self.learned.at(per_dn)
        error, noise, _ = self.linearized(error, v, per_dn, 0.0)
        if error**2 > 16 * (self.P[0, 0] + noise):
            self.P[0, 0] += error**2
            added += error**2
        self.nodes.append(Node(
            mid, at, self.x[0] + error, np.zeros(2), noise, added))
        v = self.P[0, 0] + noise
        K = self.P[:, 0] / v
        K[1:] = 0
        PH = self.P[:, 0].copy()
        self.x = self.x + K * error
        self.pull += K[0] * (per_dn - self.pull)
        self.P = self.P - np.outer(K, PH) - np.outer(PH, K) + v * np.outer(K, K)
        self.moves += (change - self.moves) / 8
        self.since, self.reference = at, mid

    def linearized(self, error, v, per_dn, motion):
        """Innovation, measurement noise and 1 / DN where both see the light."""
        noise = motion + self.learned.at(per_dn)
        spread = v - noise
        rest = error * noise / v
        if abs(rest) <= 3:
            there = motion + self.learned.at(per_dn * np.exp(rest))
            linear = error + np.expm1(rest) - rest
            if linear**2 <= 16 * (spread + there):
                return linear, there, per_dn * np.exp(rest)
        return error, noise, per_dn

    def frame(self, sample, begin, mid, end, known, per_dn):
        fresh = self.reference is None
        at = self.next(mid)
        if not fresh:
            self.weigh(sample, self.counts(self.since, at), 4.0 * per_dn**2
                       + 0.1 * per_dn)
        self.seen = sample
        if self.hot:
            return self.alone(sample, mid, at, per_dn)
        learn = not fresh and self.counts(self.since, at).sum() >= 3
        added = p_noise = unit = motion = 0.0
        event_step, theta2 = 1.0, self.x[1:].mean() ** 2
        if not fresh:
            n = self.counts(self.since, at)
            drift = (LEAK * US * (mid - self.reference)
                     + self.learned.per_event * n.sum())
            p_noise = self.p_noise(at, known)
            motion = theta2 * self.learned.motion
            if n.sum():
                drift += self.learned.motion
            comes = at < len(self.events) and self.events[at][0] <= known
            unit = theta2 * (2 if n.sum() else 1 if comes else 0)
            motion = motion if unit else 0
            if at:
                last = 0 if self.events[at - 1][1] else 1
                n[last] -= p_noise
                event_step = self.x[1 + last] * (-1 if last else 1)
            n_on, n_off = n
            F = np.eye(3)
            F[0, 1:] = n_on, -n_off
            if learn:
                self.P[[1, 2], [1, 2]] += self.learned.drift * self.x[1:]**2
            self.x = F @ self.x
            self.P = F @ self.P @ F.T
            added = theta2 * (drift + p_noise * (1 - p_noise))
            self.P[0, 0] += added
        level = sample if fresh else self.x[0]
        inner = sorted({t for t, _ in self.events if begin < t < end})
        cuts = [begin, *inner, end]
        lit = self.ripple(begin, 0) != (0, 0) or self.ripple(end, 0) != (0, 0)
        if lit:
            cuts = [cut for a, b in itertools.pairwise(cuts)
                    for cut in np.arange(a, b, FINE)] + [end]
        whole, weighted = 0.0, np.zeros(2)
        for a, b in itertools.pairwise(cuts):
            for node in (-1, 1) if inner or lit else (0, 0):
                t = (a + b) / 2 + node * (b - a) / np.sqrt(12) if node else mid
                inside, y, u, *_ = self.value(t, known, at, level)
                whole += (b - a) / 2 * np.exp(y + u)
                weighted += (b - a) / 2 * np.exp(y + u) * inside
        blur = np.log(whole / (end - begin))
        H = np.array([1.0, *(weighted / whole * (1, -1))])
        if fresh:
            self.x[0] = sample - blur
        taken = (self.part(at, mid, known, 0.0)[1]
                 if self.holds and self.ripple is steady else 0.0)
        if self.holds and self.ripple is steady and self.kept(at) is None:
            self.held = 0.0
        error = sample - self.x[0] - blur
        v = H @ self.P @ H + motion + self.learned.at(per_dn)
        error, noise, per_dn_seen = self.linearized(error, v, per_dn, motion)
        v = H @ self.P @ H + noise
        still = v - unit * self.learned.motion + (
            self.offset_dn * (per_dn - self.pull)) ** 2
        events = 0 if fresh else theta2 * self.counts(self.since, at).sum()
        still -= events * self.learned.per_event
        level = sample - blur + H[1:] @ self.x[1:]
        if fresh or self.counts(self.since, at).sum():
            self.quiet = []
        self.quiet.append(sample if self.ripple is steady else level)
        third = np.diff(self.quiet[-4:], 3) if len(self.quiet) > 3 else ()
        sums = (p_noise * np.clip(p_noise - error / event_step, 0, 1), p_noise,
                np.array([unit, events]) / still, min(error**2, 16 * v) / still - 1,
                (learn * (error**2 <= 16 * v) * self.x[1:] * (
                    H[1:] + (0 if fresh else n * (1, -1))), error, v),
                (0 if unit or noise > 0.04 or not len(third) else 1)
                * np.array([per_dn_seen**2, per_dn_seen]) / noise,
                min(third[0]**2 / 20 / noise, 16) - 1 if len(third) else 0)
        if error**2 > 16 * v:
            self.P[0, 0] += error**2
            added += error**2
        level = self.x[0] + error + H[1:] @ self.x[1:]
        self.nodes.append(Node(mid, at, level, H[1:], noise,
                               added + theta2 * p_noise**2))
        PH = self.P @ H
        v = H @ PH + noise
        K = PH / v
        if not learn:
            K[1:] = 0
        self.x = self.x + K * error
        self.pull += K[0] * (per_dn - self.pull)
        silent = self.holds and self.ripple is steady and not (
            at and self.events[at - 1][0] > begin)
        still = 1 - (noise - motion) / v if silent else K[0]
        self.held += still * (taken - self.held) + (still - K[0]) * error / event_step
        self.P = self.P - np.outer(K, PH) - np.outer(PH, K) + v * np.outer(K, K)
        self.x[1:] = np.clip(self.x[1:], 0.3 * self.prior, 3 * self.prior)
        self.since, self.reference = at, mid
        return sums

    def read(self, t, known):
        i = self.next(t)
        if self.hot:
            v = self.P[0, 0] + self.x[1:].mean()**2 * LEAK * US * (t - self.reference)
            return self.x[0], v + self.moves, v <= 0.25
        p_noise = self.p_noise(i, known)
        n, y, u, spread, lag = self.value(
            t, known, self.since, self.x[0], p_noise, mean=True)
        F = np.array([1.0, n[0], -n[1]])
        theta2 = self.x[1:].mean() ** 2
        if self.reference is not None and self.settled(i, t, known, self.reference):
            spread = 0
        variance = F @ self.P @ F + spread + theta2 * (
            LEAK * US * (t - (self.reference or 0))
            + self.learned.per_event * self.counts(self.since, i).sum()
            + p_noise * (1 - p_noise)
            + self.motion(i, known, self.sampled))
        fresh = self.reference is None
        variance = max(variance, 1e-8)
        return (self.x[0] + y + u, 0.0 if fresh else variance + lag,
                not fresh and variance <= 0.25)

    def settled(self, i, t, known, sampled):
        """Whether it is at rest, and a sample has come since the last event."""
        last = self.events[i - 1][0] if i else -np.inf
        following = i < len(self.events) and self.events[i][0] <= known
        return (self.ripple is steady and t - last >= REST and not following
                and sampled >= last)

    def path(self, start, stop):
        """Counts (on, -off) from one place among the events to another."""
        sign = 1 if stop >= start else -1
        return sign * self.counts(min(start, stop), max(start, stop)) * (1, -1)

    def fold(self, until):
        """Filter the samples up to a time, as the past of all that is read later."""
        while self.nodes and self.nodes[0].t <= until:
            node = self.nodes.pop(0)
            z = node.level - node.h @ self.x[1:]
            if self.past is None:
                base, var = z, node.noise
            else:
                _, i, base, var = self.past
                base += self.path(i, node.next) @ self.x[1:]
                var += node.drift
                gain = var / (var + node.noise)
                base, var = base + gain * (z - base), (1 - gain) * var
            self.past = node.t, node.next, base, var

    def between_samples(self, t):
        """What a hot pixel's samples say: filtered from both sides, in between."""
        theta, sides = self.x[1:], []
        for nodes in ([n for n in self.nodes if n.t <= t],
                      [n for n in self.nodes if n.t > t][::-1]):
            one = self.past if not sides else None
            drift = 0.0
            for node in nodes:
                z = node.level - node.h @ theta
                if one is None:
                    base, var = z, node.noise
                else:
                    base = one[2] + self.path(one[1], node.next) @ theta
                    var = one[3] + (drift if sides else node.drift)
                    gain = var / (var + node.noise)
                    base, var = base + gain * (z - base), (1 - gain) * var
                drift = node.drift
                one = node.t, node.next, base, var
            sides.append(one)
        known = [one for one in sides if one is not None]
        if not known:
            return 0.0, 0.0, False
        valid = max(one[3] for one in known) <= 0.25
        if len(known) == 1:
            return known[0][2], known[0][3] + self.moves, valid
        (t0, _, x0, v0), (t1, _, x1, v1) = known
        v0, v1 = v0 + self.moves * (t - t0) / (t1 - t0), v1 + self.moves * (t1 - t) / (
            t1 - t0)
        return (x0 * v1 + x1 * v0) / (v0 + v1), v0 * v1 / (v0 + v1), valid

    def smooth(self, t, known):
        """Least squares over the past, all samples, and the value at t."""
        if self.hot:
            return self.between_samples(t)
        theta, i = self.x[1:], self.next(t)
        theta2 = theta.mean() ** 2
        places = [(node.t, node.next, node.drift) for node in self.nodes]
        equations = [({k: 1}, node.level - node.h @ theta, node.noise)
                     for k, node in enumerate(self.nodes)]
        if self.past is not None:
            places.insert(0, (*self.past[:2], 0.0))
            equations = [({k + 1: 1 for k in terms}, *rest)
                         for terms, *rest in equations]
            equations.append(({0: 1}, *self.past[2:]))
        here = len(places)
        after = sum(place[0] <= t for place in places)
        sides, link = [], None      # counts from the samples next to t

        def drift(t0, i0, t1, i1):
            return theta2 * (LEAK * US * (t1 - t0)
                             + self.learned.per_event * self.counts(i0, i1).sum())

        for k in range(here + 1):
            t0, i0, _ = places[k - 1] if k else (None, None, None)
            t1, i1, variance = places[k] if k < here else (None, None, None)
            if k != after:
                if 0 < k < here:
                    equations.append(
                        ({k: 1, k - 1: -1}, self.path(i0, i1) @ theta, variance))
                continue
            if k and k < here:
                share = drift(t0, i0, t, i) / drift(t0, i0, t1, i1)
                parts = share * variance, (1 - share) * variance
            else:
                parts = (drift(t0, i0, t, i) if k else 0,
                         drift(t, i, t1, i1) if k < here else 0)
            if k:
                sides.append(self.path(i0, i))
                equations.append(
                    ({here: 1, k - 1: -1}, sides[0] @ theta, parts[0]))
            if k < here:
                sides.append(self.path(i1, i))
                link = len(equations)
                equations.append(({here: 1, k: -1}, sides[-1] @ theta, parts[1]))
        if here:
            a, z = np.zeros((len(equations), here + 1)), np.zeros(len(equations))
            weight = np.array([1 / max(v, 1e-12) for *_, v in equations])
            for row, (terms, value, _) in enumerate(equations):
                z[row] = value
                for k, factor in terms.items():
                    a[row, k] = factor
            covariance = np.linalg.inv(a.T @ (weight[:, None] * a))
            gain = covariance[here] @ (a.T * weight)
            level, variance = gain @ z, covariance[here, here]
            m = sides[0] if len(sides) == 1 else (
                sides[0] + gain[link] * (sides[1] - sides[0]))
        else:
            level = self.path(0, i) @ theta
        p, fraction, rate, *spread, ripple, slope = self.part(i, t, known, level)
        sign = np.array([1, 0]) if p else np.array([0, -1])
        level += fraction * (sign @ theta) + ripple
        slope = self.mean_slope(i, t, known, level, slope + rate * (sign @ theta))
        u, spread, lag = self.lag(slope, spread, level)
        if not here:
            return level + u, 0.0, False
        following = i < len(self.events) and self.events[i][0] <= known
        if after and self.settled(i, t, known, places[after - 1][0]):
            spread = 0
        elif following or (after and self.events and i
                           and self.events[i - 1][0] > places[after - 1][0]):
            spread += theta2 * self.learned.motion
        m = m + fraction * sign
        variance += spread + m @ self.P[1:, 1:] @ m
        variance = max(variance, 1e-8)
        return level + u, variance + lag, variance <= 0.25


def kalman(events, frames, shape, on, off, t_us, *, sigma=0.035, bandwidth=(0, 0, 0),
           lookahead_us=50_000, offline=False, offset_dn=0.0, waves=(),
           refractory_us=0.0, jitter_us=0.0):
    """Log intensity, variance and validity at t_us, from what acts on it."""
    wait_us = min(lookahead_us, 50_000)
    on, off = np.broadcast_to(on, shape), np.broadcast_to(off, shape)
    out = np.zeros((2, *shape))
    valid = np.zeros(shape, bool)
    log_ms = [np.log(f.exposure_ms) if f.exposure_ms else 0.0 for f in frames]
    noise, pixels = Noise(), {}
    for at in np.ndindex(*shape):
        lamp = ripple_of(waves) if any(wave.hz for wave in waves) else steady
        pixel = pixels[at] = Pixel(
            on[at], off[at], sigma, bandwidth, lamp, noise, offset_dn,
            refractory_us)
        pixel.holds, pixel.apart = wait_us == 0, np.sqrt(2) * jitter_us
        mine = events[(events["y"] == at[0]) & (events["x"] == at[1])]
        pixel.events = [(int(t), int(p)) for t, p in zip(mine["t"], mine["p"],
                                                        strict=True)]
    for frame, log in zip(frames, log_ms, strict=True):
        mid, end = frame.mid_us, frame.exposure_end_us
        known = max(end, mid + wait_us if wait_us else frame.available_us)
        if known > t_us + lookahead_us:
            continue
        sums = []
        for at, pixel in pixels.items():
            dn = float(frame.dn[at])
            if dn >= 1 and (frame.valid is None or frame.valid[at]):
                said = pixel.frame(
                    np.log(dn) - log, frame.exposure_start_us, mid,
                    max(end, frame.exposure_start_us + 1), known, 1 / dn)
                sums += [said] if said else []
            if offline:
                pixel.fold(known - lookahead_us)
        noise.adapt(sums)
    for at, pixel in pixels.items():
        read = pixel.smooth if offline else pixel.read
        out[0][at], out[1][at], valid[at] = read(
            t_us, t_us + wait_us)
        out[1][at] += (offset_dn * pixel.pull) ** 2
    return out[0], out[1], valid
