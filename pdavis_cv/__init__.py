"""Fuse frames and events of a polarization event camera.

The names that `__init__.pyi` lists are imported at first use, so that importing the
package is fast.
"""
from typing import Any

import lazy_loader

__version__ = "0.1.0"

_lazy, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
__all__ += ["__version__"]


def __getattr__(name: str) -> Any:
    if name.startswith("_"):
        return _lazy(name)
    if name in __all__:
        from pdavis_cv._door import public
        return public(__name__, name, _lazy(name))
    from pdavis_cv.registry import instead
    rooms = [room for room in ("analysis", "export", "live", "render", "simulation")
             if name in _lazy(room).__all__]
    where = f"; it is pdavis_cv.{rooms[0]}.{name}" if rooms else instead(name, __all__)
    raise AttributeError(f"pdavis_cv has no {name!r}{where}")
