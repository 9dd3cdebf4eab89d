"""Simulated recordings with exact truth."""
from pdavis_cv.simulation.ideal import rotating_polarizer
from pdavis_cv.simulation.scenes import RotatingPolarizer
from pdavis_cv.simulation.truth import Truth

__all__ = ["RotatingPolarizer", "Truth", "rotating_polarizer"]
