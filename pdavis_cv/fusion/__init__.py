"""fuse(): polarization images at any time.  For everybody who has a recording.

The one place that orders time: `engine` feeds a method what a recording holds and
reads images from it, of the part of the sensor that `window` says, as `options` ask
for; `camera` says what is known of the polarizers.
"""
from pdavis_cv.fusion.engine import Fusion, FusionSnapshot, fuse
from pdavis_cv.fusion.options import FusionOptions

__all__ = ["Fusion", "FusionOptions", "FusionSnapshot", "fuse"]
