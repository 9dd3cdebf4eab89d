"""The simulated recordings that ship with the library: what they show, exactly."""
from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

from pdavis_cv.simulation.camera import Camera
from pdavis_cv.simulation.patterns import Fan, Tendon
from pdavis_cv.simulation.scenes import Scene
from pdavis_cv.simulation.stream import SimulatedRecording
from pdavis_cv.simulation.truth import Truth

# Sized so that a file has at most 2 MB.
EXAMPLES: Mapping[str, tuple[Scene, tuple[int, int]]] = MappingProxyType({
    "fan": (Fan(rpm=60.0, radius=27.0, hub=5.0), (56, 56)),
    "tendon": (Tendon(hz=4.3), (64, 96)),
})
"""Scene, and (height, width) in the middle of the sensor, of the examples, by their
names in `pdavis_cv.data.example_recording`."""


def example_stream(name: str) -> SimulatedRecording:
    """Return a second of an example by a `nominal` camera, simulated while read."""
    if name not in EXAMPLES:
        raise ValueError(f"name must be one of {', '.join(EXAMPLES)}, got {name!r}")
    scene, size = EXAMPLES[name]
    return Camera.preset("nominal", seed=1, size=size).stream(scene, 1.0)


def example_truth(name: str) -> Truth:
    """Return the exact truth of a shipped recording.

    Parameters
    ----------
    name : {"fan", "tendon"}
        As for `pdavis_cv.data.example_recording`.

    Returns
    -------
    Truth
        Exact at any time and place: ``image(t_us)``, ``aop(t_us, x, y)``, ...

    Raises
    ------
    ValueError
        If there is no simulated recording of this name.

    Examples
    --------
    >>> import numpy as np
    >>> truth = example_truth("fan")
    >>> print(np.rad2deg(truth.aop([0, 100_000], 45, 20)))
    [0. 6.]
    """
    return example_stream(name).truth()
