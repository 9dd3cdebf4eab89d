"""Faults of disks and processes, for every command that writes and every file read.

Each fault is met by a process of its own, forked from this one, which loads no more
than it must: some of these processes are killed.  Prints a line of JSON per case.
"""
import contextlib
import errno
import importlib
import json
import os
import resource
import signal
import sys
import tempfile
import time
import warnings
from pathlib import Path

import numpy as np

TESTS = Path(__file__).parent
sys.path[:0] = [str(TESTS), str(TESTS.parent / "lab" / "fuzz")]

import corpus  # noqa: E402
from targets import MOST_SAMPLES, RECORDINGS  # noqa: E402

import pdavis_cv  # noqa: E402
from pdavis_cv.tools.main import main  # noqa: E402

SLOWEST_S = 60
ROOM = 200
"""Bytes that a full disk still takes: less than any of the outputs."""


def writers(folder):
    """Return name of an output -> the command that writes it."""
    source, layout = str(folder / "in.aedat4"), ("--layout", "pdavis", "--fps", "20")
    picture = ("--method", "frames", *layout)
    found = {name: ("export", source, "-o", name, *picture) for name in (
        "x.npy", "x.npz", "x.ome.tif", "x.h5", "x.png", "x.mp4", "x.webm", "x.pdf",
        "x.svg", "x.gif")}
    for name in ("y.aedat4", "y.aedat", "y.h5", "y.mcap", "y.db3", "y.raw", "y.es",
                 "y.csv", "y.npy", "y.parquet"):
        found[name] = ("convert", str(folder / "davis.aedat4"), name)
    for name in ("a.npy", "a.csv"):
        found[name] = ("export", source, "-o", name, "--what", "aop-events", *layout)
    found["z.npz"] = ("calibrate", "dark", source, "-o", "z.npz")
    found["z.csv"] = ("score", source, "-o", "z", "--methods", "cf", "--thresholds",
                      "nominal")
    found["z.aedat4"] = ("simulate", "polarizer", "-o", "z.aedat4", "--seconds", ".05")
    return found


def source_files(folder):
    """Write the recordings that commands read: noise, which nothing makes small."""
    rng = np.random.default_rng(0)
    frames = [pdavis_cv.ApsFrame(rng.uniform(50, 900, (24, 32)).astype(np.float32),
                                 t, t + 9_000, available_us=t + 12_000)
              for t in range(0, 200_000, 40_000)]
    events = np.zeros(2000, pdavis_cv.EVENT_DTYPE)
    events["t"] = np.sort(rng.integers(0, 200_000, 2000))
    events["x"], events["y"] = rng.integers(0, 32, 2000), rng.integers(0, 24, 2000)
    events["p"] = rng.integers(0, 2, 2000)
    pdavis_cv.write_aedat4(folder / "in.aedat4", pdavis_cv.recording_from_arrays(
        events, frames, sensor_size=(24, 32)))
    pdavis_cv.write_aedat4(folder / "davis.aedat4", pdavis_cv.recording_from_arrays(
        events, sensor_size=(128, 128)))


def at_the_end(number):
    """Let a signal reach this process when its first file is whole but for its name."""
    def replace(*_):
        os.kill(os.getpid(), number)
        time.sleep(SLOWEST_S)

    os.replace = replace


def failing(code):
    """Let no file get its name."""
    def replace(part, path):
        raise OSError(code, os.strerror(code), str(part))

    os.replace = replace


def preload():
    """Import what the children will need, once."""
    for module in ("cv2", "h5py", "matplotlib.backends.backend_agg", "scipy.signal",
                   "pdavis_cv.tools.score", "pdavis_cv.tools.calibrate"):
        importlib.import_module(module)


FAULTS = {
    "killed": lambda: at_the_end(signal.SIGKILL),
    "terminated": lambda: at_the_end(signal.SIGTERM),
    "full": lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (ROOM, ROOM)),
    "broken": lambda: failing(errno.EIO),
    "stdout": lambda: os.dup2(os.open("/dev/full", os.O_WRONLY), 1),
    "folder": lambda: os.chdir("/sys"),     # which takes no file, not even root's
}


LEAVE = ("killed",)
"""Faults after which the next run must clear up."""


def in_a_child(work):
    """Fork, call work there; return (exit code or -signal, what it said)."""
    read, write = os.pipe()         # holds more than any command says
    with open(read, "rb") as said:
        pid = os.fork()
        if pid == 0:
            os.dup2(write, 2)
            os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
            signal.alarm(SLOWEST_S)
            code = 99
            with contextlib.suppress(BaseException):
                code = work()
                sys.stdout.flush()
            os._exit(code)
        os.close(write)
        _, status = os.waitpid(pid, 0)
        return os.waitstatus_to_exitcode(status), said.read().decode()


def of_writers():
    """Yield what each fault did to each output, and what the next run left."""
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder)
        source_files(root)
        preload()
        for name, arguments in writers(root).items():
            for fault, cause in FAULTS.items():
                place = root / f"{name}-{fault}"
                place.mkdir()
                os.chdir(place)

                def work(cause=cause, arguments=arguments):
                    cause()
                    return main(arguments)

                code, said = in_a_child(work)
                left = sorted(os.listdir(place))
                again = 0
                if fault in LEAVE:
                    again, _ = in_a_child(lambda arguments=arguments: main(arguments))
                os.chdir(root)
                yield {"output": name, "fault": fault, "code": code, "said": said,
                       "left": left, "again": again, "after": sorted(os.listdir(place))}


def broken_reads(path):
    """Let the system read no more."""
    def pread(*_):
        raise OSError(errno.EIO, os.strerror(errno.EIO))

    os.pread = os.preadv = pread


def cut(path):
    os.truncate(path, path.stat().st_size // 2)


def grown(path):
    with open(path, "ab") as file:
        file.write(os.urandom(5000))


READS = {"nothing": lambda path: None, "EIO": broken_reads, "cut": cut, "grown": grown}


def of_readers():
    """Yield what each fault, after opening, did to reading each file."""
    with tempfile.TemporaryDirectory() as folder:
        for name, target in RECORDINGS.items():
            for number, data in enumerate(target.whole(corpus.large)):
                if b"SQLite format 3" in data:
                    continue    # read by SQLite, from a folder
                for fault, cause in READS.items():
                    path = Path(folder) / "x"
                    path.write_bytes(data)

                    def work(path=path, cause=cause):
                        warnings.simplefilter("ignore")
                        try:
                            count = 0
                            with pdavis_cv.open_recording(path) as recording:
                                cause(path)
                                for packet in recording.packets():
                                    count += len(packet.events)
                                    assert count < MOST_SAMPLES
                            print(count, "events", file=sys.stderr)
                        except pdavis_cv.RecordingError as error:
                            print("RecordingError", error, file=sys.stderr)
                        except BaseException as error:
                            print("wrong:", repr(error), file=sys.stderr)
                            return 1
                        return 0

                    code, said = in_a_child(work)
                    yield {"file": f"{name} {number}", "fault": fault, "code": code,
                           "said": said}


if __name__ == "__main__":
    for case in (of_writers if sys.argv[1] == "writers" else of_readers)():
        print(json.dumps(case), flush=True)
