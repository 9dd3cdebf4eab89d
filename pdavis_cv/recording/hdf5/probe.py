"""HDF5 of unknown origin is opened by a helper process first.

The HDF5 library can hang for ever, die, or take gigabytes on a damaged file while a
single attribute is read, and no signal reaches Python meanwhile.  The helper reads the
file, a large one as far as its first packet, within limits that the system keeps.
"""
from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

from pdavis_cv.errors import RecordingError

__all__ = ["MAGIC", "proved"]

MAGIC = b"\x89HDF\r\n\x1a\n"
LONGEST_S = 10
"""CPU seconds: opening takes far less than one, reading `WHOLE_BYTES` about two."""
WHOLE_BYTES = 32 << 20
"""A file of so many bytes is read to its end, a larger one not: it would cost as much
as what is to be done with it."""
MOST_BYTES = 2 << 30
_WAIT = 12
"""A busy machine gives a process that fraction of its time, at least."""
_OPEN = """
import os
import sys
try:
    import resource
    resource.setrlimit(resource.RLIMIT_CPU, ({seconds}, {seconds} + 1))
    resource.setrlimit(resource.RLIMIT_AS, ({bytes}, {bytes}))
except (ImportError, ValueError):
    pass        # Windows: the clock alone; or a narrower limit holds already
from pdavis_cv.recording.hdf5.reader import Hdf5Recording
try:
    with Hdf5Recording(sys.argv[1]) as recording:
        for _ in recording.packets():
            if os.path.getsize(sys.argv[1]) > {whole}:
                break
except Exception as error:
    if isinstance(error, MemoryError) or "memory allocation failed" in str(error):
        sys.exit({no_memory})
    raise
"""
_NO_MEMORY = 3
"""Exit status: HDF5 takes as much as a damaged length says, before it looks further."""


def proved(
    path: str | os.PathLike[str], program: str = _OPEN, *, seconds: int = LONGEST_S
) -> None:
    """Return if a file is no HDF5, or one that can be opened in bounded time.

    Whatever else is wrong with it, opening will say.

    Parameters
    ----------
    path : path
    program : str
        What the helper runs, given the path.
    seconds : int
        CPU time that it may take.

    Raises
    ------
    RecordingError
        If the helper takes too long or too much memory, or dies.
    """
    try:
        with Path(path).open("rb") as file:
            if file.read(len(MAGIC)) != MAGIC:
                return
    except OSError:
        return
    code = program.format(seconds=seconds, bytes=MOST_BYTES, whole=WHOLE_BYTES,
                          no_memory=_NO_MEMORY)
    try:
        done = subprocess.run(
            [sys.executable, "-P", "-W", "ignore", "-c", code, str(path)],
            capture_output=True, timeout=_WAIT * seconds, check=False,
            # Its threads would reserve memory for each core.
            env={**os.environ, "OPENBLAS_NUM_THREADS": "1"})
    except subprocess.TimeoutExpired:
        died = True
    else:
        died = done.returncode < 0 or done.returncode == _NO_MEMORY
    if died:
        raise RecordingError(
            f"{path}: the HDF5 library hangs or dies on it (a helper process was given "
            f"{seconds} s and {MOST_BYTES >> 30} GiB): the file is damaged")
