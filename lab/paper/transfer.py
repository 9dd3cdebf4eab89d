"""Transfer function of the methods: gain and phase of log intensity by frequency."""
from __future__ import annotations

import cmath
import dataclasses
import math
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pdavis_cv.fusion import fuse
from pdavis_cv.reconstruct.cf import CUTOFF_HZ
from pdavis_cv.simulation import FULL, Camera, FunctionScene, Scene

from .page import table
from .print_style import COLUMN_IN, letters, look, new_figure
from .run import OFF_LOCK, Settings

if TYPE_CHECKING:
    from matplotlib.figure import Figure


# None near 100 or 120 Hz: there, light that is alike everywhere is taken for a lamp's.
FREQUENCIES_HZ = (0.4, 0.8, 1.6, 3.0, 6.0, 12.0, 25.0, 50.0, 75.0, 170.0)
_QUICK_HZ = (0.8, 1.6, 6.0, 25.0, 75.0)
_THETA, _DEPTH, _PIXEL_HZ = 0.02, 0.5, 250.0
_FPS, _EXPOSURE_US = 20.0, 20_000
_SETTLE_S, _LEAST_S, _PERIODS = 1.0, 1.5, 3

WAYS: Mapping[str, Mapping[str, Any]] = {
    "cf": {"method": "cf"},
    "kalman causal": {"method": "kalman", "causal": True},
    "kalman": {"method": "kalman"},
    "kalman offline": {"method": "kalman", "mode": "offline"},
}
"""Name -> parameters of fuse."""


@dataclasses.dataclass(frozen=True)
class Response:
    """Gain and phase of a method at a frequency, and for `cf` what theory says."""

    method: str
    hz: float
    gain: float
    phase_deg: float
    expected_gain: float
    expected_phase_deg: float


def pixel_response(hz: float) -> complex:
    """Return what the photoreceptor passes on: all that events can tell."""
    return 1 / (1 + 1j * hz / _PIXEL_HZ)


def expected_of_cf(hz: float, cutoff_hz: float = CUTOFF_HZ) -> complex:
    """Return the complementary filter's response at a frequency.

    Events come through the photoreceptor and the high pass; between two of them their
    sum is half a threshold behind on average, in the direction of the change.  A frame
    is a mean over its exposure, and is held from its middle until the next one's: a
    sine loses sinc(f T) by the first, and sinc(f / fps) and half an interval by the
    second.  What sampling aliases to other frequencies does not count.
    """
    held = np.sinc(hz / _FPS) * cmath.exp(-1j * math.pi * hz / _FPS)
    blur = float(np.sinc(hz * _EXPOSURE_US * 1e-6))
    seen = pixel_response(hz)
    # Of a square wave of theta / 2 in quadrature, the first harmonic.
    behind = 2 * _THETA / (math.pi * _DEPTH * abs(seen))
    s = 1j * hz / cutoff_hz
    return complex((blur * held + s * seen * (1 - 1j * behind)) / (1 + s))


def measured(hz: float, way: Mapping[str, Any]) -> complex:
    """Return the response to light whose log is a sine, from simulated images."""
    camera = Camera.preset(
        "ideal", size=(2, 2),
        dvs={"theta_on": _THETA, "theta_off": _THETA, "cutoff_hz": _PIXEL_HZ},
        aps={"fps": _FPS, "exposure_us": _EXPOSURE_US})
    whole = max(_PERIODS, math.ceil(_LEAST_S * hz)) / hz
    recording, _ = camera.record(_sine(hz), _SETTLE_S + whole + 0.1)
    count = max(400, math.ceil(8 * whole * hz))
    times = 1e6 * (_SETTLE_S + whole * np.arange(count) / count)
    log = np.log([
        float(image.s0.mean()) for image in fuse(
            recording, times_us=np.rint(times).astype(np.int64),
            nominal_thresholds=(_THETA, _THETA), **way)])
    wave = np.exp(-2e-6j * np.pi * hz * np.rint(times))
    # Light: depth sin(wt) = depth Im(exp(jwt)); a constant would leak into few periods.
    return complex(2j * np.mean((log - log.mean()) * wave) / _DEPTH)


