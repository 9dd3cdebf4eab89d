"""The names of this room, and the module of each: the only list of them."""
from .animation import (
    ANIMATIONS as ANIMATIONS,
    AnimationFile as AnimationFile,
    moving_file as moving_file,
)
from .bag import BagFile as BagFile
from .embedded import (
    light_unit as light_unit,
    provenance as provenance,
    read_embedded as read_embedded,
    units as units,
)
from .figure import FIGURES as FIGURES, write_figure as write_figure
from .files import write_json as write_json
from .hdf5 import Hdf5File as Hdf5File
from .labelled import to_xarray as to_xarray
from .npy import NpyFile as NpyFile, NpzFile as NpzFile
from .ometiff import OmeTiffFile as OmeTiffFile, write_maps as write_maps
from .omezarr import OmeZarrFile as OmeZarrFile
from .stacks import StackFile as StackFile
from .tables import (
    write_csv as write_csv,
    write_jaer_csv as write_jaer_csv,
    write_traces as write_traces,
)
from .video import VideoFile as VideoFile, write_png as write_png
