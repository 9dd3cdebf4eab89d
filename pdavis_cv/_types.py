"""Names of the types that most functions take and return, and a base of classes.

Shapes, dtypes and units that a name leaves open are in the docstrings.
"""
from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

Events = NDArray[np.void]
"""Events, shape (N,), of `EVENT_DTYPE`, or of a dtype that the docstring names."""

Image = NDArray[Any]
"""An image (H, W) or (H, W, C).  Any: of each dtype that the docstring allows."""

Records = NDArray[np.void]
"""Structured records: samples of the IMU, triggers, states of pixels."""

Parameters = Mapping[str, Any]
"""Parameters of a method by name.  Any: each method checks its own."""

State = Mapping[str, Any]
"""What an object needs to continue from here.  Any: only its own class reads it."""

Facts = Mapping[str, Any]
"""What is known of a recording, image or result, by name.  Any: it is written as
JSON, or read by those who know the name."""


class Closing(ABC):
    """Base of what the end of a ``with`` block closes."""

    @abstractmethod
    def close(self) -> None:
        """Finish, and release what is held."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, *rest: object) -> None:
        self.close()
