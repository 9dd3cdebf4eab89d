"""The whole Python/C boundary, one line per kernel."""
__all__ = ["DEBUG"]

DEBUG: bool
