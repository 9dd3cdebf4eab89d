"""Paths with a scheme, such as s3://bucket/run.aedat4, by fsspec."""
from __future__ import annotations

import contextlib
import functools
import hashlib
import importlib
import os
from pathlib import Path, PurePosixPath
from typing import Any, cast

__all__ = ["RemotePath", "as_path", "is_remote"]

_BLOCK = 1 << 20
"""Bytes of a request: at 100 Mbit/s it takes 80 ms, a few times what asking takes."""
_KEPT = 32
"""Blocks that are kept of a file."""
_TAGS = ("ETag", "etag", "md5Hash", "content_md5", "sha256", "checksum")
"""What stores say of the content of an object."""


def is_remote(path: object) -> bool:
    """Tell whether a path has a scheme and two slashes."""
    if isinstance(path, RemotePath):
        return True
    return isinstance(path, str) and path.partition("://")[0].isidentifier() and (
        "://" in path) and not path.startswith("file://")


def as_path(path: str | os.PathLike[str]) -> Path:
    """Return a path as what can be opened: a Path, or what does as one in readers."""
    if is_remote(path):
        return cast("Path", RemotePath(str(path)))
    text = os.fspath(path)
    return Path(text.removeprefix("file://") if isinstance(text, str) else text)


class RemotePath(PurePosixPath):
    """An object of a store, with those methods of a Path that readers use.

    Its store's own settings (keys, address of the server) come from the environment
    or fsspec's configuration, as its library documents them.
    """

    def __str__(self) -> str:
        return super().__str__().replace(":/", "://", 1)

    @property
    def store(self) -> Any:
        """The fsspec file system.

        Raises
        ------
        ImportError
            If fsspec, of the extra ``[remote]``, or what the scheme needs is missing.
        """
        try:
            fsspec = importlib.import_module("fsspec")
        except ImportError as error:
            raise ImportError(
                f"{self} needs fsspec: pip install 'pdavis-cv[remote]'") from error
        return fsspec.filesystem(str(self).partition("://")[0])

    def _facts(self) -> dict[str, Any]:
        facts: dict[str, Any] = self.store.info(str(self))
        return facts

    def exists(self) -> bool:
        """Tell whether it is there."""
        return bool(self.store.exists(str(self)))

    def is_dir(self) -> bool:
        """Tell whether names of other objects go on from it."""
        return bool(self.store.isdir(str(self)))

    def is_file(self) -> bool:
        """Tell whether it is an object."""
        return bool(self.store.isfile(str(self)))

    def stat(self) -> os.stat_result:
        """Return its size, as that of a file."""
        return os.stat_result((0o100444, 0, 0, 1, 0, 0, self._facts()["size"], 0, 0, 0))

    def open(self, mode: str = "rb") -> Any:
        """Open it; what is written appears when it is closed."""
        return self.store.open(str(self), mode)

    def read_bytes(self) -> bytes:
        """Return all of it."""
        return bytes(self.store.cat_file(str(self)))

    def write_bytes(self, data: bytes) -> None:
        """Put it, whole or not at all."""
        self.store.pipe_file(str(self), data)

    def put(self, file: Path) -> None:
        """Put what a file holds, whole or not at all."""
        self.store.put_file(str(file), str(self))

    def remove(self) -> None:
        """Remove it, and all whose names go on from it; nothing if there are none."""
        self.store.invalidate_cache()
        names = self.store.find(str(self))
        if names:
            self.store.rm(names)

    def below(self) -> list[str]:
        """Return the last parts of the names that are one part longer, sorted."""
        self.store.invalidate_cache()
        try:
            found = self.store.ls(str(self), detail=False)
        except FileNotFoundError:
            return []
        return sorted(name.rstrip("/").rpartition("/")[2] for name in found)

    def ranges(self) -> functools._lru_cache_wrapper[bytes]:
        """Return a function that reads its i-th MiB, and keeps what it has read."""
        store, name, size = self.store, str(self), self._facts()["size"]

        @functools.lru_cache(_KEPT)
        def block(i: int) -> bytes:
            return bytes(store.cat_file(
                name, start=i * _BLOCK, end=min((i + 1) * _BLOCK, size)))

        return block

    def read(self, block: Any, offset: int, size: int) -> bytes:
        """Return bytes by means of `ranges`; fewer only at the end."""
        first, last = offset // _BLOCK, (offset + max(size, 1) - 1) // _BLOCK
        data = b"".join(block(i) for i in range(first, last + 1))
        return data[offset - first * _BLOCK:][:size]

    def content(self) -> str:
        """Return what changes with its content: the store's word, or a SHA-256."""
        facts = self._facts()
        for tag in _TAGS:
            if facts.get(tag):
                return f"{tag} {facts[tag]} {facts['size']}"
        digest = hashlib.sha256()
        with contextlib.closing(self.open()) as file:
            while part := file.read(_BLOCK):
                digest.update(part)
        return digest.hexdigest()
