"""A simulated camera: one specimen with its own parameters, and its recordings."""
from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

import numpy as np

from pdavis_cv._checks import plain, whole_number
from pdavis_cv.events import FAR
from pdavis_cv.recording.base import IMU_DTYPE, TRIGGER_DTYPE, Recording
from pdavis_cv.recording.memory import MemoryRecording
from pdavis_cv.sensor import Layout, Sensor
from pdavis_cv.simulation.aps import ApsPixel
from pdavis_cv.simulation.bus import Bus
from pdavis_cv.simulation.checks import affordable, instance, positive, require
from pdavis_cv.simulation.dvs import DvsPixel
from pdavis_cv.simulation.faults import Faults
from pdavis_cv.simulation.optics import Optics
from pdavis_cv.simulation.populations import drawn
from pdavis_cv.simulation.scenes import Scene
from pdavis_cv.simulation.specimen import Specimen
from pdavis_cv.simulation.stream import SimulatedRecording
from pdavis_cv.simulation.truth import Truth

_MOST_THREADS = 1024

_NOMINAL_DVS = DvsPixel(
    theta_on=0.16, theta_off=0.18, mismatch=0.035, cutoff_hz=250.0, leak_hz=0.3,
    leak_sigma=0.1, shot_noise_hz=1.0)
_NOMINAL_APS = ApsPixel(
    adc_bits=10, reset_dn=850.0, reset_fpn_dn=24.0, offset_fpn_dn=2.0, ktc_dn=3.0,
    full_well_dn=760.0, read_noise_dn=1.5, electrons_per_dn=80.0, dark_dn_s=15.0)
_NOMINAL_OPTICS = Optics(
    extinction_ratio=40.0, extinction_ratio_sigma=3.0,
    angle_sigma=math.radians(0.7), gain_sigma=0.02)
_REALISTIC_DVS = dataclasses.replace(
    _NOMINAL_DVS, cutoff_hz=None, cutoff_hz_per_dn_ms=0.42 * 20, burst_chance=0.002)
# A sensor that was measured pixel by pixel has this spread at every bias.
_TYPICAL_DVS = dataclasses.replace(
    _NOMINAL_DVS, theta_on=0.2, theta_off=0.2, mismatch=0.0, mismatch_ln=0.045)
# The nominal thresholds are 0.2, whatever those of a specimen.
_STATED_DVS = dataclasses.replace(_REALISTIC_DVS, theta_on=0.2, theta_off=0.2)

PRESETS: Mapping[str, Mapping[str, Any]] = MappingProxyType({
    "ideal": {"optics": Optics(), "dvs": DvsPixel(), "aps": ApsPixel(), "bus": None},
    "nominal": {"optics": _NOMINAL_OPTICS, "dvs": _NOMINAL_DVS, "aps": _NOMINAL_APS,
                "bus": None},
    "typical": {"optics": _NOMINAL_OPTICS, "dvs": _TYPICAL_DVS, "aps": _NOMINAL_APS,
                "bus": None, "faults": Faults(frame_offset_us=3000)},
    "realistic": {"optics": _NOMINAL_OPTICS, "dvs": _REALISTIC_DVS,
                  "aps": _NOMINAL_APS, "bus": Bus()},
    "hard": {"optics": _NOMINAL_OPTICS,
             "dvs": dataclasses.replace(
                 _REALISTIC_DVS, mismatch=0.0, mismatch_ln=0.035),
             "aps": _NOMINAL_APS, "bus": Bus()},
    "saturated": {"optics": _NOMINAL_OPTICS, "dvs": _NOMINAL_DVS,
                  "aps": _NOMINAL_APS, "bus": Bus()},
    "sony": {"optics": Optics(layout=Layout.SONY, extinction_ratio=350.0,
                              extinction_ratio_sigma=20.0,
                              angle_sigma=math.radians(0.2), gain_sigma=0.005),
             "dvs": None,
             "aps": ApsPixel(fps=50.0, exposure_us=20_000, readout_us=0,
                             adc_bits=12, full_well_dn=4095.0, offset_fpn_dn=0.5,
                             read_noise_dn=0.8, electrons_per_dn=2.6),
             "bus": None},
    "drawn": {"optics": _NOMINAL_OPTICS, "dvs": _STATED_DVS, "aps": _NOMINAL_APS,
              "bus": Bus()},
    "davis346": {"optics": _NOMINAL_OPTICS, "dvs": _STATED_DVS, "aps": _NOMINAL_APS,
                 "bus": Bus(), "faults": Faults()},
})
"""Parts of each named camera; `Camera.preset` says what they are.

For ``typical``, ``drawn`` and ``davis346`` these are the values that the maker would
state; those of a specimen are drawn from
`pdavis_cv.simulation.populations.POPULATIONS`.
"""

DEFAULT_CAMERA = "typical"
"""Preset of commands and addresses that name none."""


