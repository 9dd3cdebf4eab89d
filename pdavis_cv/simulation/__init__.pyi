"""The names of this room, and the module of each: the only list of them."""
from .aps import ApsPixel as ApsPixel
from .bus import Bus as Bus
from .camera import (
    DEFAULT_CAMERA as DEFAULT_CAMERA,
    PRESETS as PRESETS,
    Camera as Camera,
)
from .dvs import DvsPixel as DvsPixel
from .examples import example_truth as example_truth
from .faults import Faults as Faults
from .named import SCENES as SCENES, named_scene as named_scene
from .optics import Optics as Optics
from .patterns import (
    Fan as Fan,
    FunctionScene as FunctionScene,
    Tendon as Tendon,
    Texture as Texture,
)
from .scenes import (
    FULL as FULL,
    Coloured as Coloured,
    FlatLight as FlatLight,
    Flicker as Flicker,
    PolarizerBeforePlate as PolarizerBeforePlate,
    RotatingPlate as RotatingPlate,
    RotatingPolarizer as RotatingPolarizer,
    Scene as Scene,
    Sum as Sum,
)
from .stream import SimulatedRecording as SimulatedRecording
from .sweeps import IrradianceSweep as IrradianceSweep, MalusSweep as MalusSweep
from .truth import Truth as Truth
