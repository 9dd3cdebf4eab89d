"""Files that appear under their name only when they are whole."""
import errno
import gc
import inspect
import os
import re
import shutil
import socket
import stat
import subprocess
import sys
import threading

import numpy as np
import pytest
from faults import source_files

from pdavis_cv import Aedat4Writer, Packet, PolarFrame, as_events
from pdavis_cv._beside import Unfinished, all_or_none, sole, write_beside
from pdavis_cv.data import example_recording
from pdavis_cv.export import NpyFile, NpzFile
from pdavis_cv.export.stacks import StackFile
from pdavis_cv.recording.base import RecordingInfo
from pdavis_cv.recording.davis import Orientation
from pdavis_cv.recording.davis_trace import TraceWriter, Transfer
from pdavis_cv.tools.main import main


def test_a_file_appears_when_it_is_whole(tmp_path):
    path = tmp_path / "x.png"
    path.write_text("old")
    with write_beside(path) as part:
        assert part.parent == tmp_path
        assert part.suffix == ".png"
        part.write_text("new")
        assert path.read_text() == "old"
    assert path.read_text() == "new"
    assert list(tmp_path.iterdir()) == [path]


def test_a_block_that_raises_leaves_what_was_there(tmp_path):
    path = tmp_path / "x.png"
    path.write_text("old")

    def interrupted():
        with write_beside(path) as part:
            part.write_text("new")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_files_of_a_block_appear_together(tmp_path):
    def written(*, fails):
        with all_or_none():
            with write_beside(tmp_path / "a") as part:
                part.write_text("1")
            with all_or_none(), write_beside(tmp_path / "b") as part:
                part.write_text("2")
            assert not (tmp_path / "a").exists()
            assert not (tmp_path / "b").exists()
            if fails:
                raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        written(fails=True)
    assert not list(tmp_path.iterdir())
    written(fails=False)
    assert sorted(one.read_text() for one in tmp_path.iterdir()) == ["1", "2"]


FRAMES = ("--layout", "pdavis", "--method", "frames")
TWO_FILES = {
    "array of AoP": (("export", "--what", "aop-events", "-o", "x.npy"),
                     "pathlib.Path.write_text"),
    "table of AoP": (("export", "--what", "aop-events", "-o", "x.csv"),
                     "pathlib.Path.write_text"),
    "array": (("export", "-o", "x.npy", "--fps", "20", *FRAMES),
              "pathlib.Path.write_text"),
    "score": (("score", "-o", "x", "--methods", "cf", "--thresholds", "nominal"),
              "pathlib.Path.write_text"),
    "fan": (("fan", "-o", "x.webm", "--still", "x.png", "--fps", "20", *FRAMES),
            "pdavis_cv.export.write_png"),
    "tendon": (("tendon", "-o", ".", "--load-hz", "3", "--fps", "20", "--no-video",
                *FRAMES, "--region", "all=4,4,8,8"),
               "pdavis_cv.tools.tendon.report.write_report"),
    "dark": (("calibrate", "dark", "-o", "x.npz"), "pdavis_cv.Calibration.save"),
    "simulate": (("simulate", "polarizer", "-o", "x.aedat4", "--seconds", "0.05"),
                 "numpy.savez_compressed")}
"""Commands of several files, and what is called for the last of them."""


@pytest.mark.parametrize("name", TWO_FILES)
def test_outputs_of_several_files_are_whole_or_none_is_there(
        name, tmp_path, monkeypatch, capsys):
    source_files(tmp_path)
    if name == "tendon":
        shutil.copy(example_recording("tendon"), tmp_path / "in.aedat4")
    (tmp_path / "out").mkdir()
    monkeypatch.chdir(tmp_path / "out")
    command, last = TWO_FILES[name]
    reads = ["../in.aedat4"] if command[0] != "simulate" else []
    at = 2 if command[0] == "calibrate" else 1

    def full(*arguments, **options):
        raise OSError(errno.ENOSPC, "full")

    command = [*command[:at], *reads, *command[at:]]
    if name.endswith("AoP"):
        command += ["--layout", "pdavis"]
    with monkeypatch.context() as patched:
        patched.setattr(last, full)
        assert main(command) == 1
    assert "full" in capsys.readouterr().err
    assert not list((tmp_path / "out").iterdir())
    assert main(command) == 0
    assert len(list((tmp_path / "out").iterdir())) >= 2


