"""Tables S1 and S2: the paper's specification beside what simulated cameras have.

What a recording can show is measured from recordings, as one would of a camera; the
rest is what the code's description of the sensor says.
"""
from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from time import process_time
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdavis_cv.events import EVENT_DTYPE
from pdavis_cv.reconstruct.base import Reconstructor
from pdavis_cv.reconstruct.methods import make_reconstructor
from pdavis_cv.reconstruct.weights import Weights
from pdavis_cv.recording.base import ApsFrame
from pdavis_cv.sensor import Sensor
from pdavis_cv.simulation import (
    FULL,
    PRESETS,
    Bus,
    Camera,
    FlatLight,
    FunctionScene,
    RotatingPolarizer,
    Scene,
)

from .page import table
from .run import SONY_FULL, Settings

FloatArray = NDArray[np.float64]
Stokes = tuple[FloatArray, FloatArray, FloatArray]

_SIDE = 16
_DARK_FPS = 50.0
_FAINT_DN = 8.0, 16.0
"""Signals from which noise is extrapolated: the second twice the first."""
_LEAK_DN_PER_MS = 26.0
"""Light in which the paper counts background events (table S1, note b)."""
_AGREES = 0.15
"""A quantity agrees if it is within this part of the paper's."""


@dataclass(frozen=True, kw_only=True)
class Quantity:
    """A line of table S1; NaN where there is none."""

    quantity: str
    unit: str
    paper: float
    here: float
    paper_sony: float
    here_sony: float
    how: str

    @property
    def verdict(self) -> str:
        """Whether both agree with the paper's within 15 %."""
        pairs = [(a, b) for a, b in ((self.paper, self.here),
                                     (self.paper_sony, self.here_sony))
                 if math.isfinite(a) and math.isfinite(b)]
        if not pairs:
            return "-"
        far = max(abs(b / a - 1) for a, b in pairs)
        return "agrees" if far <= _AGREES else f"differs by {100 * far:.0f} %"


def _recorded(camera: Camera, scene: Scene, seconds: float) -> list[ApsFrame]:
    recording, _ = camera.record(scene, seconds)
    return [frame for packet in recording.packets() for frame in packet.frames]


def _frames(camera: Camera, scene: Scene, seconds: float) -> FloatArray:
    """Return frames in DN, shape (N, H, W)."""
    return np.array([frame.dn for frame in _recorded(camera, scene, seconds)],
                    np.float64)


def extinction_ratio(preset: str, seed: int) -> float:
    """Return the median over pixels of largest over least light behind a polarizer.

    A polarizer turns once; a, b, c of a + b cos 2t + c sin 2t are fitted to a pixel's
    frames.  Dark frames are subtracted (paper, section S2) where a frame may be
    negative; the mean of those that stop at 0 is too high.
    """
    full = (SONY_FULL if preset == "sony" else FULL) / 2
    camera = Camera.preset(preset, seed=seed, size=(_SIDE, _SIDE), dvs=None)
    assert camera.aps is not None
    dark = 0.0 if camera.aps.reset_dn is None else (
        _frames(camera, FlatLight(s0=0), 2.0).mean(0))
    seconds, turns = 6.0, 1
    scene = RotatingPolarizer(rpm=60 * turns / seconds, s0=full)
    frames = _recorded(camera, scene, seconds)
    t = np.array([(f.exposure_start_us + f.exposure_end_us) / 2 for f in frames]) / 1e6
    light = np.array([frame.dn for frame in frames], np.float64) - dark
    turn = 4 * np.pi * turns * t / seconds
    design = np.stack([np.ones(len(t)), np.cos(turn), np.sin(turn)], 1)
    a, b, c = np.linalg.lstsq(design, light.reshape(len(t), -1), rcond=None)[0]
    swing = np.hypot(b, c)
    return float(np.median((a + swing) / (a - swing)))


def frame_range_db(preset: str, seed: int) -> float:
    """Return 20 log10 of the largest signal over the noise in the dark, DN both.

    The noise is that of a pixel from frame to frame.  Its variance is extrapolated
    from two faint lights to none, because a converter that stops at 0 hides some of it
    in the dark.  The largest signal is what saturation leaves.
    """
    camera = Camera.preset(
        preset, seed=seed, size=(_SIDE, _SIDE), dvs=None, aps={"fps": _DARK_FPS})
    assert camera.aps is not None
    exposure_ms = camera.aps.exposure_us / 1000
    variances = [
        np.mean(_frames(camera, FlatLight(s0=2 * dn / exposure_ms), 4.0).var(0, ddof=1))
        for dn in _FAINT_DN]
    dark = 2 * variances[0] - variances[1]
    full = _frames(camera, FlatLight(s0=100 * SONY_FULL), 0.1)
    return float(20 * np.log10(np.median(full) / math.sqrt(dark)))


