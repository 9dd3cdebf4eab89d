"""Write an HDF5 file so that no error occurs within the HDF5 library.

A file that HDF5 could not write cannot be closed either, and freeing its objects later
ends the process.  So HDF5 writes to a `Sink`, which keeps the first error and takes
nothing from then on; it is raised when the file has been closed.
"""
from __future__ import annotations

import contextlib
import io
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from pdavis_cv.recording.hdf5.reader import h5py_module


class _Sink(io.RawIOBase):
    def __init__(self, path: Path) -> None:
        self.error: OSError | None = None
        self._at = self._end = 0
        self._file = path.open("w+b", buffering=0)

    def _done(self, function: Callable[..., int | None], *values: Any) -> int:
        """Return what a function of the file gives, 0 from the first error on."""
        try:
            return function(*values) or 0 if self.error is None else 0
        except OSError as error:
            self.error = error
            return 0

    def readinto(self, buffer: Any) -> int:
        self._done(self._file.seek, self._at)
        got = self._done(self._file.readinto, buffer)
        # Where nothing was written because of an error HDF5 finds zeros.
        memoryview(buffer).cast("B")[got:] = bytes(len(buffer) - got)
        self._at += len(buffer)
        return len(buffer)

    def write(self, data: Any) -> int:
        data, done = memoryview(data).cast("B"), 0
        self._done(self._file.seek, self._at)
        while self.error is None and done < len(data):
            done += self._done(self._file.write, data[done:])
        self._at += len(data)
        self._end = max(self._end, self._at)
        return len(data)

    def truncate(self, size: int | None = None) -> int:
        self._end = self._at if size is None else size
        self._done(self._file.truncate, self._end)
        return self._end

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        self._at = offset + (0, self._at, self._end)[whence]
        return self._at

    def tell(self) -> int:
        return self._at

    def seekable(self) -> bool:
        return True

    def close(self) -> None:
        try:
            self._file.close()
        except OSError as error:
            self.error = self.error or error
        super().close()


@contextlib.contextmanager
def written(path: Path) -> Iterator[Any]:
    """Open an HDF5 file to be written; raise at the end what the system refused."""
    h5py = h5py_module()
    with contextlib.closing(_Sink(path)) as sink:
        with h5py.File(sink, "w") as file:
            yield file
        sink.close()
        if sink.error is not None:
            raise sink.error
