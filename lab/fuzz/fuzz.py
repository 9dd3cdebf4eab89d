"""Read damaged files until the time is over; say what broke.

python lab/fuzz/fuzz.py --seconds 60 [--seed N] [--target aedat4]

Each parser has its turn, in a process of its own that the system ends when one file
takes too long; what broke is kept, and the other parsers go on.
"""
import argparse
import itertools
import mmap
import os
import resource
import signal
import struct
import sys
import tempfile
import time
import traceback
import warnings
from pathlib import Path

import numpy as np

sys.path[:0] = [str(Path(__file__).parent), str(Path(__file__).parents[2] / "tests")]

import corpus  # noqa: E402
import lies  # noqa: E402
from mutators import mutant  # noqa: E402
from targets import TARGETS, fuzz_one, part_mutant, whole_parts  # noqa: E402

from pdavis_cv.errors import PdavisWarning  # noqa: E402

LONGEST_S = 10
"""Of CPU time, for one file: others may use this machine."""
WAIT_S = 300
"""Of time, however little of it the machine gives to this process."""
MOST_MB = 500
TURN_S = 2.0
AGAIN, PACKETS = 16, 4
"""One file in so many is read twice; of formats with packets or records, one in so many
shows whether those that were not touched are delivered."""


class LostError(Exception):
    """Raised when events of packets that were not touched are missing."""


LIES = {f"lies {name}": name for name in lies.FORMATS}
"""Valid files with one lie, by name."""


def _numbers(name, seed, number):
    names = LIES if name in LIES else TARGETS
    return np.random.default_rng([seed, sorted(names).index(name), number])


