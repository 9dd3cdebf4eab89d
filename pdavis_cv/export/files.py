"""Write JSON."""
from __future__ import annotations

import json
import os
from collections.abc import Mapping
from typing import Any

import numpy as np

from pdavis_cv._beside import write_beside

__all__ = ["plain", "write_json"]


def write_json(path: str | os.PathLike[str], facts: Mapping[str, Any]) -> None:
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
    return str(value)
