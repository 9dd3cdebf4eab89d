"""The paper's figures; command.py composes the other files."""
