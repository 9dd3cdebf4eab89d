"""Weights of the recurrent networks: npz files, checked by name and shape."""
from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib.resources import as_file, files
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdavis_cv._arrays import read_arrays
from pdavis_cv._types import Facts
from pdavis_cv.errors import WeightsError

BINS = 5
"""Bins of the voxel grid per window."""

WIDTH = 16
"""Planes inside the networks."""

MEMORY = (8.0, 64.0)
"""Time constants of the two leaky integrals of ``joint``, in windows."""

# Numbers of planes by network: inputs, outputs, and inputs that skip to the last layer.
_ENDS = {"firenet": (BINS, 1, 0), "joint": (4 * BINS + 8, 6, 8)}
_META = "about"
_MOST_BYTES = 1 << 24
"""Bound on all weights of a network; those that ship have 0.2 MB."""


def expected_shapes(network: str) -> dict[str, tuple[int, ...]]:
    """Return the shape of each array of the weights of "firenet" or "joint"."""
    inputs, outputs, direct = _ENDS[network]
    convolutions = {
        "head": (WIDTH, inputs, 3), "pred": (outputs, WIDTH + direct, 1),
        **{f"g{i}.gates": (2 * WIDTH, 2 * WIDTH, 3) for i in (1, 2)},
        **{f"g{i}.new": (WIDTH, 2 * WIDTH, 3) for i in (1, 2)},
        **{f"r{i}.{part}": (WIDTH, WIDTH, 3) for i in (1, 2) for part in "ab"}}
    shapes: dict[str, tuple[int, ...]] = {}
    for name, (out, into, kernel) in convolutions.items():
        shapes[f"{name}.weight"] = (out, into, kernel, kernel)
        shapes[f"{name}.bias"] = (out,)
    return shapes


@dataclass(frozen=True, eq=False)
class Weights:
    """The weights of one network, and the scale of its input.

    Parameters
    ----------
    network : {"firenet", "joint"}
        Its architecture.
    arrays : mapping of str to ndarray of float32
        Arrays of the names and shapes of `expected_shapes`.
    unit : float or None
        Change of log intensity per unit of the input; None: an event is one unit,
        whatever its threshold.
    about : mapping of str to object
        Provenance, which the file contains.

    Raises
    ------
    WeightsError
        If an array is missing, not expected, of another shape or not finite.
    """

    network: str
    arrays: Mapping[str, NDArray[np.float32]]
    unit: float | None = 0.2
    about: Facts = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.network not in _ENDS:
            raise WeightsError(
                f"network must be one of {', '.join(_ENDS)}, got {self.network!r}")
        wanted = expected_shapes(self.network)
        for name in sorted(wanted.keys() | self.arrays.keys()):
            if name not in wanted:
                raise WeightsError(f"weights of {self.network} have no {name!r}")
            if name not in self.arrays:
                raise WeightsError(f"weights of {self.network} need {name!r}")
            array = self.arrays[name]
            if array.shape != wanted[name] or array.dtype != np.float32:
                raise WeightsError(
                    f"{name} must be float32 of shape {wanted[name]}, got "
                    f"{array.dtype} of shape {array.shape}")
            if not np.isfinite(array).all():
                raise WeightsError(f"{name} must be finite, got NaN or infinity")

    @property
    def parameters(self) -> int:
        """Number of trained numbers."""
        return sum(array.size for array in self.arrays.values())

    @property
    def digest(self) -> str:
        """First 16 hex digits of a hash over weights, network and unit."""
        seen = hashlib.sha256(f"{self.network} {self.unit}".encode())
        for name in sorted(self.arrays):
            seen.update(np.ascontiguousarray(self.arrays[name]).tobytes())
        return seen.hexdigest()[:16]

    def save(self, path: str | Path) -> None:
        """Write an npz file."""
        about = {"network": self.network, "unit": self.unit, "about": dict(self.about)}
        stored: dict[str, Any] = {_META: np.array(json.dumps(about)), **self.arrays}
        with open(path, "wb") as stream:
            np.savez_compressed(stream, **stored)

    @classmethod
    def load(cls, path: str | Path) -> Weights:
        """Read an npz file; nothing in it is executed.

        Raises
        ------
        WeightsError
            If it is not such a file; the message names it and says why.
        OSError
            If it cannot be opened.
        """
        try:
            arrays = read_arrays(path, _MOST_BYTES)
            about = json.loads(str(arrays.pop(_META)))
            return cls(about["network"], arrays,
                       None if about["unit"] is None else float(about["unit"]),
                       dict(about["about"]))
        except WeightsError as error:
            raise WeightsError(f"{path}: {error}") from None
        except (ValueError, KeyError, TypeError, OverflowError,
                RecursionError) as error:
            raise WeightsError(
                f"{path}: not weights that pdavis_cv wrote ({error})") from error

    @classmethod
    def shipped(cls, network: str) -> Weights:
        """Return the weights that come with the package."""
        with as_file(files("pdavis_cv.data").joinpath(f"{network}.npz")) as path:
            return cls.load(path)
