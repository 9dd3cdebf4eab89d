"""Write files that appear under their name only when they are complete."""
from __future__ import annotations

import contextlib
import errno
import functools
import os
import re
import secrets
import shutil
import stat
import tempfile
from collections.abc import Iterator
from pathlib import Path

__all__ = ["Unfinished", "clear", "takes_bytes", "write_beside"]


def takes_bytes(path: Path) -> bool:
    """Return whether a path is a pipe or device, to which bytes are written.

    Parameters
    ----------
    path : Path

    Raises
    ------
    OSError
        If it is a folder, a block device or a socket, or cannot be examined: a file
        would replace a disk or socket.
    """
    try:
        mode = path.stat().st_mode
    except FileNotFoundError:
        return False
    if stat.S_ISDIR(mode):
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
    if stat.S_ISCHR(mode) or stat.S_ISFIFO(mode):
        return True
    if not stat.S_ISREG(mode):
        raise OSError(errno.EINVAL, "a block device or socket is not written to",
                      str(path))
    # The output of a command that a shell redirects to a file.
    folder = os.path.realpath(path.parent)
    return folder.startswith("/proc/") or (
        folder == "/dev" and path.name in ("stdout", "stderr"))


class Unfinished:
    """A file that is written under a temporary name and then renamed.

    A symbolic link is followed: the file that it names is replaced, the link stays.  A
    pipe or device, to which nothing can be renamed, takes the bytes of the whole file.

    Parameters
    ----------
    path : path
        Final name.  A file that is there stays as it is until `finish`.
    suffix : str, optional
        Suffix of the name to write to, for a writer that needs it; default: `path`'s.

    Attributes
    ----------
    part : Path
        Name to write to, in the file's folder, or for a pipe or device in a new one;
        nobody can guess it, so no link is there.

    Raises
    ------
    OSError
        As for `takes_bytes`.
    """

    def __init__(
        self, path: str | os.PathLike[str], suffix: str | None = None
    ) -> None:
        self.path = Path(path)
        self._takes_bytes = takes_bytes(self.path)
        if self._takes_bytes:
            beside = Path(tempfile.mkdtemp(prefix="pdavis-")) / self.path.name
        else:
            beside = Path(os.path.realpath(self.path)) if (
                self.path.is_symlink()) else self.path
        self._target = beside
        suffix = self.path.suffix if suffix is None else suffix
        self.part = beside.with_name(
            f".{beside.stem}.part{os.getpid()}-{secrets.token_hex(8)}{suffix}")

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

    def finish(self, whole: Path | None = None) -> None:
        """Give the file, or one in the folder that was made in its place, its name."""
        whole = whole or self.part
        with self.named():
            if not self._takes_bytes:
                if whole.is_file():     # its bytes, before its name
                    with whole.open("rb") as file:
                        os.fsync(file.fileno())
                os.replace(whole, self._target)
                return
            # Not truncated: a shell may append a command's output to it.
            out = os.open(self.path, os.O_WRONLY | os.O_APPEND)
            with open(out, "wb") as target, whole.open("rb") as source:
                shutil.copyfileobj(source, target)
        self.discard()

    def discard(self) -> None:
        """Remove what was written, if it has not been renamed."""
        _remove(self.part.parent if self._takes_bytes else self.part)


def clear(path: str | os.PathLike[str]) -> None:
    """Remove temporary files of killed processes for a file that is made again.

    Those of live recordings are kept, as they hold the only data.

    Parameters
    ----------
    path : path
        Final name; its suffix does not count.
    """
    path = Path(os.path.realpath(path))
    for name in _left_behind(os.path.abspath(path.parent)).get(path.stem, ()):
        _remove(path.with_name(name))


def _remove(path: Path) -> None:
    """Remove a file or folder if it is there and can be removed."""
    with contextlib.suppress(OSError):
        shutil.rmtree(path) if path.is_dir() else path.unlink()


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
            part = re.fullmatch(r"\.(.+)\.part(\d{1,9})(?:-\w+)?(\..*)?", name)
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
        Final name; see `Unfinished`.  An existing file is replaced at the end.
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
