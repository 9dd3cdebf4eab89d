"""Simulated recordings with exact truth."""
from pdavis_cv.simulation.aps import ApsPixel
from pdavis_cv.simulation.bus import Bus
from pdavis_cv.simulation.camera import DEFAULT_CAMERA, PRESETS, Camera
from pdavis_cv.simulation.dvs import DvsPixel
from pdavis_cv.simulation.elements import Behind, Waveplate
from pdavis_cv.simulation.examples import example_truth
from pdavis_cv.simulation.faults import Faults
from pdavis_cv.simulation.ideal import rotating_polarizer
from pdavis_cv.simulation.lens import Lens
from pdavis_cv.simulation.named import SCENES, named_scene
from pdavis_cv.simulation.optics import LENSES, Optics
from pdavis_cv.simulation.patterns import (
    Fan,
    FunctionScene,
    Tendon,
    Texture,
    VideoScene,
)
from pdavis_cv.simulation.scenes import (
    FULL,
    FlatLight,
    Flicker,
    PolarizerBeforePlate,
    RotatingPlate,
    RotatingPolarizer,
    Scene,
    Sum,
)
from pdavis_cv.simulation.stream import SimulatedRecording
from pdavis_cv.simulation.sweeps import IrradianceSweep, MalusSweep
from pdavis_cv.simulation.temperature import Temperature
from pdavis_cv.simulation.truth import Truth

__all__ = [
    "DEFAULT_CAMERA",
    "FULL",
    "LENSES",
    "PRESETS",
    "SCENES",
    "ApsPixel",
    "Behind",
    "Bus",
    "Camera",
    "DvsPixel",
    "Fan",
    "Faults",
    "FlatLight",
    "Flicker",
    "FunctionScene",
    "IrradianceSweep",
    "Lens",
    "MalusSweep",
    "Optics",
    "PolarizerBeforePlate",
    "RotatingPlate",
    "RotatingPolarizer",
    "Scene",
    "SimulatedRecording",
    "Sum",
    "Temperature",
    "Tendon",
    "Texture",
    "Truth",
    "VideoScene",
    "Waveplate",
    "example_truth",
    "named_scene",
    "rotating_polarizer",
]
