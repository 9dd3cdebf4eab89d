"""fuse(): make polarization images of a recording, at any time.

This is the one place that orders time.  `options` holds what the caller asks for, and
`camera` what is known of the polarizers.  `feed` puts the events and frames of a source
in order, `learning` estimates the parameters that the method needs, `states` feeds the
method, `window` is the part of the sensor that is computed, and `images` makes
PolarFrames of the result.  `engine` connects them, and `iteration` reads images
ahead.

The names that `__init__.pyi` lists are imported at first use, so that code that only
needs `FusionOptions` loads nothing else.
"""
import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