def test_errors_name_the_final_file(tmp_path):
    missing = tmp_path / "none" / "x.png"
    with pytest.raises(FileNotFoundError) as error, write_beside(missing) as part:
        part.write_text("")
    assert error.value.filename == str(missing)
    with pytest.raises(OSError, match=r"x\.png: odd") as error, write_beside(
            tmp_path / "x.png"):
        raise OSError("odd")


def test_errors_of_other_files_keep_their_names(tmp_path):
    with pytest.raises(FileNotFoundError) as error, write_beside(tmp_path / "x"):
        (tmp_path / "source").read_text()
    assert error.value.filename == str(tmp_path / "source")


def test_what_was_never_written_can_be_given_up(tmp_path):
    Unfinished(tmp_path / "x").discard()
    assert not list(tmp_path.iterdir())


@pytest.mark.skipif(os.name != "posix", reason="asks which processes live")
def test_what_a_killed_process_left_is_removed_and_what_a_living_one_writes_stays(
        tmp_path):
    gone = subprocess.run([sys.executable, "-c", "import os; print(os.getpid())"],
                          capture_output=True, text=True, check=True).stdout.strip()
    stay = [f".x.part{os.getppid()}.npy", f".y.part{gone}.npy", f"x.part{gone}.npy"]
    for name in [*stay, f".x.part{gone}.npy", f".x.part{gone}.mkv"]:
        (tmp_path / name).write_text("")
    with write_beside(tmp_path / "x.npy") as part:
        part.write_text("whole")
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted([*stay, "x.npy"])


POSIX = pytest.mark.skipif(os.name != "posix", reason="devices, pipes, locks")
INFO = RecordingInfo(format="USB", sensor_size=(4, 6))
ORIENTATION = Orientation()


def by_block(path):
    with write_beside(path) as part:
        part.write_bytes(b"whole")


def by_writer(path):
    Aedat4Writer(path, sensor_size=(4, 6)).close()


def by_stack(path):
    with NpzFile(path, ("s0",), resume=True) as stack:
        stack.add(PolarFrame(np.ones((4, 4, 6)), t_us=5))


def by_trace(path):
    with TraceWriter(path, INFO, ORIENTATION) as trace:
        trace.add(Transfer(b"1234", 0.5))


WAYS = pytest.mark.parametrize("write", [by_block, by_writer, by_stack, by_trace])


@POSIX
@WAYS
def test_the_file_that_a_link_names_is_replaced_and_the_link_stays(write, tmp_path):
    (tmp_path / "there").mkdir()
    real, link = tmp_path / "there" / "x.npz", tmp_path / "y.npz"
    real.write_text("old")
    link.symlink_to(real)
    write(link)
    assert link.is_symlink()
    assert b"old" != real.read_bytes() == link.read_bytes()
    assert [*(tmp_path / "there").iterdir()] == [real]
    assert len(list(tmp_path.iterdir())) == 2
    real.unlink()       # a link to what is to be made
    write(link)
    assert link.is_symlink()
    assert real.is_file()


@POSIX
@WAYS
def test_a_pipe_and_a_device_take_the_bytes_and_stay(write, tmp_path, monkeypatch):
    kept = tmp_path / "kept"
    kept.mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(kept))
    write(tmp_path / "x.npz")
    wanted = (tmp_path / "x.npz").read_bytes()
    pipe, read = tmp_path / "pipe.npz", []
    os.mkfifo(pipe)
    reader = threading.Thread(target=lambda: read.append(pipe.read_bytes()))
    reader.start()
    write(pipe)
    reader.join(20)
    assert len(read[0]) == len(wanted) > 0
    assert stat.S_ISFIFO(pipe.stat().st_mode)
    null = tmp_path / "null"        # by a link, as a mistake must not cost the device
    null.symlink_to("/dev/null")
    write(null)
    assert stat.S_ISCHR(os.stat("/dev/null").st_mode)
    assert sorted(tmp_path.iterdir()) == sorted(
        [kept, null, pipe, tmp_path / "x.npz"])
    assert not list(kept.iterdir())


@POSIX
@WAYS
def test_a_socket_and_a_folder_are_refused_and_stay(write, tmp_path):
    place = tmp_path / "s"
    with socket.socket(socket.AF_UNIX) as one:
        one.bind(str(place))
        with pytest.raises(OSError, match="socket is not written to") as error:
            write(place)
    assert error.value.filename == str(place)
    assert stat.S_ISSOCK(place.stat().st_mode)
    (tmp_path / "folder").mkdir()
    with pytest.raises(IsADirectoryError):
        write(tmp_path / "folder")
    assert len(list(tmp_path.iterdir())) == 2
    assert not list((tmp_path / "folder").iterdir())


