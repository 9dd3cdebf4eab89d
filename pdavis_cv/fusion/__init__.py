"""fuse(): polarization images at any time.  For everybody who has a recording.

The one place that orders time: `engine` feeds a method what a recording holds and
reads images from it, at the times of `grid`, of the part of the sensor that `window`
says, as `options` ask for.
"""
from pdavis_cv.fusion.engine import Fusion, FusionSnapshot, fuse

__all__ = ["Fusion", "FusionSnapshot", "fuse"]
