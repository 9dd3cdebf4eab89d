"""Reading bytes of a file, or of an object behind a URL, at any position."""
from __future__ import annotations

import os
import weakref
from _thread import allocate_lock  # threading is slow to import
from pathlib import Path
from typing import Any

from pdavis_cv._remote import RemotePath
from pdavis_cv.errors import RecordingError

_POSITIONED = hasattr(os, "preadv")     # which Windows lacks


class FileReader:
    """A file that several threads may read at any position.

    It is closed when it is garbage-collected.  Of an open file's descriptor, which
    `close` closes, the path is only a name.
    """

    def __init__(
        self, path: str | os.PathLike[str], descriptor: int | None = None
    ) -> None:
        self.path = Path(path)
        flags = os.O_RDONLY | getattr(os, "O_BINARY", 0) | getattr(os, "O_CLOEXEC", 0)
        try:
            self._descriptor = (
                os.open(self.path, flags) if descriptor is None else descriptor)
        except OSError as error:
            raise RecordingError(
                f"{path}: cannot be opened: {error.strerror}") from error
        self._close = weakref.finalize(self, os.close, self._descriptor)
        self._lock = allocate_lock()
        self.size = os.fstat(self._descriptor).st_size

    def read(self, offset: int, size: int) -> bytes:
        """Return size bytes from offset on; fewer only at the end of the file."""
        if not self._close.alive:
            raise ValueError(f"{self.path.name}: recording is closed")
        size, data = min(size, self.size - offset), b""
        if offset < 0 or size <= 0:
            return b""
        try:
            data = self._pread(size, offset)
            while len(data) < size and (
                    part := self._pread(size - len(data), offset + len(data))):
                data += part
        except OSError as error:
            raise self._unreadable(offset + len(data), error) from error
        return data

    def read_into(self, offset: int, buffer: memoryview) -> int:
        """Read bytes from offset on into a buffer; return their number.

        Reusing memory is faster than allocating it for each read.  Raises the errors of
        `read`.
        """
        if not _POSITIONED:
            data = self.read(offset, len(buffer))
            buffer[:len(data)] = data
            return len(data)
        if not self._close.alive:
            raise ValueError(f"{self.path.name}: recording is closed")
        size, done = min(len(buffer), max(self.size - offset, 0)), 0
        try:
            while done < size:
                part = os.preadv(self._descriptor, [buffer[done:size]], offset + done)
                if not part:
                    break
                done += part
        except OSError as error:
            raise self._unreadable(offset + done, error) from error
        return done

    def _unreadable(self, offset: int, error: OSError) -> RecordingError:
        return RecordingError(
            f"{self.path}: byte {offset} cannot be read: {error.strerror}")

    def _pread(self, size: int, offset: int) -> bytes:
        if _POSITIONED:
            return os.pread(self._descriptor, size, offset)
        with self._lock:
            os.lseek(self._descriptor, offset, os.SEEK_SET)
            return os.read(self._descriptor, size)

    def close(self) -> None:
        """Release the file."""
        self._close()


class RemoteReader(FileReader):
    """An object in a store that several threads may read at any position, by ranges."""

    def __init__(self, path: RemotePath) -> None:
        self.path: Any = path
        try:
            self.size = path.stat().st_size
            self._block = path.ranges()
        except OSError as error:
            raise RecordingError(f"{path}: cannot be opened: {error}") from error
        self._close: Any = weakref.finalize(self, self._block.cache_clear)

    def read_into(self, offset: int, buffer: memoryview) -> int:
        """Read bytes from offset on into a buffer; return their number."""
        data = self.read(offset, len(buffer))
        buffer[:len(data)] = data
        return len(data)

    def _pread(self, size: int, offset: int) -> bytes:
        found: bytes = self.path.read(self._block, offset, size)
        return found
