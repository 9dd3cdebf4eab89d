"""Write files that appear under their name only when they are complete."""
from __future__ import annotations

import contextlib
import functools
import itertools
import os
import re
from collections.abc import Iterator
from pathlib import Path

__all__ = ["Unfinished", "clear", "write_beside"]

_COUNT = itertools.count()
"""Makes temporary names unique, as two threads may write the same file."""


class Unfinished:
    """A file that is written under a temporary name and then renamed.

    Parameters
    ----------
    path : path
        Final name; a file that is there stays as it is until `finish`.
    suffix : str, optional
        Suffix of the name to write to, for a writer that needs it; default: `path`'s.

    Attributes
    ----------
    part : Path
        Name to write to, in the same folder.
    """

    def __init__(
        self, path: str | os.PathLike[str], suffix: str | None = None
    ) -> None:
        self.path = Path(path)
        suffix = self.path.suffix if suffix is None else suffix
        self.part = self.path.with_name(
            f".{self.path.stem}.part{os.getpid()}-{next(_COUNT)}{suffix}")

    @contextlib.contextmanager
    def named(self) -> Iterator[None]:
        """Add the final file's name to an OSError in the block that names no file."""
        try:
            yield
        except OSError as error:
            named = error.filename not in (None, str(self.part), self.part)
            if named or (error.errno is None and type(error) is not OSError):
                raise  # of another file, e.g. the one that is read
            if error.errno is not None:
                raise OSError(error.errno, error.strerror, str(self.path)) from error
            said = str(error)  # a message by NumPy or by this library
            raise OSError(said if str(self.path) in said else f"{self.path}: {said}"
                          ) from error

    def finish(self) -> None:
        """Give the file its final name."""
        with self.named():
            self.part.replace(self.path)

    def discard(self) -> None:
        """Remove what was written, if it has not been renamed."""
        with contextlib.suppress(OSError):
            self.part.unlink()


def clear(path: str | os.PathLike[str]) -> None:
    """Remove temporary files of killed processes for a file that is made again.

    Those of live recordings are kept, as they hold the only data.

    Parameters
    ----------
    path : path
        Final name; its suffix does not count.
    """
    path = Path(path)
    for name in _left_behind(os.path.abspath(path.parent)).get(path.stem, ()):
        with contextlib.suppress(OSError):
            path.with_name(name).unlink()


@functools.cache   # a series of pictures would list the folder for each picture
def _left_behind(folder: str) -> dict[str, list[str]]:
    """Return the temporary files of ended processes in a folder, by stem.

    None on Windows, where it cannot be checked whether a process runs.
    """
    found: dict[str, list[str]] = {}
    if os.name != "posix":
        return found
    with contextlib.suppress(OSError):
        for name in os.listdir(folder):
            part = re.fullmatch(r"\.(.+)\.part(\d{1,9})(?:-\d+)?(\..*)?", name)
            if part is not None and not _lives(int(part[2])):
                found.setdefault(part[1], []).append(name)
    return found


def _lives(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except OSError:
        pass    # a process of another user
    return True


@contextlib.contextmanager
def write_beside(
    path: str | os.PathLike[str], suffix: str | None = None
) -> Iterator[Path]:
    """Write a file under a temporary name, and rename it when it is complete.

    Temporary files that killed processes left of the same file are removed.

    Parameters
    ----------
    path : path
        Final name; an existing file is replaced at the end.
    suffix : str, optional
        Suffix of the name to write to, for a writer that needs it; default: `path`'s.

    Yields
    ------
    Path
        Name to write to, in the same folder.  If the block raises, this file is removed
        and `path` is unchanged.

    Raises
    ------
    OSError
        Errors of the system in the block, with the final name if they have none.
    """
    clear(path)
    unfinished = Unfinished(path, suffix)
    try:
        with unfinished.named():
            yield unfinished.part
        unfinished.finish()
    finally:
        unfinished.discard()
