"""Plain NumPy versions of the redundancy kernels, written to be read."""
import numpy as np

LINE_ERROR, FAR_ERRORS = 2.2, 2.6   # sigma of a line in 1 / (2 N)^2, and of outliers


class Macropixel:
    """Four pixels in float64: moments of n exp(log), balances, gains."""

    def __init__(self, null, prior, keep, sigma, per_event, loss):
        self.null, self.prior = null, prior
        self.keep, self.sigma, self.per_event, self.loss = keep, sigma, per_event, loss
        self.base = np.zeros(4)
        self.theta = prior.copy()
        self.curves = [[] for _ in range(4)]    # (weight, all events, ON events)
        self.counts = np.zeros((4, 2))
        self.M, self.n = np.zeros((4, 4)), 0.0
        self.ratio = self.least = 1.0
        self.definite = True    # rounding decided nothing so far

    def sample(self, log, on, off):
        if not (on + off).any():
            return
        level = log.mean()
        v = self.null * np.exp(log - level)
        self.M = self.M * self.keep + np.outer(v, v) / (v @ v)
        self.n = self.n * self.keep + 1
        self.base += self.theta[:, 0] * on - self.theta[:, 1] * off - level * self.loss
        for i in np.flatnonzero(on + off):
            n = on[i] + off[i]
            self.counts[i] += n, on[i]
            self.curves[i] = [(w * np.exp(-n * self.per_event), *point)
                              for w, *point in self.curves[i]]
            self.curves[i].append((n, *self.counts[i]))
            self.rebalance(i)

    def rebalance(self, i):
        """Fit a line to ON events against all events."""
        w, every, on = np.array(self.curves[i]).T
        total = self.prior[i].sum()
        travel = total * w.sum() / 4
        every = every - np.average(every, weights=w)
        on = on - np.average(on, weights=w)
        spread = w @ every**2
        if spread <= 1e-9:
            return
        slope = w @ (every * on) / spread
        level = 2 * (on - every * self.prior[i, 1] / total)
        swing = w @ level**2 / spread
        if swing >= 1:
            return
        rest = 4 * (w @ (on - slope * every)**2) / spread
        # A ratio of sigma adds sigma^2 / 4 to the swing.
        error = LINE_ERROR * min(max(swing - self.sigma**2 / 4, rest),
                                 max(rest, 4 / travel**2))
        part = np.clip(slope, 0.05, 0.95)
        before = np.log(self.prior[i, 0] / self.prior[i, 1])
        shift = np.log((1 - part) / part) - before
        believed = max(shift**2 - (FAR_ERRORS * error)**2, self.sigma**2)
        ratio = np.exp(before + shift * believed / (believed + error**2))
        self.theta[i] = total * ratio / (1 + ratio), total / (1 + ratio)

    def solve(self, pull, least):
        if self.n < least:
            return
        scale = np.sqrt(np.diag(self.M))
        R = self.M / np.outer(scale, scale) + pull * (np.eye(4) - 0.25)
        values, vectors = np.linalg.eigh(R)
        gain = vectors[:, 0] * np.sign(vectors[:, 0].sum())
        self.definite &= values[1] - values[0] > 0.05 and abs(gain.min() - 0.02) > 0.01
        if gain.min() < 0.02:
            self.ratio = self.least = 1.0
            return
        self.least = max(values[0], 1e-6)
        second = values[1] - pull
        self.ratio = self.least / second if second > self.least else 1.0
        shift = np.log(gain / scale)
        shift -= shift.mean()
        self.base += shift
        self.M *= np.exp(np.add.outer(shift, shift))


def saturated_events(events, cell_of, columns):
    """Events of the numbered macropixels, on a sensor of `columns` of them in a row."""
    rows, wide = cell_of.shape
    y, x = events["y"].astype(int), events["x"].astype(int)
    cell = np.full(len(events), -1)
    inside = (y < 2 * rows) & (x < 2 * wide)
    cell[inside] = cell_of[y[inside] // 2, x[inside] // 2]
    moved = events.copy()
    moved["y"], moved["x"] = cell // columns * 2 + y % 2, cell % columns * 2 + x % 2
    return moved[cell >= 0]


def saturated_fill(cells, seen, bound, prior, excess, dim, valid_variance, shown):
    """Weigh (log, variance, valid) and what events tell, by their variances."""
    pixels, missing = cells
    columns = seen[0].shape[1] // 2
    log, variance, valid = (plane.copy() for plane in shown)
    for i, (at, gone) in enumerate(zip(pixels.T, missing.T.astype(bool), strict=True)):
        row, column = i // columns * 2, i % columns * 2
        of = tuple(np.array([(row + k // 2, column + k % 2) for k in range(4)]).T)
        log.ravel()[at[gone]] = bound.ravel()[at[gone]]
        told, rest, enough, quality = (plane[of] for plane in seen)
        spread = excess * (rest + prior * quality).astype(float)
        weight = np.where(gone, 0, 1 / (variance.ravel()[at] + spread))
        offset = bound.ravel()[at].mean()
        kept = np.full(4, False)
        if weight.sum() * valid_variance < 1:
            kept = ~gone & ((variance.ravel()[at] <= valid_variance) | (enough == 0))
            gone = ~kept
            log.ravel()[at[gone]] = bound.ravel()[at[gone]]
        else:
            apart = log.ravel()[at] - told
            offset = (weight * apart).sum() / weight.sum()
            known = 4 - gone.sum()
            square = (weight * (apart - offset)**2).sum()
            if known > 1 and bound.ravel()[at].max() <= dim:
                spread = spread * (1 + (square / (known - 1) / 9)**2)
            spread = spread + 1 / weight.sum()
        own = variance.ravel()[at].astype(float)
        share = np.where(gone, 1, own / (own + spread))
        here = enough.astype(bool) & ~kept
        log.ravel()[at[here]] += (share * (told + offset - log.ravel()[at]))[here]
        variance.ravel()[at[here]] = np.where(gone, spread, (1 - share) * own)[here]
        valid.ravel()[at[here]] = variance.ravel()[at[here]] <= valid_variance
    return log, variance, valid
