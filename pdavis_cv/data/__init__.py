"""Sample data that ships with the library; see THIRD_PARTY.md."""
from importlib.resources import files
from pathlib import Path

__all__ = ["example_recording"]


def example_recording() -> Path:
    """Return the path of a short recording of a DAVIS346, a camera without polarizers.

    0.17 s with 6,676 events and 4 frames, as DV wrote them; from event-vision-library
    (MIT, notice beside it).
    """
    return Path(str(files(__name__).joinpath("davis346_short.aedat4")))