def made(name, seed, number):
    """Return the mutant of this number, the events that it must still give or None.

    Last, how many of those may be missing.
    """
    rng = _numbers(name, seed, number)
    if name in LIES:
        return lies.made(LIES[name], number, rng)
    if TARGETS[name].divided and number % PACKETS == 0:
        return part_mutant(name, number // PACKETS, rng)
    files = corpora(name)
    return mutant(files[number % len(files)], TARGETS[name].grammar, rng), None, 0


_CORPORA = {}


def corpora(name):
    """Return the whole files of a parser."""
    if name not in _CORPORA:
        _CORPORA[name] = lies.whole(LIES[name]) if name in LIES else (
            TARGETS[name].whole(corpus.small))
    return _CORPORA[name]


def check(name, seed, number, folder):
    """Make a mutant and read it; raise if that breaks a promise."""
    if name in LIES:
        lies.check(LIES[name], number, _numbers(name, seed, number), folder)
        return
    data, wanted, spare = made(name, seed, number)
    found = fuzz_one(name, data, folder)
    if wanted is not None:
        missing = len(wanted) if found is None else len(np.setdiff1d(wanted, found))
        if missing > spare:
            raise LostError(f"{missing} events of parts that are whole")
    if number % AGAIN == 0:
        again = fuzz_one(name, data, folder)
        assert type(found) is type(again)
        np.testing.assert_array_equal(found, again)


def turn(name, seed, first, seconds, most_mb, told):
    """Read mutants for a while, in this process; note each in `told`."""
    with tempfile.TemporaryDirectory(dir=_memory()) as folder:
        os.chdir(folder)        # what a file makes us write is gone with it
        warnings.simplefilter("error")
        warnings.simplefilter("ignore", PdavisWarning)
        slowest, end = 0.0, time.process_time() + seconds
        number = first
        while True:
            begun = time.process_time()
            if begun >= end:
                return
            told[:] = struct.pack("<qd", number, slowest)
            signal.setitimer(signal.ITIMER_PROF, LONGEST_S)
            signal.setitimer(signal.ITIMER_REAL, WAIT_S)
            check(name, seed, number, Path(folder))
            slowest = max(slowest, time.process_time() - begun)
            peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
            if peak > most_mb:
                raise MemoryError(f"{peak:.0f} MB")
            number += 1
            told[:] = struct.pack("<qd", number, slowest)


def _memory():
    """Return a folder in memory, None where there is none."""
    return "/dev/shm" if os.access("/dev/shm", os.W_OK) else None


def in_a_child(name, seed, first, seconds, most_mb):
    """Return (next number, slowest in s, None or why the child ended early)."""
    told = mmap.mmap(-1, 16)
    told[:] = struct.pack("<qd", first, 0.0)
    read, write = os.pipe()
    with open(read, "rb") as said:
        pid = os.fork()
        if pid == 0:
            code = 1
            try:
                os.close(read)
                for number in (signal.SIGPROF, signal.SIGALRM):
                    signal.signal(number, signal.SIG_DFL)
                turn(name, seed, first, seconds, most_mb, told)
                code = 0
            except BaseException:
                os.write(write, traceback.format_exc().encode()[-60_000:])
            finally:
                os._exit(code)
        os.close(write)
        text = said.read().decode(errors="replace")
        _, status = os.waitpid(pid, 0)
    code = os.waitstatus_to_exitcode(status)
    number, slowest = struct.unpack("<qd", told[:])
    told.close()
    if code == 0:
        return number, slowest, None
    if code < 0:
        text = f"ended by {signal.Signals(-code).name}"
    return number, slowest, text


def excused(name, data):
    """Tell whether a file on which a process died is one that commands refuse.

    The HDF5 library hangs, dies or takes gigabytes on some files: that commands refuse
    them is what is promised (docs/promises.md).
    """
    from pdavis_cv import RecordingError, open_recording
    if name.removeprefix("lies ") not in ("hdf5", "rpg"):
        return False
    with tempfile.NamedTemporaryFile(suffix=".h5") as file:
        file.write(data)
        file.flush()
        try:
            with open_recording(file.name, isolated=True) as recording:
                for _ in recording.packets():
                    pass
        except RecordingError as error:
            return "process that reads it" in str(error) or "limit memory" in str(error)
    return False


def main(argv=None):
    """Return 0 if nothing broke."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=60)
    parser.add_argument("--seed", type=int, default=None)
    parser.add_argument("--first", type=int, default=0, help="number to begin with")
    targets = [*TARGETS, *LIES]
    parser.add_argument("--target", choices=targets, default=None)
    parser.add_argument("--without", choices=targets, nargs="+", default=())
    parser.add_argument("--keep", type=Path, default=Path("."),
                        help="folder for files that broke something")
    parser.add_argument("--most-mb", type=float, default=MOST_MB,
                        help="memory; sanitizers keep what is freed")
    args = parser.parse_args(argv)
    seed = int.from_bytes(os.urandom(4)) if args.seed is None else args.seed
    # Without h5py, rosbags or roifile there is nothing to damage.
    names = [name for name in ([args.target] if args.target else targets)
             if name not in args.without and corpora(name)]
    for name in names:      # load what reading takes, once
        with tempfile.TemporaryDirectory() as folder:
            if name not in ("http", *LIES):     # threads do not survive a fork
                fuzz_one(name, corpora(name)[0], Path(folder))
            if name in TARGETS and TARGETS[name].divided:
                whole_parts(name)
    end = time.monotonic() + args.seconds
    # On a busy machine CPU time lasts longer: all have a turn nevertheless.
    turn_s = min(TURN_S, args.seconds / len(names) / 3)
    numbers = dict.fromkeys(names, args.first)
    slowest, broken, refused = 0.0, 0, 0
    for name in itertools.cycle(names):
        if time.monotonic() >= end:
            break
        try:
            number, took, why = in_a_child(
                name, seed, numbers[name], turn_s, args.most_mb)
        except KeyboardInterrupt:       # enough: say how far it came
            break
        slowest = max(slowest, took)
        numbers[name] = number
        if why is None:
            continue
        numbers[name] += 1
        data, *_ = made(name, seed, number)
        if (why.startswith("ended") or "MemoryError" in why) and excused(name, data):
            refused += 1
            continue
        broken += 1
        path = args.keep / f"fuzz-{name}-{seed}-{number}.bin"
        path.write_bytes(data)
        print(f"{name}: seed {seed}, number {number}, kept as {path}: {why}",
              flush=True)
    counts = {name: number - args.first for name, number in numbers.items()}
    print(f"seed {seed}: {sum(counts.values())} files, "
          + ", ".join(f"{n} {c}" for n, c in counts.items())
          + f"; slowest {slowest:.2f} CPU s, {refused} HDF5 files that commands "
          f"refuse, {broken} broke something")
    return int(broken > 0)


if __name__ == "__main__":
    raise SystemExit(main())
