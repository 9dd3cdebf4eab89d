"""The names of the package, and the module of each."""
from .engine import Fusion as Fusion
from .iteration import fuse as fuse
from .learning import (
    bandwidth_in_situ as bandwidth_in_situ,
    clock_offset_in_situ as clock_offset_in_situ,
    thresholds_in_situ as thresholds_in_situ,
)
from .options import FusionOptions as FusionOptions
from .snapshot import FusionSnapshot as FusionSnapshot
