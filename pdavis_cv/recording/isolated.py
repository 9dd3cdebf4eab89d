"""Recordings that a process of their own reads, limited by the system.

The library that decodes a file can hang, crash or take gigabytes on a damaged one, and
a made-up one may take over the process.
"""
from __future__ import annotations

import contextlib
import itertools
import json
import mmap
import os
import signal
import subprocess
import sys
import tempfile
import threading
import warnings
import weakref
from collections.abc import Iterator, Sequence
from multiprocessing import Pipe
from pathlib import Path
from typing import Any

from pdavis_cv import errors
from pdavis_cv._remote import is_remote
from pdavis_cv._workers import deaf
from pdavis_cv.errors import RecordingError
from pdavis_cv.recording import sandbox, wire
from pdavis_cv.recording.base import Packet, PlainSource, Problem, Recording
from pdavis_cv.recording.limits import Budget
from pdavis_cv.recording.members import Member, members_of
from pdavis_cv.recording.options import SourceOptions
from pdavis_cv.recording.packetise import Batch, packetise

_MOST_TEXT, _MOST_SHARED = 16 << 20, 1 << 40
"""Bytes of an answer beside its arrays, and of these: addresses, not memory."""
_SECONDS, _BYTES_PER_S = 10, 1e6
"""Time of a processor for an answer, and bytes of the file that each second adds.  A
choice."""
_SERVE = ("import json, sys; sys.path[:] = json.loads(sys.argv[1]); "
          "from pdavis_cv.recording.isolated_reader import serve; "
          "serve(*map(int, sys.argv[2:]))")
_CLASSES: dict[str, Any] = {
    **{name: kind for name, kind in vars(errors).items()
       if isinstance(kind, type)},
    "TypeError": TypeError, "ValueError": ValueError, "UserWarning": UserWarning}


class IsolatedRecording(Recording, PlainSource):
    """A recording that another process reads; see `open_recording`.

    Parameters
    ----------
    source : path, or sequence of paths
    options : SourceOptions
        As of `open_recording`.

    Raises
    ------
    RecordingError
        If it cannot be opened, its process dies, or the system has no such processes.
    """

    def __init__(self, source: Any, options: SourceOptions) -> None:
        self._source, self._options, self._name = source, options, str(source)
        paths = [source] if isinstance(source, str | os.PathLike) else list(source)
        self._path = Path(source) if paths == [source] else None
        self._problems: tuple[Problem, ...] = ()
        self._lock, self._numbers = threading.Lock(), itertools.count()
        if not sandbox.available():
            raise RecordingError("isolation needs Linux 5.13 or later, on x86-64 "
                                 "or ARM, with Landlock and seccomp")
        if any(map(is_remote, paths)):
            raise RecordingError(f"{source}: a process without network cannot read it: "
                                 "copy it to a disk")
        folders = {Path(one).resolve().parent for one in paths}
        files: tuple[Member, ...] = ()
        with contextlib.suppress(RecordingError, OSError):      # said by its process
            files = members_of(source)
            folders |= {one.path.resolve().parent for one in files}
        self._budget = Budget(source, options.limits)
        size = self._budget.size = sum(one.size for one in files)
        self._start(min(int(self._budget.limits.memory), _MOST_SHARED))
        try:
            self._name, self._info = self._ask(
                [*map(str, folders)], _SECONDS + size / _BYTES_PER_S, source,
                options.replace(isolated=False))
        except BaseException:
            self.close()
            raise

    def _start(self, most: int) -> None:
        with deaf(), contextlib.ExitStack() as stack:
            folder = stack.enter_context(tempfile.TemporaryDirectory(
                prefix="pdavis-", ignore_cleanup_errors=True))
            size = most + 2 * wire.ROOM
            shared = os.memfd_create("pdavis")
            os.ftruncate(shared, size)
            self._memory = mmap.mmap(shared, size, prot=mmap.PROT_READ)
            self._pipe, pipe = Pipe()
            stack.callback(self._pipe.close)
            path = [os.path.abspath(one) for one in sys.path]
            with pipe, open(shared, "rb"):
                self._process = subprocess.Popen(
                    [sys.executable, "-P", "-W", "ignore", "-c", _SERVE,
                     json.dumps(path), str(most), str(pipe.fileno()), str(shared)],
                    stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL,
                    stderr=subprocess.DEVNULL, pass_fds=(pipe.fileno(), shared),
                    # OpenBLAS threads would reserve memory for each core.
                    env={**os.environ, "OPENBLAS_NUM_THREADS": "1", "TMPDIR": folder})
            stack.callback(self._process.wait)
            stack.callback(self._process.kill)
            self._end = weakref.finalize(self, stack.pop_all().close)

    def _ask(self, *question: Any) -> Any:
        """Return what the process answers, or raise what it raised.

        A RecordingError if it died or sends no answer, ValueError if it was ended.
        """
        with self._lock:
            if not self._end.alive:
                raise ValueError(f"{self.name}: recording is closed")
            try:
                self._pipe.send(question)
                value, error, problems, said = wire.read(
                    self._pipe.recv_bytes(_MOST_TEXT), memoryview(self._memory))
            except (EOFError, OSError):
                raise self._died() from None
            except Exception as bad:
                raise RecordingError(f"{self._source}: the process that reads it sent "
                                     f"no answer: {bad}") from bad
            except BaseException:       # an interrupt: the answer is still to come
                self._end()
                raise
            self._problems = problems
        for kind, text in said:
            warnings.warn(text, _CLASSES.get(kind, UserWarning), stacklevel=3)
        if error is not None:
            kind, text = error
            raise _CLASSES.get(kind, RecordingError)(text)
        return value

    def _died(self) -> RecordingError:
        try:
            code = self._process.wait(1)
        except subprocess.TimeoutExpired:   # it sent too much, or closed its pipe
            code = 0
        self._end()
        how = ("took too much time for an answer" if code == -signal.SIGXCPU
               else f"died ({signal.Signals(-code).name})" if code < 0 else "ended")
        return RecordingError(f"{self._source}: the process that reads it {how}: the "
                              "file is damaged")

    @property
    def problems(self) -> Sequence[Problem]:
        """Problems found so far."""
        return self._problems

    @property
    def path(self) -> Path | None:
        """The file that is read, None if there are several."""
        return self._path

    @property
    def members(self) -> tuple[Member, ...]:
        """The files that it is made of."""
        return members_of(self._source)

    @property
    def name(self) -> str:
        """Short name for people."""
        return self._name

    def packets(
        self, start_us: int | None = None, stop_us: int | None = None
    ) -> Iterator[Packet]:
        """Iterate over the samples with start_us <= time < stop_us, in time order."""
        return packetise(self._batches(start_us, stop_us), start_us, stop_us,
                         self._budget, own=True)

    def _batches(self, *window: int | None) -> Iterator[Batch]:
        number = next(self._numbers)
        self._ask("window", number, *window)
        try:
            while batches := self._ask("next", number):
                yield from batches
        finally:
            with contextlib.suppress(ValueError, RecordingError):
                self._ask("end", number)

    def close(self) -> None:
        """End the process; reading afterwards raises ValueError."""
        self._end()

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self._source, self._options)