@POSIX
def test_what_a_shell_redirects_to_a_file_is_appended_to(tmp_path):
    code = ("import sys\nfrom pdavis_cv._beside import write_beside\n"
            "print('before', flush=True)\n"
            "with write_beside('/dev/stdout') as part: part.write_text('whole')\n"
            "print('after')")
    with (tmp_path / "out").open("ab") as out:
        subprocess.run([sys.executable, "-P", "-c", code], stdout=out, check=True)
    assert (tmp_path / "out").read_text() == "before\nwholeafter\n"


@POSIX
def test_a_command_does_not_replace_a_device(tmp_path, capsys):
    null = tmp_path / "null.aedat4"
    null.symlink_to("/dev/null")
    assert main(["simulate", "polarizer", "-o", str(null), "--seconds", ".01"]) == 0
    assert null.is_symlink()
    assert stat.S_ISCHR(os.stat("/dev/null").st_mode)
    place = tmp_path / "s.aedat4"
    with socket.socket(socket.AF_UNIX) as one:
        one.bind(str(place))
    capsys.readouterr()
    assert main(["simulate", "polarizer", "-o", str(place), "--seconds", ".01"]) == 2
    assert capsys.readouterr().err.count("socket is not written to") == 1


@POSIX
def test_two_programs_do_not_write_the_same_stack_at_once(tmp_path):
    path = tmp_path / "x.npz"
    with NpzFile(path, ("s0",)) as stack:
        stack.add(PolarFrame(np.ones((4, 4, 6)), t_us=5))
        for resume in (False, True):
            with pytest.raises(OSError, match="another process is writing it"):
                NpzFile(path, ("s0",), resume=resume)
        stack.add(PolarFrame(np.ones((4, 4, 6)), t_us=6))
    with np.load(path) as whole:
        assert len(whole["t_us"]) == 2
    by_stack(path)


@POSIX
@pytest.mark.parametrize("name", [".x.npy.unfinished", ".x.npy.unfinished.log"])
@pytest.mark.parametrize("resume", [False, True])
def test_a_link_under_the_name_of_an_unfinished_stack_is_not_followed(
        tmp_path, name, resume):
    (tmp_path / "other").write_text("kept")
    (tmp_path / name).symlink_to("other")
    with pytest.raises(OSError, match=r"symbolic links|ELOOP"):
        NpyFile(tmp_path / "x.npy", ("s0",), resume=resume)
    assert (tmp_path / "other").read_text() == "kept"


@POSIX
@pytest.mark.parametrize("resume", [False, True])
def test_an_interrupt_at_any_line_of_opening_a_stack(tmp_path, resume):
    """Nothing is left, or with `resume` all images of the earlier run."""
    path = tmp_path / "x.npz"

    def begin():
        with NpzFile(path, ("s0",), resume=True) as stack:
            for t_us in (5, 6):
                stack.add(PolarFrame(np.ones((4, 4, 6)), t_us=t_us))
            raise KeyboardInterrupt

    if resume:
        with pytest.raises(KeyboardInterrupt):
            begin()
    lines = 0

    def interrupt(frame, event, _):
        nonlocal countdown
        if event == "line":
            countdown -= 1
            if countdown == 0:
                raise KeyboardInterrupt
        return interrupt

    def called(frame, *_):
        ours = frame.f_code in (
            inspect.unwrap(StackFile.__init__).__code__, sole.__code__,
            StackFile._continue.__code__)
        return interrupt if ours else None

    while True:
        lines += 1
        countdown = lines
        sys.settrace(called)
        try:
            stack = NpzFile(path, ("s0",), resume=resume)
        except KeyboardInterrupt:
            sys.settrace(None)
            assert resume or not list(tmp_path.iterdir())
            continue
        finally:
            sys.settrace(None)
        break
    assert lines > 20     # the constructor was interrupted that many times
    assert stack.count == 2 * resume
    stack.discard()
    assert not list(tmp_path.iterdir())


