"""Works and executors that the tests of batch hand out; a module, so that they pickle.
"""
import os
import signal
import time
from concurrent.futures import BrokenExecutor, Executor, Future
from pathlib import Path

from pdavis_cv import RecordingError


class Inline(Executor):
    """Does everything at once, in the thread that asks."""

    def __init__(self):
        self.sent = 0

    def submit(self, function, /, *args, **kwargs):
        self.sent += 1
        future = Future()
        try:
            future.set_result(function(*args, **kwargs))
        except Exception as error:
            future.set_exception(error)
        return future


class Breaks(Inline):
    """Breaks for a recording whose name holds ``bad``, and whatever follows it."""

    _max_workers = 2

    def __init__(self, log):
        super().__init__()
        self.broken, self.log = False, log
        log.append([])

    def submit(self, function, job, *args, **kwargs):
        self.log[-1].append(Path(job.source).stem)
        future = Future()
        if self.broken or "bad" in job.source:
            self.broken = True
            future.set_exception(BrokenExecutor("a process died"))
            return future
        return super().submit(function, job, *args, **kwargs)


def count(recording, options, folder):
    """Count events; a file and figures."""
    total = sum(len(packet.events) for packet in recording.packets())
    (folder / "events.txt").write_text(f"{total}\n")
    return {"events": total, "mean": float("nan")}


def note(recording, options, folder):
    """Leave a line each time in a log beside the recording."""
    with recording.path.with_suffix(".log").open("a") as log:
        log.write("done\n")
    return count(recording, options, folder)


def half(recording, options, folder):
    """Fail with half a file written."""
    (folder / "half.bin").write_bytes(b"1234")
    raise RecordingError("damaged in the middle")


def twice(recording, options, folder):
    """Fail the first time, as a network drive may."""
    flag = recording.path.with_suffix(".flag")
    if not flag.exists():
        flag.touch()
        raise OSError(5, "Input/output error")
    return {}


def endless(recording, options, folder):
    """Take a minute."""
    time.sleep(60)


def deadly(recording, options, folder):
    """Take the process along, for a recording whose name holds ``bad``."""
    if "bad" in recording.path.name:
        os.kill(os.getpid(), signal.SIGKILL)
    time.sleep(0.05)
    return count(recording, options, folder)


def killed_once(recording, options, folder):
    """Meet a kill -9 with half a file written, the first time, if so named."""
    flag = recording.path.with_suffix(".flag")
    if "unlucky" in recording.path.name and not flag.exists():
        flag.touch()
        (folder / "half.bin").write_bytes(b"1234")
        os.kill(os.getpid(), signal.SIGKILL)
    return count(recording, options, folder)


def slow(recording, options, folder):
    """Write half of a file, wait, write the other half; the later half is held."""
    while recording.path.stem >= "run09" and recording.path.with_name("hold").exists():
        time.sleep(0.05)
    with (folder / "events.txt").open("w") as file:
        file.write("half ")
        file.flush()
        time.sleep(0.4)
        file.write("and half\n")
    return {}


class Nothing:
    """Opens nothing and does next to nothing."""

    opens = False

    def __call__(self, source, options, folder):
        return {"length": len(source)}


nothing = Nothing()
