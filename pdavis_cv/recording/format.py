"""What a format is: how files of it are known, read and written."""
from __future__ import annotations

import importlib
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pdavis_cv.recording.base import Recording

__all__ = ["Format", "loaded"]

_KINDS = frozenset(("events", "frames", "imu", "triggers"))


@dataclass(frozen=True, kw_only=True)
class Format:
    """A kind of file: how it is known, read and written.

    Functions are named as ``"package.module:function"`` and loaded at first use, so
    that a format costs nothing until a file has it.

    Parameters
    ----------
    name : str
        Short, for ``pdavis convert --format``.
    title : str
        For people.
    reader : str or callable
        Called with (path, layout=, bad_events=, camera=, and those of `read_options`
        that the caller gave); returns a `Recording`.
    magic : tuple of bytes
        First bytes of such a file, any of them.
    sniff : str or callable, optional
        Called with the first 4096 bytes, where first bytes alone do not tell; returns
        whether this is such a file.
    folder : str, optional
        A recording is a folder that holds a file of this name.
    suffixes : tuple of str
        What names of such files end in, lower case with the dot.  They never decide
        what a file is; they tell what to write, and what other libraries hand over.
    writer : str or callable, optional
        Called with (path, recording, and those of `write_options` that were given);
        returns a mapping of what the format could not hold to how often.
    holds : frozenset of str
        Of ``"events"``, ``"frames"``, ``"imu"``, ``"triggers"``.
    needs_layout : bool
        True if such a file is read as a recording only where a layout is given,
        because the same format holds other things, such as any video.
    read_options, write_options : tuple of str
        Keyword arguments that the reader and the writer have beyond the common ones.
    by_ranges : bool
        Whether the reader asks for bytes by `FileRecording._bytes` alone, so that it
        reads objects of a store as well.
    extra : str, optional
        Extra of pdavis-cv that the format needs.

    Raises
    ------
    ValueError
        If a name or a suffix is not of its form.
    """

    name: str
    title: str
    reader: str | Callable[..., Recording]
    magic: tuple[bytes, ...] = ()
    sniff: str | Callable[[bytes], bool] | None = None
    folder: str | None = None
    suffixes: tuple[str, ...] = ()
    writer: str | Callable[..., Mapping[str, int]] | None = None
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
        for suffix in self.suffixes:
            if not re.fullmatch(r"\.[a-z0-9_.]+", suffix):
                raise ValueError(
                    f"suffixes must be lower case with a dot, got {suffix!r}")
        if not self.holds <= _KINDS:
            raise ValueError(
                f"holds must be of {', '.join(sorted(_KINDS))}, got "
                f"{', '.join(sorted(self.holds))}")

    def knows(self, path: Path, start: bytes) -> bool:
        """Tell whether a file that begins so, or a folder, is of this format.

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


def loaded(what: str | Callable[..., Any]) -> Callable[..., Any]:
    """Return a function that may be given by name, ``"package.module:function"``."""
    if not isinstance(what, str):
        return what
    module, _, name = what.partition(":")
    found: Callable[..., Any] = getattr(importlib.import_module(module), name)
    return found
