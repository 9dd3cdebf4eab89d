"""Files that appear under their name only when they are whole."""
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
"""Two threads may write one file at once: each to a part of its own."""


class Unfinished:
    """A file that is written beside its final name and then renamed.

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
        """Let an OSError in the block name the final file where it named none."""
        try:
            yield
        except OSError as error:
            named = error.filename not in (None, str(self.part), self.part)
            if named or (error.errno is None and type(error) is not OSError):
                raise  # of another file, e.g. the one that is read
            if error.errno is not None:
                raise OSError(error.errno, error.strerror, str(self.path)) from error
            said = str(error)  # NumPy's own words, or ours
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
    """Remove what processes that were killed left of a file that is to be made again.

    That of a live recording stays: it is all there is of it.

    Parameters
    ----------
    path : path
        Final name; its suffix does not count.
    """
    path = Path(path)
    for name in _left_behind(os.path.abspath(path.parent)).get(path.stem, ()):
        with contextlib.suppress(OSError):
            path.with_name(name).unlink()


@functools.cache   # a series of pictures would list its folder for each of them
def _left_behind(folder: str) -> dict[str, list[str]]:
    """Return what processes that are gone left unfinished in a folder, by stem.

    Where a process cannot be asked whether it lives (Windows), nothing is.
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
        pass    # another user's
    return True


@contextlib.contextmanager
def write_beside(
    path: str | os.PathLike[str], suffix: str | None = None
) -> Iterator[Path]:
    """Write a file beside its final name, and rename it when it is whole.

    What a process that was killed left of the same file is removed.

    Parameters
    ----------
    path : path
        Final name; an existing file is replaced at the end.
    suffix : str, optional
        Suffix of the name to write to, for a writer that needs it; default: `path`'s.

    Yields
    ------
    Path
        Name to write to, in the same folder.  When the block raises, the file is
        removed and `path` is as before.

    Raises
    ------
    OSError
        What the system says in the block, with the final name where it named none.
    """
    clear(path)
    unfinished = Unfinished(path, suffix)
    try:
        with unfinished.named():
            yield unfinished.part
        unfinished.finish()
    finally:
        unfinished.discard()
