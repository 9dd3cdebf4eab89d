"""SourceOptions: the one list of what a caller may state about a source.

The signatures of `open_recording`, `open_source` and `VideoCapture` and the options of
every command are made from its fields: a field that is added here appears in all of
them.
"""
from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypedDict

from pdavis_cv._checks import checked_rate, sensor_shape, typed, whole_number
from pdavis_cv._options import Options, documented, option
from pdavis_cv._types import Parameters
from pdavis_cv.recording.limits import Limits
from pdavis_cv.sensor import SENSORS, Layout, Sensor

if TYPE_CHECKING:
    from pdavis_cv.steps import AnalyserSteps

MOST_DN = 2**32
"""Largest full scale that is accepted; converters have 8 to 16 bits."""
MAX_SIDE = 8192
"""Longest side of a sensor that is accepted, pixels."""
_MOST_US = 10**9
_BAD_EVENTS = ("drop", "raise")


@dataclass(frozen=True, kw_only=True, eq=False)
class SourceOptions(Options):
    """What a caller states about a source, checked once; picklable.

    Parameters
    ----------
    parameters : mapping of str to object
        Options of the file's format that are not in this list.
    {options}

    Raises
    ------
    TypeError
        If a value has the wrong type.
    ValueError
        If a value is out of range.

    Examples
    --------
    >>> SourceOptions(layout="sony", bits=10).known_full_scale_dn
    1023
    """

    layout: Layout | str | None = option(
        None, "Layout or str, optional",
        'Polarizer layout, or its name ("pdavis", "sony"), which also states the '
        'sensor, or four angles by row ("135,90,0,45"), with the colours of a colour '
        'sensor after a hyphen ("sony-rggb").  Videos and images of a '
        "polarization camera need it.", "layout",
        "polarizers of the 2x2 cell: pdavis, sony or four angles by row, e.g. "
        "135,90,0,45, with colours as sony-rggb; videos and images of a polarization "
        "camera need it")
    sensor: Sensor | str | None = option(
        None, "Sensor or str, optional",
        f"Sensor, or its name: {', '.join(SENSORS)}.  It gives the layout, the "
        "extinction ratio, and the size if the file does not.", "text",
        "sensor of the camera", choices=tuple(SENSORS))
    sensor_size: tuple[int, int] | None = option(
        None, "(int, int), optional",
        "(height, width) of the sensor in pixels, for files that do not give it; "
        "default: the smallest usual one that holds the first events.", "size",
        "size of the sensor in pixels, for files that do not give it")
    camera: str | None = option(
        None, "str, optional",
        "Name or serial number of the camera, or a part of it, if the source holds "
        "several.", "text", "name of the camera, if the file has several")
    source_fps: float | None = option(
        None, "float, optional",
        "Frames per second of a source whose frames have no times, or wrong ones; "
        "default: as the file says, 25 if it does not.", "number",
        "frames per second of a source whose frames have no times; default: 25")
    exposure_us: int | None = option(
        None, "int, optional",
        "Exposure of each frame in us, for sources that do not give it.", "us",
        "exposure of each frame in microseconds, for files that do not give it")
    bits: int | None = option(
        None, "int, optional",
        "Bits of the converter: its full scale is 2**bits - 1.", "bits",
        "bits of the converter, e.g. 10 or 12 in images of 16 bits")
    full_scale_dn: int | None = option(
        None, "int, optional",
        "Largest DN of the converter, if it is not 2**bits - 1; default: as the file "
        "says, else measured from clipped pixels, else assumed.", "dn",
        "largest value of the converter, if --bits does not say it")
    columns: str | None = option(
        None, "str, optional",
        'Order of the columns of a text file of events, e.g. "xypt", with "_" for one '
        'of something else; default: the names in the text, else "txyp".', "text",
        "order of the columns of a text file of events, e.g. xypt")
    analyser_steps: AnalyserSteps | str | None = option(
        None, "AnalyserSteps or str, optional",
        "The files are images of an ordinary camera before a scene at rest, each at "
        'another angle of a polarizer before it: the angles, "names" (in the files\' '
        'names: pol_030.png), degrees ("0,30,60"), a text file of them, or "found" '
        "from the images, up to their zero and direction.  They become one frame of "
        "four planes.", "text",
        "images of an ordinary camera, each at another angle of a polarizer: names "
        "(pol_030.png), degrees as 0,30,60, a text file of them, or found")
    align_planes: bool = option(
        False, "bool",
        "Lay images of four channels, or of several angles, over the first one: they "
        "come from other cameras, or the camera moved; by shift and turn.", "flag",
        "lay the images of four channels, or of several angles, over the first one")
    trigger_channel: int = option(
        0, "int",
        "Channel of the external triggers that are read, of cameras that have several.",
        "channel")
    bad_events: str = option(
        "drop", '{"drop", "raise"}',
        "Whether events outside the sensor or before their predecessor are dropped and "
        "counted in ``problems``, or raise RecordingError.", "text",
        "what to do with events outside the sensor or before their predecessor",
        choices=_BAD_EVENTS)
    limits: Limits | None = option(
        None, "Limits, optional",
        "What the file may make its reader take; beyond it is a RecordingError.  "
        "Default: `Limits()`, which no known recording comes near.", "limits",
        "what the file may make its reader take: memory=BYTES,ratio=R,work_per_byte=W,"
        "time_span=US; the defaults suit all known recordings")
    isolated: bool = option(
        False, "bool",
        "Whether a process of its own reads the file, which has no network, reads only "
        "the file's folder and installed programs, writes nothing, and is limited in "
        "memory and time: for files of strangers.  Linux only.", "flag",
        "read the file in a process without network and write access, for files of "
        "strangers (Linux)")

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.layout is not None:
            self._put("layout", Layout.of(self.layout))
        if self.sensor is not None:
            self._put("sensor", Sensor.of(self.sensor))
        if self.sensor_size is not None:
            self._put("sensor_size", sensor_shape(self.sensor_size, "sensor_size"))
        for name in ("camera", "columns"):
            typed(name, getattr(self, name), str | None, "a str")
        self._put("source_fps", checked_rate("source_fps", self.source_fps))
        for name, most in (("exposure_us", _MOST_US), ("bits", 32),
                           ("full_scale_dn", MOST_DN)):
            value = getattr(self, name)
            if value is not None:
                self._put(name, whole_number(name, value, 1, most))
        if self.bits is not None and self.full_scale_dn is not None:
            raise ValueError("give bits or full_scale_dn, not both")
        self._put("align_planes", bool(self.align_planes))
        self._put("trigger_channel", whole_number(
            "trigger_channel", self.trigger_channel, 0, 31))
        if self.analyser_steps is not None:
            from pdavis_cv.steps import AnalyserSteps  # slow to import
            typed("analyser_steps", self.analyser_steps, AnalyserSteps | str,
                  "AnalyserSteps or a str")
        typed("limits", self.limits, Limits | None, "Limits")
        typed("isolated", self.isolated, bool, "a bool")
        if self.bad_events not in _BAD_EVENTS:
            raise ValueError(f"bad_events must be one of {', '.join(_BAD_EVENTS)}, got "
                             f"{self.bad_events!r}")

    @property
    def known_layout(self) -> Layout | None:
        """Layout that the caller states, directly or by naming the sensor."""
        layout, sensor = self.layout, self.known_sensor
        assert not isinstance(layout, str)
        return layout or (None if sensor is None else sensor.layout)

    @property
    def known_sensor(self) -> Sensor | None:
        """Sensor that the caller states, directly or by naming its layout."""
        assert not isinstance(self.layout, str)
        assert not isinstance(self.sensor, str)
        return self.sensor or (None if self.layout is None else self.layout.sensor)

    @property
    def known_full_scale_dn(self) -> int | None:
        """Largest DN that the caller states."""
        return self.full_scale_dn if self.bits is None else 2**self.bits - 1

    @property
    def size(self) -> tuple[int, int] | None:
        """(height, width) that the caller states, directly or by naming the sensor."""
        sensor = self.sensor
        assert not isinstance(sensor, str)
        return self.sensor_size or (None if sensor is None else sensor.size)


class SourceKeywords(TypedDict, total=False):
    """The fields of SourceOptions as keywords, for type checkers and editors.

    Options of other packages' formats are given in `parameters`.
    """

    parameters: Parameters
    layout: Layout | str | None
    sensor: Sensor | str | None
    sensor_size: tuple[int, int] | None
    camera: str | None
    source_fps: float | None
    exposure_us: int | None
    bits: int | None
    full_scale_dn: int | None
    columns: str | None
    analyser_steps: AnalyserSteps | str | None
    align_planes: bool
    trigger_channel: int
    bad_events: str
    limits: Limits | None
    isolated: bool


def source_part(parameters: Mapping[str, Any]) -> dict[str, Any]:
    """Return those parameters that are fields of SourceOptions."""
    return {name: parameters[name] for name in SourceOptions.facts()
            if name in parameters}


SourceOptions.__doc__ = documented(SourceOptions.__doc__, SourceOptions)
