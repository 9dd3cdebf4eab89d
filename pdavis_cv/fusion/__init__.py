"""fuse(): polarization images at any time.  For everybody who has a recording.

The one place that orders time.  `options` say what is asked for, `camera` what is known
of the polarizers; `feed` puts the samples of a source in order, `learning` finds out
what the method must know, `states` take it in, of the part of the sensor that `window`
says; `images` are made of what they tell; `engine` leads from one to the next.

The names below load at first use: who only says what is to be done needs `options`.
"""
from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from pdavis_cv.fusion.engine import Fusion, fuse
    from pdavis_cv.fusion.learning import (
        bandwidth_in_situ,
        clock_offset_in_situ,
        thresholds_in_situ,
    )
    from pdavis_cv.fusion.options import FusionOptions
    from pdavis_cv.fusion.snapshot import FusionSnapshot
    from pdavis_cv.fusion.stripes import tiles

__all__ = ["Fusion", "FusionOptions", "FusionSnapshot", "bandwidth_in_situ",
           "clock_offset_in_situ", "fuse", "thresholds_in_situ", "tiles"]

_HOME = {"Fusion": "engine", "FusionOptions": "options", "FusionSnapshot": "snapshot",
         "bandwidth_in_situ": "learning", "clock_offset_in_situ": "learning",
         "fuse": "engine", "thresholds_in_situ": "learning", "tiles": "stripes"}


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_HOME[name]}"), name)
