"""Results in object storage: objects are complete or absent, the marker comes last."""
from __future__ import annotations

import contextlib
import errno
import json
import os
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import cast

from pdavis_cv._remote import RemotePath, is_remote
from pdavis_cv._types import Facts
from pdavis_cv.batch.results import Claim, Results
from pdavis_cv.export.files import plain


class StoredResults(Results):
    """Results under a URL, e.g. ``s3://bucket/out``.

    A work writes to a local folder, whose files are then uploaded.  There are no locks:
    two runs at the same time may both do a job, with the same result.
    """

    def __init__(self, out: str) -> None:
        self._store = RemotePath(out)
        self.out = cast("Path", self._store)    # has what this class and workers use

    def begin(self) -> None:
        """Do nothing: object storage has no folders."""

    def _read(self, name: str) -> bytes:
        return self._at(name).read_bytes()

    def _write(self, name: str, facts: Facts) -> None:
        text = json.dumps(facts, indent=2, default=plain, allow_nan=False) + "\n"
        self._at(name).write_bytes(text.encode())

    def _at(self, name: str) -> RemotePath:
        return self._store / name

    def names(self) -> list[str]:
        """Return the names of all jobs that have a marker, as `Results.names` does."""
        found = self._store.below()
        if not found:
            raise FileNotFoundError(
                errno.ENOENT, "no results of pdavis batch", str(self._store))
        return [name.removesuffix(".json") for name in found if name.endswith(".json")]

    def claim(self, name: str) -> Claim | None:
        """Return a claim to a job, which does not exclude other runs."""
        return Claim(Path(), None)

    def clean(self, name: str) -> None:
        """Do nothing: files of a killed process are on its own machine."""

    @contextlib.contextmanager
    def part(self, name: str) -> Iterator[Path]:
        """Make an empty folder to work in, which is removed afterwards."""
        with tempfile.TemporaryDirectory(prefix="pdavis-batch-") as folder:
            yield Path(folder)

    def publish(self, name: str, folder: Path) -> None:
        """Upload the files of a folder, replacing those of an earlier one."""
        self._at(name).remove()
        for path in sorted(folder.rglob("*")):
            if path.is_file():
                self._at(f"{name}/{path.relative_to(folder).as_posix()}").put(path)

    def mark(self, name: str, facts: Facts) -> None:
        """Upload the marker of a job."""
        self._write(f"{name}.json", facts)

    @contextlib.contextmanager
    def written(self, name: str) -> Iterator[Path]:
        """Yield a path to write to; the file is uploaded when it is complete."""
        with tempfile.TemporaryDirectory(prefix="pdavis-batch-") as folder:
            yield Path(folder) / name
            self._at(name).put(Path(folder) / name)


def results_at(out: str | os.PathLike[str]) -> Results:
    """Return the results at a path or URL."""
    return StoredResults(str(out)) if is_remote(out) else Results(out)
