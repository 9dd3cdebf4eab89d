"""Compiled kernels (private); typed in pdavis_cv/_kernels.pyi."""
# ruff: noqa: F401  listed in the last line
from ._aedat2 import aedat2_rows, aedat2_samples
from ._aedat4 import aedat4_events, aedat4_table_fields
from ._aop_events import aop_event_stokes
from ._build import DEBUG
from ._bus import read_out, sort_events
from ._clock import settle
from ._colours import colour_means, smooth
from ._davis_usb import davis_words
from ._degree import degree_frame, lasting_degree
from ._demosaic import bilinear, bilinear_variance, bilinear_weighted, binned, reached
from ._denoise import denoise_events, denoise_rates
from ._elementwise import exp, least_squares, mismatch, reconcile
from ._event_text import text_events
from ._event_words import (
    event_columns,
    evt2_words,
    evt3_words,
    ros_events,
    stream_events,
)
from ._events import count, surface, voxel
from ._guided import guided
from ._increments import (
    increments_commit,
    increments_drop,
    increments_push,
    increments_rest,
    increments_weigh,
)
from ._increments_frames import (
    increments_back,
    increments_close,
    increments_differ,
    increments_node,
    increments_pass,
)
from ._increments_read import increments_image, increments_move, increments_rest_planes
from ._lamp import lamp_push, lamp_wave
from ._leaky import (
    cf_frame,
    cf_frame_authors,
    cf_frame_printed,
    check_events,
    check_times,
    leak_events,
    leak_read,
    leak_shown,
    mean_around,
)
from ._learning import learning_around, learning_means, learning_past, learning_silences
from ._network import voxel_planes
from ._picture import fade_bgr, hue_bgr, ramp_bgr, tone_bgr
from ._polarization import aop, aop_dolp, dolp, mix, stokes
from ._redundancy import (
    redundancy_read,
    redundancy_sample,
    redundancy_shown,
    redundancy_solve,
    saturated_events,
    saturated_fill,
)
from ._samples import log_frame
from ._scenes import analysed, fan_stokes, plane_waves, texture_stokes
from ._simulate import pixel_events
from ._turning import turning_events, turning_images

__all__ = [name for name in dir() if name[0] != "_"]
