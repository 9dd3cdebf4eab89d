"""The paper's five supplementary videos, simulated, with the truth beside.

1: a polarizer turns; 2: a quarter-wave plate turns; 3, 4: the fan at 105 and 1000 RPM
with a Sony camera; 5: a tendon that is pulled at 1 and 10 Hz.
"""
from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pdavis_cv import PolarFrame, Recording
from pdavis_cv.analysis import axial_difference
from pdavis_cv.export import VideoFile
from pdavis_cv.fusion import fuse
from pdavis_cv.render import (
    Line,
    Panel,
    Picture,
    ToneCurve,
    aop_bgr,
    chart,
    dolp_bgr,
    events_on,
    fade,
    grey_bgr,
    panel,
    stack,
    tile,
)
from pdavis_cv.simulation import (
    FULL,
    Camera,
    Fan,
    RotatingPlate,
    RotatingPolarizer,
    Scene,
    Tendon,
    Truth,
)

from . import run as runs
from .index import played
from .page import table
from .run import OFF_LOCK, SONY_FULL, Settings

_SIDE, _QUICK_SIDE = 64, 32
_BEFORE_S, _AFTER_S = 0.5, 0.1
"""Recorded before what is shown and after it: frames come, and a future to look at."""
_PICTURES, _QUICK_PICTURES = 150, 24
_PLAYED_PER_S = 25.0
_WIDTH = 256                # of a picture in the video, at least
_TRACE_HEIGHT = 150


class Shown(NamedTuple):
    """What stands side by side in a video: a name, the method whose images it shows."""

    name: str
    method: str


_PDAVIS = (Shown("truth", "truth"), Shown("PDAVIS frames", "frames"),
           Shown("complementary filter", "cf"), Shown("kalman", "kalman"))
_WITH_SONY = (_PDAVIS[0], Shown("Sony 75 fps", "Sony 75 fps"), *_PDAVIS[1:])


@dataclass(frozen=True, kw_only=True)
class Video:
    """One of the supplementary videos.

    Parameters
    ----------
    what : str
        What it shows, for the caption.
    light : callable
        (Camera, S0 in DN per ms) -> Scene.
    seconds : float
        Of the scene.
    shown : sequence of Shown
        From left to right.
    pictures : sequence of str
        Of each, from top to bottom: ``channels``, ``i0``, ``aop``, ``dolp``.
    trace : bool
        Whether the mean DoLP over time stands below; events take the place of the
        truth's intensity.
    """

    what: str
    light: Callable[[Camera, float], Scene]
    seconds: float
    shown: Sequence[Shown] = _PDAVIS
    pictures: Sequence[str] = field(default=("channels", "aop"))
    trace: bool = False


def _fan(rpm: float) -> Callable[[Camera, float], Scene]:
    def light(camera: Camera, s0: float) -> Scene:
        (row, column), side = camera.origin, camera.size[0]
        return Fan(rpm=rpm * OFF_LOCK, radius=0.48 * side, hub=0.08 * side, s0=s0,
                   centre=(column + (side - 1) / 2, row + (side - 1) / 2))
    return light


_TENDON = (Shown("truth", "truth"), Shown("frames", "frames"),
           Shown("kalman", "kalman"))

VIDEOS: dict[str, Video] = {
    "1": Video(
        what="a linear polarizer turns at 100 RPM: intensity of the four channels, AoP",
        light=lambda camera, s0: RotatingPolarizer(rpm=100 * OFF_LOCK, s0=s0),
        seconds=0.6),
    "2": Video(
        what="a quarter-wave plate turns at 100 RPM behind a polarizer: DoLP",
        light=lambda camera, s0: RotatingPlate(rpm=100 * OFF_LOCK, s0=s0),
        seconds=0.6, pictures=("channels", "dolp")),
    "3": Video(
        what="six polarizers at 105 RPM, the left half lit 2000 times more",
        light=_fan(105), seconds=0.6, shown=_WITH_SONY, pictures=("i0", "aop", "dolp")),
    "4": Video(
        what="the same at 1000 RPM: frames are blurred, events are not",
        light=_fan(1000), seconds=0.12, shown=_WITH_SONY,
        pictures=("i0", "aop", "dolp")),
    "5-1Hz": Video(
        what="fibres of a tendon that is pulled at 1 Hz, and their mean DoLP",
        light=lambda camera, s0: Tendon(hz=1, s0=s0), seconds=2.0, shown=_TENDON,
        pictures=("i0", "dolp"), trace=True),
    "5-10Hz": Video(
        what="the same at 10 Hz: more than frames can follow",
        light=lambda camera, s0: Tendon(hz=10, s0=s0), seconds=0.3, shown=_TENDON,
        pictures=("i0", "dolp"), trace=True),
}
"""By the number that the paper gives them; the fifth shows two rates."""


