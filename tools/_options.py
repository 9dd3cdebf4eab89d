"""Options of commands that are made from SourceOptions and FusionOptions."""
from __future__ import annotations

import argparse
import contextlib
import math
import os
import re
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pdavis_cv._remote import as_path
from pdavis_cv.recording.base import start_of

from ._common import UsageError, require_samples
from ._flags import WORDS, add_offered, fusion_options, offered, source_options
from ._values import number, setting, within

if TYPE_CHECKING:  # `command` must handle an interrupt while NumPy is imported
    from pdavis_cv import Calibration, Recording, Source, TurningAnalyser
    from pdavis_cv.recording.open import AnySource

_HDF5 = b"\x89HDF\r\n\x1a\n"


def opened(args: argparse.Namespace, file: AnySource | None = None) -> Recording:
    """Open a recording, ``args.file`` by default, according to a command's options.

    A live source is first recorded to a temporary file until it ends, as commands may
    read their input more than once.
    """
    from pdavis_cv.recording.base import Recording
    source = source_of(args, file)
    if isinstance(source, Recording):
        return source
    from pdavis_cv.live import recorded
    return recorded(source)


def source_of(args: argparse.Namespace, file: AnySource | None = None) -> Source:
    """Open a recording, as `opened`, or a live source as it is."""
    from pdavis_cv import open_source
    where = args.file if file is None else file
    given = source_given(args)
    if isinstance(where, str | os.PathLike):
        from pdavis_cv.recording import sandbox
        with contextlib.suppress(OSError, ValueError), as_path(
                where).open("rb") as begun:
            if begun.read(len(_HDF5)) == _HDF5:  # whose library damage can hang
                given.setdefault("isolated", sandbox.available())
    return open_source(where, **given)


def source_given(args: argparse.Namespace) -> dict[str, Any]:
    """Return what the options of a command state about its source."""
    values = {name: getattr(args, name, None) for name, _ in offered(source_options())}
    if getattr(args, "trigger", None) is not None:
        values["trigger_channel"] = args.trigger
    return {name: value for name, value in values.items()
            if value is not None and value is not False}


class _Source(argparse.Action):
    """Stores one path, or several in the order of the numbers in their names."""

    def __call__(
        self, parser: argparse.ArgumentParser, namespace: argparse.Namespace,
        values: Any, option_string: str | None = None,
    ) -> None:
        setattr(namespace, self.dest, together(values))


def together(files: Sequence[str]) -> str | list[str]:
    """Return one path as it is, several in the order of the numbers in their names."""
    from pdavis_cv.recording.images.names import natural_order
    return files[0] if len(files) == 1 else natural_order(files)


def add_file(parser: argparse.ArgumentParser, help: str, name: str = "file") -> None:
    """Add the recording that a command reads, which may be several images."""
    parser.add_argument(name, nargs="+", action=_Source, metavar=name,
                        help=f"{help}; several images are one recording")


def add_source_options(
    parser: argparse.ArgumentParser, without: Sequence[str] = ()
) -> None:
    """Add what can be stated about a source, without what the command has itself."""
    group = parser.add_argument_group("source")
    add_offered(
        group, (one for one in offered(source_options()) if one[0] not in without))


