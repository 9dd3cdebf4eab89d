"""Recordings that ship with the library; see THIRD_PARTY.md."""
from importlib.resources import files
from pathlib import Path

__all__ = ["example_recording"]

_FILES = {"davis346": "davis346_short.aedat4", "fan": "simulated_fan.aedat4",
          "tendon": "simulated_tendon.aedat4"}


def example_recording(name: str = "davis346") -> Path:
    """Return the path of a short recording.

    Parameters
    ----------
    name : {"davis346", "fan", "tendon"}
        ``davis346``: a real DAVIS346, a camera without polarizers, so that its AoP and
        DoLP are meaningless; 0.17 s with 6,676 events and 4 frames, written by DV, from
        event-vision-library (MIT, its notice is next to it).
        ``fan``: a simulated PDAVIS before a wheel of six polarizers at 60 RPM, its left
        half 2000 times brighter; 1 s, 56 x 56 pixels.
        ``tendon``: a simulated PDAVIS before a fibre sheet that is stretched at 4.3 Hz;
        1 s, 96 x 64 pixels.

    Returns
    -------
    Path
        An AEDAT-4 file.  `pdavis_cv.simulation.example_truth` returns the ground truth
        of the simulated ones.

    Raises
    ------
    ValueError
        If there is no recording of this name.
    """
    if name not in _FILES:
        raise ValueError(f"name must be one of {', '.join(_FILES)}, got {name!r}")
    return Path(str(files(__name__).joinpath(_FILES[name])))
