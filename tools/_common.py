"""Shared code of the commands: one-line errors, and the options of fuse()."""
from __future__ import annotations

import argparse
import contextlib
import difflib
import functools
import json
import os
import re
import sys
import warnings
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn, Protocol, TextIO

from pdavis_cv._beside import takes_bytes
from pdavis_cv.errors import PdavisError, PdavisWarning

from ._interrupts import interruptible
from ._progress import AlwaysProgress, own_progress, progress, progress_in_time, stage
from ._values import (
    layout_option,
    offset,
    pair,
    positive,
    ratio,
    roi_option,
    seconds,
    setting,
    thresholds,
    within,
)

if TYPE_CHECKING:  # `command` must handle an interrupt while NumPy is imported
    from pdavis_cv import Calibration, Recording, Source
    from pdavis_cv.fusion.options import OptionFacts

__all__ = [
    "OneLineParser",
    "Parser",
    "UsageError",
    "add_fuse_options",
    "add_json_option",
    "add_layout_option",
    "calibration_of",
    "can_draw",
    "checked_out",
    "command",
    "covered",
    "for_people",
    "fuse_options",
    "fusion_given",
    "opened",
    "option_value",
    "progress",
    "progress_in_time",
    "require_samples",
    "source_of",
    "stage",
    "start_of",
    "tell",
    "tell_now",
]


TRACEBACK = "PDAVIS_CV_TRACEBACK"


class Main(Protocol):
    """A command: a function of the arguments, by default those of the process."""

    def __call__(self, argv: Sequence[str] | None = None) -> int:
        """Run it and return the exit code."""
        ...


class UsageError(Exception):
    """A mistake of the user; its text is printed as one line."""


class OneLineParser(argparse.ArgumentParser):
    """An ArgumentParser whose error messages are one line."""

    def _get_values(self, action: argparse.Action, arg_strings: list[str]) -> Any:
        value = super()._get_values(action, arg_strings)
        if value == [] and action.nargs is None:    # of --option=--, in Python 3.11
            raise argparse.ArgumentError(action, "expected one argument, got '--'")
        return value

    def error(self, message: str) -> NoReturn:
        """Raise UsageError instead of printing the whole usage."""
        asked = re.match(r"unrecognized arguments: (--[^\s=]+)", message)
        close = difflib.get_close_matches(
            asked[1], self._option_string_actions, 1) if asked else []
        advice = f"did you mean {close[0]}? " if close else ""
        raise UsageError(f"{message} ({advice}see {self.prog} --help)")


class Parser(OneLineParser):
    """The parser of a subcommand.

    Parameters
    ----------
    name : str
        Name of the subcommand.
    description : str
        Description, shown by ``--help``.
    example : str
        An example command line, shown by ``--help``.
    """

    def __init__(self, name: str, description: str, example: str) -> None:
        super().__init__(
            prog=f"pdavis {name}", description=description,
            epilog=f"example:\n  {example}",
            formatter_class=argparse.RawDescriptionHelpFormatter)
        self.add_argument(
            "--progress", action=AlwaysProgress, nargs=0, default=argparse.SUPPRESS,
            help="show stages and the remaining time even if stderr is not a terminal")


def command(main: Main) -> Main:
    """Decorate the main function of a command to report errors in one line.

    The exit code is 2 for a mistake of the user or a file that cannot be read, 1 for an
    output that cannot be written, and 130 for an interrupt.  Warnings are one line
    each.  Any other exception is a bug: the line says how to report it, and the exit
    code is 70 (EX_SOFTWARE).  If PDAVIS_CV_TRACEBACK is set, the traceback is printed.
    """

    @functools.wraps(main)
    def run(argv: Sequence[str] | None = None) -> int:
        with warnings.catch_warnings():
            warnings.simplefilter("always", PdavisWarning)
            warnings.showwarning = functools.partial(_show_warning, set())
            try:
                with own_progress(), interruptible():
                    code = _flushed(main, argv)
            except SystemExit as leave:  # argparse after --help
                return leave.code if isinstance(leave.code, int) else 0
            except BrokenPipeError:  # the reader of the output has exited
                return 1
            except (FileNotFoundError, NotADirectoryError, IsADirectoryError,
                    PermissionError, PdavisError, UsageError, ImportError,
                    TypeError, ValueError) as error:
                return _complain(error, 2)
            except OSError as error:
                return _complain(error, 1)
            except MemoryError as error:
                return _complain(f"not enough memory{error and f': {error}'}", 1)
            except KeyboardInterrupt:
                return _complain("interrupted; nothing unfinished was left", 130)
            except Exception as error:
                if TRACEBACK in os.environ:
                    raise
                return _complain(
                    f"this is a mistake of pdavis, {type(error).__name__}: {error}; "
                    f"please report the command and what it prints with {TRACEBACK}=1",
                    70)
            return code

    return run


def _flushed(main: Main, argv: Sequence[str] | None) -> int:
    """Run a command and flush its output, so that errors of writing are reported."""
    try:
        code = main(argv)
        if sys.stdout is not None:
            sys.stdout.flush()
    except OSError:
        _drop_output()
        raise
    return code


