"""Constants in the style of OpenCV: outputs, properties and the backend."""
from __future__ import annotations

CAP_PDAVIS = 9400
"""Backend: a value of ``apiPreference`` and of ``CAP_PROP_BACKEND``."""

# Outputs: values of the flag of retrieve() and of CAP_PROP_PDAVIS_OUTPUT.
CAP_PDAVIS_BGR = 0          # uint8 (H, W, 3): grey S0 / 2
CAP_PDAVIS_I0 = 1           # float32 (H, W), DN per ms, as the next six
CAP_PDAVIS_I45 = 2
CAP_PDAVIS_I90 = 3
CAP_PDAVIS_I135 = 4
CAP_PDAVIS_S0 = 5
CAP_PDAVIS_S1 = 6
CAP_PDAVIS_S2 = 7
CAP_PDAVIS_AOP = 8          # float32 (H, W), radians in [0, pi)
CAP_PDAVIS_DOLP = 9         # float32 (H, W)
CAP_PDAVIS_VALID = 10       # uint8 (H, W), 255 = usable: a mask for cv2
CAP_PDAVIS_QUAD = 11        # float32 (H, W, 4): I0, I45, I90, I135
CAP_PDAVIS_STOKES = 12      # float32 (H, W, 3): S0, S1, S2
CAP_PDAVIS_AOP_BGR = 13     # uint8 (H, W, 3), as the next two
CAP_PDAVIS_DOLP_BGR = 14
CAP_PDAVIS_EVENTS_BGR = 15

# Properties; "set" means that set() and the params of open() accept it.
CAP_PROP_PDAVIS_OUTPUT = 94000       # set: output of read()
CAP_PROP_PDAVIS_FPS = 94001          # set: images per second of recording time
CAP_PROP_PDAVIS_CAPTURE_FPS = 94002  # frames per second of the camera
CAP_PROP_PDAVIS_EXPOSURE_US = 94003  # of the first frame
CAP_PROP_PDAVIS_START_US = 94004     # time of the first image
CAP_PROP_PDAVIS_POS_US = 94005       # time of the last grabbed image
CAP_PROP_PDAVIS_GAIN = 94006         # set: brightness of the grey picture
CAP_PROP_PDAVIS_GAMMA = 94007        # set: grey = 255 * x ** (1 / gamma)
CAP_PROP_PDAVIS_LOG = 94008          # set: 1 = logarithmic grey
CAP_PROP_PDAVIS_WHITE = 94009        # S0 / 2 that is white at gain 1

# OpenCV's own constants, equal in all versions: timeouts of a live source, ms.
CAP_PROP_OPEN_TIMEOUT_MSEC = 53
CAP_PROP_READ_TIMEOUT_MSEC = 54
