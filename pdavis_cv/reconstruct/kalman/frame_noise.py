"""Noise of frames: what is assumed of it, and what innovations say."""
from __future__ import annotations

from collections.abc import Sequence

__all__ = ["DN_PER_SHOT", "READ_NOISE_DN", "frame_noise"]

# Prior of a frame: read noise in DN, and DN per unit of shot noise variance.
READ_NOISE_DN, DN_PER_SHOT = 2.0, 10.0
FRAME_NOISE = ((4.0, 0.1), (1.0, 0.005), (400.0, 1.0))
"""Variances of read noise (DN^2) and of shot noise (DN^2 per DN): sigma of the prior,
as large as its mean; lower bounds; upper bounds.  Engineering choice: read noise of 1
to 20 DN, shot noise from half of that of 80 electrons per DN to that of one."""

# Turns of a least-squares fit of two numbers, which converges geometrically.
_TURNS = 20


def frame_noise(normal: Sequence[float]) -> tuple[float, float]:
    """Return the variances of read and shot noise by their normal equations.

    Least squares within the bounds and with the prior of `FRAME_NOISE`, by turns.

    Parameters
    ----------
    normal : sequence of float
        Sums over innovations e of variance v, whose derivatives by both variances are
        r v and s v: of r (e^2 / v - 1) and s (e^2 / v - 1), both with what the present
        variances make added to them, and of r r, r s and s s.

    Returns
    -------
    (float, float)
        DN^2, and DN^2 per DN.
    """
    (sigma, sigma_shot), (low, low_shot), (high, high_shot) = FRAME_NOISE
    read, shot = READ_NOISE_DN**2, 1 / DN_PER_SHOT
    weight, weight_shot = 2 / sigma**2, 2 / sigma_shot**2   # var(e^2 / v) is 2
    of_read, of_shot, read_read, read_shot, shot_shot = normal
    of_read, of_shot = of_read + weight * read, of_shot + weight_shot * shot
    for _ in range(_TURNS):
        read = min(max((of_read - read_shot * shot) / (read_read + weight), low), high)
        shot = min(max((of_shot - read_shot * read) / (shot_shot + weight_shot),
                       low_shot), high_shot)
    return read, shot
