"""Files that appear under their name only when they are whole."""
from __future__ import annotations

import contextlib
import json
import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

__all__ = ["beside", "plain", "write_json"]


@contextlib.contextmanager
def beside(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Write a file beside its final name, and rename it when it is whole.

    Parameters
    ----------
    path : path
        Final name; an existing file is replaced at the end.

    Yields
    ------
    Path
        Name to write to: same folder, same suffix.  When the block raises, the
        file is removed and `path` is as before.
    """
    final = Path(path)
    part = final.with_name(f".{final.stem}.part{os.getpid()}{final.suffix}")
    try:
        yield part
        part.replace(final)
    finally:
        part.unlink(missing_ok=True)


def write_json(path: str | os.PathLike[str], facts: Mapping[str, Any]) -> None:
    """Write facts as JSON; NumPy numbers and arrays become plain ones.

    Parameters
    ----------
    path : path
        File to write; appears when it is whole.
    facts : mapping of str to object
        What to write.
    """
    with beside(path) as part:
        part.write_text(
            json.dumps(facts, indent=2, default=plain, allow_nan=False) + "\n",
            encoding="utf-8")


def plain(value: Any) -> Any:
    """Return a value as JSON can hold it."""
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    if isinstance(value, Mapping):
        return dict(value)
    return str(value)
