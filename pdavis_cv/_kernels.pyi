"""The whole Python/C boundary, one line per kernel."""
from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

_F32 = NDArray[np.float32]
_Pair = tuple[NDArray[Any], NDArray[Any]]
_F64 = NDArray[np.float64]
_I32 = NDArray[np.int32]
_I64 = NDArray[np.int64]
_U8 = NDArray[np.uint8]
_Pixel = TypeVar("_Pixel", np.uint8, np.uint16, np.float32)

DEBUG: bool
def aedat2_rows(
    words: _U8, n: int, origin: int, height: int, width: int, state: _I64,
    out: NDArray[Any],
) -> int: ...
def aedat2_samples(
    rows: NDArray[Any], begin: int, state: _I64, frame: _I64, reset: NDArray[np.uint16],
    signal: NDArray[np.uint16], seen: _U8, times: _I64, sample: NDArray[np.int16],
    imu_t: _I64, imu: NDArray[np.int16], trigger_t: _I64, trigger: _U8,
) -> tuple[int, int]: ...
def aedat4_events(
    data: bytes | memoryview | _U8, at: int, n: int, height: int, width: int,
    flip: bool, first: int, last: int, state: _I64, out: NDArray[Any],
) -> None: ...
def aedat4_packets(
    block: _U8, begin: int, index: _I64, number: int, stop: int, stream: int,
    packed: bool, height: int, width: int, flip: bool, unpacked: _U8, state: _I64,
    out: NDArray[Any],
) -> int: ...
def aedat4_vector(
    data: bytes | memoryview, field: int, item: int,
) -> tuple[int, int]: ...
def cells(samples: _U8, size: int, width: int) -> tuple[list[int], list[int]]: ...
def davis_words(
    words: NDArray[np.uint16], begin: int, turned: bool, height: int, width: int,
    state: _I64, reads: NDArray[np.uint16], times: _I64, out: NDArray[Any], imu: _I64,
    triggers: _I64,
) -> tuple[int, int]: ...
def event_columns(
    t: _I64, x: _I32, y: _I32, p: _I32, height: int, width: int, state: _I64,
    out: NDArray[Any],
) -> None: ...
def evt2_words(
    words: NDArray[np.uint32], begin: int, height: int, width: int, stream: _I64,
    state: _I64, triggers: _I64, out: NDArray[Any],
) -> int: ...
def evt3_words(
    words: NDArray[np.uint16], begin: int, height: int, width: int, stream: _I64,
    state: _I64, triggers: _I64, out: NDArray[Any],
) -> int: ...
def ros_events(
    data: _U8, start: int, stride: int, count: int, places: _I64, shift: int,
    height: int, width: int, state: _I64, out: NDArray[Any],
) -> None: ...
def least_squares(
    images: NDArray[_Pixel], solution: _F32, response: _F32, out: _F32, rest: _F32
) -> None: ...
def colour_bilinears(
    mosaic: NDArray[_Pixel], cell: _U8, scratch: _F32, out: _F32
) -> None: ...
def colour_planes(
    quad: _F32, places: NDArray[np.intp], tints: _F32, parts: _F32, gain: float,
    scratch: _F32, out: _F32,
) -> None: ...
def colour_ratios(mosaic: _F32, scratch: _F32, tints: _F32, parts: _F32) -> None: ...
def grey_mosaic(tints: _F32, parts: _F32, scratch: _F32, mosaic: _F32) -> None: ...
def settle(
    samples: NDArray[Any], accepted: int, n: int, reach: int, held: int, final: bool,
    move: Callable[[int], int] | None, state: _I64,
) -> tuple[int, int, int]: ...
def stream_events(
    data: _U8, atis: bool, height: int, width: int, time: _I64, state: _I64,
    out: NDArray[Any],
) -> int: ...
def text_events(
    data: _U8, begin: int, order: _I64, more: bool, unit: int, height: int, width: int,
    state: _I64, out: NDArray[Any],
) -> tuple[int, int]: ...
def aedat4_table_fields(data: _U8, at: int, field: int, out: _U8) -> int: ...
def aop(s1: _F32, s2: _F32, out: _F32) -> None: ...
def s0_aop_dolp(quad: _F32, gain: float, s0: _F32, aop: _F32, dolp: _F32) -> None: ...
def aop_event_stokes(
    events: NDArray[Any], step: _F32, axes: _F64, radius: int, last: int, rate: float,
    span: float, correct: bool, epoch: _F64, turns: NDArray[Any], out: _F32,
) -> int: ...
def bilinear(
    mosaic: NDArray[_Pixel], places: NDArray[np.intp], uncertain: bool, scratch: _F32,
    out: _F32,
) -> None: ...
def bilinear_variance(
    variance: _F32, places: NDArray[np.intp], scratch: _F32, out: _F32
) -> None: ...
def bilinear_weighted(
    mosaic: _F32, variance: _F32, places: NDArray[np.intp], spread: _F32, null: _F32,
    rows: tuple[int, int], scratch: _F32, quad: _F32, out: _F32, gain: float,
    aop: _F32, dolp: _F32,
) -> None: ...
def binned(
    mosaic: NDArray[_Pixel], places: NDArray[np.intp], scratch: _F32, out: _F32
) -> None: ...
def cf_frame(
    sample: _F32, valid: _U8, log_8bit: _F32, age: _F32, t: float, rate: float,
    floor: float, held: _F32, cells: NDArray[Any],
) -> None: ...
def cf_frame_authors(
    sample: _F32, valid: _U8, log_8bit: _F32, t: float, rate: float, floor: float,
    held: _F32, cells: NDArray[Any],
) -> None: ...
def cf_frame_printed(
    sample: _F32, valid: _U8, t: float, rate: float, floor: float, log_scale: float,
    cells: NDArray[Any],
) -> None: ...
def check_events(events: NDArray[Any], last: int, h: int, w: int) -> int: ...
def check_times(events: NDArray[Any]) -> int: ...
def denoise_events(
    events: NDArray[Any], start: int, last: int, stop: int, window: int, needed: int,
    hot: _U8, times: NDArray[np.int64], counts: NDArray[np.int32], keep: _U8,
) -> int: ...
def denoise_rates(
    counts: NDArray[np.int32], rates: _F32, hot: _U8, share: float, per_count: float,
    floor: float, factor: float,
) -> None: ...
def dolp(s0: _F32, s1: _F32, s2: _F32, out: _F32) -> None: ...
def exp(x: _F32, out: _F32) -> None: ...
def count(
    events: NDArray[Any], start: int, stop: int, out: NDArray[np.int32]
) -> int: ...
def fade_bgr(weight: _F32, valid: _U8, scale: float, ground: int, out: _U8) -> None: ...
def guided(
    mosaic: NDArray[_Pixel], clean: _U8, variance: _F32, places: NDArray[np.intp],
    constants: NDArray[Any], scratch: _F32, out: _F32,
) -> None: ...
def increments_back(
    frames: list[tuple[object, ...]], due: _I64, camera: _F64, anchors: NDArray[Any],
    back: _F32, bands: tuple[int, int],
) -> None: ...
def increments_close(
    pixels: NDArray[Any], store: NDArray[Any], frame: tuple[object, ...], ahead: int,
    oldest: int, camera: _F64, waves: NDArray[Any], listed: _I32,
) -> None: ...
def increments_commit(
    store: NDArray[Any], at: int, stop: int, until: int, pixels: NDArray[Any],
    due: _I64, awake: _I32, woken: int,
) -> tuple[int, int]: ...
def increments_differ(
    new: _F64, old: _F64, anchors: NDArray[Any], listed: _I32, planes: _F32, out: _F32,
) -> None: ...
def increments_drop(
    store: NDArray[Any], stop: int, by: int, pixels: NDArray[Any],
) -> None: ...
def increments_image(
    planes: _F32, around: _F32 | None, times: tuple[int, int], waves: NDArray[Any],
    most: float, out: tuple[_F32, _F32, _U8], bands: tuple[int, int],
) -> None: ...
def increments_move(
    pixels: NDArray[Any], store: NDArray[Any], frames: tuple[Any, ...],
    times: tuple[int, int, bool], waves: NDArray[Any], camera: _F64, listed: _I32,
    due: _I64, shown: NDArray[Any], courses: NDArray[Any] | None, planes: _F32,
    around: _F32 | None, bands: tuple[int, int],
) -> None: ...
def increments_node(
    pixels: NDArray[Any], store: NDArray[Any], frame: tuple[object, ...], known: int,
    ahead: int, camera: _F64, waves: NDArray[Any], again: tuple[bool, bool],
    listed: _I32, bands: tuple[int, int],
) -> None: ...
def increments_pass(
    old: tuple[object, ...], new: tuple[object, ...], due: _I64, camera: _F64,
    anchors: NDArray[Any], middles: _F32, bands: tuple[int, int],
) -> None: ...
def increments_push(
    events: NDArray[Any], last: int, first: int, at: int, store: NDArray[Any],
    pixels: NDArray[Any], camera: _F64, due: _I64, awake: _I32, woken: int,
) -> tuple[int, int]: ...
def increments_rest(
    store: NDArray[Any], known: int, oldest: int, pixels: NDArray[Any],
    anchors: NDArray[Any], camera: _F64, due: _I64, awake: _I32, woken: int,
    rested: _I32,
) -> tuple[int, int]: ...
def increments_rest_planes(
    frames: tuple[Any, ...], camera: _F64, planes: _F32, bands: tuple[int, int],
) -> None: ...
def increments_weigh(
    store: NDArray[Any], stop: int, first: int, pixels: NDArray[Any], camera: _F64,
) -> None: ...
def lamp_push(
    events: NDArray[Any], until: int, sensor: tuple[int, int, int],
    thresholds: tuple[float, float], even_us: _F64, hz: _F32, stamps: _I64, sums: _F64,
) -> int: ...
def lamp_wave(sums: _F64, t: int, out: _F64) -> None: ...
def lasting_degree(
    lasting: _F32, analyser: _F32, shown: tuple[_F32, _F32, _U8], rows: tuple[int, int],
) -> None: ...
def learning_around(
    events: NDArray[Any], start: _I64, places: _I32, times: _I64, known: _I64,
    lags: _F64, camera: _F64, out: _F32,
) -> None: ...
def learning_past(
    events: NDArray[Any], start: _I64, first: _I64, camera: _F64,
) -> None: ...
def learning_rows(
    events: NDArray[Any], start: _I64, pixel: _I32, exposure: _I64, ahead: int,
    log: _F64, samples: int, camera: _F64, gains: _F64, out: _F64,
) -> None: ...
def learning_silences(
    events: NDArray[Any], start: _I64, pixels: _I32, times: _I64, ahead: int,
    camera: _F64, rows: _F64, target: _F64,
) -> int: ...
def leak_events(
    events: NDArray[Any], step: _F32, last: int, cells: NDArray[Any]
) -> int: ...
def leak_read(cells: NDArray[Any], base: _F32, t: float, out: _F32) -> None: ...
def leak_shown(
    events: NDArray[Any], cells: NDArray[Any], out: _F32, seen: _U8
) -> None: ...
def log_frame(
    dn: _F32, usable: _U8, log_exposure: _F32, out: _F32, valid: _U8
) -> None: ...
def mean_around(
    own: _F32, count: _F32, offsets: NDArray[np.intp], out: _F32
) -> None: ...
def mismatch(
    quad: _F32, gain: float, angle: float, contrast: float, offset: float,
    variance: _F32,
) -> None: ...
def mix(quad: _F32, solution: _F32, out: _F32) -> None: ...
def reconcile(quad: _F32, variance: _F32, null: _F32) -> None: ...
def stokes(quad: _F32, gain: float, out: _F32) -> None: ...
def pixel_events(
    light: NDArray[np.float64], slope: NDArray[np.float64],
    analyser: NDArray[np.float64] | None, pixels: NDArray[np.float64],
    keys: NDArray[np.uint64], edges: NDArray[np.float64], first_edge: int,
    settings: NDArray[np.float64], places: NDArray[np.uint16],
    state: NDArray[np.float64], counters: NDArray[np.uint64], start: int, stop: int,
    out: NDArray[Any]
) -> tuple[int, int]: ...
def reached(valid: _U8, rows: tuple[int, int], scratch: _U8, out: _U8) -> None: ...
def read_out(
    events: NDArray[Any], until_us: float, event_us: float, row_us: float,
    clock: NDArray[np.float64], waiting: NDArray[np.int32], queue: NDArray[np.uint16],
    pending: NDArray[np.uint8], out: NDArray[Any]
) -> tuple[int, int, int]: ...
def redundancy_read(
    t: int, known: int, recent: tuple[NDArray[Any], NDArray[Any]],
    model: tuple[NDArray[Any], NDArray[Any]], states: NDArray[Any],
    rows: tuple[int, int], wanted: _U8, log: _F32,
) -> None: ...
def redundancy_sample(
    t: int, known: int, recent: tuple[NDArray[Any], NDArray[Any], int, int],
    model: tuple[NDArray[Any], NDArray[Any]],
    policy: NDArray[Any],
    cells: tuple[NDArray[Any], NDArray[Any], NDArray[Any]],
) -> None: ...
def redundancy_solve(
    policy: NDArray[Any], moments: NDArray[Any], states: NDArray[Any],
) -> None: ...
def saturated_events(
    events: NDArray[Any], cell_of: NDArray[np.int32], columns: int, out: NDArray[Any]
) -> int: ...
def saturated_fill(
    cells: tuple[NDArray[np.intp], _U8],
    seen: tuple[_F32, _F32, _U8, _F32], bound: _F32, prior: float, excess: float,
    dim: float, valid_variance: float, shown: tuple[_F32, _F32, _U8],
) -> None: ...
def sort_events(
    events: NDArray[Any], start: int, counts: NDArray[np.int32], out: NDArray[Any]
) -> int: ...
def hue_bgr(
    plane: NDArray[Any], valid: _U8, scale: float, least: float, table: _U8, out: _U8
) -> None: ...
def ramp_bgr(
    plane: NDArray[Any], valid: _U8, scale: float, least: float, table: _U8, out: _U8
) -> None: ...
def tone_bgr(
    plane: NDArray[Any], valid: _U8, scale: float, least: float, table: _U8, out: _U8
) -> None: ...
def surface(events: NDArray[Any], t: int, rate: float, out: _F32) -> None: ...
def voxel(events: NDArray[Any], start: int, stop: int, out: _F32) -> int: ...
def voxel_planes(
    events: NDArray[Any], last: int, start: int, stop: int, steps: _F32,
    height: int, width: int, out: _F32, seen: _U8,
) -> int: ...
def analysed(analyser: _F64, s0: _F64, s1: _F64, s2: _F64, out: _F64) -> None: ...
def fan_stokes(
    turns: _F64, cosines: _F64, sines: _F64, rest: _F64, steep: _F64, light: _F64,
    s1: _F64, s2: _F64,
) -> None: ...
def plane_waves(
    down_c: _F64, down_s: _F64, cos: _F64, sin: _F64, out: _F64
) -> None: ...
def texture_stokes(
    first: _F64, second: _F64, third: _F64, s0: float, contrast: float, dolp: float,
    dolp_spread: float, aop: float, aop_spread: float,
) -> None: ...
def turning_events(
    events: NDArray[Any], last: int, cells: NDArray[Any], lasting: NDArray[Any],
    seen: NDArray[np.uint8], segments: _F64, tau: float, share: float,
) -> int: ...
def turning_images(
    cells: NDArray[Any], seen: NDArray[np.uint8], t: float, tau: float, half_us: float,
    late: float, common: float, level: _F32, planes: _F32, valid: NDArray[np.uint8],
) -> None: ...