def add_fuse_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of fuse(), and what can be stated about the source."""
    group = parser.add_argument_group("fusion")
    add_offered(group, offered(fusion_options()))
    add_source_options(parser, ("layout",))
    group.add_argument("--analyser-rpm", type=number, metavar="RPM",
                       help="a polarizer turns before the camera, so many times a "
                            "minute, negative = clockwise as displayed")
    group.add_argument("--analyser-phase", type=number, default=0.0, metavar="DEG",
                       help="its angle at time 0 of the recording's clock, or at the "
                            "first pulse; default 0")
    group.add_argument("--trigger", type=within(0, 31), metavar="CHANNEL",
                       help="the file's external trigger of this channel pulses as it "
                            "turns; most cameras have 0 only")
    group.add_argument("--trigger-pulses", type=within(1, 4096), default=1, metavar="N",
                       help="pulses of the trigger per turn; default 1")
    group.add_argument("--analyser-found", action="store_true", help="a polarizer "
                       "turns before the camera; find its speed from the events")
    group.add_argument("--set", action="append", default=[], type=setting,
                       metavar="NAME=VALUE", dest="settings", help="a parameter of the "
                       "method, e.g. cutoff_hz=1.6 or mode=offline")


def fuse_options(args: argparse.Namespace, recording: Recording) -> dict[str, Any]:
    """Return the keyword arguments of fuse() for the options.

    A recording without a sample after ``--start`` is a UsageError.
    """
    from pdavis_cv._workers import usable_cores
    from pdavis_cv.fusion.iteration import LEAST_PIXELS
    from pdavis_cv.fusion.options import FusionOptions
    defaults = FusionOptions()
    options: dict[str, Any] = {
        name: getattr(defaults, name) for name, _ in offered(FusionOptions)}
    height, width = recording.info.sensor_size
    options["threads"] = usable_cores() if height * width >= LEAST_PIXELS else 1
    options |= fusion_given(args)
    for name in ("start_us", "stop_us"):
        if options[name] is not None:
            options[name] += start_of(recording)
    require_samples(recording, options["start_us"])
    return options


def fusion_given(args: argparse.Namespace) -> dict[str, Any]:
    """Return the keyword arguments of fuse() for the options that were given.

    Times are in us after the start of the recording, which is unknown here.
    """
    options: dict[str, Any] = {}
    for name, facts in offered(fusion_options()):
        value = getattr(args, name)
        if value is None or (facts.word == "flag" and not value):
            continue
        if facts.word == "seconds":
            value = round(value * 1e6)
        elif facts.word == "calibration":
            value = calibration_of(value)
        elif facts.word in ("ratio", "offset") and value == "none":
            value = None
        options[name] = value
    if (analyser := analyser_given(args)) is not None:
        options["analyser"] = analyser
    return {**options, **dict(args.settings)}


def analyser_given(args: argparse.Namespace) -> TurningAnalyser | None:
    """Return the turning analyser that options of fuse() state, or None."""
    if not args.analyser_found and (args.analyser_rpm, args.trigger) == (None, None):
        return None
    from pdavis_cv import TurningAnalyser
    try:
        return TurningAnalyser(
            rpm=args.analyser_rpm, phase=math.radians(args.analyser_phase),
            triggers=None if args.trigger is None else args.trigger_pulses)
    except ValueError as error:
        raise UsageError(str(error)) from None


def option_value(name: str, text: str) -> tuple[str, Any]:
    """Return name and value of an option of fuse() or a parameter of its method.

    Numbers of one value may be separated by slashes.  An option that is specific to one
    recording, as times, is a UsageError.
    """
    if re.fullmatch(r"[-+.\deE]+(/[-+.\deE]+)+", text):
        text = text.replace("/", ",")
    found = dict(offered(fusion_options())).get(name)
    if found is None:
        if name in ("start", "stop", "times_us"):
            raise UsageError(f"{name} is a time in one recording, not an option of all")
        return setting(f"{name}={text}")
    if found.word == "flag":
        return setting(f"{name}={text}")
    read = WORDS[found.word][0]
    try:
        value = read(text)
    except (argparse.ArgumentTypeError, ValueError) as error:
        raise UsageError(f"{name}: {error}") from None
    if found.word == "calibration":
        return name, calibration_of(value)
    none = found.word in ("ratio", "offset") and value == "none"
    return name, None if none else value


def calibration_of(path: Path) -> Calibration:
    """Return a calibration that ``pdavis calibrate`` wrote."""
    from pdavis_cv.calibration.model import Calibration
    return Calibration.load(path)
