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

    Raises
    ------
    OSError
        What the system says in the block, with the final name where it named none.
    """
    final = Path(path)
    part = final.with_name(f".{final.stem}.part{os.getpid()}{final.suffix}")
    try:
        yield part
        part.replace(final)
    except OSError as error:
        named = error.filename not in (None, str(part), part)
        if named or (error.errno is None and type(error) is not OSError):
            raise  # of another file, e.g. the one that is read
        if error.errno is not None:
            raise OSError(error.errno, error.strerror, str(final)) from error
        said = str(error)  # NumPy's own words, or ours
        raise OSError(said if str(path) in said else f"{final}: {said}") from error
    finally:
        with contextlib.suppress(OSError):
            part.unlink()


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