def leak_hz(preset: str, seed: int) -> float:
    """Return events per pixel and second in light that does not change."""
    camera = Camera.preset(preset, seed=seed, size=(_SIDE, _SIDE), aps=None)
    recording, _ = camera.record(FlatLight(s0=2 * _LEAK_DN_PER_MS), 20.0)
    return len(recording.events()) / _SIDE**2 / 20.0


def threshold_spread(preset: str, seed: int) -> tuple[float, float]:
    """Return mean and standard deviation over pixels of the ON threshold, ln units.

    Log light rises by 20 within 4 s; a pixel's threshold is that over its number of
    events.  Thresholds of 0.2 give 100 of them: that a count is whole adds 0.3 %.
    """
    rise, seconds = 20.0, 4.0

    def ramp(t_us: FloatArray, x: FloatArray, y: FloatArray) -> Stokes:
        s0 = 2 * np.exp(rise * t_us / (seconds * 1e6))
        return s0, 0 * s0, 0 * s0

    camera = Camera.preset(preset, seed=seed, size=(_SIDE, _SIDE), aps=None, bus=None)
    recording, _ = camera.record(
        FunctionScene(ramp, sampling_us=500.0, uniform=True), seconds)
    events = recording.events()
    events = events[events["p"] == 1]
    counts = np.bincount(events["y"].astype(np.int64) * _SIDE + events["x"],
                         minlength=_SIDE**2)
    thresholds = rise / np.maximum(counts, 1)
    return float(thresholds.mean()), float(thresholds.std(ddof=1))


def first_event_us(preset: str, seed: int) -> float:
    """Return the median time from a doubling of bright light to a pixel's first event.

    Expected of a pixel of one pole at f Hz: -ln(1 - theta / ln 2) / (2 pi f).
    """
    at_us = 100_000

    def step(t_us: FloatArray, x: FloatArray, y: FloatArray) -> Stokes:
        s0 = np.where(t_us < at_us, FULL / 2, FULL)
        return s0, 0 * s0, 0 * s0

    camera = Camera.preset(preset, seed=seed, size=(_SIDE, _SIDE), aps=None, bus=None,
                           dvs={"shot_noise_hz": 0.0, "leak_hz": 0.0})
    recording, _ = camera.record(
        FunctionScene(step, sampling_us=1.0, uniform=True), 0.13)
    events = recording.events()
    events = events[(events["t"] >= at_us) & (events["p"] == 1)]
    _, first = np.unique(
        events["y"].astype(np.int64) * _SIDE + events["x"], return_index=True)
    return float(np.median(events["t"][first] - at_us))


def specification(settings: Settings) -> Iterator[Quantity]:
    """Yield the lines of table S1, of the first camera and specimen asked for."""
    preset = (settings.cameras or ("nominal",))[0]
    seed = settings.seeds[0]
    aps, sony = PRESETS[preset]["aps"], PRESETS["sony"]["aps"]
    none = {"paper_sony": math.nan, "here_sony": math.nan}
    yield Quantity(
        quantity="extinction ratio", unit="", paper=40, paper_sony=350,
        here=extinction_ratio(preset, seed), here_sony=extinction_ratio("sony", seed),
        how="turning polarizer, dark frames subtracted, median of the pixels")
    yield Quantity(
        quantity="most frames", unit="Hz", paper=53, paper_sony=75,
        here=1e6 / (80 + aps.readout_us), here_sony=75,
        how="exposure of 80 us and the readout that is simulated; Sony: as stated")
    yield Quantity(
        quantity="dynamic range of frames", unit="dB", paper=52, paper_sony=72,
        here=frame_range_db(preset, seed), here_sony=frame_range_db("sony", seed),
        how="saturation over the noise from frame to frame without light, "
            f"{aps.exposure_us / 1000:g} and {sony.exposure_us / 1000:g} ms")
    yield Quantity(
        quantity="most events", unit="MHz", paper=10, here=Bus().rate_hz / 1e6, **none,
        how="bus as described, within a row")
    yield Quantity(
        quantity="time to the first event", unit="us", paper=3,
        here=first_event_us(preset, seed), **none,
        how="light doubles at full scale of the frames, in which pixels have some 250 "
            "Hz; the paper's figure is for 1 klux, far brighter, where they are faster")
    theta, spread = threshold_spread(preset, seed)
    yield Quantity(
        quantity="least threshold", unit="%", paper=14,
        here=100 * (math.exp(theta) - 1), **none,
        how="events in an exponential ramp; simulated as the camera was used, not at "
            "its least threshold")
    yield Quantity(
        quantity="spread of thresholds", unit="% contrast", paper=3.5,
        here=100 * spread, **none,
        how="standard deviation over pixels, the same ramp; `nominal` reads the "
            "figure as 3.5 % of the threshold, `hard` as contrast")
    yield Quantity(
        quantity="events in constant light", unit="Hz per pixel", paper=0.7,
        here=leak_hz(preset, seed), **none,
        how=f"{_LEAK_DN_PER_MS:g} DN/ms; leak and shot noise, at the same bias")