def _drop_output() -> None:
    """Discard buffered output if standard output cannot be written."""
    try:
        sys.stdout.flush()
    except OSError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _complain(error: object, code: int) -> int:
    if isinstance(error, OSError) and error.strerror and error.filename:
        error = f"{error.filename}: {error.strerror}"
    print("pdavis:", " ".join(str(error).split()), file=sys.stderr)
    return code


def _show_warning(
    said: set[str], message: Warning | str, category: type[Warning], filename: str,
    lineno: int, file: TextIO | None = None, line: str | None = None,
) -> None:
    text = " ".join(str(message).split())
    if text not in said:    # a command may read a recording several times
        said.add(text)
        print("pdavis: warning:", text, file=sys.stderr)


def opened(
    args: argparse.Namespace, file: str | os.PathLike[str] | None = None
) -> Recording:
    """Open a recording of any format according to the options of a command.

    A live source is first recorded to a temporary file until it ends, as commands may
    read their input more than once.

    Parameters
    ----------
    args : Namespace
        Has ``layout``; if that is None, videos and images are not recordings.
    file : path, optional
        Default: ``args.file``.

    Raises
    ------
    RecordingError
        If it cannot be opened.
    """
    from pdavis_cv.recording.base import Recording
    source = source_of(args, file)
    if isinstance(source, Recording):
        return source
    from pdavis_cv.live import recorded
    return recorded(source)


def source_of(
    args: argparse.Namespace, file: str | os.PathLike[str] | None = None
) -> Source:
    """Open a recording or a live source according to the options of a command.

    Parameters
    ----------
    args, file
        As in `opened`.

    Raises
    ------
    RecordingError
        If it cannot be opened.
    """
    from pdavis_cv import open_source
    from pdavis_cv.recording.hdf5.probe import proved
    where = args.file if file is None else file
    proved(where)
    return open_source(
        where, layout=args.layout,
        camera=getattr(args, "camera", None))


def checked_out(
    path: Path, source: str | os.PathLike[str] | None = None, *,
    recording: bool = False, force: bool = False,
) -> None:
    """Raise UsageError if a command cannot write a file, or must not.

    Commands ask before their work, which may take minutes.  They replace the output of
    an earlier run, but never the recording that they read, and another recording only
    with ``--force``, as it may be irreplaceable.

    Parameters
    ----------
    path : Path
        The output.
    source : path, optional
        The input.
    recording : bool
        Whether the output is a recording.
    force : bool
        Whether ``--force`` was given.

    Raises
    ------
    UsageError
        With the reason.
    """
    if not path.absolute().parent.is_dir():
        raise UsageError(f"{path}: there is no folder {path.parent} to write to")
    if not path.exists():
        return
    try:
        if not path.is_dir() and takes_bytes(path):     # a folder may hold a stem
            return
    except OSError as error:
        raise UsageError(f"{path}: {error.strerror}") from None
    if source is not None and os.path.exists(source) and path.samefile(source):
        raise UsageError(f"{path} is the recording that is read; write another file")
    if recording and not force:
        raise UsageError(f"{path} exists; --force replaces it")


def require_samples(recording: Recording, start_us: int | None) -> None:
    """Raise UsageError if a recording has no sample at start_us or later.

    Parameters
    ----------
    recording : Recording
    start_us : int or None
        None = any time.
    """
    if next(recording.packets(start_us), None) is not None:
        return
    name = recording.path or "the recording"
    if start_us is None or next(recording.packets(), None) is None:
        raise UsageError(f"{name}: holds no frame and no event")
    after = (start_us - start_of(recording)) / 1e6
    raise UsageError(
        f"{name}: no image at {after:g} s or later: {covered(recording)}")


def covered(recording: Recording) -> str:
    """Return a text with the seconds that a recording covers; reads it to its end."""
    report = recording.scan()
    if report.start_us is None or report.stop_us is None:
        return "the recording is empty"
    return f"the recording covers 0 .. {(report.stop_us - report.start_us) / 1e6:g} s"


def add_layout_option(parser: argparse.ArgumentParser) -> None:
    """Add --layout to a command that does not fuse."""
    parser.add_argument(
        "--layout", type=layout_option, metavar="LAYOUT",
        help="polarizers of the 2x2 cell: pdavis, sony or four angles by row; videos "
             "and images of a polarization camera need it")


