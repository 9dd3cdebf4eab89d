"""The public names, and the module of each: the only list of them."""
from . import (
    adapters as adapters,
)
from . import (
    analysis as analysis,
)
from . import (
    batch as batch,
)
from . import (
    calibration as calibration,
)
from . import (
    data as data,
)
from . import (
    export as export,
)
from . import (
    live as live,
)
from . import (
    render as render,
)
from . import (
    simulation as simulation,
)
from .adapters.patching import patched_cv2 as patched_cv2
from .analyser import Analyser as Analyser
from .aps import cds as cds
from .calibration.model import Calibration as Calibration
from .capture.constants import (
    CAP_PDAVIS as CAP_PDAVIS,
)
from .capture.constants import (
    CAP_PDAVIS_AOP as CAP_PDAVIS_AOP,
)
from .capture.constants import (
    CAP_PDAVIS_AOP_BGR as CAP_PDAVIS_AOP_BGR,
)
from .capture.constants import (
    CAP_PDAVIS_BGR as CAP_PDAVIS_BGR,
)
from .capture.constants import (
    CAP_PDAVIS_DOLP as CAP_PDAVIS_DOLP,
)
from .capture.constants import (
    CAP_PDAVIS_DOLP_BGR as CAP_PDAVIS_DOLP_BGR,
)
from .capture.constants import (
    CAP_PDAVIS_EVENTS_BGR as CAP_PDAVIS_EVENTS_BGR,
)
from .capture.constants import (
    CAP_PDAVIS_I0 as CAP_PDAVIS_I0,
)
from .capture.constants import (
    CAP_PDAVIS_I45 as CAP_PDAVIS_I45,
)
from .capture.constants import (
    CAP_PDAVIS_I90 as CAP_PDAVIS_I90,
)
from .capture.constants import (
    CAP_PDAVIS_I135 as CAP_PDAVIS_I135,
)
from .capture.constants import (
    CAP_PDAVIS_QUAD as CAP_PDAVIS_QUAD,
)
from .capture.constants import (
    CAP_PDAVIS_S0 as CAP_PDAVIS_S0,
)
from .capture.constants import (
    CAP_PDAVIS_S1 as CAP_PDAVIS_S1,
)
from .capture.constants import (
    CAP_PDAVIS_S2 as CAP_PDAVIS_S2,
)
from .capture.constants import (
    CAP_PDAVIS_STOKES as CAP_PDAVIS_STOKES,
)
from .capture.constants import (
    CAP_PDAVIS_VALID as CAP_PDAVIS_VALID,
)
from .capture.constants import (
    CAP_PROP_PDAVIS_CAPTURE_FPS as CAP_PROP_PDAVIS_CAPTURE_FPS,
)
from .capture.constants import (
    CAP_PROP_PDAVIS_CAUSAL as CAP_PROP_PDAVIS_CAUSAL,
)
from .capture.constants import (
    CAP_PROP_PDAVIS_CUTOFF_HZ as CAP_PROP_PDAVIS_CUTOFF_HZ,
)
from .capture.constants import (
    CAP_PROP_PDAVIS_DEMOSAIC as CAP_PROP_PDAVIS_DEMOSAIC,
)
from .capture.constants import (
    CAP_PROP_PDAVIS_EXPOSURE_US as CAP_PROP_PDAVIS_EXPOSURE_US,
)
from .capture.constants import (
    CAP_PROP_PDAVIS_FPS as CAP_PROP_PDAVIS_FPS,
)
from .capture.constants import (
    CAP_PROP_PDAVIS_GAIN as CAP_PROP_PDAVIS_GAIN,
)
from .capture.constants import (
    CAP_PROP_PDAVIS_GAMMA as CAP_PROP_PDAVIS_GAMMA,
)
from .capture.constants import (
    CAP_PROP_PDAVIS_LAYOUT as CAP_PROP_PDAVIS_LAYOUT,
)
from .capture.constants import (
    CAP_PROP_PDAVIS_LOG as CAP_PROP_PDAVIS_LOG,
)
from .capture.constants import (
    CAP_PROP_PDAVIS_METHOD as CAP_PROP_PDAVIS_METHOD,
)
from .capture.constants import (
    CAP_PROP_PDAVIS_OUTPUT as CAP_PROP_PDAVIS_OUTPUT,
)
from .capture.constants import (
    CAP_PROP_PDAVIS_POS_US as CAP_PROP_PDAVIS_POS_US,
)
from .capture.constants import (
    CAP_PROP_PDAVIS_START_US as CAP_PROP_PDAVIS_START_US,
)
from .capture.constants import (
    CAP_PROP_PDAVIS_WHITE as CAP_PROP_PDAVIS_WHITE,
)
from .capture.video import (
    CaptureStatus as CaptureStatus,
)
from .capture.video import (
    VideoCapture as VideoCapture,
)
from .errors import (
    AnalysisWarning as AnalysisWarning,
)
from .errors import (
    CalibrationError as CalibrationError,
)
from .errors import (
    DamagedFileWarning as DamagedFileWarning,
)
from .errors import (
    DeviceError as DeviceError,
)
from .errors import (
    ExposureWarning as ExposureWarning,
)
from .errors import (
    LayoutError as LayoutError,
)
from .errors import (
    LayoutWarning as LayoutWarning,
)
from .errors import (
    PdavisError as PdavisError,
)
from .errors import (
    PdavisWarning as PdavisWarning,
)
from .errors import (
    RecordingError as RecordingError,
)
from .errors import (
    WeightsError as WeightsError,
)
from .errors import (
    WindowWarning as WindowWarning,
)
from .events import (
    EVENT_DTYPE as EVENT_DTYPE,
)
from .events import (
    accumulate as accumulate,
)
from .events import (
    as_events as as_events,
)
from .events import (
    slices as slices,
)
from .events import (
    time_surface as time_surface,
)
from .events import (
    voxel_grid as voxel_grid,
)
from .fusion.iteration import fuse as fuse
from .fusion.learning import (
    bandwidth_in_situ as bandwidth_in_situ,
)
from .fusion.learning import (
    clock_offset_in_situ as clock_offset_in_situ,
)
from .fusion.learning import (
    thresholds_in_situ as thresholds_in_situ,
)
from .fusion.options import FusionOptions as FusionOptions
from .live.address import (
    SOURCES as SOURCES,
)
from .live.address import (
    open_source as open_source,
)
from .mosaic import demosaic as demosaic
from .packed import unpack as unpack
from .polarimetry import (
    PolarFrame as PolarFrame,
)
from .polarimetry import (
    polarization as polarization,
)
from .quantities import (
    QUANTITIES as QUANTITIES,
)
from .quantities import (
    Quantity as Quantity,
)
from .reconstruct.aop_events import (
    AOP_EVENT_DTYPE as AOP_EVENT_DTYPE,
)
from .reconstruct.aop_events import (
    AopEvents as AopEvents,
)
from .reconstruct.base import (
    Estimate as Estimate,
)
from .reconstruct.base import (
    Needs as Needs,
)
from .reconstruct.base import (
    Reconstructor as Reconstructor,
)
from .reconstruct.cf import ComplementaryFilter as ComplementaryFilter
from .reconstruct.deblur import deblur as deblur
from .reconstruct.kalman import KalmanFilter as KalmanFilter
from .reconstruct.methods import (
    DEFAULT_METHOD as DEFAULT_METHOD,
)
from .reconstruct.methods import (
    METHODS as METHODS,
)
from .recording.aedat2.writer import (
    Aedat2Writer as Aedat2Writer,
)
from .recording.aedat2.writer import (
    write_aedat2 as write_aedat2,
)
from .recording.aedat4.writer import (
    Aedat4Writer as Aedat4Writer,
)
from .recording.aedat4.writer import (
    write_aedat4 as write_aedat4,
)
from .recording.base import (
    IMU_DTYPE as IMU_DTYPE,
)
from .recording.base import (
    TRIGGER_DTYPE as TRIGGER_DTYPE,
)
from .recording.base import (
    ApsFrame as ApsFrame,
)
from .recording.base import (
    Packet as Packet,
)
from .recording.base import (
    Recording as Recording,
)
from .recording.base import (
    RecordingInfo as RecordingInfo,
)
from .recording.base import (
    Source as Source,
)
from .recording.files import FileRecording as FileRecording
from .recording.format import Format as Format
from .recording.memory import recording_from_arrays as recording_from_arrays
from .recording.open import open_recording as open_recording
from .recording.registry import FORMATS as FORMATS
from .recording.stream import source_from_packets as source_from_packets
from .sensor import (
    CHANNELS as CHANNELS,
)
from .sensor import (
    Layout as Layout,
)
from .sensor import (
    Sensor as Sensor,
)
from .stokes_vector import (
    aop as aop,
)
from .stokes_vector import (
    debias_dolp as debias_dolp,
)
from .stokes_vector import (
    dolp as dolp,
)
from .stokes_vector import (
    stokes as stokes,
)
from .viewer.server import (
    serve as serve,
)
from .viewer.server import (
    view as view,
)

__version__: str
