"""fuse(): make polarization images of a recording, at any time.

This is the one place that orders time.  `options` holds what the caller asks for, and
`camera` what is known of the polarizers.  `feed` puts the events and frames of a source
in order, `learning` estimates the parameters that the method needs, `states` feeds the
method, `window` is the part of the sensor that is computed, and `images` makes
PolarFrames of the result.  `engine` connects them, and `iteration` reads one image
ahead.

The names below are imported at first use, so that code that only needs `FusionOptions`
loads nothing else.
"""
from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from pdavis_cv.fusion.engine import Fusion
    from pdavis_cv.fusion.iteration import fuse
    from pdavis_cv.fusion.learning import (
        bandwidth_in_situ,
        clock_offset_in_situ,
        thresholds_in_situ,
    )
    from pdavis_cv.fusion.options import FusionOptions
    from pdavis_cv.fusion.snapshot import FusionSnapshot

__all__ = ["Fusion", "FusionOptions", "FusionSnapshot", "bandwidth_in_situ",
           "clock_offset_in_situ", "fuse", "thresholds_in_situ"]

_HOME = {"Fusion": "engine", "FusionOptions": "options", "FusionSnapshot": "snapshot",
         "bandwidth_in_situ": "learning", "clock_offset_in_situ": "learning",
         "fuse": "iteration", "thresholds_in_situ": "learning"}


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_HOME[name]}"), name)
