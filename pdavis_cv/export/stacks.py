"""Stacks of planes that are written image by image."""
from __future__ import annotations

import contextlib
import os
import sys
from abc import abstractmethod
from collections.abc import Mapping, Sequence
from pathlib import Path
from tempfile import TemporaryFile
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdavis_cv._beside import write_beside
from pdavis_cv.export.files import SeriesFile
from pdavis_cv.polarimetry import PolarFrame
from pdavis_cv.quantities import chosen

__all__ = ["StackFile"]


class StackFile(SeriesFile):
    """Write float32 planes, one per quantity and time; NaN = not valid.

    Until the file is complete, its data are in a temporary file without a name in the
    same folder.

    Parameters
    ----------
    path : path
        File to write; appears when it is complete.
    quantities : sequence of str
        Names from `pdavis_cv.QUANTITIES`, or ``"quad"`` and ``"stokes"``.
    facts : mapping of str to object
        Provenance, written into the file; see `provenance`.  Its ``units`` replace
        those of the quantities, for intensities without an exposure.
    pixel_um : float, optional
        Size of a pixel in the object, micrometres.

    Attributes
    ----------
    count : int
        Number of images so far.
    quantities : tuple of str
        Names of the planes.
    units : dict of str to str
        Their units.

    Raises
    ------
    ValueError
        If a quantity is unknown or ``pixel_um`` is not positive.
    """

    def __init__(
        self, path: str | os.PathLike[str],
        quantities: Sequence[str] = ("quad", "s0", "aop", "dolp"),
        facts: Mapping[str, Any] | None = None, *, pixel_um: float | None = None,
    ) -> None:
        self.path = Path(path)
        self._chosen = chosen(quantities)
        self.quantities = tuple(one.name for one in self._chosen)
        if pixel_um is not None and not (np.isfinite(pixel_um) and pixel_um > 0):
            raise ValueError(f"pixel_um must be positive, got {pixel_um!r}")
        self.pixel_um = pixel_um
        self.units = {one.name: one.unit for one in self._chosen} | dict(
            (facts or {}).get("units", {}))
        self.facts = {**(facts or {}), "units": self.units}
        self.times_us: list[int] = []
        self.shape: tuple[int, int] | None = None
        self._stack = contextlib.ExitStack()
        try:
            self._part = self._stack.enter_context(write_beside(self.path))
            folder = self._part.parent
            self._data: Any = self._stack.enter_context(TemporaryFile(dir=folder))
        except BaseException:   # an interrupt may come at any of these lines
            self._stack.__exit__(*sys.exc_info())
            raise

    @property
    def count(self) -> int:
        """Number of images so far."""
        return len(self.times_us)

    def add(self, frame: PolarFrame) -> None:
        """Append an image.

        Parameters
        ----------
        frame : PolarFrame
            All images must have the same shape, and a time.

        Raises
        ------
        ValueError
            If the shape differs from the first image's, or time does not increase.
        OSError
            If it cannot be written.
        """
        if frame.t_us is None:
            raise ValueError("frame must have a time")
        if self.shape is None:
            self.shape = frame.shape
        elif frame.shape != self.shape:
            raise ValueError(
                f"frame must have the first one's shape {self.shape}, got "
                f"{frame.shape}")
        if self.times_us and frame.t_us <= self.times_us[-1]:
            raise ValueError(
                f"frame must be later than {self.times_us[-1]} us, got {frame.t_us}")
        bad = None if frame.valid.all() else ~frame.valid
        for one in self._chosen:
            values = one.of(frame)
            if bad is not None and one.dtype == np.float32:
                values = np.where(bad, np.float32(np.nan), values)
            self._data.write(np.ascontiguousarray(values, "<f4").data)
        self.times_us.append(frame.t_us)

    @abstractmethod
    def _complete(self, part: Path, stack: NDArray[np.float32]) -> None:
        """Write the final file from the data, (T, quantity, H, W)."""

    def _finish(self) -> None:
        if not self.times_us:
            raise ValueError(f"{self.path}: no image to write")
        self._data.flush()
        self._complete(self._part, np.memmap(self._data, np.dtype("<f4"), "r", shape=(
            self.count, len(self.quantities), *(self.shape or (0, 0)))))

    def _abandon(self) -> None:
        with contextlib.suppress(OSError):  # buffered data do not fit; already reported
            self._data.close()
