"""What the Kalman method estimates of its noise, in plain float64 NumPy."""
from dataclasses import dataclass, field

import numpy as np

FRAME_SIGMA, PER_EVENT = 0.01, 0.0003


@dataclass
class Noise:
    """Noise of events at rest, of motion and of frames, estimated from innovations."""

    p_noise: float = 0.5
    motion: float = 0.002
    noise_count: float = 0.0
    noise_weight: float = 0.0
    per_event: float = PER_EVENT
    matrix: np.ndarray = 0.0    # of motion and events, normal equations
    product: np.ndarray = 0.0
    of_frames: np.ndarray = field(default_factory=lambda: np.array([4.0, 0.1]))
    normal: np.ndarray = 0.0    # of both, normal equations: matrix and right-hand side
    right: np.ndarray = 0.0
    drift: float = 0.0          # variance of thresholds from frame to frame, relative
    product_of_drift: float = 0.0
    weight_of_drift: float = 0.0
    change: tuple = ()          # of the frame before, and its information matrix

    def follow(self, sums):
        """Drift by what two frames say of a common change of the thresholds."""
        normal, right = np.eye(2) / 0.1**2, np.zeros(2)
        for _, _, _, _, (by, e, v), *_ in sums:
            normal, right = normal + np.outer(by, by) / v, right + by * e / v
        change = np.linalg.solve(normal, right)
        information = np.linalg.inv(np.linalg.inv(normal) + 0.002**2 * np.eye(2))
        if self.change:
            before, known = self.change
            self.product_of_drift += (information @ change) @ (known @ before)
            self.weight_of_drift += np.sum(information * known)
        self.change = change, information
        self.drift = max(self.product_of_drift, 0) / (
            self.weight_of_drift + 0.005**-4)

    def at(self, per_dn):
        """Variance of a sample in light of 1 / per_dn DN."""
        return self.of_frames @ (per_dn**2, per_dn) + FRAME_SIGMA**2

    def adapt(self, sums):
        for *_, w, excess in sums:
            self.normal = self.normal + np.outer(w, w)
            self.right = self.right + w * (excess + w @ self.of_frames)
        prior = 2 * 2.31 * np.diag([1 / 4.0**2, 1 / 0.1**2])
        normal, right = self.normal + prior, self.right + prior @ (4.0, 0.1)
        x = np.array([4.0, 0.1])
        for k in (0, 1) * 20:
            x[k] = np.clip((right[k] - normal[k, 1 - k] * x[1 - k]) / normal[k, k],
                           (1, 0.005)[k], (400, 1)[k])
        self.of_frames = x
        noise_count, noise_weight = np.sum(
            [each[:2] for each in sums], axis=0) if sums else np.zeros(2)
        self.noise_count += noise_count
        self.noise_weight += noise_weight
        self.p_noise = (25 + self.noise_count) / (50 + self.noise_weight)
        u = np.array([each[2] for each in sums]).reshape(-1, 2)
        weight = 1 / (u[:, 0] @ u[:, 0] + 2 / 0.05**2)
        self.matrix = self.matrix + weight * u.T @ u
        self.product = self.product + weight * u.T @ [each[3] for each in sums]
        x = np.array([0.002, PER_EVENT])
        normal = self.matrix + np.diag([1, 400])
        right = self.product + np.array([1, 400]) * x
        for k in (0, 1) * 20:
            x[k] = np.clip((right[k] - normal[k, 1 - k] * x[1 - k]) / normal[k, k],
                           (0, PER_EVENT)[k], (1, 0.5)[k])
        self.motion, self.per_event = x
        self.follow(sums)
        for name in ("noise_count", "noise_weight", "matrix", "product", "normal",
                     "right", "product_of_drift", "weight_of_drift"):
            setattr(self, name, getattr(self, name) * np.exp(-1 / 20))