def test_a_trace_that_cannot_be_written_leaves_nothing(tmp_path, monkeypatch):
    path = tmp_path / "x.usb"
    trace = TraceWriter(path, INFO, ORIENTATION)
    trace.add(Transfer(b"1234", 0.5))
    assert not path.exists()
    monkeypatch.setattr(os, "replace", lambda *_: (_ for _ in ()).throw(
        OSError(28, "No space left on device")))
    with pytest.raises(OSError, match="No space") as error:
        trace.close()
    assert error.value.filename == str(path)
    trace.close()
    assert not list(tmp_path.iterdir())


def test_a_trace_that_an_error_ends_is_kept(tmp_path):
    def ended():
        with TraceWriter(tmp_path / "x.usb", INFO, ORIENTATION) as trace:
            trace.add(Transfer(b"1234", 0.5))
            raise RuntimeError("unplugged")

    with pytest.raises(RuntimeError):
        ended()
    assert (tmp_path / "x.usb").read_bytes().endswith(b"1234")


def test_a_temporary_name_cannot_be_guessed(tmp_path):
    names = {Unfinished(tmp_path / "a.npy").part.name for _ in range(100)}
    assert len(names) == 100
    assert all(re.fullmatch(r"\.a\.part\d+-[0-9a-f]{16}\.npy", name) for name in names)


def test_bytes_are_on_the_disk_before_their_name(tmp_path, monkeypatch):
    done = []
    monkeypatch.setattr(os, "fsync", lambda number: done.append(
        os.fstat(number).st_size))
    with write_beside(tmp_path / "a") as part:
        part.write_bytes(b"whole")
        assert done == []
    assert done == [5]


def test_a_descriptor_that_was_closed_is_not_written_again(tmp_path):
    events = as_events({name: np.full(9, k) for name, k in zip(
        "txyp", (5, 3, 4, 1), strict=True)})
    writer = Aedat4Writer(tmp_path / "a.aedat4", sensor_size=(12, 14))
    writer.add(Packet(events))
    number = writer._file.fileno()
    os.close(number)

    def rest(writer):
        for k in range(1, 10_000):
            later = events.copy()
            later["t"] += 10**6 * k
            writer.add(Packet(later))

    with pytest.raises(OSError, match="Bad file descriptor"):
        rest(writer)
    other = os.open(tmp_path / "other", os.O_CREAT | os.O_RDWR)
    assert other == number      # as any program may get it
    del writer
    gc.collect()
    assert os.fstat(other).st_size == 0
    os.close(other)
    assert [one.name for one in tmp_path.iterdir()] == ["other"]


def test_a_demo_without_room_leaves_no_half_recording(tmp_path, monkeypatch, capsys):
    def copied(source, path):
        path.write_bytes(source.read_bytes()[:999])
        raise OSError(errno.ENOSPC, "full")

    monkeypatch.setattr("shutil.copyfile", copied)
    assert main(["demo", "-o", str(tmp_path / "demo")]) == 1
    assert list((tmp_path / "demo").iterdir()) == []
    assert "fan.aedat4: full" in capsys.readouterr().err


@pytest.mark.parametrize("failing", ["write", "seek", "readinto", "truncate"])
def test_hdf5_survives_a_file_that_fails(failing, tmp_path):
    pytest.importorskip("h5py")
    code = f"""if True:
    import errno, gc, numpy
    from pathlib import Path
    from pdavis_cv.recording.hdf5 import sink
    class Failing:
        def __init__(self, file):
            self.file = file
        def __getattr__(self, name):
            def call(*values):
                Failing.count += name == {failing!r}
                if Failing.count >= after:
                    raise OSError(errno.ENOSPC, "full")
                return found(*values)
            found = getattr(self.file, name)
            return found if name == "close" else call
    made = sink._Sink.__init__
    def init(self, path):
        made(self, path)
        self._file = Failing(self._file)
    sink._Sink.__init__ = init
    for after in (1, 3, 9, 30):
        Failing.count = 0
        try:
            with sink.written(Path({str(tmp_path)!r}, str(after))) as file:
                for k in range(20):
                    file.create_dataset(str(k), data=numpy.arange(9),
                                        compression="gzip")
                    file.attrs[str(k)] = "text"
        except OSError as error:
            assert error.errno == errno.ENOSPC
        else:
            assert Failing.count < after
        gc.collect()
        print("alive after", after)
    """
    done = subprocess.run([sys.executable, "-P", "-c", code], capture_output=True,
                          text=True, timeout=60, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (
        0, "".join(f"alive after {n}\n" for n in (1, 3, 9, 30)), "")
