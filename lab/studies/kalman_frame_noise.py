"""Prior of the noise of frames that `kalman` learns, on light that is not in the score.

Finds what `FRAME_NOISE` (reconstruct/kalman/frame_noise.py) should be.  Pixels at rest,
of any light between 10 and 600 DN, get read and shot noise drawn from the whole range
that the bounds allow; no events, no polarizer, no preset.  After 1, 3 and 18 third
differences, for which three frames more are needed, the noise that the filter assumes
is compared, in ln of the variance of a sample, with the true one, for priors that are
four times narrower and wider.  The same with light that moves within the dead band, so
that no event comes: at up to 2 Hz the third differences must leave it out.

    python lab/studies/kalman_frame_noise.py [--quick]
"""
from __future__ import annotations

import math
import sys
from unittest import mock

import numpy as np
from common import Found, main

from pdavis_cv import ApsFrame, KalmanFilter
from pdavis_cv.reconstruct.kalman import frame_noise

SIDE, FRAMES = 16, (4, 6, 21)
SLOW = 0.1, (0.25, 2.0)     # amplitude, ln: half a threshold; frequencies, Hz
FACTORS = (0.25, 1.0, 4.0)


def error(read_dn: float, per_shot: float, seed: int,
          slow: bool = False) -> list[float]:
    """Return the rms error of ln of a sample's variance after some frames."""
    rng = np.random.default_rng(seed)
    rest = np.exp(rng.uniform(math.log(10), math.log(600), (SIDE, SIDE)))
    amplitude, range_hz = SLOW
    hz, phase = rng.uniform(*range_hz), rng.uniform(0, math.tau, rest.shape)
    method = KalmanFilter((SIDE, SIDE), theta_on=0.2, theta_off=0.2, mode="causal")
    found = []
    for k in range(max(FRAMES)):
        light = rest * np.exp(
            slow * amplitude * np.sin(math.tau * hz * k / 20 + phase))
        true = read_dn**2 + light / per_shot
        dn = light + np.sqrt(true) * rng.normal(size=light.shape)
        method.add_frame(ApsFrame(dn.astype(np.float32), 50_000 * k, 50_000 * k + 500))
        if k + 1 in FRAMES:
            method.settle(50_000 * k + 1_000)
            tuning = method._tuning[0]
            known = tuning["read_variance"] + light * tuning["shot_variance"]
            found.append(float(np.sqrt(np.mean(np.log(known / true) ** 2))))
    return found


def study(quick: bool) -> list[Found]:
    """Print the errors by width of the prior; the code's is to be as good as others."""
    rng = np.random.default_rng(0)
    cameras = [(math.exp(rng.uniform(0, math.log(15))),
                math.exp(rng.uniform(math.log(1.5), math.log(150))))
               for _ in range(6 if quick else 40)]
    (read, shot), low, high = frame_noise.FRAME_NOISE
    means = {}
    for factor in FACTORS:
        with mock.patch.object(frame_noise, "FRAME_NOISE",
                               ((factor * read, factor * shot), low, high)):
            rows = np.array([error(*camera, seed) for seed, camera in enumerate(
                cameras)])
        means[factor] = rows.mean(0)
        print(f"prior x {factor:g}: error of ln R after {FRAMES} frames",
              " ".join(f"{value:.2f}" for value in means[factor]))
    moves = np.mean([error(*camera, seed, slow=True)
                     for seed, camera in enumerate(cameras)], axis=0)
    print(f"light that moves without an event: after {FRAMES} frames",
          " ".join(f"{value:.2f}" for value in moves))
    # Together: a wide prior is better in the end, a narrow one would be at first.
    whole = {factor: float(mean.mean()) for factor, mean in means.items()}
    return [
        Found("error with the code's FRAME_NOISE over the least of three",
              whole[1.0] / min(whole.values()), 1.15, at_least=True),
        Found("error of ln R after 21 frames", float(means[1.0][-1]), 0.35,
              at_least=True),
        Found("the same, of light that moves without an event", float(moves[-1]), 0.35,
              at_least=True)]


if __name__ == "__main__":
    sys.exit(main(study))