# ---- table S2 --------------------------------------------------------------------

_SENSOR = Sensor.PDAVIS.size
_WINDOW_US, _WINDOWS, _PER_WINDOW = 10_000, 12, 2_000
"""Time, number, and events of what is fed between two images."""

_WAYS: Mapping[str, tuple[str, Mapping[str, Any]]] = {
    "frames": ("frames", {}),
    "events": ("events", {}),
    "events, redundancy": ("events", {"offsets": "redundancy"}),
    "cf": ("cf", {}),
    "kalman causal": ("kalman", {"mode": "causal"}),
    "kalman": ("kalman", {}),
    "kalman offline": ("kalman", {"mode": "offline"}),
    "firenet": ("firenet", {"window_us": _WINDOW_US}),
    "joint": ("joint", {"window_us": _WINDOW_US}),
}
_PAPER_WAYS = {"frames": "1 frame, 8", "events": "1 event, 12",
               "cf": "1 event or 1 frame, 14", "firenet": "2000 events, 41000"}

# Additions, multiplications and functions of a float that the kernels do: an event is
# dt, times the rate, expm1, value times that, value plus that, plus the step
# (_leaky.pyx); an image of `events` and `cf` is the same decay, plus the base of the
# frame, and exp.
_OPERATIONS: Mapping[str, tuple[float, float]] = {
    "frames": (math.nan, 1), "events": (6, 6), "cf": (6, 7)}
# I to S0, S1, S2 (3), AoP (division, arc tangent, half), DoLP (two squares, sum, root,
# division), for a super-pixel of four pixels.
_STOKES_OPERATIONS = 11 / 4


def operations(method: str) -> tuple[float, float]:
    """Return operations per event, and per pixel of an image with its AoP and DoLP.

    Those of the networks are two for each weight and pixel that it is applied to:
    ``firenet`` sees each channel alone, ``joint`` all four at once.  NaN where they
    have not been counted.
    """
    if method in ("firenet", "joint"):
        weights = Weights.shipped(method).arrays
        count = sum(array.size for name, array in weights.items()
                    if name.endswith(".weight"))
        pixels = 1 if method == "firenet" else 4
        return math.nan, 2 * count / pixels + _STOKES_OPERATIONS
    per_event, per_pixel = _OPERATIONS.get(method, (math.nan, math.nan))
    return per_event, per_pixel + _STOKES_OPERATIONS


@dataclass(frozen=True, kw_only=True)
class Way:
    """A line of table S2: what a method uses, gives, waits for and takes.

    Parameters
    ----------
    method : str
    paper : str
        Latency, and operations per pixel, that the paper states.
    events, frames, dolp : bool
        What it uses, and whether its DoLP means anything.
    latency : str
        What an image waits for.
    event_operations, pixel_operations : float
        Of `operations`.
    event_ns, image_ns, image_ms : float
        CPU time of an event, of an image per pixel, and of an image of the whole
        sensor: what its latency is beyond what it waits for.
    """

    method: str
    paper: str
    events: bool
    frames: bool
    dolp: bool
    latency: str
    event_operations: float
    pixel_operations: float
    event_ns: float
    image_ns: float
    image_ms: float


def latency(made: Reconstructor) -> str:
    """Say what an image of a method waits for."""
    if "window_us" in made.parameters:
        return f"window of {made.parameters['window_us'] / 1000:g} ms"
    if made.lookahead_us is None:
        return "the whole recording"
    if made.lookahead_us:
        return f"{made.lookahead_us / 1000:g} ms"
    return " or ".join(name for used, name in (
        (made.needs.events, "1 event"), (made.needs.frames, "1 frame")) if used)


