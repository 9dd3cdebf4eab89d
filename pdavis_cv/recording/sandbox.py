"""Limits that Linux enforces on a process: memory, time, files, network.

Landlock (Linux 5.13) restricts files and TCP, seccomp the rest; see `landlock(7)` and
`seccomp(2)`.
"""
from __future__ import annotations

import contextlib
import ctypes
import functools
import os
import sys
import time
from collections.abc import Iterable
from pathlib import Path

_CREATE, _ADD, _RESTRICT = 444, 445, 446    # landlock_*, the same on all machines
_VERSION, _BENEATH = 1, 1
_RIGHTS = {1: 13, 2: 14, 3: 15, 5: 16}
"""Number of rights to files from a version of Landlock on."""
_READ_FILE, _READ_FOLDER = 1 << 2, 1 << 3
_SYSTEM = ("/usr", "/lib", "/lib64", "/proc", "/sys", "/dev/null", "/dev/urandom")
"""What programs need to be read."""
_REFUSED = {
    "x86_64": (0xC000003E, (41, 59, 101, 310, 311, 322, 425)),
    "aarch64": (0xC00000B7, (198, 221, 117, 270, 271, 281, 425))}
"""Number of a machine, and of the system calls socket, execve, ptrace,
process_vm_readv, process_vm_writev, execveat, io_uring_setup."""
_NO_NEW_PRIVILEGES, _SECCOMP = 38, 22       # of prctl
_LOAD, _EQUAL, _AT_LEAST, _RETURN = 0x20, 0x15, 0x35, 0x06      # BPF
_ALLOW, _FAIL, _KILL = 0x7FFF0000, 0x00050001, 0x80000000


class _Ruleset(ctypes.Structure):
    _fields_ = (("files", ctypes.c_uint64), ("network", ctypes.c_uint64),
                ("scopes", ctypes.c_uint64))


class _Beneath(ctypes.Structure):
    _pack_ = 1
    _layout_ = "ms"
    _fields_ = (("rights", ctypes.c_uint64), ("folder", ctypes.c_int32))


class _Step(ctypes.Structure):
    _fields_ = (("code", ctypes.c_uint16), ("true", ctypes.c_uint8),
                ("false", ctypes.c_uint8), ("k", ctypes.c_uint32))


class _Program(ctypes.Structure):
    _fields_ = (("length", ctypes.c_uint16), ("steps", ctypes.POINTER(_Step)))


def _call(function: str, *arguments: object) -> int:
    system = ctypes.CDLL(None, use_errno=True)
    found: int = getattr(system, function)(*arguments)
    if found < 0:
        error = ctypes.get_errno()
        raise OSError(error, os.strerror(error))
    return found


@functools.cache
def _version() -> int:
    """Return the version of Landlock."""
    return _call("syscall", _CREATE, None, ctypes.c_size_t(0), _VERSION)


def available() -> bool:
    """Return whether this system can do what `enter` does."""
    if sys.platform != "linux" or os.uname().machine not in _REFUSED:
        return False
    try:
        return _version() >= 1
    except OSError:
        return False


def enter(read: Iterable[str | os.PathLike[str]], write: str, more_bytes: int) -> None:
    """Restrict this process for good.

    Parameters
    ----------
    read : iterable of path
        Folders that it may read, beside libraries and programs.
    write : path
        Folder in which it may write.
    more_bytes : int
        Memory that it may take in addition to what it has.
    """
    import resource
    taken = int(Path("/proc/self/statm").read_text().split()[5])    # data, in pages
    most = taken * resource.getpagesize() + more_bytes
    resource.setrlimit(resource.RLIMIT_DATA, (most, most))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    _call("prctl", _NO_NEW_PRIVILEGES, 1, 0, 0, 0)
    _restrict_files((*_SYSTEM, *read), write)
    _restrict_calls()


def _restrict_files(read: Iterable[str | os.PathLike[str]], write: str) -> None:
    version = _version()
    rights = (1 << max(n for since, n in _RIGHTS.items() if since <= version)) - 1
    rules = _Ruleset(rights, 3 if version >= 4 else 0, 3 if version >= 6 else 0)
    size = 8 if version < 4 else 16 if version < 6 else 24
    made = _call("syscall", _CREATE, ctypes.byref(rules), ctypes.c_size_t(size), 0)
    for path in (*read, write):
        with contextlib.suppress(FileNotFoundError):
            folder = os.open(path, os.O_PATH | os.O_CLOEXEC)
            reads = _READ_FILE | (_READ_FOLDER if Path(path).is_dir() else 0)
            rule = _Beneath(rights if path == write else reads, folder)
            _call("syscall", _ADD, made, _BENEATH, ctypes.byref(rule), 0)
            os.close(folder)
    _call("syscall", _RESTRICT, made, 0)
    os.close(made)


def _restrict_calls() -> None:
    machine, refused = _REFUSED[os.uname().machine]
    steps = [
        _Step(_LOAD, 0, 0, 4), _Step(_EQUAL, 1, 0, machine),
        _Step(_RETURN, 0, 0, _KILL), _Step(_LOAD, 0, 0, 0),
        *(_Step(_EQUAL, len(refused) - i + 1, 0, n) for i, n in enumerate(refused)),
        # Above lie those of another word length (x32).
        _Step(_AT_LEAST, 1, 0, 1 << 30), _Step(_RETURN, 0, 0, _ALLOW),
        _Step(_RETURN, 0, 0, _FAIL)]
    _call("prctl", _SECCOMP, 2, ctypes.byref(
        _Program(len(steps), (_Step * len(steps))(*steps))), 0, 0)


def more_time(seconds: float) -> None:
    """Let this process take so much more time of a processor; then it dies."""
    import resource
    _, most = resource.getrlimit(resource.RLIMIT_CPU)
    ends = int(time.process_time() + seconds) + 1
    resource.setrlimit(resource.RLIMIT_CPU, (
        ends if most == resource.RLIM_INFINITY else min(ends, most), most))
