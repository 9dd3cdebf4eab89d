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
from contextvars import ContextVar
from pathlib import Path
from typing import BinaryIO

try:
    import fcntl
except ImportError:     # Windows
    fcntl = None  # type: ignore[assignment]


class Place:
    """The place of an output: a file, or a pipe or device that takes its bytes.

    A symbolic link is followed: the file that it names is replaced, the link stays.
    What is neither a file, a pipe nor a character device is refused by an OSError: a
    disk or socket would be replaced by a file.

    `path` is as given; `takes_bytes` tells a pipe or device; `beside` is the path of
    the output in a folder for temporary files: the file's own folder, or for a pipe or
    device a new one, as nothing can be renamed to it.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = Path(path)
        self.takes_bytes = takes_bytes(self.path)
        if self.takes_bytes:
            self.beside = Path(tempfile.mkdtemp(prefix="pdavis-")) / self.path.name
        else:
            self.beside = Path(os.path.realpath(self.path)) if (
                self.path.is_symlink()) else self.path

    def put(self, part: Path) -> None:
        """Rename a complete file in the folder of `beside` to the output, or copy it.

        If this fails, `part` remains.
        """
        if not self.takes_bytes:
            os.replace(part, self.beside)
            return
        # Not truncated: a shell may append a command's output to it.
        out = os.open(self.path, os.O_WRONLY | os.O_APPEND)
        with open(out, "wb") as target, part.open("rb") as source:
            shutil.copyfileobj(source, target)

    def close(self) -> None:
        """Remove the folder that was made for temporary files."""
        if self.takes_bytes:
            shutil.rmtree(self.beside.parent, ignore_errors=True)


def takes_bytes(path: Path) -> bool:
    """Return whether bytes are written to a path, not a file renamed to it.

    For what cannot be an output, the error is that of `Place`.
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


def no_link(path: str, flags: int) -> int:
    """Open a file whose name others may know, as `open` does, unless it is a link."""
    return os.open(path, flags | getattr(os, "O_NOFOLLOW", 0), 0o666)


def sole(file: BinaryIO, path: Path) -> None:
    """Lock an open file until it is closed: no other process writes the same output.

    If another process holds the lock, that is an OSError that names the output `path`;
    never on Windows or on a file system without such locks.
    """
    if fcntl is None:
        return
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        raise OSError(errno.EBUSY, "another process is writing it", str(path)) from None
    except OSError:
        return      # the file system has no locks


@contextlib.contextmanager
def named(path: Path, part: Path) -> Iterator[None]:
    """Add a file's name to an OSError in the block that names none, or its part."""
    try:
        yield
    except OSError as error:
        of_another = error.filename not in (None, str(part), part)
        if of_another or (error.errno is None and type(error) is not OSError):
            raise  # e.g. the file that is read
        if error.errno is not None:
            raise OSError(error.errno, error.strerror, str(path)) from error
        said = str(error)  # a message by NumPy or by this library
        raise OSError(said if str(path) in said else f"{path}: {said}") from error


_WAITING: ContextVar[list[Unfinished] | None] = ContextVar("waiting", default=None)


@contextlib.contextmanager
def all_or_none() -> Iterator[None]:
    """Give the files that the block writes their names when all of them are complete.

    If the block raises, none of them appears.
    """
    if _WAITING.get() is not None:      # a block around this one does so
        yield
        return
    files: list[Unfinished] = []
    token = _WAITING.set(files)
    try:
        yield
        for one in files:
            one.put()
    finally:
        _WAITING.reset(token)
        for one in files:
            one.discard()


class Unfinished:
    """A file that is written under a temporary name, `part`, and then renamed.

    The part lies in the same folder; nobody can guess its name, so no link is there.  A
    file of the final name, `path`, stays as it is until `finish`; see `Place`.  A
    writer that needs a suffix of the part gives it; by default it is that of `path`.
    """

    def __init__(self, path: str | os.PathLike[str], suffix: str | None = None) -> None:
        self.path = Path(path)
        self._place = Place(path)
        beside = self._place.beside
        suffix = self.path.suffix if suffix is None else suffix
        self.part = beside.with_name(
            f".{beside.stem}.part{os.getpid()}-{secrets.token_hex(8)}{suffix}")

    def named(self) -> contextlib.AbstractContextManager[None]:
        """Add the final file's name to an OSError in the block that names no file."""
        return named(self.path, self.part)

    def finish(self, whole: Path | None = None) -> None:
        """Give the file, or one in the folder that was made in its place, its name.

        In a block of `all_or_none`, this is done at its end.
        """
        self._whole, waiting = whole or self.part, _WAITING.get()
        if self._whole.is_file():       # its bytes, before its name
            with self.named(), self._whole.open("rb") as file:
                os.fsync(file.fileno())
        self.put() if waiting is None else waiting.append(self)

    def put(self) -> None:
        """Give the finished file its name."""
        with self.named():
            self._place.put(self._whole)
        self._place.close()

    def discard(self) -> None:
        """Remove what was written, if it has no name yet nor waits for one."""
        if self not in (_WAITING.get() or ()):
            remove(self.part)
            self._place.close()


def clear(path: str | os.PathLike[str]) -> None:
    """Remove temporary files of killed processes for a file that is made again.

    The suffix of its final name, `path`, does not count.  Files of live recordings are
    kept, as they hold the only data.
    """
    path = Path(os.path.realpath(path))
    for name in _left_behind(os.path.abspath(path.parent)).get(path.stem, ()):
        remove(path.with_name(name))


def remove(path: Path) -> None:
    """Remove a file or folder if it is there and can be removed."""
    with contextlib.suppress(OSError):
        shutil.rmtree(path, ignore_errors=True) if path.is_dir() else path.unlink()


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

    Yields the name to write to; see `Unfinished`.  If the block raises, this file is
    removed and `path` is unchanged; errors of the system in it get the final name if
    they have none.  Temporary files that killed processes left are removed.
    """
    clear(path)
    unfinished = Unfinished(path, suffix)
    try:
        with unfinished.named():
            yield unfinished.part
        unfinished.finish()
    finally:
        unfinished.discard()
