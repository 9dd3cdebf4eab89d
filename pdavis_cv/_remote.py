"""Paths of objects in stores, e.g. s3://bucket/run.aedat4, through fsspec."""
from __future__ import annotations

import contextlib
import functools
import os
from pathlib import Path, PurePosixPath
from typing import Any, cast

from pdavis_cv._packages import package
from pdavis_cv.errors import RecordingError

_BLOCK = 1 << 20
"""Bytes per request: 80 ms at 100 Mbit/s, a few times the latency of a request."""
_KEPT = 32
"""Number of blocks of a file that are cached."""
_TAGS = ("ETag", "etag", "md5Hash", "content_md5", "sha256", "checksum")
"""Names under which stores give a hash of an object's content."""


def is_remote(path: object) -> bool:
    """Return whether a path begins with a scheme and two slashes."""
    if isinstance(path, RemotePath):
        return True
    return isinstance(path, str) and path.partition("://")[0].isidentifier() and (
        "://" in path) and not path.startswith("file://")


def as_path(path: str | os.PathLike[str]) -> Path:
    """Return a Path, or for a URL a RemotePath, which readers accept as well.

    A pipe, which may never end, a device or a socket is a RecordingError.
    """
    if is_remote(path):
        return cast("Path", RemotePath(str(path)))
    text = os.fspath(path)
    if isinstance(text, str) and "\0" in text:
        raise RecordingError(f"{text!r}: a path cannot hold a null character")
    found = Path(text.removeprefix("file://") if isinstance(text, str) else text)
    if os.path.exists(found) and not (found.is_file() or found.is_dir()):
        raise RecordingError(f"{found}: neither a file nor a folder")
    return found


class RemotePath(PurePosixPath):
    """An object in a store, with the methods of Path that readers use.

    Settings of the store (keys, address of the server) come from the environment or
    fsspec's configuration, as its library documents.
    """

    def __str__(self) -> str:
        return super().__str__().replace(":/", "://", 1)

    @property
    def store(self) -> Any:
        """The fsspec file system; an ImportError tells which package it lacks."""
        fsspec = package(
            "fsspec", f"{self} needs fsspec: pip install 'pdavis-cv[remote]'")
        return fsspec.filesystem(str(self).partition("://")[0])

    def _facts(self) -> dict[str, Any]:
        facts: dict[str, Any] = self.store.info(str(self))
        return facts

    def exists(self) -> bool:
        """Return whether it exists."""
        return bool(self.store.exists(str(self)))

    def is_dir(self) -> bool:
        """Return whether it is a prefix of other objects' names."""
        return bool(self.store.isdir(str(self)))

    def is_file(self) -> bool:
        """Return whether it is an object."""
        return bool(self.store.isfile(str(self)))

    def stat(self) -> os.stat_result:
        """Return its size, in the form of `Path.stat`."""
        return os.stat_result((0o100444, 0, 0, 1, 0, 0, self._facts()["size"], 0, 0, 0))

    def open(self, mode: str = "rb") -> Any:
        """Open it; data that are written appear when it is closed."""
        return self.store.open(str(self), mode)

    def read_bytes(self) -> bytes:
        """Return its content."""
        return bytes(self.store.cat_file(str(self)))

    def write_bytes(self, data: bytes) -> None:
        """Write it, completely or not at all."""
        self.store.pipe_file(str(self), data)

    def put(self, file: Path) -> None:
        """Upload a file, completely or not at all."""
        self.store.put_file(str(file), str(self))

    def remove(self) -> None:
        """Remove it and all objects below it, if they exist."""
        self.store.invalidate_cache()
        names = self.store.find(str(self))
        if names:
            self.store.rm(names)

    def below(self) -> list[str]:
        """Return the names of the objects and folders directly below it, sorted."""
        self.store.invalidate_cache()
        try:
            found = self.store.ls(str(self), detail=False)
        except FileNotFoundError:
            return []
        return sorted(name.rstrip("/").rpartition("/")[2] for name in found)

    def ranges(self) -> functools._lru_cache_wrapper[bytes]:
        """Return a caching function that reads the i-th MiB."""
        store, name, size = self.store, str(self), self._facts()["size"]

        @functools.lru_cache(_KEPT)
        def block(i: int) -> bytes:
            return bytes(store.cat_file(
                name, start=i * _BLOCK, end=min((i + 1) * _BLOCK, size)))

        return block

    def read(self, block: Any, offset: int, size: int) -> bytes:
        """Return bytes, read with a function from `ranges`; fewer only at the end."""
        first, last = offset // _BLOCK, (offset + max(size, 1) - 1) // _BLOCK
        data = b"".join(block(i) for i in range(first, last + 1))
        return data[offset - first * _BLOCK:][:size]

    def content(self) -> str:
        """Return the store's hash of its content, or a SHA-256."""
        facts = self._facts()
        for tag in _TAGS:
            if facts.get(tag):
                return f"{tag} {facts[tag]} {facts['size']}"
        import hashlib  # slow to import
        digest = hashlib.sha256()
        with contextlib.closing(self.open()) as file:
            while part := file.read(_BLOCK):
                digest.update(part)
        return digest.hexdigest()
