"""``pdavis tendon``: command.py measures, video.py and report.py show."""
from .command import main

__all__ = ["main"]
