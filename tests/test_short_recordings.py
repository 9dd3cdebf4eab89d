"""Recordings with few events, odd counts, pixels without any: they fuse."""
import numpy as np
import pytest

from pdavis_cv import fuse
from pdavis_cv.simulation import PRESETS, Camera, RotatingPolarizer

WAYS = ({"causal": True}, {}, {"mode": "offline"})


@pytest.mark.gate
@pytest.mark.parametrize("seeds", [
    range(200), pytest.param(range(200, 230), marks=pytest.mark.accuracy)], ids=str)
def test_random_short_recordings_fuse_without_a_failure(seeds):
    """10 to 100 RPM for .2 to 2 s, any angle, every preset that has events."""
    presets = [name for name, parts in PRESETS.items() if parts["dvs"] is not None]
    failures = []
    for seed in seeds:
        rng = np.random.default_rng(1000 + seed)
        preset, way = presets[seed % len(presets)], WAYS[seed % len(WAYS)]
        camera = Camera.preset(
            preset, seed=seed, size=((8, 8), (8, 4), (4, 6), (2, 2))[seed % 4])
        made, _ = camera.record(RotatingPolarizer(
            rpm=rng.uniform(10, 100), start_angle=rng.uniform(0, np.pi),
            dolp=rng.uniform(0.1, 1)), 0.2 * 10 ** rng.uniform(0, 1))
        try:
            images = list(fuse(made, method="kalman", fps=5, **way))
            assert images, "no image"
            assert all(np.isfinite(image.quad).all() for image in images), "not finite"
        except Exception as error:
            failures.append((seed, preset, way, repr(error)))
    assert not failures
