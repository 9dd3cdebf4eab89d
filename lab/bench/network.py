"""What `python -m lab.bench` times of the networks."""
from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from lab.paper.network import all_weights, network_steps
from pdavis_cv.reconstruct.runner import BACKENDS, chosen_backend, make_runner
from pdavis_cv.reconstruct.weights import Weights

from .cases import Comparison, case

_STEPS, _SIZE = 20, (13, 17)


def _check(weights: Weights) -> None:
    """Both libraries must give the same, whichever of them is timed."""
    random = np.random.default_rng(0)
    runs = [make_runner(weights, *_SIZE, backend) for backend in BACKENDS]
    states = [[np.zeros((1, 16, *_SIZE), np.float32)] * 2 for _ in runs]
    for _ in range(_STEPS):
        x = random.poisson(0.4, (1, 28, *_SIZE)).astype(np.float32) - np.float32(0.4)
        (one, *states[0]), (other, *states[1]) = (
            run(x, *state) for run, state in zip(runs, states, strict=True))
        assert np.abs(one - other).max() <= 1e-5 * np.abs(one).max()


@case("joint", "one 346x260 image of joint, against firenet's four passes", 0.35,
      by_time=True)
def _joint() -> Iterator[Comparison]:
    for backend in BACKENDS:
        chosen_backend(backend)  # says what is not installed
    weights = all_weights(())
    steps = network_steps(weights)
    yield Comparison("a quarter event per pixel", lambda: _check(weights["joint"]),
                     steps["joint"], steps["firenet"], lambda s: 1e3 * s, "ms")
