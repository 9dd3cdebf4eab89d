"""Compiled kernels (private); typed in pdavis_cv/_kernels.pyi."""
from ._build import DEBUG

__all__ = ["DEBUG"]