def _sine(hz: float) -> Scene:
    def light(
        t: NDArray[np.float64], x: NDArray[np.float64], y: NDArray[np.float64],
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        s0 = 0.5 * FULL * np.exp(_DEPTH * np.sin(2e-6 * np.pi * hz * t)) + 0 * x * y
        return s0, 0 * s0, 0 * s0

    step = min(1000.0, 0.04e6 / (2 * math.pi * hz))
    return FunctionScene(light, sampling_us=step, uniform=True)


def transfer_rows(settings: Settings) -> Iterator[Response]:
    """Measure every method at every frequency."""
    for nominal_hz in _QUICK_HZ if settings.quick else FREQUENCIES_HZ:
        hz = nominal_hz * OFF_LOCK
        for name, way in WAYS.items():
            if name in settings.methods:
                found = measured(hz, way)
                theory = expected_of_cf(hz) if name == "cf" else complex(math.nan)
                yield Response(name, hz, abs(found), _degrees(found), abs(theory),
                               _degrees(theory))


def _degrees(value: complex) -> float:
    return math.degrees(cmath.phase(value))


def transfer_page(rows: Sequence[Response]) -> list[str]:
    """Return the Markdown: gain / phase by frequency."""
    speeds = list(dict.fromkeys(row.hz for row in rows))
    lines = []
    for name in dict.fromkeys(row.method for row in rows):
        mine = [row for row in rows if row.method == name]
        lines.append([name, *(f"{row.gain:.3f} / {row.phase_deg:.1f}" for row in mine)])
        if name == "cf":
            lines.append(["cf, theory", *(
                f"{row.expected_gain:.3f} / {row.expected_phase_deg:.1f}"
                for row in mine)])
    seen = [pixel_response(hz) for hz in speeds]
    lines.append(["photoreceptor", *(
        f"{abs(one):.3f} / {_degrees(one):.1f}" for one in seen)])
    return [
        "# transfer", "",
        f"Unpolarized light whose log is a sine of amplitude {_DEPTH:g}, seen by "
        f"pixels without noise: thresholds {_THETA:g}, photoreceptor {_PIXEL_HZ:g} Hz, "
        f"{_FPS:g} frames per second of {_EXPOSURE_US / 1000:g} ms. Gain / phase in "
        "degrees of the log intensity of images, by frequency in Hz (times "
        f"{OFF_LOCK}: none is locked to the frame clock). Theory of `cf`: "
        f"docs/theory/complementary-filter.md, with a corner of {CUTOFF_HZ:g} Hz.", "",
        *table(("method", *(f"{hz / OFF_LOCK:g}" for hz in speeds)), lines),
        *_beside(rows)]


def _beside(rows: Sequence[Response]) -> list[str]:
    """Set the paper's equation and picture beside what was measured of `cf`."""
    mine = [row for row in rows if row.method == "cf"]
    if not mine:
        return []
    off = max(abs(row.gain - row.expected_gain) for row in mine)
    turned = max(abs(math.remainder(row.phase_deg - row.expected_phase_deg, 360))
                 for row in mine)
    return ["## Beside the paper", "", *table(("quantity", "paper", "here", ""), [
        ("transfer function of `cf`", f"low pass of frames, high pass of events, "
         f"{CUTOFF_HZ:g} Hz", f"gain within {off:.3f}, phase within {turned:.1f} "
         "degrees of theory, in which frames are held, blurred, and events come by "
         "thresholds", "agrees" if off < 0.03 and turned < 2 else "differs")])]


def transfer_figure(rows: Sequence[Response]) -> Figure:
    """Draw gain and phase: measured as points, theory as lines."""
    drawing = new_figure(COLUMN_IN, 4.2)
    gain, phase = drawing.subplots(2, 1, sharex=True)
    hz = np.geomspace(0.3, 300, 400)
    for response, name, line in (
            (expected_of_cf, "cf, theory", {"color": look("cf")["color"]}),
            (pixel_response, "photoreceptor", {"color": "black", "linestyle": ":"})):
        values = np.array([response(float(f)) for f in hz])
        gain.plot(hz, np.abs(values), label=name, **line)
        phase.plot(hz, np.rad2deg(np.angle(values)), **line)
    for place, name in enumerate(dict.fromkeys(row.method for row in rows)):
        mine = [row for row in rows if row.method == name]
        line = {**look(name), "markerfacecolor": "none", "markersize": 6.5 - place,
                "linestyle": "none" if name == "cf" else "--"}
        gain.plot([row.hz for row in mine], [row.gain for row in mine], label=name,
                  **line)
        phase.plot([row.hz for row in mine], [row.phase_deg for row in mine], **line)
    gain.set_xscale("log")
    gain.xaxis.set_major_formatter("{x:g}")
    gain.set_ylim(0, 1.3)
    gain.set_ylabel("gain of log intensity")
    phase.set_ylabel("phase (degrees)")
    phase.set_xlabel("frequency of the light on a pixel (Hz)")
    letters((gain, phase))
    drawing.legend(*gain.get_legend_handles_labels(), loc="outside lower center",
                   ncols=2)
    return drawing
