"""The names of the package, and the module of each."""
from .engine import Fusion as Fusion
from .iteration import fuse as fuse
from .options import FusionOptions as FusionOptions
from .snapshot import FusionSnapshot as FusionSnapshot
