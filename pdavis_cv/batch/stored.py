"""Results in object storage: each object is put whole, the marker of a job last."""
from __future__ import annotations

import contextlib
import errno
import json
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, cast

from pdavis_cv._remote import RemotePath
from pdavis_cv.batch.results import Claim, Results
from pdavis_cv.export.files import plain

__all__ = ["StoredResults"]


class StoredResults(Results):
    """Results under a name with a scheme, as ``s3://bucket/out``.

    A work writes into a folder of this machine, whose files are then put.  There are no
    locks: two runs at once may do a job twice, to the same end.

    Parameters
    ----------
    out : str
    """

    def __init__(self, out: str) -> None:
        self._store = RemotePath(out)
        self.out = cast("Path", self._store)    # as far as this class and workers go

    def begin(self) -> None:
        """Nothing to do: folders are parts of names."""

    def _read(self, name: str) -> bytes:
        return self._at(name).read_bytes()

    def _write(self, name: str, facts: Mapping[str, Any]) -> None:
        text = json.dumps(facts, indent=2, default=plain, allow_nan=False) + "\n"
        self._at(name).write_bytes(text.encode())

    def _at(self, name: str) -> RemotePath:
        return self._store / name

    def names(self) -> list[str]:
        """Return the names of all jobs that have a marker, sorted.

        Raises
        ------
        FileNotFoundError
            If there are no results.
        """
        found = self._store.below()
        if not found:
            raise FileNotFoundError(
                errno.ENOENT, "no results of pdavis batch", str(self._store))
        return [name.removesuffix(".json") for name in found if name.endswith(".json")]

    def claim(self, name: str) -> Claim | None:
        """Take a job for this run; others are not kept from it."""
        return Claim(Path(), None)

    def clean(self, name: str) -> None:
        """Nothing to do: what a killed process left is on its own machine."""

    @contextlib.contextmanager
    def part(self, name: str) -> Iterator[Path]:
        """Give an empty folder to work in, which is gone afterwards."""
        with tempfile.TemporaryDirectory(prefix="pdavis-batch-") as folder:
            yield Path(folder)

    def publish(self, name: str, folder: Path) -> None:
        """Put the files of a folder, in place of those of an earlier one."""
        self._at(name).remove()
        for path in sorted(folder.rglob("*")):
            if path.is_file():
                self._at(f"{name}/{path.relative_to(folder).as_posix()}").put(path)

    def mark(self, name: str, facts: Mapping[str, Any]) -> None:
        """Put the marker of a job."""
        self._write(f"{name}.json", facts)

    @contextlib.contextmanager
    def written(self, name: str) -> Iterator[Path]:
        """Let a file be written; it is put when it is whole."""
        with tempfile.TemporaryDirectory(prefix="pdavis-batch-") as folder:
            yield Path(folder) / name
            self._at(name).put(Path(folder) / name)

    def forget(self, run: str) -> None:
        """Note that a run has ended."""
        self._at(f".batch/runs/{run}.json").remove()

    def told(self) -> Iterator[dict[str, Any]]:
        """Yield what runs have told."""
        for name in self._at(".batch/runs").below():
            with contextlib.suppress(OSError):      # it has just ended
                yield json.loads(self._read(f".batch/runs/{name}"))
