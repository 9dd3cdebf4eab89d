"""The benchmark; command.py times the cases that the other files register."""
