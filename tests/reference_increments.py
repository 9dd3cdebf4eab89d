"""A plain version of the filter of increments, written to be read: one pixel at a time,
all events at hand.  Symbols and numbers of equations are those of
docs/theory/kalman.md."""
import bisect
import itertools
import math

import numpy as np

SAMPLES, SHORT_US, GATE = 7, 1500, 16.0
RESTS, EARLIEST_TURN = 2.5, 3 - 2 * math.sqrt(2)
SMOOTH_FROM_S, KNOT = 0.045, 1.1
CLAIM, SHOWN, HOT, MORE, LESS, HOT_MEMORY = 0.5, 0.25, 6.91, 4.5, 2.29, 8.0


def moves(gap, m):
    return 1 / (1 + (gap / m.rest_s) ** 2)      # (3)


def goes_on(gap, m):
    rest = 1 / (1 + RESTS ** 2)
    return max(moves(gap, m) - rest, 0) / (1 - rest)


class Pixel:
    """The events of a pixel, and what they stand for."""

    def __init__(self, t_us, signs, first_us, m):
        self.t, self.signs, self.m = [int(t) for t in t_us], [int(s) for s in signs], m
        self.before, self.run, self.context, self.weight = [], [], [], []
        self.light, self.count = [np.zeros(2)], [np.zeros(2)]
        for k, (t, sign) in enumerate(zip(self.t, self.signs, strict=True)):
            same = k > 0 and self.signs[k - 1] == sign
            before = 1e-6 * (t - (self.t[k - 1] if k else first_us))
            self.run.append(min(self.run[-1] + 1, 3) if same else 1)
            self.context.append(3 if self.run[-1] < 2 else 2 if self.run[-1] < 3 else
                                0 if before < self.before[-1] else 1)
            self.before.append(before)
            on = int(sign > 0)
            self.weight.append(self.stands_for(before, k, same))
            x = min(max(math.log(max(before, 1e-6) / 2e-3) / math.log(4), 0), 4 - 1e-6)
            i = int(x)
            step = m.theta[on] + (1 - x + i) * m.by_class[on, i] + (
                x - i) * m.by_class[on, i + 1]
            passed = np.eye(2)[on] * sign * self.weight[-1]
            self.light.append(self.light[-1] + passed * step)
            self.count.append(self.count[-1] + passed)

    def live(self, gap):
        """What of a gap the pixel was not held in reset."""
        return max(gap - self.m.dead_s, self.m.dead_s / 4)

    def pace(self, k, gap):
        """The gap before event k, of a turn in the gap after it."""
        q = self.m.turn if self.context[k] == 3 else self.before[k] / gap
        return gap * min(max(q, EARLIEST_TURN), 1)

    def stands_for(self, gap, k, same):
        """Thresholds of event k, which comes after a gap.  (4)"""
        d = self.m.dead_s
        if k == 0 or d == 0 or gap <= 0:
            return 1.0
        if same:
            return 1 + d / self.live(gap)
        before = self.pace(k - 1, gap)
        return gap / (before + gap) * (
            (self.live(before) + gap) / self.live(gap) - d / self.live(before))

    def last(self, t):
        """Index of the last event at or before t, -1: none."""
        return bisect.bisect_right(self.t, t) - 1

    def open_event(self, t, known):
        """Time of the event of the silence that is open at t, or None."""
        k = self.last(t)
        return self.t[k] if k >= 0 and self.last(known) == k else None

    def part(self, t, known):
        """Parts of a threshold since the last event, rates per s, variance.  (2)"""
        m, k = self.m, self.last(t)
        part, rate = np.zeros(2), np.zeros(2)
        if k < 0:
            return part, rate, 0.0
        since, on, sign = 1e-6 * (t - self.t[k]), int(self.signs[k] > 0), self.signs[k]
        if self.last(known) > k:
            gap = 1e-6 * max(self.t[k + 1] - self.t[k], 1)
            s, to = since / gap, self.signs[k + 1]
            p, w = moves(gap, m), self.weight[k + 1]
            part[int(to > 0)], rate[int(to > 0)] = to * s * p * w, to * p * w / gap
            if to != sign:
                before = self.pace(k, gap)
                h = gap**2 / (before + gap) * (
                    1 / self.live(gap) + 1 / self.live(before))
                part[on] = sign * s * (1 - s) * p * h
                rate[on] = sign * (1 - 2 * s) * p * h / gap
            return part, rate, 0.0
        length = max(1e-6 * (known - self.t[k]), 1e-6)
        before = max(self.before[k], 1e-5)
        r, s = length / before, since / length

        def table(values):
            return np.interp(r, [0.25, 0.5, 1, 2, 4], values[self.context[k]])
        end, bow, v = table(m.end), 4 * table(m.bow), table(m.open_variance)
        if r < 0.25:
            first, second = m.bow[self.context[k], :2]
            bow = 4 * (first + (4 * r - 1) * (second - first))
            end *= r / 0.25
        z = goes_on(max(length, before), m)
        part[on] = sign * z * s * (end + bow * (1 - s))
        rate[on] = sign * z * (end + bow * (1 - 2 * s)) / length
        return part, rate, v * z * (s if s > 0.5 else 2 * s * (1 - s))

    def mean_part(self, begin, end, known):
        """Mean of `part` over an exposure within one silence: of a parabola."""
        return sum(w * self.part(begin + (end - begin) * k // 2, known)[0]
                   for k, w in enumerate((1, 4, 1))) / 6

    def y(self, t, known):
        """Changes of light so far by polarity, and their slopes."""
        part, rate, _ = self.part(t, known)
        return self.light[self.last(t) + 1] + self.m.theta * part, self.m.theta * rate

    def lead(self, slope, light):
        """u of u (f0 + k I e^u) = y' / 2 pi, by bisection.  (5)"""
        f0, k = self.m.bandwidth
        if f0 + k <= 0:
            return 0.0
        low, high = -0.85, 2.0
        for _ in range(30):
            u = (low + high) / 2
            if u * (f0 + k * light * math.exp(u)) < slope / (2 * math.pi):
                low = u
            else:
                high = u
        return u

    def around(self, t, known, ahead):
        """What other times and this one say: for the pixel, its cell, neighbours."""
        m = self.m

        def counts(t):
            return self.count[self.last(t) + 1] + self.part(t, known)[0]
        now = counts(t)
        out = np.array([-(m.cell_now + m.near_now) @ now, m.cell_now @ now,
                        m.near_now @ now])
        for i, lag in enumerate(m.lags_s):
            if lag and 1e6 * lag <= ahead:
                d = counts(t + int(1e6 * lag)) - now
                out += [m.own[i] @ d, m.cell[i] @ d, m.near[i] @ d]
        return out

    def node(self, begin, end, sample, known, gain):
        """h of a frame, linear in the gains about `gain`, and its parts.  (6)"""
        n = 1 if end - begin <= SHORT_US else SAMPLES
        times = [begin + int((end - begin) * (i + 0.5) / n) for i in range(n)]
        each = [self.y(t, max(known, t)) for t in times]
        y = np.array([(1 + gain) @ light for light, _ in each])
        u, h = np.zeros(n), 0.0
        for turn in range(3):
            if turn and sample is not None:
                u = np.array([self.lead((1 + gain) @ slope, max(
                    math.exp(sample - h + one) - self.m.black, 1e-3))
                    for one, (_, slope) in zip(y, each, strict=True)])
            e = np.exp(y + u - y.max())
            h = y.max() + math.log(e.mean())
        light = sum(w * one for w, (one, _) in zip(e / e.sum(), each, strict=True))
        middle = begin + (end - begin) // 2
        return {"h": h - gain @ light, "light": light, "around": 0.0,
                "open": self.open_event(middle, max(known, middle)),
                "at_end": self.open_event(end, max(known, end)),
                "variance": self.part(middle, max(known, middle))[2]}


def between(a, b, seconds, m):
    """Change from frame a to frame b, its parts, thresholds passed, noise.  (8)"""
    part = b["light"] - a["light"]
    passed = (abs(part) / m.theta).sum()
    alpha, beta, gamma = m.noise
    opened = b["variance"]
    if b["open"] is not None and b["open"] == a["open"]:
        opened = max(opened - a["variance"], 0)
    return (b["h"] - a["h"] + b["around"], part, passed,
            alpha * abs(seconds) + gamma * passed + beta / 2 * min(passed, 1)
            + m.theta.mean() ** 2 * opened)


class Level:
    """State (L, g-, g+) of a pixel at the last frame, and its covariance."""

    def __init__(self, gain):
        self.x, self.P = np.array([0.0, *gain]), np.zeros((3, 3))
        self.sampled = 0
        self.hot = self.motion = 0.0

    def update(self, a, b, seconds, z, r, m):
        """Pass from frame a to frame b, whose sample is z with variance r.  (12)"""
        beta = m.noise[1]
        if not self.sampled:
            if z is not None:
                self.sampled = 1
                self.x[0] = z
                moved = beta / 4 * bool(np.any(b["light"]))
                self.P = np.diag([r + moved, m.spread ** 2, m.spread ** 2])
            return
        change, d, passed, noise = between(a, b, seconds, m)
        hot = self.hot > HOT
        if z is not None:
            claim, e = d.sum(), z - self.x[0]
            short = SHOWN * abs(claim) - e * (1 if claim > 0 else -1)
            if abs(claim) > CLAIM * abs(d).sum() and short > 0 and (
                    short ** 2 > GATE * (r + self.P[0, 0])):
                self.hot = min(self.hot + MORE, 2 * HOT)
            elif claim:
                self.hot = max(self.hot - LESS, 0)
            self.motion += (e * e - self.motion) / HOT_MEMORY
        if hot:
            self.P[0, 0] += self.motion
        else:
            F = np.eye(3)
            F[0, 1:] = d
            self.x = F @ self.x + [change, 0, 0]
            self.P = F @ self.P @ F.T
            self.P[0, 0] += noise
        if z is None:
            return
        r += 0 if hot else beta / 4 * min(passed, 1)
        e = z - self.x[0]
        jump = e * e > GATE * (self.P[0, 0] + r)
        if jump:
            self.P[0, 0] += e * e
        K = self.P[:, 0] / (self.P[0, 0] + r)
        if hot or jump or passed == 0:
            K[1:] = 0
        A = np.eye(3) - np.outer(K, [1, 0, 0])
        self.x, self.P = self.x + K * e, A @ self.P @ A.T + r * np.outer(K, K)


def mean_around(planes):
    """The pixel's own, the mean of its cell, the mean of the four nearest alike."""
    own, cell, near = planes
    h, w = own.shape
    ys, xs = np.arange(h), np.arange(w)
    out = 0.25 * (near[np.maximum(ys - 2, 0)] + near[np.minimum(ys + 2, h - 1)]
                  + near[:, np.where(xs < 2, 0, xs - 2)]
                  + near[:, np.where(xs + 2 < w, xs + 2, w - 1)])
    out = out + own
    blocks = cell.reshape(h // 2, 2, w // 2, 2).mean((1, 3))
    return out + np.kron(blocks, np.ones((2, 2)))


class Filter:
    """All of it: fed at once with all events and frames; even shapes."""

    def __init__(self, events, frames, m, shape, *, gain=None, mode="buffered"):
        self.m, self.shape, self.mode = m, shape, mode
        self.ahead = {"causal": 0, "buffered": 50_000, "offline": 500_000}[mode]
        self.frames, self.t = frames, [int(t) for t in events["t"]]
        self.gain = np.zeros((*shape, 2)) if gain is None else gain
        first = int(events["t"][0]) if len(events) else 0
        self.pixels = np.empty(shape, object)
        for at in np.ndindex(shape):
            e = events[(events["y"] == at[0]) & (events["x"] == at[1])]
            self.pixels[at] = Pixel(e["t"], np.where(e["p"], 1, -1), first, m)

    def hole(self, first, last, known):
        """Where events are missing: no pixel has one for longer than by chance."""
        i, j = bisect.bisect_left(self.t, first), bisect.bisect_right(self.t, known)
        t = [*self.t[max(i - 1, 0):j], known]
        found = [(a, b) for a, b in itertools.pairwise(t) if (
            (b - a) * len(t) > 30 * (known - t[0]) and b - a > 0.2 * (last - first))]
        return [min(max(one, first), last) for one in (
            found[0][0], found[-1][1])] if found else (0, 0)

    def even(self, t, before, after, middles):
        """Noise per s (8) at t, and where middles would be if it grew so all along."""
        alpha, more, (begin, end) = self.m.noise[0], 0.0, (0, 0)
        if before is not None and self.m.missing:
            more, first = self.m.missing / alpha, self.latest(before)
            begin, end = self.hole(first, *(
                (t, t + self.ahead) if after is None else
                (self.latest(after), int(np.max(after.exposure_end_us)))))
        slope = 1 + more * (begin <= t < end)

        def integral(x):
            return x + more * (min(max(x, begin), end) - begin)
        return alpha * slope, [t + (integral(x) - integral(t)) / slope for x in middles]

    @staticmethod
    def latest(frame):
        """Middle of the exposure of its last column."""
        return int(np.max(frame.column_mid_us))

    def passes(self, frame):
        return max(int(np.max(frame.exposure_end_us)) + 1, frame.available_us
                   if self.mode == "causal" else self.latest(frame) + self.ahead)

    def usable(self, frame):
        if self.mode == "causal":
            return self.passes(frame)
        return max(int(np.max(frame.exposure_end_us)) + 1, self.latest(frame) + (
            250_000 if self.mode == "offline" else 0))

    def sample(self, frame, at):
        """z and its variance, None if it is not usable."""
        dn, m = frame.dn[at], self.m
        begin, end = self.exposure(frame, at)
        ms = (end - begin) / 1000 or 1.0
        if dn < 1 or (frame.valid is not None and not frame.valid[at]):
            return None, 1.0
        full = dn + m.black * ms
        return math.log(full / ms), min(
            (m.read_variance + m.shot * dn) / full ** 2 + 1e-4, 1)

    @staticmethod
    def exposure(frame, at):
        return tuple(int(edge[min(at[1], len(edge) - 1)]) for edge in map(np.ravel, (
            frame.exposure_start_us, frame.exposure_end_us)))

    def nodes(self, frame, known, t=None):
        """Nodes of a frame and what `around` says: as known then; a silence that ended
        since, up to t, as it ended."""
        nodes, planes = np.empty(self.shape, object), np.zeros((3, *self.shape))
        ahead = min(known - self.latest(frame), self.ahead)
        newest = max([0, *(int(1e6 * lag) for i, lag in enumerate(self.m.lags_s) if (
            lag and 1e6 * lag <= ahead) and (
            np.any([self.m.own[i], self.m.cell[i], self.m.near[i]])))])
        middles = np.broadcast_to(frame.column_mid_us, self.shape[1]).tolist()
        for at, p in np.ndenumerate(self.pixels):
            begin, end = self.exposure(frame, at)
            middle = middles[at[1]]
            now, here = known, known
            if t is not None and p.last(t) >= 0:
                e = p.t[p.last(t)]
                was = p.open_event(end, max(known, end))
                now = e if was is not None and e > was else known
                was = p.open_event(middle + newest, known)
                here = e if was is not None and e > was and not self.ahead else known
            nodes[at] = p.node(begin, end, self.sample(frame, at)[0], now,
                               self.about[id(frame)][at])
            planes[(slice(None), *at)] = p.around(middle, here, ahead)
        return nodes, planes

    @staticmethod
    def differ(nodes, planes, old, levels):
        """Set what other times and pixels say since the frame before."""
        hot = np.vectorize(lambda level: level.hot > HOT)(levels)
        for at, value in np.ndenumerate(mean_around(np.where(hot, 0, planes - old))):
            nodes[at]["around"] = value

    def read(self, t):
        """ln light and its variance, without the weighing of the degree."""
        seen = t + self.ahead
        levels = np.empty(self.shape, object)
        for at in np.ndindex(self.shape):
            levels[at] = Level(self.gain[at])
        passed = [f for f in self.frames if self.passes(f) <= seen]
        self.about = {}     # gains about which a frame's mean is linear: when it comes
        for k, f in enumerate(passed):
            self.add(lambda g, f=f: g.mid_us < self.passes(f), levels)
            known = self.passes(f) - 1
            new, planes = self.nodes(f, known)
            g = passed[max(k - 1, 0)]
            old = new
            if k:
                # as known now: all lags of g's were known when it passed
                old, before = self.nodes(g, known)
                self.differ(new, planes, before, levels)
            for at in np.ndindex(self.shape):
                seconds = self.seconds(g, f, at)
                levels[at].update(
                    old[at], new[at], seconds, *self.sample(f, at), self.m)
        self.add(lambda g: True, levels)
        later = [f for f in self.frames if f not in passed and self.usable(f) <= seen]
        self.alone = len(later) < 2
        looked, said = [], []
        for f in later:
            nodes, planes = self.nodes(f, self.usable(f) - 1)
            looked.append(nodes)
            said.append(planes)
        anchor = passed[-1] if passed else None
        here = then = None
        if anchor is not None:
            here, then = self.nodes(anchor, self.passes(anchor) - 1, t)
            said = [then, *said]
        elif later:
            then = said[0]
            for node in looked[0].flat:
                node["around"] = 0.0
        for nodes, new, old in zip(
                looked[anchor is None:], said[1:], said, strict=False):
            self.differ(nodes, new, old, levels)
        now = np.zeros((3, *self.shape))
        out = np.zeros((2, *self.shape))
        for at, p in np.ndenumerate(self.pixels):
            level, hot = levels[at], levels[at].hot > HOT
            node = here[at] if here is not None else None
            b, v = self.back(later, looked, level, at)
            f = later[0] if later else None
            after = looked[0][at] if later else None
            if after is not None and after["at_end"] is not None:
                begin, end = self.exposure(f, at)
                if p.last(after["at_end"]) > p.last(t) or after["at_end"] > begin:
                    known = self.known_of(p, after["at_end"], seen)
                    after = {**p.node(begin, end, self.sample(f, at)[0], known,
                                      self.about[id(f)][at]), "around": after["around"]}
            *values, t_around = self.at(
                t, p, level, node, anchor, b, v, f, after, at)
            out[(slice(None), *at)] = values
            if not hot:
                now[(slice(None), *at)] = p.around(
                    t_around, t_around + self.ahead, self.ahead)
                if then is not None:
                    now[(slice(None), *at)] -= then[(slice(None), *at)]
        log, variance = out[0] + mean_around(now), out[1]
        return log, variance

    @staticmethod
    def known_of(p, since, seen):
        """Up to when a silence is known that was open in the frame after."""
        k = p.last(since) + 1
        if k < len(p.t) and p.t[k] <= seen:
            return p.t[k]
        length = max(seen - since, 0)
        step = 1 << max(length.bit_length() - 4, 0)
        return since + length // step * step

    def add(self, which, levels):
        """Note the gains when frames come."""
        gains = np.empty((*self.shape, 2))
        for at, level in np.ndenumerate(levels):
            gains[at] = level.x[1:]
        for frame in self.frames:
            if id(frame) not in self.about and which(frame):
                self.about[id(frame)] = gains

    def seconds(self, old, new, at):
        """Time between two frames, and what it counts more."""
        lost = 0.0
        if new is not old and self.m.missing:
            begin, end = self.hole(
                self.latest(old), self.latest(new), int(np.max(new.exposure_end_us)))
            lost = self.m.missing / self.m.noise[0] * (end - begin)
        return 1e-6 * (self.mid(new, at) - self.mid(old, at) + lost)

    def mid(self, frame, at):
        return int(np.broadcast_to(frame.column_mid_us, self.shape[1])[at[1]])

    def back(self, later, looked, level, at):
        """The estimate of the frames after t, at the first of them."""
        b, v = 0.0, -1.0
        for i in range(len(later) - 1, -1, -1):
            if v > 0:
                change, d, _, noise = between(
                    looked[i][at], looked[i + 1][at],
                    self.seconds(later[i], later[i + 1], at), self.m)
                if level.hot > HOT:
                    v += level.motion
                else:
                    b, v = b - change - d @ level.x[1:], v + noise
            z, r = self.sample(later[i], at)
            if len(later) > 1 and level.hot <= HOT:
                k = max(i - 1, 0)
                r += self.m.noise[1] / 4 * min(
                    between(looked[k][at], looked[k + 1][at], 0.0, self.m)[2], 1)
            if z is not None:
                if v <= 0 or (z - b) ** 2 > GATE * (v + r):
                    b, v = z, r
                else:
                    b, v = b + v / (v + r) * (z - b), v * r / (v + r)
        return b, v

    def at(self, t, p, level, node, anchor, b, v, later, after, at):
        """J and its variance at t, and the time at which other times are looked at.

        A long silence is interpolated between times that grow by KNOT."""
        m, ahead = self.m, self.ahead
        k = p.last(t)
        since = 1e-6 * (t - p.t[k]) if k >= 0 else 0.0
        if k < 0 or p.last(t + ahead) > k or since <= SMOOTH_FROM_S or (
                t - p.t[k] > 40_000 and goes_on(
                    max(since + 1e-6 * ahead, p.before[k]), m) <= 0):
            return *self.exact(t, t + ahead, t, p, level, node, anchor, b, v, later,
                               after, at), t
        knot = SMOOTH_FROM_S
        while knot * KNOT <= since:
            knot *= KNOT
        t0, t1 = (p.t[k] + int(1e6 * one) for one in (knot, knot * KNOT))
        ends = [np.array(self.exact(x, x + ahead, t, p, level, node, anchor, b, v,
                                    later, after, at)) for x in (t0, t1)]
        J, V = ends[0] + (t - t0) / (t1 - t0) * (ends[1] - ends[0])
        return J, V, t0

    def exact(self, t, known, event_t, p, level, node, anchor, b, v, later, after, at):
        m, hot = self.m, level.hot > HOT
        _, beta, gamma = m.noise
        alpha, middles = self.even(event_t, anchor, later, [
            self.mid(frame, at) for frame in (anchor, later) if frame is not None])
        k = p.last(event_t)
        theta = (1 + level.x[1:]) * m.theta * (not hot)
        J = slope = extra = 0.0
        light, now, c = p.light[k + 1], np.zeros(2), np.zeros(2)
        # Passed since the frame before, and until the one after; variances of the part
        # of an open silence.
        d1 = light - node["light"] if node is not None else c
        d2 = after["light"] - light if after is not None else c
        open_1 = open_2 = 0.0
        more_1, more_2 = c, c       # what is known by now, in both
        if k >= 0 and not hot:
            q = Pixel.__new__(Pixel)        # the same silence, later events unknown
            q.__dict__ = dict(p.__dict__)
            silent = p.last(event_t + self.ahead) == k
            if silent:
                q.t = p.t[:k + 1]
            part, rate, open_v = q.part(t, known)
            J, slope, now = theta @ part, theta @ rate, m.theta * part
            then = node["variance"] if node is not None and (
                node["open"] == p.t[k]) else 0.0
            ends = [(node, anchor, -1, d1), (after, later, 1, d2)]
            for i, (one, frame, sign, d) in enumerate(ends):
                if one is None:
                    continue
                exposure = self.exposure(frame, at)
                if one["at_end"] == p.t[k] <= exposure[0]:
                    mean = q.mean_part(*exposure, known)
                    more = sign * m.theta * mean - d
                    if i:
                        more_2 = more
                    else:
                        more_1 = more
                        then = q.part(self.mid(frame, at), known)[2]
            if silent:
                square = m.theta.mean() ** 2
                open_1 = square * max(open_v - then, 0)
                if after is not None:
                    open_2 = square * max(
                        q.part(self.mid(later, at), known)[2] - open_v, 0)
        S = level.P[1:, 1:] + m.theta_cov / np.outer(m.theta, m.theta)
        e1, e2 = d1, d2
        d1, d2 = d1 + more_1 + now, d2 + more_2 - now
        n1, n2 = (0 if hot else (abs(d) / m.theta).sum() for d in (d1, d2))
        has1, has2 = level.sampled > 0, v > 0
        n1, n2 = n1 * has1, n2 * has2
        each = beta / 2 * min(n1 + n2, 1) / (n1 + n2) if n1 + n2 else 0.0
        common = 0.0
        if has1:
            J1, V1 = level.x[0], level.P[0, 0]
            if hot:
                V1 += level.motion
            else:
                J1 += light.sum() - node["h"] + e1 @ level.x[1:] + (
                    1 + level.x[1:]) @ more_1
                V1 += 2 * d1 @ level.P[0, 1:] + d1 @ S @ d1 + gamma * n1
            V1 += each * n1 + open_1 + alpha * 1e-6 * abs(t - middles[0])
            extra += beta / 4 * min(n1, 1)
        if has2:
            J2 = b - after["around"]
            V2 = v
            if hot:
                V2 += level.motion
            else:
                J2 -= after["h"] - light.sum() + e2 @ level.x[1:] + (
                    1 + level.x[1:]) @ more_2
                V2 += d2 @ S @ d2 + gamma * n2
                V2 += beta / 4 * min(n1 + n2, 1) * self.alone
                common = -d2 @ (level.P[0, 1:] + S @ d1)
            V2 += each * n2 + open_2 + alpha * 1e-6 * abs(t - middles[-1])
        if has1 and has2:
            all_ = V1 + V2 - 2 * common
            u = min(max((V1 - common) / all_, 0), 1)
            J += J1 + u * (J2 - J1)
            V = V1 + u * (u * all_ - 2 * (V1 - common))
        elif has1 or has2:
            J, V = (J + J1, V1) if has1 else (J + J2, V2)
        else:
            return 0.0, 1e3
        if slope:
            ahead = p.lead(slope, max(math.exp(J) - m.black, 1e-3))
            J += ahead
        V += extra
        return J, V
