"""Packages that need not be there: imported when they are needed."""
from __future__ import annotations

import importlib
from typing import Any


def package(name: str, missing: str) -> Any:
    """Return a module; where it is missing, an ImportError says how to install it."""
    try:
        return importlib.import_module(name)
    except ModuleNotFoundError:
        raise ImportError(missing) from None
    except Exception as error:      # one that does not fit the others here
        raise ImportError(f"{name} is installed, but cannot be imported: {error}"
                          ) from error