class Moment(NamedTuple):
    """What a video shows at one time: an image of each method, and recent events."""

    t_us: int
    images: Sequence[PolarFrame]
    events: NDArray[Any]


def moments(video: Video, settings: Settings) -> Iterator[Moment]:
    """Record the scene and yield what its pictures show.

    Parameters
    ----------
    video : Video
    settings : Settings
        Preset, specimen, and whether a first look is enough.
    """
    side = _QUICK_SIDE if settings.quick else _SIDE
    times = _times(video, settings)
    preset, seed = (settings.cameras or ("nominal",))[0], settings.seeds[0]
    made: dict[str, tuple[Recording, Truth]] = {}
    streams: list[Iterator[PolarFrame]] = []
    for row in video.shown:
        method = runs.METHODS.get(row.method, runs.Method(parameters={}))
        maker = method.preset or preset
        if maker not in made:
            s0 = SONY_FULL if method.preset else FULL
            camera = Camera.preset(
                maker, seed=seed, size=(side, side), **method.changes)
            made[maker] = camera.record(
                video.light(camera, s0), _BEFORE_S + video.seconds + _AFTER_S)
        recording, truth = made[maker]
        streams.append(
            (_true(truth, int(t)) for t in times) if row.method == "truth" else
            fuse(recording, times_us=times, demosaic="bilinear", **method.parameters))
    events = made[preset][0].events()
    step = int(times[1] - times[0])
    for t, *images in zip(times.tolist(), *streams, strict=True):
        lo, hi = np.searchsorted(events["t"], (t - step, t))
        yield Moment(t, images, events[lo:hi])


def _times(video: Video, settings: Settings) -> NDArray[np.int64]:
    count = _QUICK_PICTURES if settings.quick else _PICTURES
    return np.rint(1e6 * (_BEFORE_S + np.arange(count) * video.seconds / count)
                   ).astype(np.int64)


def _true(truth: Truth, t_us: int) -> PolarFrame:
    """Return the light itself as an image."""
    s0, s1, s2 = truth.image(t_us)
    return PolarFrame(np.stack([s0 + s1, s0 + s2, s0 - s1, s0 - s2]) / 2, t_us=t_us,
                      provenance={"method": "truth"})


# ---- pictures --------------------------------------------------------------------


def write_video(path: Path, name: str, settings: Settings, facts: Mapping[str, Any]
                ) -> list[tuple[str, float, float]]:
    """Write one of `VIDEOS`; return (name, mean AoP error in degrees, of DoLP).

    Parameters
    ----------
    path : Path
        ``.webm`` or another that `VideoFile` takes.
    name : str
        Key of `VIDEOS`.
    settings : Settings
    facts : mapping of str to object
        Embedded.
    """
    video = VIDEOS[name]
    seen = list(moments(video, settings))
    slower = len(seen) / _PLAYED_PER_S / video.seconds
    drawn = _Drawing(video, seen)
    with VideoFile(path, _PLAYED_PER_S, {**facts, "video": name,
                                         "times slower": f"{slower:g}"}) as file:
        for moment in seen:
            title = (f"Video {name}   t = {moment.t_us / 1e6:.4f} s   "
                     f"{slower:.3g} x slower")
            file.add(drawn.picture(moment, title))
    return [(row.name, *error_of(seen, k)) for k, row in enumerate(video.shown)
            if row.method != "truth"]


