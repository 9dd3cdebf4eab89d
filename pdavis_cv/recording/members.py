"""Members: the files, or objects in stores, that a source is made of."""
from __future__ import annotations

import functools
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pdavis_cv._remote import RemotePath, as_path, is_remote
from pdavis_cv.recording.images.names import names_of

_BLOCK = 1 << 20


@dataclass(frozen=True)
class Member:
    """One file of a source; of an object in a store, `path` is its address."""

    path: Path

    @property
    def size(self) -> int:
        """Size in bytes."""
        return self.path.stat().st_size

    @functools.cached_property
    def sha256(self) -> str:
        """SHA-256 of the content, read at first use."""
        import hashlib  # slow to import
        digest = hashlib.sha256()
        with self.path.open("rb") as file:
            while block := file.read(_BLOCK):
                digest.update(block)
        return digest.hexdigest()

    @property
    def facts(self) -> dict[str, Any]:
        """Name, size and SHA-256, for provenance."""
        return {"name": self.path.name, "bytes": self.size, "sha256": self.sha256}


def members_of(source: str | os.PathLike[str] | Sequence[str | os.PathLike[str]]
               ) -> tuple[Member, ...]:
    """Return the files that a path, a pattern, a folder or several paths denote."""
    if not isinstance(source, str | os.PathLike):
        return tuple(member for one in source for member in members_of(one))
    path = as_path(source)
    if isinstance(path, RemotePath) or is_remote(source):
        return (Member(path),)
    if path.is_dir():
        return tuple(Member(one) for one in sorted(path.rglob("*")) if one.is_file())
    return tuple(Member(Path(name)) for name in names_of(os.fspath(path)))
