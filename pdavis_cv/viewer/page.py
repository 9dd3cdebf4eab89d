"""Access to the page's files in the package."""
from __future__ import annotations

import functools
from importlib.resources import files

__all__ = ["page"]


@functools.cache
def page(name: str) -> bytes:
    """Return a file of the page, such as ``page.html``."""
    return files("pdavis_cv.viewer").joinpath(name).read_bytes()