def add_fuse_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of fuse()."""
    group = parser.add_argument_group("fusion")
    for name, facts in _offered():
        add: dict[str, Any] = {"help": facts.brief or facts.help}
        if facts.word == "flag":
            add["action"] = "store_true"
        else:
            add["type"], add["metavar"] = _WORDS[facts.word]
            if facts.choices:
                add["choices"], add["metavar"] = facts.choices, None
        group.add_argument(_flag(name), dest=name, **add)
    group.add_argument(
        "--set", action="append", default=[], type=setting, metavar="NAME=VALUE",
        dest="settings", help="a parameter of the method, e.g. cutoff_hz=1.6, "
                              "bandwidth=250,0 or mode=offline")


def fuse_options(args: argparse.Namespace, recording: Recording) -> dict[str, Any]:
    """Return the keyword arguments of fuse() for the options.

    Raises
    ------
    UsageError
        If the recording has no sample after ``--start``.
    """
    from pdavis_cv.fusion.options import FusionOptions
    defaults = FusionOptions()
    options: dict[str, Any] = {name: getattr(defaults, name) for name, _ in _offered()}
    options["threads"] = _threads_for(recording.info.sensor_size)
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
    for name, facts in _offered():
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
    return {**options, **dict(args.settings)}


def option_value(name: str, text: str) -> tuple[str, Any]:
    """Return name and value of an option of fuse() or a parameter of its method.

    Parameters
    ----------
    name : str
        Name on the command line.
    text : str
        Numbers of one value may be separated by slashes.

    Raises
    ------
    UsageError
        If the text is invalid, or the option is specific to one recording, as times.
    """
    if re.fullmatch(r"[-+.\deE]+(/[-+.\deE]+)+", text):
        text = text.replace("/", ",")
    found = dict(_offered()).get(name)
    if found is None:
        if name in ("start", "stop", "times_us"):
            raise UsageError(f"{name} is a time in one recording, not an option of all")
        return setting(f"{name}={text}")
    if found.word == "flag":
        return setting(f"{name}={text}")
    read = _WORDS[found.word][0]
    try:
        value = read(text)
    except (argparse.ArgumentTypeError, ValueError) as error:
        raise UsageError(f"{name}: {error}") from None
    if found.word == "calibration":
        return name, calibration_of(value)
    none = found.word in ("ratio", "offset") and value == "none"
    return name, None if none else value


def _threads_for(size: tuple[int, int]) -> int:
    """Return the number of threads for images of a size, 1 for small ones."""
    from pdavis_cv._workers import usable_cores
    return usable_cores() if size[0] * size[1] > 65_536 else 1


def calibration_of(path: Path) -> Calibration:
    """Return a calibration that ``pdavis calibrate`` wrote."""
    from pdavis_cv.calibration.model import Calibration
    return Calibration.load(path)


def _offered() -> list[tuple[str, OptionFacts]]:
    """Return the names and facts of the options of fuse() that commands offer."""
    from pdavis_cv.fusion.options import FusionOptions
    return [(name, facts) for name, facts in FusionOptions.facts().items()
            if facts.word is not None]


def _flag(name: str) -> str:
    """Return the name of an option on the command line, e.g. --start for start_us."""
    return "--" + name.removesuffix("_us").replace("_", "-")


def start_of(recording: Recording) -> int:
    """Return the time of the recording's first sample, 0 if it is empty."""
    start = recording.info.start_us
    if start is None:
        start = next((packet.start_us for packet in recording.packets()), None)
    return 0 if start is None else start


def can_draw() -> bool:
    """Return whether matplotlib is installed; if not, print how to install it."""
    try:
        import matplotlib  # noqa: F401
    except ImportError:
        print("no picture: matplotlib is missing (pip install matplotlib)")
        return False
    return True


def add_json_option(parser: argparse.ArgumentParser) -> None:
    """Add --json to a command that reports its result with `tell`."""
    parser.add_argument(
        "--json", action="store_true",
        help="print what was done as JSON, for programs")


def for_people(args: argparse.Namespace) -> contextlib.AbstractContextManager[object]:
    """Redirect messages to standard error if --json was given.

    Standard output is then reserved for `tell`.
    """
    return (contextlib.redirect_stdout(sys.stderr) if args.json
            else contextlib.nullcontext())


def tell(args: argparse.Namespace, lines: Iterable[str], **facts: Any) -> None:
    """Print the result of a command: lines, or with --json an object of facts.

    Parameters
    ----------
    args : Namespace
        With ``json``.
    lines : iterable of str
        Text for users.
    **facts
        The same for programs; arrays and paths are converted for JSON, NaN to null.
    """
    if args.json:
        print(_as_json(facts, indent=2))
    else:
        for line in lines:
            print(line)


def tell_now(args: argparse.Namespace, lines: Iterable[str], **facts: Any) -> None:
    """Print an intermediate result of a command, as `tell` prints the final one.

    With --json each is an object in one line, which a program can read before the
    command ends.
    """
    for line in [_as_json(facts)] if args.json else lines:
        print(line, flush=True)


def _as_json(facts: dict[str, Any], indent: int | None = None) -> str:
    from pdavis_cv.export.files import plain
    text = json.dumps(facts, default=plain)
    return json.dumps(json.loads(text, parse_constant=lambda _: None), indent=indent)


_WORDS: dict[str | None, tuple[Callable[[str], Any], str]] = {
    "text": (str, "NAME"),
    "number": (positive, "RATE"),
    "count": (within(1, 1024), "N"),
    "seconds": (seconds, "S"),
    "offset": (offset, "US"),
    "region": (roi_option, "X,Y,W,H"),
    "layout": (layout_option, "LAYOUT"),
    "calibration": (Path, "NPZ"),
    "ratio": (ratio, "RATIO"),
    "thresholds": (thresholds, "T"),
    "pair": (pair, "ON,OFF"),
}
"""The parser of each kind of option of fuse(), and the placeholder of its value."""
