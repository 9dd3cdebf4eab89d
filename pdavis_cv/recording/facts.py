"""Facts about a recording: each a value, and where it comes from."""
from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from pdavis_cv.recording.options import SourceOptions
from pdavis_cv.sensor import SENSORS, Layout, Sensor, resolve_layout

FILE, CALLER, CALIBRATION = "file", "caller", "calibration"
MEASURED, ASSUMED = "measured", "assumed"


@dataclass(frozen=True, slots=True)
class Fact:
    """A fact about a recording, and where it comes from.

    Parameters
    ----------
    value : object
        In the unit of its name, as a field of `RecordingInfo`.
    origin : str
        ``"file"``, ``"caller"``, ``"calibration"``, ``"measured"`` (from the data) or
        ``"assumed"``.
    """

    value: Any
    origin: str


_SAID = {"sensor_size": "sensor size assumed ({0[1]}x{0[0]})",
         "frame_times": "rate assumed ({:g} per second)",
         "full_scale_dn": "full scale assumed ({} DN)",
         "layout": "polarizer layout assumed ({})",
         "thresholds": "thresholds assumed (ON {0[0]:g}, OFF {0[1]:g})"}


def assumptions(facts: Mapping[str, Fact]) -> list[str]:
    """Return a text for each fact that is only assumed, to be said beside results."""
    return [text.format(facts[name].value) for name, text in _SAID.items()
            if name in facts and facts[name].origin == ASSUMED]


def text_of(
    facts: Mapping[str, Fact], demosaic: str | None, biases: Mapping[str, float]
) -> str:
    """Return what is known of a recording as text for the header of a copy.

    See `RecordingInfo` for the facts.
    """
    values = {name: fact.value for name, fact in facts.items() if fact.value}
    values.pop("extinction_ratio", None)    # that of the sensor
    if isinstance(rate := values.pop("frame_times", None), int | float):
        values["source_fps"] = rate
    if (layout := values.get("layout")) is not None:
        values["layout"] = layout.stored_angles, layout.owner
    if (sensor := values.pop("sensor", None)) in SENSORS.values():
        values["sensor"] = sensor.name
    import json  # slow to import
    return json.dumps({
        "facts": values, "demosaic": demosaic, "biases": dict(biases), "origins": {
            name: fact.origin for name, fact in facts.items()
            if fact.origin in _UNCERTAIN}})


_UNCERTAIN = (MEASURED, ASSUMED)
"""Origins that a copy keeps; what a caller stated, the copy states."""


def _of_copy(text: str, found: Mapping[str, Fact]) -> dict[str, Fact]:
    """Return what is known of a copy: what was found in it, and what `text_of` says.

    A text that is damaged says nothing.
    """
    import json  # slow to import
    try:
        stored = json.loads(text)
        values, origins = stored["facts"], dict(stored["origins"])
        if "layout" in values:
            values["layout"] = Layout.stored(*values["layout"])
        checked = SourceOptions(**values)
        biases = {name: float(value) for name, value in stored["biases"].items()}
    except (AttributeError, KeyError, RecursionError, TypeError, ValueError):
        return dict(found)
    said = {name: getattr(checked, name) for name in (
        "sensor_size", "sensor", "layout", "exposure_us", "full_scale_dn")}
    said |= {"frame_times": checked.source_fps, "biases": biases or None, "demosaic":
             "superpixel" if stored.get("demosaic") == "superpixel" else None}
    # A chip may be only what the copy's format had to name.
    known = {name: fact for name, fact in found.items() if name != "sensor"}
    for name, value in said.items():
        # Numbers that the format holds otherwise are right; all its times are stamps.
        if value is not None and (name == "frame_times" or name not in known or (
                known[name].value == value)):
            origin = origins.get(name)
            known[name] = Fact(value, origin if origin in _UNCERTAIN else FILE)
    return known


def stated(options: SourceOptions, copied: str | None = None, **found: Any
           ) -> dict[str, Any]:
    """Return the facts of a recording, with origins, as arguments of `RecordingInfo`.

    What the caller states in options replaces what the file says, what was measured or
    assumed; layouts that differ, and sizes of which both are stated, are refused.
    `copied` is what a file of this library says of its source; see `text_of`.  Those
    found are named as in `RecordingInfo`: a value that the file gives, or a `Fact` with
    another origin; None = not known.  ``frame_times`` is the frames' rate in Hz if they
    have no times of their own, else their kind.
    """
    known = {name: value if isinstance(value, Fact) else Fact(value, FILE)
             for name, value in found.items() if value is not None}
    size = _size(options, known.get("sensor_size"))
    if copied is not None:
        known = _of_copy(copied, known)
    known |= size
    known |= {name: Fact(value, CALLER) for name, value in (
        ("frame_times", options.source_fps), ("exposure_us", options.exposure_us),
        ("full_scale_dn", options.known_full_scale_dn)) if value is not None}
    known |= _polarizers(options, known.get("sensor"), known.get("layout"))
    return {**{name: one.value for name, one in known.items()},
            "origins": {name: one.origin for name, one in known.items()}}


def _size(options: SourceOptions, found: Fact | None) -> dict[str, Fact]:
    size = options.sensor_size
    if size is None:
        return {}
    if found is not None and found.origin == FILE and found.value != size:
        raise ValueError(
            f"sensor_size says {size[1]}x{size[0]}, the file {found.value[1]}x"
            f"{found.value[0]}: one of them is wrong")
    return {"sensor_size": Fact(size, CALLER)}


def _polarizers(
    options: SourceOptions, sensor: Fact | None, layout: Fact | None
) -> dict[str, Fact]:
    """Return sensor and layout, each if it is known."""
    facts = {}
    of_file: Layout | None = None if layout is None else layout.value
    chip: Sensor | None = None if sensor is None else sensor.value
    if layout is not None and of_file is not None:
        chip, origin = sensor_of(of_file.sensor, chip), layout.origin
        if chip is not None and (sensor is None or chip != sensor.value):
            facts["sensor"] = Fact(chip, origin)
    of_caller = options.known_layout
    if of_caller is not None:
        facts["layout"] = Fact(resolve_layout(of_caller, recording=of_file), CALLER)
    named = options.known_sensor
    if options.sensor is None:
        named = sensor_of(named, chip)
    if named is not None and named != chip:
        facts["sensor"] = Fact(named, CALLER)
    return facts


def sensor_of(named: Sensor | None, found: Sensor | None) -> Sensor | None:
    """Return the sensor that a layout names, unless the file gives another one."""
    if named is None or (found is not None and found.name not in (
            named.name, named.chip)):
        return found
    return named
