"""Store results: a folder and a marker file for each job, complete or absent."""
from __future__ import annotations

import contextlib
import errno
import hashlib
import json
import os
import secrets
from collections.abc import Iterator
from pathlib import Path

from pdavis_cv._beside import remove, write_beside
from pdavis_cv._remote import RemotePath, as_path, is_remote
from pdavis_cv._types import Facts
from pdavis_cv.errors import RecordingError
from pdavis_cv.export.files import write_json
from pdavis_cv.recording.members import members_of

try:
    import fcntl
except ImportError:  # Windows: two runs at the same time may both do a job
    fcntl = None  # type: ignore[assignment]

DONE, FAILED = "done", "failed"
_TRIES = 10
_DAMAGED: Facts = {
    **dict.fromkeys(("recording", "name", "attempt", "wall_s", "cpu_s", "peak_mib",
                     "started", "host", "version")),
    "state": FAILED, "error": "its marker is damaged", "options": {}, "figures": {},
    "problems": 0, "warnings": [], "files": []}
"""The row of a job whose marker is none."""


class Claim:
    """The claim of this run to a job, which other runs leave alone until `release`.

    The system releases it if the process is killed.
    """

    def __init__(self, path: Path, descriptor: int | None) -> None:
        self._path, self._descriptor = path, descriptor

    def release(self) -> None:
        """Give up the claim; a second call does nothing."""
        if self._descriptor is not None:
            with contextlib.suppress(OSError):
                self._path.unlink()
            os.close(self._descriptor)
            self._descriptor = None


class Results:
    """A folder of results.

    For each job it holds ``NAME/``, the files that its work wrote, and ``NAME.json``,
    the marker, with the row of the table and its provenance.  Both appear when they are
    complete, the marker last.  Unfinished files are in ``.batch/``.
    """

    def __init__(self, out: str | os.PathLike[str]) -> None:
        self.out = Path(out)
        self._private = self.out / ".batch"
        self._parts, self._claims = self._private / "parts", self._private / "claims"

    def begin(self) -> None:
        """Create the folders."""
        for name in ("parts", "claims", "identities"):
            (self._private / name).mkdir(parents=True, exist_ok=True)

    # ---- reading -------------------------------------------------------------

    def marker(self, name: str) -> Facts | None:
        """Return the content of a job's marker, None if there is none.

        A damaged one, or another file, is that of a job that failed.
        """
        try:
            facts: Facts = json.loads(self._read(f"{name}.json"))
            row = facts["row"]
            if row.keys() >= _DAMAGED.keys() and row["state"] in (DONE, FAILED) and all(
                    value is None or isinstance(row[one], type(value))
                    for one, value in _DAMAGED.items()):
                return facts
        except FileNotFoundError:
            return None
        except (RecordingError, ValueError, TypeError, LookupError, AttributeError,
                RecursionError):
            pass
        return {"row": {**_DAMAGED, "recording": name, "name": name}}

    def _read(self, name: str) -> bytes:
        return as_path(self.out / name).read_bytes()

    def _write(self, name: str, facts: Facts) -> None:
        write_json(self.out / name, facts)

    def is_done(self, name: str) -> bool:
        """Return whether a job was done successfully."""
        found = self.marker(name)
        return found is not None and found["row"]["state"] == DONE

    def names(self) -> list[str]:
        """Return the names of all jobs that have a marker, sorted.

        FileNotFoundError if there are no results.
        """
        if not self._private.is_dir():
            raise FileNotFoundError(
                errno.ENOENT, "no results of pdavis batch", str(self.out))
        return sorted(path.stem for path in self.out.glob("*.json"))

    # ---- doing a job ---------------------------------------------------------

    def claim(self, name: str) -> Claim | None:
        """Claim a job for this run; None if another running process has claimed it."""
        path = self._claims / name
        while True:
            descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o666)
            try:
                if fcntl is not None:
                    fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError:
                os.close(descriptor)
                return None
            with contextlib.suppress(FileNotFoundError):
                if os.path.samestat(os.fstat(descriptor), path.stat()):
                    return Claim(path, descriptor)
            os.close(descriptor)    # removed by its last owner in the meantime: again

    def clean(self, name: str) -> None:
        """Remove the files that a killed process left of a claimed job."""
        for left in self._parts.glob(f"{name}.*"):
            remove(left)

    @contextlib.contextmanager
    def part(self, name: str) -> Iterator[Path]:
        """Make an empty folder to work in, which is removed afterwards."""
        self._parts.mkdir(parents=True, exist_ok=True)
        folder = self._unfinished(name)
        folder.mkdir()
        try:
            yield folder
        finally:
            remove(folder)

    def publish(self, name: str, folder: Path) -> None:
        """Rename a folder from `part` to its final name, replacing an earlier one."""
        for _ in range(_TRIES):
            aside = self._unfinished(name)
            with contextlib.suppress(FileNotFoundError):
                (self.out / name).rename(aside)
            try:
                folder.rename(self.out / name)
            except OSError:
                if not (self.out / name).is_dir():
                    raise
                continue        # another process has just published this job
            finally:
                remove(aside)
            return
        raise OSError(f"{self.out / name}: another process keeps writing it")

    def mark(self, name: str, facts: Facts) -> None:
        """Write the marker of a job."""
        part = self._unfinished(name)
        write_json(part, facts)
        part.replace(self.out / f"{name}.json")

    def _unfinished(self, name: str) -> Path:
        """Return an unused path for an unfinished file or folder."""
        return self._parts / f"{name}.{secrets.token_hex(4)}"

    # ---- other files ---------------------------------------------------------

    @contextlib.contextmanager
    def written(self, name: str) -> Iterator[Path]:
        """Yield a path to write to; it is renamed to `name` when it is complete."""
        with write_beside(self.out / name) as part:
            yield part

    def identity(self, source: str) -> str:
        """Return the SHA-256 of the content of all files of a source.

        It is stored with the files' sizes and times, so that they are read only once.
        If a file cannot be read, its path is used instead; the job will report why.
        """
        if is_remote(source):
            try:
                return RemotePath(source).content()
            except (OSError, ImportError):
                return f"unread {source}"
        try:
            files = [member.path for member in members_of(source)]
            state = [[str(one), one.stat().st_size, one.stat().st_mtime_ns]
                     for one in files]
        except OSError:
            return f"unread {source}"
        digest = hashlib.sha256(source.encode()).hexdigest()[:32]
        kept = f".batch/identities/{digest}"
        with contextlib.suppress(OSError, ValueError, KeyError):
            known = json.loads(self._read(kept))
            if known["state"] == state:
                return str(known["sha256"])
        bytes_of = hashlib.sha256()
        try:
            for path in files:
                with path.open("rb") as file:
                    hashlib.file_digest(file, lambda: bytes_of)
        except OSError:
            return f"unread {source}"
        found = bytes_of.hexdigest()
        with contextlib.suppress(OSError):      # then the next run reads it again
            self._write(kept, {"state": state, "sha256": found})
        return found
