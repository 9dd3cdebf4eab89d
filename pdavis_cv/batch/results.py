"""Where results lie: a folder and a marker for each job, whole or not at all."""
from __future__ import annotations

import contextlib
import errno
import hashlib
import json
import os
import secrets
import shutil
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from pdavis_cv._beside import write_beside
from pdavis_cv._remote import RemotePath, is_remote
from pdavis_cv.export.files import write_json

try:
    import fcntl
except ImportError:  # Windows: two runs at once may do a job twice, to the same end
    fcntl = None  # type: ignore[assignment]

__all__ = ["DONE", "FAILED", "Claim", "Results", "results_at"]

DONE, FAILED = "done", "failed"
_BLOCK = 1 << 20
_TRIES = 10


class Claim:
    """A job that this run has taken; other runs leave it alone until `release`.

    The system releases it when the process ends, however that ends.
    """

    def __init__(self, path: Path, descriptor: int | None) -> None:
        self._path, self._descriptor = path, descriptor

    def release(self) -> None:
        """Let others have it; nothing happens the second time."""
        if self._descriptor is not None:
            with contextlib.suppress(OSError):
                self._path.unlink()
            os.close(self._descriptor)
            self._descriptor = None


class Results:
    """A folder of results.

    Of each job there are ``NAME/``, what its work wrote, and ``NAME.json``, the marker:
    its row of the table and where the numbers come from.  Both appear when they are
    whole, the marker last.  What is not finished lies in ``.batch/``.

    Parameters
    ----------
    out : path
        Made if it is not there.
    """

    def __init__(self, out: str | os.PathLike[str]) -> None:
        self.out = Path(out)
        self._own = self.out / ".batch"
        self._parts, self._claims = self._own / "parts", self._own / "claims"

    def begin(self) -> None:
        """Make the folders."""
        for name in ("parts", "claims", "identities", "runs"):
            (self._own / name).mkdir(parents=True, exist_ok=True)

    # ---- what is there -------------------------------------------------------

    def marker(self, name: str) -> Mapping[str, Any] | None:
        """Return what the marker of a job holds, None if there is none."""
        try:
            facts: Mapping[str, Any] = json.loads(self._read(f"{name}.json"))
        except FileNotFoundError:
            return None
        return facts

    def _read(self, name: str) -> bytes:
        return (self.out / name).read_bytes()

    def _write(self, name: str, facts: Mapping[str, Any]) -> None:
        write_json(self.out / name, facts)

    def is_done(self, name: str) -> bool:
        """Tell whether a job has been done, and not only tried."""
        found = self.marker(name)
        return found is not None and found["row"]["state"] == DONE

    def names(self) -> list[str]:
        """Return the names of all jobs that have a marker, sorted.

        Raises
        ------
        FileNotFoundError
            If there are no results.
        """
        if not self._own.is_dir():
            raise FileNotFoundError(
                errno.ENOENT, "no results of pdavis batch", str(self.out))
        return sorted(path.stem for path in self.out.glob("*.json"))

    # ---- doing a job ---------------------------------------------------------

    def claim(self, name: str) -> Claim | None:
        """Take a job for this run; None if another one that lives has it."""
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
            os.close(descriptor)    # its last owner has removed it meanwhile

    def clean(self, name: str) -> None:
        """Remove what a killed process left of a claimed job."""
        for left in self._parts.glob(f"{name}.*"):
            _remove(left)

    @contextlib.contextmanager
    def part(self, name: str) -> Iterator[Path]:
        """Give an empty folder to work in, which is gone afterwards."""
        self._parts.mkdir(parents=True, exist_ok=True)
        folder = self._beside(name)
        folder.mkdir()
        try:
            yield folder
        finally:
            _remove(folder)

    def publish(self, name: str, folder: Path) -> None:
        """Give a folder of `part` its final name, in place of an earlier one."""
        for _ in range(_TRIES):
            aside = self._beside(name)
            with contextlib.suppress(FileNotFoundError):
                (self.out / name).rename(aside)
            try:
                folder.rename(self.out / name)
            except OSError:
                if not (self.out / name).is_dir():
                    raise
                continue        # another process has just published the same
            finally:
                _remove(aside)
            return
        raise OSError(f"{self.out / name}: another process keeps on writing it")

    def mark(self, name: str, facts: Mapping[str, Any]) -> None:
        """Write the marker of a job."""
        part = self._beside(name)
        write_json(part, facts)
        part.replace(self.out / f"{name}.json")

    def _beside(self, name: str) -> Path:
        """Return a name that nobody else uses, for what is not finished."""
        return self._parts / f"{name}.{secrets.token_hex(4)}"

    # ---- beside the jobs -----------------------------------------------------

    @contextlib.contextmanager
    def written(self, name: str) -> Iterator[Path]:
        """Let a file be written; it has its name when it is whole."""
        with write_beside(self.out / name) as part:
            yield part

    def identity(self, source: str) -> str:
        """Return the SHA-256 of a file's content, of a folder's files.

        Kept with size and time of the file, so that it is read once.  What cannot be
        read has none: its path stands for it, and its job will say why.
        """
        if is_remote(source):
            try:
                return RemotePath(source).content()
            except (OSError, ImportError):
                return f"unread {source}"
        try:
            path = Path(source)
            files = sorted(p for p in path.rglob("*") if p.is_file()) if (
                path.is_dir()) else [path]
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
        try:
            found = _digest(files)
        except OSError:
            return f"unread {source}"
        with contextlib.suppress(OSError):      # it is looked at again then
            self._write(kept, {"state": state, "sha256": found})
        return found

    # ---- how far runs are ----------------------------------------------------

    def tell(self, run: str, facts: Mapping[str, Any]) -> None:
        """Note how far a run is."""
        self._write(f".batch/runs/{run}.json", facts)

    def forget(self, run: str) -> None:
        """Note that a run has ended."""
        (self._own / "runs" / f"{run}.json").unlink()

    def told(self) -> Iterator[dict[str, Any]]:
        """Yield what runs have told."""
        for path in (self._own / "runs").glob("*.json"):
            with contextlib.suppress(OSError, ValueError):  # it has just ended
                yield json.loads(path.read_bytes())


def _remove(path: Path) -> None:
    """Remove a file or a folder, if it is there."""
    if path.is_dir():
        shutil.rmtree(path, ignore_errors=True)
    else:
        with contextlib.suppress(OSError):
            path.unlink()


def _digest(files: list[Path]) -> str:
    digest = hashlib.sha256()
    for path in files:
        with path.open("rb") as file:
            while block := file.read(_BLOCK):
                digest.update(block)
    return digest.hexdigest()


def results_at(out: str | os.PathLike[str]) -> Results:
    """Return the results at a path, which may have a scheme.

    Parameters
    ----------
    out : path
    """
    if is_remote(out):
        from pdavis_cv.batch.stored import StoredResults
        return StoredResults(str(out))
    return Results(out)
