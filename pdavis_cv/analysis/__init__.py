"""Measuring polarization images: regions, traces, loads, optics."""
from pdavis_cv._door import attached

__getattr__, __dir__, __all__ = attached(__name__, __file__)