def _times(made: Reconstructor) -> tuple[float, float]:
    """Return CPU seconds of an event and of an image, medians of the windows."""
    height, width = _SENSOR
    random = np.random.default_rng(0)
    of_events, of_images = [], []
    for window in range(_WINDOWS):
        start = window * _WINDOW_US
        events = np.zeros(_PER_WINDOW, EVENT_DTYPE)
        events["t"] = start + np.sort(random.integers(1, _WINDOW_US, _PER_WINDOW))
        events["x"] = random.integers(0, width, _PER_WINDOW)
        events["y"] = random.integers(0, height, _PER_WINDOW)
        events["p"] = random.integers(0, 2, _PER_WINDOW)
        if made.needs.frames and window % 5 == 0:
            made.add_frame(ApsFrame(
                np.full(_SENSOR, 300, np.float32), exposure_start_us=start - 10_000,
                exposure_end_us=start + 10_000))
        began = process_time()
        if made.needs.events:
            made.add_events(events)
        fed = process_time()
        last = start + _WINDOW_US
        made.read(last - (made.lookahead_us or 0))
        of_images.append(process_time() - fed)
        of_events.append((fed - began) / _PER_WINDOW)
    return float(np.median(of_events)), float(np.median(of_images))


def ways(settings: Settings) -> Iterator[Way]:
    """Yield the lines of table S2, of the methods asked for."""
    for name, (method, parameters) in _WAYS.items():
        if name not in settings.methods:
            continue
        made = make_reconstructor(method, _SENSOR, 0.2, 0.2, parameters)
        event_s, image_s = _times(made)
        per_event, per_pixel = operations(name)
        yield Way(
            method=name, paper=_PAPER_WAYS.get(name, "-"), events=made.needs.events,
            frames=made.needs.frames, dolp=name != "events", latency=latency(made),
            event_operations=per_event, pixel_operations=per_pixel,
            event_ns=1e9 * event_s if made.needs.events else math.nan,
            image_ns=1e9 * image_s / (_SENSOR[0] * _SENSOR[1]), image_ms=1e3 * image_s)


# ---- words -----------------------------------------------------------------------


def _number(value: float) -> str:
    return "-" if math.isnan(value) else f"{value:.3g}"


def _because(way: Way) -> str:
    """Set the operations beside the paper's."""
    if way.method not in _PAPER_WAYS:
        return "-"
    stated = float(_PAPER_WAYS[way.method].rsplit(", ", 1)[1])
    if way.method == "firenet":
        macs = way.pixel_operations / 2
        return (f"agrees: {macs / 1000:.0f} k multiplications, each with its addition"
                if abs(macs / stated - 1) < _AGREES else "differs")
    here = np.nansum([way.event_operations, way.pixel_operations])
    return ("agrees in size; what counts as one operation is not stated"
            if 0.4 < here / stated < 2.5 else
            "differs: no more than a copy, and a super-pixel's AoP and DoLP")


def specification_page(
    camera: str, found: Sequence[Quantity], compared: Sequence[Way]
) -> list[str]:
    """Return the Markdown of both tables.

    Parameters
    ----------
    camera : str
        Preset that was measured.
    found : sequence of Quantity
    compared : sequence of Way
    """
    lines = ["# Tables S1 and S2", "", f"## S1: the camera, `{camera}`, beside a Sony",
             "", *table(
                 ("quantity", "unit", "PDAVIS, paper", "PDAVIS, here", "Sony, paper",
                  "Sony, here", "", "how"),
                 [(q.quantity, q.unit, *map(_number, (
                     q.paper, q.here, q.paper_sony, q.here_sony)), q.verdict, q.how)
                  for q in found]),
             "Measured on recordings of simulated cameras, except what is said to be "
             "described or stated. Array: 346x260 and 2448x2048 pixels, as in the "
             "paper. Not simulated: process, pixel size, power.", ""]
    if compared:
        yes = {True: "x", False: "-"}
        lines += ["## S2: the methods", "", *table(
            ("method", "events", "frames", "AoP", "DoLP", "an image waits for",
             "and then, ms", "operations per event", "per pixel of an image",
             "ns per event", "ns per pixel of an image",
             "paper: latency, operations per pixel", ""),
            [(way.method, yes[way.events], yes[way.frames], "x", yes[way.dolp],
              way.latency, _number(way.image_ms), _number(way.event_operations),
              _number(way.pixel_operations), _number(way.event_ns),
              _number(way.image_ns), way.paper, _because(way)) for way in compared]),
            f"Images may be asked for at any time, to the microsecond (the paper: 10 "
            "kHz, frames 25 Hz). CPU time of log "
            f"intensity on {_SENSOR[1]}x{_SENSOR[0]} pixels, {_PER_WINDOW} events "
            f"every {_WINDOW_US / 1000:g} ms, on the machine that made this page; "
            "demosaicing, AoP and DoLP cost the same for all. Operations: additions, "
            "multiplications and functions of floats in the kernels, two for each "
            "weight of a network, AoP and DoLP among them; those of `kalman` and of "
            "the redundancy depend on the data and are not counted.", ""]
    return lines
