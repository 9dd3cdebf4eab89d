"""Open HDF5 files in a helper process first, as damaged ones can crash the library.

While a single attribute of a damaged file is read, the HDF5 library can hang forever,
crash, or take gigabytes, and signals do not reach Python.  The helper reads the file (a
large one up to its first packet) within limits that the system enforces.
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
"""Limit of CPU time, s: opening takes far below 1, reading `WHOLE_BYTES` about 2."""
WHOLE_BYTES = 32 << 20
"""Files up to this size are read completely; for larger ones that would cost as much as
using them."""
MORE_BYTES = 384 << 20
"""Limit of memory in addition to what the libraries take before the file is opened."""
_WAIT = 12
"""Ratio of wall-clock limit to CPU limit: a busy machine gives a process at least one
part in this of its time."""
_OPEN = """
import os
import sys
try:
    import resource
    resource.setrlimit(resource.RLIMIT_CPU, ({seconds}, {seconds} + 1))
except (ImportError, ValueError):
    pass        # Windows: the clock alone; or a narrower limit holds already
from pdavis_cv.recording.hdf5.reader import Hdf5Recording, h5py_module
h5py_module()
try:
    with open("/proc/self/statm") as numbers:
        most = int(numbers.read().split()[0]) * resource.getpagesize() + {bytes}
    resource.setrlimit(resource.RLIMIT_AS, (most, most))
except (NameError, OSError, ValueError):
    pass        # not Linux; or a narrower limit holds already
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
"""Exit status for lack of memory: HDF5 allocates what a damaged length claims."""


def proved(
    path: str | os.PathLike[str], program: str = _OPEN, *, seconds: int = LONGEST_S
) -> None:
    """Return unless opening an HDF5 file would hang or crash.

    Any other error is left to the reader.

    Parameters
    ----------
    path : path
    program : str
        Code that the helper runs, with the path as argument.
    seconds : int
        Limit of its CPU time.

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
    code = program.format(seconds=seconds, bytes=MORE_BYTES, whole=WHOLE_BYTES,
                          no_memory=_NO_MEMORY)
    try:
        done = subprocess.run(
            [sys.executable, "-P", "-W", "ignore", "-c", code, str(path)],
            capture_output=True, timeout=_WAIT * seconds, check=False,
            # OpenBLAS threads would reserve memory for each core.
            env={**os.environ, "OPENBLAS_NUM_THREADS": "1"})
    except subprocess.TimeoutExpired:
        died = True
    else:
        died = done.returncode < 0 or done.returncode == _NO_MEMORY
    if died:
        raise RecordingError(
            f"{path}: the HDF5 library hangs or dies on it (a helper process was given "
            f"{seconds} s and {MORE_BYTES >> 20} MiB): the file is damaged")
