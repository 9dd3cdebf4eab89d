"""``pdavis bench``: command.py times the cases that the other files register."""
from .command import Result, main, measure

__all__ = ["Result", "main", "measure"]
