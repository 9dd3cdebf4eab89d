"""Write images and series of images to files for other programs."""
from pdavis_cv._beside import write_beside
from pdavis_cv.export.animation import ANIMATIONS, AnimationFile, moving_file
from pdavis_cv.export.aop_events import AopEventsFile, read_aop_events
from pdavis_cv.export.arrays import ArrayFile
from pdavis_cv.export.figure import FIGURES, write_figure
from pdavis_cv.export.files import write_json
from pdavis_cv.export.hdf5 import Hdf5File
from pdavis_cv.export.labelled import to_xarray
from pdavis_cv.export.npz import NpzFile
from pdavis_cv.export.ometiff import OmeTiffFile, write_maps
from pdavis_cv.export.provenance import (
    light_unit,
    provenance,
    read_embedded,
    units,
)
from pdavis_cv.export.stacks import StackFile
from pdavis_cv.export.tables import write_csv, write_jaer_csv, write_traces
from pdavis_cv.export.video import PlaneVideo, VideoFile, write_png
from pdavis_cv.quantities import plane

__all__ = [
    "ANIMATIONS",
    "FIGURES",
    "AnimationFile",
    "AopEventsFile",
    "ArrayFile",
    "Hdf5File",
    "NpzFile",
    "OmeTiffFile",
    "PlaneVideo",
    "StackFile",
    "VideoFile",
    "light_unit",
    "moving_file",
    "plane",
    "provenance",
    "read_aop_events",
    "read_embedded",
    "to_xarray",
    "units",
    "write_beside",
    "write_csv",
    "write_figure",
    "write_jaer_csv",
    "write_json",
    "write_maps",
    "write_png",
    "write_traces",
]
