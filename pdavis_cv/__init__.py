"""Fuse frames and events of a polarization event camera.

The names that `__init__.pyi` lists are imported at first use, so that importing the
package is fast.
"""
import lazy_loader

__version__ = "0.1.0"

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
__all__ += ["__version__"]
