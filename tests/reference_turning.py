"""Plain versions of the regression behind a turning analyser, pixel by pixel."""
import numpy as np

GUESS, FLOOR, WIDE, OUTLIER, RATIO, DARKEST, FEW, SILENT = (
    0.0256, 0.02, 0.5, 0.25, 2, 0.02, 0.8, 0.35)


def phi(a):
    return np.array([np.cos(a), np.sin(a)])


def solved(a, b, ridge):
    q = np.linalg.solve(a + ridge * np.eye(2), b)
    return q / max(np.hypot(*q), 1)


class Pixel:
    """One pixel: fading normal equations, and all rows for its thresholds."""

    def __init__(self, on, off):
        self.theta = {1: on, 0: -off}
        self.last = None
        self.a, self.b, self.yy, self.n = np.zeros((2, 2)), np.zeros(2), 0.0, 0.0
        self.s, self.rest = np.zeros(2), 0.0
        self.rows = []

    def add(self, g, y, weight, rows):
        self.a += weight * np.outer(g, g)
        self.b += weight * g * y
        self.yy += weight * y * y
        self.n += rows

    def event(self, t, p, angle, rate, tau, share):
        last, self.last = self.last, (t, p, angle)
        if last is None:
            return
        slow = np.exp(-(t - last[0]) / (RATIO * tau))
        for name in ("a", "b", "yy", "n", "s"):
            setattr(self, name, getattr(self, name) * max(slow**RATIO, FEW))
        step = 2 * np.sinh(self.theta[p] / 2)
        ridge = (FLOOR * step / WIDE) ** 2
        q = solved(self.a, self.b, ridge)
        middle = last[2] + rate * (t - last[0]) / 2
        here, mid, before = (max(1 + q @ phi(a), DARKEST)
                             for a in (angle, middle, last[2]))
        half = step / 4 * (p == last[1])
        self.add(phi(middle) - phi(last[2]) - half * (phi(middle) + phi(last[2])),
                 2 * half, GUESS * share / (mid * before), 0)
        e = np.exp(self.theta[p] / 2)
        g = (phi(angle) / e - phi(last[2]) * e) / np.sqrt(here * before)
        y = (e - 1 / e) / np.sqrt(here * before)
        self.add(g, y, 1, 1)
        error = y - g @ q
        self.s += g * error
        self.rest = self.rest * slow + np.clip(error, -2 * abs(step), 2 * abs(step))
        self.rows.append((*g, y, p, 1 / (1 + (error / (OUTLIER * step)) ** 2)))

    def read(self, t, tau, span, scale, common, late):
        """Return q, its errors along and across its direction, and S0."""
        age = max(t - self.last[0], 0)
        slow = np.exp(-age / (RATIO * tau))
        gone = slow**RATIO
        theta = np.sinh(self.theta[1] / 2) + np.sinh(-self.theta[0] / 2)
        floor = (FLOOR * theta) ** 2
        ridge = floor / WIDE**2 + (age > span) * (FLOOR / SILENT) ** 2
        a, b, n = self.a * gone, self.b * gone, self.n * gone
        q = solved(a, b, ridge)
        ratio = n / (2 * n - 1) if n > 1 else 1
        left = max(self.yy * gone - 2 * q @ b + q @ a @ q, 0)
        variance = (left + floor) / (max(n - 2 * ratio, 0) + 1)
        a = a + ridge * variance / floor * np.eye(2)
        q = solved(a, b, 0)
        drift = np.linalg.solve(a, self.s * gone)
        degree = np.hypot(*q)
        directions = np.array([q, (-q[1], q[0])]) / degree
        along, across = (max(variance * ratio * way @ np.linalg.solve(a, way),
                             (late * way @ drift)**2) for way in directions)
        along += ((1 - degree**2) * np.arctanh(degree))**2 * (scale**2 + common**2)
        return q, np.sqrt(along), np.sqrt(across), np.exp(self.rest * slow)

    def thresholds(self, on, off, spread):
        """Least squares for q, ln on and ln off, with their prior, on all rows."""
        rows = np.array(self.rows)
        g, y, p, w = rows[:, :2], rows[:, 2], rows[:, 3], rows[:, 4]
        u = np.array([self.theta[1], self.theta[0]])
        prior = np.log(u / [on, -off])
        floor = (FLOOR * (u[0] - u[1]) / 2) ** 2
        a, b = (g.T * w) @ g, (g.T * w) @ y
        q = solved(a, b, floor / WIDE**2)
        variance = max(np.sum(w * (y - g @ q) ** 2) / w.sum(), floor)
        # y - g q + u d = 0, d + prior = 0, q = 0.
        design = np.concatenate((g, -np.where(p == 1, u[0], 0)[:, None],
                                 -np.where(p == 0, u[1], 0)[:, None]), 1)
        normal = (design.T * w) @ design + np.diag(
            variance / np.array([WIDE, WIDE, spread, spread]) ** 2)
        right = (design.T * w) @ y
        right[2:] -= variance / spread**2 * prior
        return np.linalg.solve(normal, right)[2:]
