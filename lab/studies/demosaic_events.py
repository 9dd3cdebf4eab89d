"""Guided against bilinear demosaicing of a moving texture through `kalman`.

Three ``nominal`` cameras before textures whose AoP and DoLP are as detailed as their
intensity (shortest wavelength 8 pixels), thresholds known; RMS errors where the true
DoLP exceeds .1.  Simulated events only: no constant was chosen on these specimens.
"""
from __future__ import annotations

import sys

import numpy as np
from common import Found, main

from pdavis_cv import fuse
from pdavis_cv.simulation import Camera, Texture

# Specimen -> velocity of the texture in pixels per second.
TAKES = {3: (200.0, 60.0), 11: (200.0, 60.0), 12: (150.0, -100.0)}
METHODS = ("bilinear", "guided", "binned", "superpixel")


def errors(seed: int, velocity: tuple[float, float], size: tuple[int, int],
           seconds: float) -> dict[str, np.ndarray]:
    """Return RMS errors of AoP (degrees) and of DoLP by demosaicing."""
    camera = Camera.preset("nominal", seed=seed, size=size)
    recording, truth = camera.record(Texture(velocity=velocity, seed=seed), seconds)
    times_us = np.arange(307_000, int((seconds - 0.1) * 1e6), 20_000)
    found = {}
    for method in METHODS:
        squares = []
        for image in fuse(recording, method="kalman", demosaic=method,
                          thresholds=(camera.maps["theta_on"],
                                      camera.maps["theta_off"]), times_us=times_us):
            s0, s1, s2 = (plane if image.s0.shape == size else plane.reshape(
                size[0] // 2, 2, size[1] // 2, 2).mean((1, 3))
                for plane in truth.image(image.t_us))
            dolp = np.hypot(s1, s2) / s0
            seen = (dolp > 0.1) & image.valid
            turn = (image.aop - np.arctan2(s2, s1) / 2 + np.pi / 2) % np.pi - np.pi / 2
            squares.append((np.mean(np.rad2deg(turn[seen])**2),
                            np.mean((image.dolp - dolp)[seen]**2)))
        found[method] = np.sqrt(np.mean(squares, 0))
    return found


def study(quick: bool) -> list[Found]:
    """Simulate the takes and compare."""
    takes = dict(list(TAKES.items())[:1]) if quick else TAKES
    size, seconds = ((24, 32), 0.6) if quick else ((40, 48), 1.0)
    gains = []
    for seed, velocity in takes.items():
        found = errors(seed, velocity, size, seconds)
        gains.append(1 - found["guided"] / found["bilinear"])
        if not quick:
            print(f"specimen {seed}:", *(f"{name} {aop:.2f} degrees {dolp:.4f},"
                                         for name, (aop, dolp) in found.items()))
    aop, dolp = np.mean(gains, 0)
    least = -0.05 if quick else 0.09    # a small image for a short time: no worse
    return [Found("guided, AoP better by", aop, least, at_most=True),
            Found("guided, DoLP better by", dolp, least, at_most=True)]


if __name__ == "__main__":
    sys.exit(main(study))
