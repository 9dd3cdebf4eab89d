"""JSON files, and the base of files that are written image by image."""
from __future__ import annotations

import contextlib
import json
import os
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from typing import Any, Self

import numpy as np

from pdavis_cv._beside import write_beside
from pdavis_cv._types import Facts


class SeriesFile(ABC):
    """Base of files that are written image by image in a ``with`` block.

    The file is completed at the end of the block; after an error it is removed.
    `_stack` holds what has to be closed, `write_beside` first.
    """

    _stack: contextlib.ExitStack

    @abstractmethod
    def _finish(self) -> None:
        """Complete the file."""

    def _abandon(self) -> None:  # noqa: B027  an optional hook
        """Prepare for the removal of the file after an error in the block."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: Any) -> None:
        if error[0] is None:
            try:
                self._finish()
            except BaseException as failure:
                self._stack.__exit__(type(failure), failure, failure.__traceback__)
                raise
        else:
            self._abandon()
        self._stack.__exit__(*error)


def write_json(path: str | os.PathLike[str], facts: Facts) -> None:
    """Write facts as JSON; NumPy numbers and arrays become plain ones.

    Parameters
    ----------
    path : path
        File to write; appears when it is complete.
    facts : mapping of str to object
        Content.
    """
    with write_beside(path) as part:
        part.write_text(
            json.dumps(facts, indent=2, default=plain, allow_nan=False) + "\n",
            encoding="utf-8")


def plain(value: Any) -> Any:
    """Return a value that JSON can represent."""
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    if isinstance(value, Mapping):
        return dict(value)
    if is_dataclass(value) and not isinstance(value, type):
        return {one.name: getattr(value, one.name) for one in fields(value)}
    return str(value)
