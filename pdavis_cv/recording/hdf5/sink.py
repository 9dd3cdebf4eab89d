"""Write an HDF5 file so that no error occurs within the HDF5 library.

A file that HDF5 could not write cannot be closed either, and freeing its objects later
ends the process.  So HDF5 writes to a `Sink`, which keeps the first error and takes
nothing from then on; it is raised when the file has been closed.
"""
from __future__ import annotations

import contextlib
import io
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from pdavis_cv.recording.hdf5.reader import h5py_module

__all__ = ["written"]


class _Sink(io.RawIOBase):
    def __init__(self, path: Path) -> None:
        self.error: OSError | None = None
        self._file = path.open("w+b", buffering=0)

    def readinto(self, buffer: Any) -> int:
        got = self._file.readinto(buffer) or 0
        # Where nothing was written because of an error HDF5 finds zeros.
        memoryview(buffer).cast("B")[got:] = bytes(len(buffer) - got)
        return len(buffer)

    def write(self, data: Any) -> int:
        data = memoryview(data).cast("B")
        done = 0
        try:
            while self.error is None and done < len(data):
                done += self._file.write(data[done:]) or 0
        except OSError as error:
            self.error = error
        return len(data)

    def truncate(self, size: int | None = None) -> int:
        size = self.tell() if size is None else size
        try:
            if self.error is None:
                self._file.truncate(size)
        except OSError as error:
            self.error = error
        return size

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        return self._file.seek(offset, whence)

    def tell(self) -> int:
        return self._file.tell()

    def seekable(self) -> bool:
        return True

    def close(self) -> None:
        self._file.close()
        super().close()


@contextlib.contextmanager
def written(path: Path) -> Iterator[Any]:
    """Open an HDF5 file to be written; raise at the end what went wrong.

    Parameters
    ----------
    path : path

    Yields
    ------
    h5py.File

    Raises
    ------
    OSError
        If the file cannot be written, e.g. because the disk is full.
    """
    h5py = h5py_module()
    with contextlib.closing(_Sink(path)) as sink:
        with h5py.File(sink, "w") as file:
            yield file
        if sink.error is not None:
            raise sink.error
