"""``pdavis reproduce``: the paper's figures; command.py composes the other files."""
from .command import EXPERIMENTS, main

__all__ = ["EXPERIMENTS", "main"]