class Camera(Specimen):
    """One specimen of a camera; the same seed is the same specimen.

    Parameters
    ----------
    optics : Optics
        Polarizers and sensitivity.
    dvs : DvsPixel, optional
        Event pixel; None for a camera of frames only.
    aps : ApsPixel, optional
        Frame pixel; None for a camera of events only.
    bus : Bus, optional
        Read-out bus of the events; None for one without limits.
    faults : Faults, optional
        Faults of stamps and streams; None for none.
    seed : int
        Names the specimen: its maps, and with ``run`` its noise.
    size : (int, int)
        (height, width) of the region that is simulated.
    origin : (int, int), optional
        (row, column) of its first pixel on the sensor; default such that the
        region is in the middle, on even numbers.
    sensor : Sensor
        Kind of sensor; gives the full size.
    name : str
        Name of the camera in the recording's header.

    Attributes
    ----------
    maps : mapping of str to ndarray of float64, shape (H, W)
        Parameters per pixel: ``angle`` (radians), ``extinction_ratio``, ``gain``,
        ``analyser`` (H, W, 3), ``theta_on``, ``theta_off`` (natural log), ``leak_hz``,
        ``reset_dn``, ``dark_dn``.
    """

    @classmethod
    def preset(cls, name: str, **changes: Any) -> Camera:
        """Make a camera by name.

        Parameters
        ----------
        name : str
            ``ideal``: exact crossings at 0.15, ER 40, no noise, floats.
            ``nominal``: thresholds 0.16/0.18 with 3.5 % mismatch, 250 Hz, leak
            0.3 Hz, shot noise 1 Hz, ER 40 +- 3, angle error 0.7 degrees, gain 2 %,
            10-bit frames with fixed-pattern, shot and read noise; no bus limit.
            ``typical``: nominal, but as cameras are measured: thresholds .22/.26
            that are stated as .2 (20 % less than their mean), with a spread of .045
            in natural-log units from pixel to pixel; frames are stamped 3 ms late.
            ``realistic``: nominal, with a bandwidth of 0.42 Hz per DN of light in
            20 ms, read-out bus, and bursts at frame edges.
            ``hard``: realistic with a mismatch of 0.035 in natural-log units.
            ``saturated``: nominal on the whole sensor, whose events saturate the bus.
            ``sony``: 12-bit frames at 50 fps, ER 350, 72 dB.
            ``drawn``: each seed another camera: thresholds, mismatch, bandwidth,
            refractory period, leak, noise, offsets, sensitivities, angles and ER
            from ranges wider than the estimators' priors and centred elsewhere.
            ``davis346``: the same from the ranges of published and measured
            DAVIS346: thresholds of .26 to .43 that are stated as .2, refractory
            period, leak that grows with light, and events 4 to 7.4 ms behind frames.
        **changes
            Parameters of `Camera` (``seed``, ``size``, ``origin``, ...), and whole
            parts (``optics``, ``dvs``, ``aps``, ``bus``, ``faults``) or mappings of
            single parameters of a part: ``dvs={"leak_hz": 0}``.

        Raises
        ------
        ValueError
            If there is no such preset, or a parameter is impossible.
        """
        require("name", name, name in PRESETS, f"be one of {', '.join(PRESETS)}")
        parts = drawn(name, PRESETS[name], changes.get("seed", 0))
        parts.setdefault("faults", Faults())
        for part, given in changes.items():
            if part in parts and isinstance(given, dict):
                parts[part] = dataclasses.replace(parts[part], **given)
            else:
                parts[part] = given
        if name == "sony":
            parts.setdefault("sensor", Sensor.SONY)
        if name == "saturated":
            parts.setdefault("size", Sensor.PDAVIS.size)
        return cls(**{"name": f"simulated {name}", **parts})

    def stream(
        self, scene: Scene, seconds: float, *, run: int = 0, threads: int = 1,
        step_us: float | None = None,
    ) -> SimulatedRecording:
        """Return a recording that is simulated while it is read, in constant memory.

        Parameters
        ----------
        scene : Scene
            The light.
        seconds : float
            Duration; the recording covers [0, seconds).
        run : int
            Number of the recording, 0 to 2**63 - 1: the same specimen, other noise.
        threads : int
            Threads over bands of rows, 1 to 1024; they do not change the result.
        step_us : float, optional
            Interval at which the scene is sampled; default its own ``step_us``.
        """
        instance(Scene)("scene", scene)
        seconds, step_us = positive("seconds", plain(seconds)), plain(step_us)
        if step_us is not None:
            positive("step_us", step_us)
        threads = whole_number("threads", threads, 1, _MOST_THREADS)
        run = whole_number("run", run, 0, 2**63 - 1)
        require("seconds", seconds, seconds * 1e6 < FAR, "be less than 2**61 us")
        return SimulatedRecording(
            self, scene, round(seconds * 1e6), run, threads, step_us)

    def record(
        self, scene: Scene, seconds: float, *, run: int = 0, threads: int = 1,
        step_us: float | None = None,
    ) -> tuple[Recording, Truth]:
        """Simulate a recording into memory.

        Parameters
        ----------
        scene, seconds, run, threads, step_us
            As for `stream`.

        Returns
        -------
        recording : Recording
            Events, and frames as the camera delivers them.
        truth : Truth
            The light in front of the camera, and the load of the bus.
        """
        stream = self.stream(scene, seconds, run=run, threads=threads, step_us=step_us)
        height, width = self.size
        frames_per_s = 0.0 if self.aps is None else self.aps.fps
        affordable("the frames; stream() holds none of them",
                   4 * frames_per_s * seconds * height * width, seconds=seconds)
        pieces = list(stream.pieces())
        events = np.concatenate([piece.events for piece in pieces])
        frames = tuple(frame for piece in pieces for frame in piece.frames)
        info = dataclasses.replace(
            stream.info, event_count=len(events), frame_count=len(frames),
            imu_count=0, trigger_count=0)
        recording = MemoryRecording(
            info, events, frames, np.empty(0, IMU_DTYPE), np.empty(0, TRIGGER_DTYPE))
        return recording, stream.truth()
