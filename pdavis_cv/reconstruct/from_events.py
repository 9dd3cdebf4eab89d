"""The ``events`` method: a high-pass filter, or the channels' redundancy."""
from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from numpy.typing import ArrayLike

from pdavis_cv.reconstruct.base import Reconstructor
from pdavis_cv.reconstruct.events import EventHighPass
from pdavis_cv.reconstruct.redundancy import EventRedundancy

_KINDS: dict[str, Any] = {"mean": EventHighPass, "redundancy": EventRedundancy}
_ONLY = {"mean": ("radius", "hold"),
         "redundancy": ("lookahead_us", "bandwidth", "ratio_sigma")}


def from_events(
    shape: Sequence[int], *, theta_on: ArrayLike, theta_off: ArrayLike,
    offsets: str = "mean", cutoff_hz: float = 0.5, radius: int | None = None,
    hold: bool | None = None, lookahead_us: int | None = None,
    bandwidth: tuple[float, float] | None = None, ratio_sigma: float | None = None,
    response: ArrayLike | None = None,
) -> Reconstructor:
    """Make an EventHighPass, or an EventRedundancy.

    Parameters
    ----------
    shape, theta_on, theta_off, cutoff_hz
        As for both classes.
    offsets : {"mean", "redundancy"}
        "mean": the channels' means are taken to be equal, as in the paper;
        "redundancy": they follow from I0 + I90 = I45 + I135, and DoLP with them.
    radius, hold
        As for `EventHighPass`, with its defaults.
    lookahead_us, bandwidth, ratio_sigma
        As for `EventRedundancy`, with its defaults.
    response
        As for `EventRedundancy`.

    Raises
    ------
    TypeError
        If a parameter of the other class is given.
    ValueError
        If ``offsets`` is another word, or a parameter out of range.
    """
    if offsets not in _KINDS:
        raise ValueError(f"offsets must be 'mean' or 'redundancy', got {offsets!r}")
    given: dict[str, Any] = {
        "radius": radius, "hold": hold, "lookahead_us": lookahead_us,
        "bandwidth": bandwidth,
        "ratio_sigma": ratio_sigma}
    given = {name: value for name, value in given.items() if value is not None}
    for name in given:
        if name not in _ONLY[offsets]:
            raise TypeError(f"{name} has no meaning with offsets={offsets!r}")
    if offsets == "redundancy":
        given["response"] = response
    made: Reconstructor = _KINDS[offsets](
        shape, theta_on=theta_on, theta_off=theta_off, cutoff_hz=cutoff_hz, **given)
    return made
