"""Stacks of planes that are written image by image and can be resumed."""
from __future__ import annotations

import contextlib
import hashlib
import os
from abc import abstractmethod
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from pdavis_cv._beside import Place, all_or_none, named, no_link, sole, write_beside
from pdavis_cv._checks import positive
from pdavis_cv._types import Closing
from pdavis_cv.export.embedded import to_json
from pdavis_cv.polarimetry import PolarFrame
from pdavis_cv.quantities import chosen


class StackFile(Closing):
    """Write float32 planes, one per quantity and time; NaN = not valid.

    Until the file is complete, its data are in ``.NAME.unfinished`` next to it.  If the
    block ends with an error they are removed, unless ``resume`` is set: then a later
    StackFile with ``resume`` and the same facts continues, and its `count` is the
    number of images that it already has.

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
    resume : bool
        Keep the data if interrupted, and continue from those of an earlier run.

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
        resume: bool = False,
    ) -> None:
        self.path = Path(path)
        self._chosen = chosen(quantities)
        self.quantities = tuple(one.name for one in self._chosen)
        self.pixel_um = None if pixel_um is None else positive("pixel_um", pixel_um)
        self.units = {one.name: one.unit for one in self._chosen} | dict(
            (facts or {}).get("units", {}))
        self.facts = {**(facts or {}), "units": self.units}
        self.times_us: list[int] = []
        self.shape: tuple[int, int] | None = None
        self._closed = False
        self._place = Place(self.path)
        self.resume = resume and not self._place.takes_bytes
        beside = self._place.beside
        self.unfinished = beside.with_name(f".{beside.name}.unfinished")
        self._log_path = beside.with_name(f".{beside.name}.unfinished.log")
        self._identity = hashlib.sha256(to_json(
            {**self.facts, "kind": type(self).__name__}).encode()).digest()
        try:
            self._log: BinaryIO = open(
                self._log_path, "ab", buffering=0, opener=no_link)
            sole(self._log, self.path)
            if not (self.resume and self._continue()):
                self._data: BinaryIO = open(self.unfinished, "wb", opener=no_link)
                self._log.truncate(0)
                self._log.write(self._identity)
        except BaseException:   # an interrupt may come at any of these lines
            self._release()
            if not self.resume and self._sole():
                self.discard()
            raise

    def _sole(self) -> bool:
        """Return whether no other process writes the same output."""
        with contextlib.suppress(OSError):
            with open(self._log_path, "ab", opener=no_link) as log:
                sole(log, self.path)
            return True
        return False

    @property
    def count(self) -> int:
        """Number of images so far."""
        return len(self.times_us)

    def _continue(self) -> bool:
        """Continue from the complete images of an earlier run with the same identity.

        The log holds the identity, height, width, and a time per image.  It is written
        after each image, so it never lists an incomplete one.
        """
        try:
            log = self._log_path.read_bytes()
            size = self.unfinished.stat().st_size
        except OSError:
            return False
        known = np.frombuffer(log[32:32 + (len(log) - 32) // 8 * 8], "<i8")
        if log[:32] != self._identity or len(known) < 3 or np.any(known[:2] <= 0):
            return False
        self.shape = (int(known[0]), int(known[1]))
        whole = min(len(known) - 2, size // self._image_bytes)
        if whole < 1:
            self.shape = None
            return False
        self.times_us = [int(t) for t in known[2:2 + whole]]
        self._data = open(self.unfinished, "r+b", opener=no_link)
        self._data.truncate(whole * self._image_bytes)
        self._data.seek(0, os.SEEK_END)
        self._log.truncate(32 + 16 + 8 * whole)
        return True

    @property
    def _image_bytes(self) -> int:
        height, width = self.shape or (0, 0)
        return len(self.quantities) * height * width * 4

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
            self._log.write(np.array(self.shape, "<i8").tobytes())
        elif frame.shape != self.shape:
            raise ValueError(
                f"frame must have the first one's shape {self.shape}, got "
                f"{frame.shape}")
        if self.times_us and frame.t_us <= self.times_us[-1]:
            raise ValueError(
                f"frame must be later than {self.times_us[-1]} us, got {frame.t_us}")
        bad = None if frame.valid.all() else ~frame.valid
        with named(self.path, self.unfinished):
            for one in self._chosen:
                values = one.of(frame)
                if bad is not None and one.dtype == np.float32:
                    values = np.where(bad, np.float32(np.nan), values)
                self._data.write(np.ascontiguousarray(values, "<f4").data)
            self._log.write(frame.t_us.to_bytes(8, "little", signed=True))
        self.times_us.append(frame.t_us)

    @abstractmethod
    def _finish(self, part: Path, stack: NDArray[np.float32]) -> None:
        """Write the final file, and others, from the data, (T, quantity, H, W)."""

    def close(self) -> None:
        """Complete the file and give it its name.

        Raises
        ------
        ValueError
            If there is no image.
        OSError
            If it cannot be written.
        """
        if self._closed:
            return
        if not self.times_us:
            raise ValueError(f"{self.path}: no image to write")
        with named(self.path, self.unfinished):
            self._data.flush()
        stack = np.memmap(self.unfinished, np.dtype("<f4"), "r", shape=(
            self.count, len(self.quantities), *(self.shape or (0, 0))))
        try:
            with all_or_none(), write_beside(self.path) as part:
                self._finish(part, stack)
        finally:
            # Unmap before the file is removed; the array would keep it open.
            stack._mmap.close()  # type: ignore[attr-defined]
        self.discard()

    def discard(self) -> None:
        """Remove the unfinished file."""
        self._release()
        self.unfinished.unlink(missing_ok=True)
        self._log_path.unlink(missing_ok=True)
        self._place.close()

    def _release(self) -> None:
        self._closed = True
        for name in ("_data", "_log"):
            file = getattr(self, name, None)
            if file is not None:
                with contextlib.suppress(OSError):  # data do not fit: it was reported
                    file.close()

    def __exit__(self, kind: type[BaseException] | None, *rest: object) -> None:
        try:
            if kind is None:
                self.close()
        finally:
            if not self._closed:
                self._release() if self.resume else self.discard()
