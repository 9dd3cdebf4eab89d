"""Shared code of the commands: one-line errors, checks and results."""
from __future__ import annotations

import argparse
import contextlib
import functools
import io
import json
import os
import re
import sys
import warnings
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn, Protocol, TextIO

from pdavis_cv._beside import takes_bytes
from pdavis_cv._text import MOST_TEXT, Shown, shown
from pdavis_cv.errors import PdavisError, PdavisWarning
from pdavis_cv.registry import nearest

from ._flags import flags
from ._interrupts import interruptible
from ._progress import AlwaysProgress, own_progress

if TYPE_CHECKING:  # `command` must handle an interrupt while NumPy is imported
    from pdavis_cv import Recording

TRACEBACK = "PDAVIS_CV_TRACEBACK"
_ARGUMENT = re.compile(
    r'(?<![\w/.-])([a-z]+(?:_[a-z]+)*)(?![\w/.]\w)(?:=("[^"]*"|\([^)]*\))?)?')
"""A word, which may be the name of an argument, and what follows its equals sign."""


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
        if arg_strings == ["--"] and action.nargs is None:  # of --option=--
            raise argparse.ArgumentError(action, "expected one argument, got '--'")
        return super()._get_values(action, arg_strings)

    def error(self, message: str) -> NoReturn:
        """Raise UsageError instead of printing the whole usage."""
        asked = re.match(r"unrecognized arguments: --([^\s=]+)", message)
        options = {flag[2:]: flag for flag in self._option_string_actions}
        options |= {name: flag for name, (flag, *_) in flags().items()
                    if flag in self._option_string_actions}
        near = asked and nearest(asked[1], options)
        advice = f"did you mean {options[near]}? " if near else ""
        raise UsageError(f"{message} ({advice}see {self.prog} --help)")


class Parser(OneLineParser):
    """The parser of a subcommand; ``--help`` shows description and example."""

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
        with warnings.catch_warnings(), contextlib.ExitStack() as stack:
            if sys.stdout is not None:
                stack.enter_context(contextlib.redirect_stdout(Shown(sys.stdout)))
            stack.enter_context(contextlib.redirect_stderr(
                io.StringIO() if sys.stderr is None else Shown(sys.stderr)))
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
        try:    # what is buffered is discarded if it cannot be written
            sys.stdout.flush()
        except OSError:
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        raise
    return code


def _complain(error: object, code: int) -> int:
    if isinstance(error, OSError) and error.strerror and error.filename:
        error = f"{error.filename}: {error.strerror}"
    print("pdavis:", shown(in_flags(str(error)), MOST_TEXT), file=sys.stderr)
    return code


def in_flags(text: str) -> str:
    """Return a message of the library in one line, with flags in place of arguments.

    ``camera=`` and ``layout="sony"`` become ``--camera`` and ``--layout sony``.
    """
    def flag(found: re.Match[str]) -> str:
        name, value = found[1], found[2] or ""
        if name not in known or not (value or found[0][-1] == "=" or "_" in name):
            return found[0]
        placeholder = value[:1] == "("
        return known[name][0] + (f" {known[name][1]}" if placeholder else
                                 f" {value.strip(chr(34))}" if value else "")

    text = " ".join(text.split())
    if not re.search(r"[a-z](=|_)", text):
        return text
    known = flags()
    return _ARGUMENT.sub(flag, text)


def _show_warning(
    said: set[str], message: Warning | str, category: type[Warning], filename: str,
    lineno: int, file: TextIO | None = None, line: str | None = None,
) -> None:
    text = shown(in_flags(str(message)), MOST_TEXT)
    if text not in said:    # a command may read a recording several times
        said.add(text)
        print("pdavis: warning:", text, file=sys.stderr)


def checked_out(
    path: Path, source: Any = None, *, recording: bool = False, force: bool = False,
) -> None:
    """Raise UsageError if a command cannot write a file, or must not.

    Commands ask before their work, which may take minutes.  They replace the output of
    an earlier run, but never the recording that they read, `source`, and another
    recording (if the output is one) only with ``--force``, as it may be irreplaceable.
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
    if source is not None and _reads(source, path):
        raise UsageError(f"{path} is the recording that is read; write another file")
    if recording and not force:
        raise UsageError(f"{path} exists; --force replaces it")


def _reads(source: Any, path: Path) -> bool:
    """Return whether a file is one of those that a source is made of."""
    from pdavis_cv.live.address import is_address
    from pdavis_cv.recording.members import members_of
    if is_address(source):
        source = source.partition(":")[2].partition("?")[0]
    try:
        return any(path.samefile(member.path) for member in members_of(source))
    except (OSError, ValueError):   # there is no such file; opening it will say so
        return False


def require_samples(recording: Recording, start_us: int | None) -> None:
    """Raise UsageError if a recording has no sample at start_us or later."""
    if next(recording.packets(start_us), None) is not None:
        return
    from pdavis_cv.recording.base import start_of

    name = recording.path or "the recording"
    if start_us is None or next(recording.packets(), None) is None:
        raise UsageError(f"{name}: holds no frame and no event")
    after = (start_us - start_of(recording)) / 1e6
    raise UsageError(f"{name}: no image at {after:g} s or later: {covered(recording)}")


def covered(recording: Recording) -> str:
    """Return a text with the seconds that a recording covers; reads it to its end."""
    report = recording.scan()
    if report.start_us is None or report.stop_us is None:
        return "the recording is empty"
    return f"the recording covers 0 .. {(report.stop_us - report.start_us) / 1e6:g} s"


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

    Arrays and paths are converted for JSON, NaN to null.
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
