"""``pdavis tendon``: measure a loaded sample, make a video and a report."""
from .command import main

__all__ = ["main"]
