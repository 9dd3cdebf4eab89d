"""The simulated recordings that ship with the library: what they show, exactly."""
from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

from pdavis_cv.simulation.camera import Camera
from pdavis_cv.simulation.patterns import Fan, Tendon
from pdavis_cv.simulation.scenes import Scene
from pdavis_cv.simulation.stream import SimulatedRecording
from pdavis_cv.simulation.truth import Truth

__all__ = ["EXAMPLES", "Example", "example_truth"]


@dataclass(frozen=True, kw_only=True)
class Example:
    """A simulated recording of a scene by a `nominal` camera.

    Parameters
    ----------
    scene : Scene
        The scene.
    size : (int, int)
        (height, width) of the recorded region in the middle of the sensor.
    seconds : float
        Duration.
    seed : int
        Seed of the camera's specimen.
    """

    scene: Scene
    size: tuple[int, int]
    seconds: float = 1.0
    seed: int = 1

    def stream(self) -> SimulatedRecording:
        """Return the recording, simulated while it is read."""
        camera = Camera.preset("nominal", seed=self.seed, size=self.size)
        return camera.stream(self.scene, self.seconds)


# Sized so that a file has at most 2 MB.
EXAMPLES: Mapping[str, Example] = MappingProxyType({
    "fan": Example(scene=Fan(rpm=60.0, radius=27.0, hub=5.0), size=(56, 56)),
    "tendon": Example(scene=Tendon(hz=4.3), size=(64, 96)),
})
"""The examples, by their names in `pdavis_cv.data.example_recording`."""


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
    if name not in EXAMPLES:
        raise ValueError(f"name must be one of {', '.join(EXAMPLES)}, got {name!r}")
    return EXAMPLES[name].stream().truth()
