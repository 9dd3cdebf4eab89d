"""Read and shot noise of frames: the prior, and the estimate from frames."""
from __future__ import annotations

from collections.abc import Sequence

__all__ = ["DN_PER_SHOT", "READ_NOISE_DN", "frame_noise"]

# Prior of a frame's noise: read noise in DN, and signal in DN per DN^2 of shot noise
# variance.
READ_NOISE_DN, DN_PER_SHOT = 2.0, 10.0
FRAME_NOISE = ((4.0, 0.1), (1.0, 0.005), (400.0, 1.0))
"""Variances of read noise (DN^2) and of shot noise (DN^2 per DN): prior sigmas, which
equal the prior means; lower bounds; upper bounds.  Engineering choice: read noise of 1
to 20 DN, shot noise from that of 200 electrons per DN to that of one."""

# Independent differences tell so many times as much as third differences that share
# samples.  Two of them, 1, 2 or 3 frames apart, have the correlations -15/20, 6/20 and
# -1/20, and their squares the squares of these: 1 + 2 (15^2 + 6^2 + 1) / 20^2.
_SHARED = 2.31

# Iterations of the alternating least-squares fit, which converges geometrically.
_TURNS = 20


def frame_noise(normal: Sequence[float]) -> tuple[float, float]:
    """Return the variances of read and shot noise that fit third differences.

    Solves the normal equations, with the prior and the bounds of `FRAME_NOISE`, by
    alternating between both.

    Parameters
    ----------
    normal : sequence of float
        Sums of r z, s z, r r, r s and s s over third differences d of a pixel's
        samples, where v is the variance of a sample with the present noise, r v and s v
        its derivatives by the two variances, and z is d^2 / 20 v - 1 plus r and s times
        the present variances.

    Returns
    -------
    (float, float)
        Variances in DN^2, and in DN^2 per DN.
    """
    (sigma, sigma_shot), (low, low_shot), (high, high_shot) = FRAME_NOISE
    read, shot = READ_NOISE_DN**2, 1 / DN_PER_SHOT
    of_one = 2 * _SHARED    # d^2 / 20 v of a Gaussian difference has the variance 2
    weight, weight_shot = of_one / sigma**2, of_one / sigma_shot**2
    of_read, of_shot, read_read, read_shot, shot_shot = normal
    of_read, of_shot = of_read + weight * read, of_shot + weight_shot * shot
    for _ in range(_TURNS):
        read = min(max((of_read - read_shot * shot) / (read_read + weight), low), high)
        shot = min(max((of_shot - read_shot * read) / (shot_shot + weight_shot),
                       low_shot), high_shot)
    return read, shot