class _Drawing:
    """Draws the pictures of a video, each method by its own range of brightness."""

    def __init__(self, video: Video, seen: Sequence[Moment]) -> None:
        self._video, self._seen = video, seen
        side = seen[0].images[0].shape[1]
        self._scale = max(1, round(_WIDTH / side))
        self._tones = [_tone([one.images[k] for one in seen[::10]])
                       for k in range(len(video.shown))]
        # All channels of all methods by one scale: what the light itself reaches.
        self._white = max(float(np.quantile(one.images[0].quad, 0.999)) for one in seen)
        self._panels = [
            Panel(_TITLES[what].format(one.name),
                  _LEGENDS.get(what) if one is video.shown[-1] else None)
            for given in video.pictures for one in video.shown
            for what in (self._what(given, one),)]
        self._means = np.array([[_mean_dolp(image) for image in one.images]
                                for one in seen])

    def picture(self, moment: Moment, title: str) -> Picture:
        """Return the picture of a moment."""
        pictures = [self._panel(self._what(given, one), k, moment)
                    for given in self._video.pictures
                    for k, one in enumerate(self._video.shown)]
        sheet = tile([panel(picture, **each._asdict(), scale=self._scale)
                      for picture, each in zip(pictures, self._panels, strict=True)],
                     columns=len(self._video.shown), title=title)
        if not self._video.trace:
            return sheet
        times = np.array([one.t_us for one in self._seen]) / 1e6
        lines = [Line(times, values, _COLOURS[row.method], row.name)
                 for row, values in zip(self._video.shown, self._means.T, strict=True)]
        low, high = np.nanmin(self._means), np.nanmax(self._means)
        return stack([sheet, chart(
            lines, (_TRACE_HEIGHT, sheet.shape[1]), span_s=(times[0], times[-1]),
            limits=(max(low - 0.05, 0), min(high + 0.05, 1)),
            now_s=moment.t_us / 1e6, title="mean DoLP; time / s")])

    def _what(self, given: str, one: Shown) -> str:
        replaced = self._video.trace and given == "i0" and one.method == "truth"
        return "events" if replaced else given

    def _panel(self, what: str, k: int, moment: Moment) -> Picture:
        image = moment.images[k]
        if what == "channels":
            return _channels(image, self._white)
        if what == "i0":
            return self._tones[k].seen(image.quad[0], image.valid)
        if what == "events":
            return events_on(image.shape, moment.events)
        if what == "dolp":
            return dolp_bgr(image.dolp, image.valid)
        picture = aop_bgr(image.aop, image.valid)
        fade(picture, image.dolp, image.valid)
        return picture


