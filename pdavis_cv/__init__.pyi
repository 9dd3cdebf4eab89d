"""The public names, and the module of each: the only list of them."""
from . import (
    adapters as adapters,
    analysis as analysis,
    batch as batch,
    calibration as calibration,
    data as data,
    export as export,
    live as live,
    render as render,
    simulation as simulation,
)
from .adapters.patching import patched_cv2 as patched_cv2
from .analyser import Analyser as Analyser
from .aps import cds as cds
from .calibration.model import Calibration as Calibration
from .camera_array import AnalyserArray as AnalyserArray
from .capture.constants import (
    CAP_PDAVIS as CAP_PDAVIS,
    CAP_PDAVIS_AOP as CAP_PDAVIS_AOP,
    CAP_PDAVIS_AOP_BGR as CAP_PDAVIS_AOP_BGR,
    CAP_PDAVIS_BGR as CAP_PDAVIS_BGR,
    CAP_PDAVIS_DOLP as CAP_PDAVIS_DOLP,
    CAP_PDAVIS_DOLP_BGR as CAP_PDAVIS_DOLP_BGR,
    CAP_PDAVIS_EVENTS_BGR as CAP_PDAVIS_EVENTS_BGR,
    CAP_PDAVIS_I0 as CAP_PDAVIS_I0,
    CAP_PDAVIS_I45 as CAP_PDAVIS_I45,
    CAP_PDAVIS_I90 as CAP_PDAVIS_I90,
    CAP_PDAVIS_I135 as CAP_PDAVIS_I135,
    CAP_PDAVIS_QUAD as CAP_PDAVIS_QUAD,
    CAP_PDAVIS_S0 as CAP_PDAVIS_S0,
    CAP_PDAVIS_S1 as CAP_PDAVIS_S1,
    CAP_PDAVIS_S2 as CAP_PDAVIS_S2,
    CAP_PDAVIS_STOKES as CAP_PDAVIS_STOKES,
    CAP_PDAVIS_VALID as CAP_PDAVIS_VALID,
    CAP_PROP_PDAVIS_CAPTURE_FPS as CAP_PROP_PDAVIS_CAPTURE_FPS,
    CAP_PROP_PDAVIS_EXPOSURE_US as CAP_PROP_PDAVIS_EXPOSURE_US,
    CAP_PROP_PDAVIS_FPS as CAP_PROP_PDAVIS_FPS,
    CAP_PROP_PDAVIS_GAIN as CAP_PROP_PDAVIS_GAIN,
    CAP_PROP_PDAVIS_GAMMA as CAP_PROP_PDAVIS_GAMMA,
    CAP_PROP_PDAVIS_LOG as CAP_PROP_PDAVIS_LOG,
    CAP_PROP_PDAVIS_OUTPUT as CAP_PROP_PDAVIS_OUTPUT,
    CAP_PROP_PDAVIS_POS_US as CAP_PROP_PDAVIS_POS_US,
    CAP_PROP_PDAVIS_START_US as CAP_PROP_PDAVIS_START_US,
    CAP_PROP_PDAVIS_WHITE as CAP_PROP_PDAVIS_WHITE,
)
from .capture.video import CaptureStatus as CaptureStatus, VideoCapture as VideoCapture
from .errors import (
    AnalysisWarning as AnalysisWarning,
    CalibrationError as CalibrationError,
    DamagedFileWarning as DamagedFileWarning,
    DeviceError as DeviceError,
    ExposureWarning as ExposureWarning,
    LayoutError as LayoutError,
    LayoutWarning as LayoutWarning,
    PdavisError as PdavisError,
    PdavisWarning as PdavisWarning,
    RecordingError as RecordingError,
    WeightsError as WeightsError,
    WindowWarning as WindowWarning,
)
from .events import (
    EVENT_DTYPE as EVENT_DTYPE,
    accumulate as accumulate,
    as_events as as_events,
    slices as slices,
    time_surface as time_surface,
    voxel_grid as voxel_grid,
)
from .fusion.iteration import fuse as fuse
from .fusion.options import FusionOptions as FusionOptions
from .live.address import SOURCES as SOURCES, open_source as open_source
from .mosaic import demosaic as demosaic
from .packed import unpack as unpack
from .polarimetry import PolarFrame as PolarFrame, polarization as polarization
from .quantities import QUANTITIES as QUANTITIES
from .reconstruct.aop_events import (
    AOP_EVENT_DTYPE as AOP_EVENT_DTYPE,
    AopEvents as AopEvents,
)
from .reconstruct.base import (
    Estimate as Estimate,
    Needs as Needs,
    Reconstructor as Reconstructor,
)
from .reconstruct.cf import ComplementaryFilter as ComplementaryFilter
from .reconstruct.kalman import KalmanFilter as KalmanFilter
from .reconstruct.methods import DEFAULT_METHOD as DEFAULT_METHOD, METHODS as METHODS
from .recording.aedat2.writer import (
    Aedat2Writer as Aedat2Writer,
    write_aedat2 as write_aedat2,
)
from .recording.aedat4.writer import (
    Aedat4Writer as Aedat4Writer,
    write_aedat4 as write_aedat4,
)
from .recording.base import (
    IMU_DTYPE as IMU_DTYPE,
    TRIGGER_DTYPE as TRIGGER_DTYPE,
    ApsFrame as ApsFrame,
    Packet as Packet,
    Recording as Recording,
    RecordingInfo as RecordingInfo,
    Source as Source,
)
from .recording.files import FileRecording as FileRecording
from .recording.limits import Limits as Limits
from .recording.memory import recording_from_arrays as recording_from_arrays
from .recording.open import open_recording as open_recording
from .recording.registry import FORMATS as FORMATS
from .recording.stream import source_from_packets as source_from_packets
from .sensor import CHANNELS as CHANNELS, Layout as Layout, Sensor as Sensor
from .steps import AnalyserSteps as AnalyserSteps
from .stokes_vector import (
    aop as aop,
    debias_dolp as debias_dolp,
    dolp as dolp,
    stokes as stokes,
)
from .turning import TurningAnalyser as TurningAnalyser
from .viewer.server import serve as serve, view as view

__version__: str
