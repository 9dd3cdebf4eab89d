"""Format: how files of one kind are recognized, read and written."""
from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

from pdavis_cv.recording.base import Recording
from pdavis_cv.registry import loaded

_KINDS = frozenset(("events", "frames", "imu", "triggers"))


@dataclass(frozen=True, kw_only=True, eq=False)
class Format:
    """Description of a file format: how it is recognized, read and written.

    Functions may be given as ``"package.module:function"``; they are imported at first
    use, so that a format that is not used costs nothing.

    Parameters
    ----------
    name : str
        Short name, for ``pdavis convert --format``.
    title : str
        Name to show to users.
    reader : str or callable
        Called with a path (or several, of images) and `SourceOptions`; returns a
        `Recording`.
    magic : tuple of bytes
        Possible first bytes of such a file.
    sniff : str or callable, optional
        Called with the first 4096 bytes; returns whether this is such a file.  For
        formats that `magic` cannot identify.
    folder : str, optional
        Name of a file that identifies a folder as a recording of this format.
    suffixes : tuple of str
        Suffixes of such files, lower case with the dot.  They select the format for
        writing and the files that adapters of other libraries accept, but never decide
        what a file that is read contains.
    writer : str or callable, optional
        Called with (path, recording, and the given ones of `write_options`); returns a
        mapping from what the format could not hold to its number.
    written : tuple of str
        Suffixes of files that are written, if not all of `suffixes`.
    holds : frozenset of str
        Any of ``"events"``, ``"frames"``, ``"imu"``, ``"triggers"``.
    needs_layout : bool
        True if such a file is a recording only if a layout is given, because the format
        is also used for other data, such as any video.
    read_options : tuple of str
        Options that not every format has: names of fields of `SourceOptions`, or keys
        of its ``parameters``.
    write_options : tuple of str
        Names of further keyword arguments of the writer.
    by_ranges : bool
        Whether the reader gets all bytes from `FileRecording._bytes`, so that it can
        read objects in a store as well.
    extra : str, optional
        Extra of pdavis-cv that the format needs.

    Raises
    ------
    ValueError
        If a name or a suffix is malformed.
    """

    name: str
    title: str
    reader: str | Callable[..., Recording]
    magic: tuple[bytes, ...] = ()
    sniff: str | Callable[[bytes], bool] | None = None
    folder: str | None = None
    suffixes: tuple[str, ...] = ()
    writer: str | Callable[..., Mapping[str, int]] | None = None
    written: tuple[str, ...] = ()
    holds: frozenset[str] = frozenset(("events",))
    needs_layout: bool = False
    read_options: tuple[str, ...] = ()
    write_options: tuple[str, ...] = ()
    by_ranges: bool = False
    extra: str | None = None

    def __post_init__(self) -> None:
        if not re.fullmatch(r"[a-z][a-z0-9_-]*", self.name):
            raise ValueError(
                f"name must be lower-case letters and digits, got {self.name!r}")
        if self.writer is not None and not self.written:
            object.__setattr__(self, "written", self.suffixes)
        for suffix in (*self.suffixes, *self.written):
            if not re.fullmatch(r"\.[a-z0-9_.]+", suffix):
                raise ValueError(
                    f"suffixes must be lower case with a dot, got {suffix!r}")
        if not self.holds <= _KINDS:
            raise ValueError(
                f"holds must be of {', '.join(sorted(_KINDS))}, got "
                f"{', '.join(sorted(self.holds))}")

    def knows(self, path: Path, start: bytes) -> bool:
        """Return whether a file or folder has this format.

        Parameters
        ----------
        path : Path
        start : bytes
            First bytes, at most 4096; empty for a folder.
        """
        if self.folder is not None and path.is_dir():
            return (path / self.folder).is_file()
        if self.magic and start.startswith(self.magic):
            return True
        return self.sniff is not None and bool(start) and bool(
            loaded(self.sniff)(start))