def _channels(image: PolarFrame, white: float) -> Picture:
    """Return every second pixel of I0 and I45, above those of I90 and I135."""
    height, width = (side // 2 * 2 for side in image.shape)
    parts = [grey_bgr(channel[:height:2, :width:2], white) for channel in image.quad]
    return np.vstack((np.hstack(parts[:2]), np.hstack(parts[2:])))


_TITLES = {"channels": "{}: I0 I45 / I90 I135", "i0": "{}: I0", "aop": "{}: AoP",
           "dolp": "{}: DoLP", "events": "events: ON white, OFF black"}
_LEGENDS = {"aop": "faded", "dolp": "dolp"}
_COLOURS = {"truth": (255, 255, 255), "frames": (0, 159, 230),
            "kalman": (255, 180, 86)}   # BGR


def _tone(images: Sequence[PolarFrame]) -> ToneCurve:
    """Return a curve for some images; what frames cannot tell apart becomes white."""
    good = [image for image in images if image.valid.any()]
    if not good:
        return ToneCurve(1.0)
    top = max(float(image.quad[0][image.valid].max()) for image in good)
    return ToneCurve.of([image.quad[0] for image in good],
                        [image.valid for image in good], saturated=top / 2)


def _mean_dolp(image: PolarFrame) -> float:
    """Return the DoLP of the mean Stokes vector of an image's usable pixels."""
    good = image.valid
    if not good.any():
        return float("nan")
    s0, s1, s2 = (float(plane[good].mean()) for plane in (image.s0, image.s1, image.s2))
    return float(np.hypot(s1, s2) / s0)


def error_of(seen: Sequence[Moment], k: int) -> tuple[float, float]:
    """Return the mean error of usable pixels of the k-th method: AoP in degrees, DoLP.

    AoP where the truth's DoLP is over a tenth: elsewhere it means nothing.
    """
    aop_off, dolp_off = [], []
    for one in seen:
        image, true = one.images[k], one.images[0]
        good = image.valid & (true.s0 > 0)
        if good.any():
            dolp_off.append(np.abs(image.dolp - true.dolp)[good].mean())
        good &= true.dolp > 0.1
        if good.any():
            aop_off.append(np.rad2deg(np.abs(axial_difference(
                image.aop[good], true.aop[good]))).mean())
    aop, dolp = (float(np.mean(part)) if part else float("nan")
                 for part in (aop_off, dolp_off))
    return aop, dolp


# ---- pages -----------------------------------------------------------------------


COLUMNS = ("video", "method", "aop_error_deg", "dolp_error")


def videos_page(stem: str, errors: Mapping[str, Sequence[tuple[str, float, float]]],
                sizes: Mapping[str, int]) -> list[str]:
    """Return the Markdown: each video, what it shows, and its errors.

    Parameters
    ----------
    stem : str
        What the files' names begin with.
    errors : mapping of str to sequence of (str, float, float)
        By video, as `write_video` returns them.
    sizes : mapping of str to int
        Bytes of each file.
    """
    lines = ["# videos", "", "The supplementary videos of the paper, simulated; the "
             "truth stands at the left of each. Mean error of usable pixels, bilinear "
             "demosaicing: AoP in degrees where the true DoLP is over .1 / DoLP.", ""]
    for name, rows in errors.items():
        lines += [f"**Video {name}**, `{stem}-{name}.webm`, "
                  f"{sizes[name] / 1e6:.1f} MB: {VIDEOS[name].what}.", "",
                  played(f"{stem}-{name}.webm"), ""]
        lines += table(("method", "AoP / DoLP"), [
            (row, f"{aop:.1f} / {dolp:.3f}") for row, aop, dolp in rows])
    beside = [(f"video {name}", stated, _beside(rows, column), _shown(
        rows, column)) for name, rows in errors.items()
        for stated, column in (_STATED[name],)]
    head = ("", "paper", "frames' errors over those of methods with events", "")
    return [*lines, "## Beside the paper", "", *table(head, beside)]


# What the supplement says of each video, and whether AoP (1) or DoLP (2) shows it.
_STATED = {
    "1": ("frames update AoP much slower than events", 1),
    "2": ("frames update DoLP much slower than events", 2),
    "3": ("frames of neither camera have AoP in all of the scene", 1),
    "4": ("severe motion blur in the Sony, none with events", 1),
    "5-1Hz": ("frames monitor the changes accurately", 2),
    "5-10Hz": ("frames are severely aliased, events are not", 2)}


def _split(rows: Sequence[tuple[str, float, float]], column: int
           ) -> tuple[float, float]:
    """Return the least error of frames, and the least one of methods with events."""
    errors = {name: (aop, dolp)[column - 1] for name, aop, dolp in rows}
    frames = {name for name in errors if "frames" in name or "Sony" in name}
    return (min(errors[name] for name in frames),
            min(errors[name] for name in errors.keys() - frames))


def _beside(rows: Sequence[tuple[str, float, float]], column: int) -> str:
    frames, others = _split(rows, column)
    form = "{:.1f} / {:.1f} degrees" if column == 1 else "{:.3f} / {:.3f}"
    return form.format(frames, others)


_MUCH, _ALIKE = 2.0, 0.05
"""Times as large an error that shows; an error of DoLP that does not."""


def _shown(rows: Sequence[tuple[str, float, float]], column: int) -> str:
    """Say whether frames err at least twice as much, or if not, no more than a bit."""
    frames, others = _split(rows, column)
    if frames > _MUCH * others and frames > _ALIKE:
        return "agrees: events only"
    return "agrees: both" if column == 2 and frames < _ALIKE else "differs"
