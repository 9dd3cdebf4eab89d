"""Colour pictures of polarization, their legends, and sheets of several."""
import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
