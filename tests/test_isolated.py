"""A file that another process reads, which can do nothing else."""
import mmap
import os
import pickle
import resource
import signal
import textwrap

import numpy as np
import pytest
from streams import random_events
from test_aedat4 import joined
from test_aedat4_writer import small

from pdavis_cv import (
    EVENT_DTYPE,
    LayoutError,
    Limits,
    PdavisWarning,
    RecordingError,
    open_recording,
    recording_from_arrays,
    write_aedat4,
)
from pdavis_cv.recording import isolated, isolated_reader, sandbox, wire
from pdavis_cv.recording.packetise import Batch
from pdavis_cv.recording.registry import writer_for
from pdavis_cv.tools.main import main

pytestmark = pytest.mark.skipif(not sandbox.available(), reason="Linux 5.13")

READER = '''
import os, socket, subprocess, sys, tempfile, warnings
from pathlib import Path
import numpy as np
from pdavis_cv import FileRecording, PdavisWarning, RecordingInfo
from pdavis_cv.recording.format import Format


class Reader(FileRecording):
    def _open(self, options):
        exec(self._path.read_text())
        return RecordingInfo(format="bad", sensor_size=(4, 4))

    def packets(self, start_us=None, stop_us=None):
        yield from ()


BAD = Format(name="bad", title="Bad", magic=(b"# bad",), reader="bad_events:Reader")
'''


@pytest.fixture
def reads(tmp_path, monkeypatch):
    """Return a function that opens a file whose reader does what the file says."""
    facts = tmp_path / "site/bad-1.0.dist-info"
    facts.mkdir(parents=True)
    (tmp_path / "site/bad_events.py").write_text(READER)
    (facts / "METADATA").write_text("Metadata-Version: 2.1\nName: bad\nVersion: 1.0\n")
    (facts / "entry_points.txt").write_text(
        "[pdavis_cv.formats]\nbad = bad_events:BAD\n")
    monkeypatch.syspath_prepend(str(tmp_path / "site"))

    def opened(code, **options):
        path = tmp_path / "there/x.bad"
        path.parent.mkdir(exist_ok=True)
        path.write_text("# bad\n" + textwrap.dedent(code))
        return open_recording(path, isolated=True, **options)
    return opened


def same(one, other, *window):
    """Assert that two recordings give the same packets in a window."""
    assert one.info == other.info
    assert one.name == other.name
    assert [m.path.name for m in one.members] == [m.path.name for m in other.members]
    for a, b in zip(one.packets(*window), other.packets(*window), strict=True):
        for name in ("events", "imu", "triggers"):
            got, want = getattr(a, name), getattr(b, name)
            np.testing.assert_array_equal(got, want)
            assert got.dtype == want.dtype
            assert got.flags.writeable
        for got, want in zip(a.frames, b.frames, strict=True):
            for name in ("exposure_start_us", "exposure_end_us", "available_us",
                         "full_scale_dn", "valid", "reset", "signal", "dn"):
                np.testing.assert_array_equal(
                    getattr(got, name), getattr(want, name))
        assert a.until_us == b.until_us
    assert one.problems == other.problems


@pytest.mark.parametrize("suffix", [
    "aedat4", "h5", "raw", "es", "csv", "npy", "parquet", "mcap"])
def test_what_is_read_is_the_same(tmp_path, suffix):
    path = tmp_path / f"x.{suffix}"
    writer_for(path)[1](path, small())
    with open_recording(path) as here, open_recording(path, isolated=True) as there:
        same(there, here)
        whole = here.events()
        t = whole["t"][len(whole) // 2]
        np.testing.assert_array_equal(there.events(t), whole[whole["t"] >= t])
        for window in ((t - 1, t + 1), (None, t), (t, t + 20_000), (-9, -3)):
            same(there, here, *window)
        with pickle.loads(pickle.dumps(there)) as again:
            assert len(again.events()) == len(whole)


def test_no_events_leave_the_place_of_others():
    shared = wire.Shared(mmap.mmap(-1, 9 + 2 * wire.ROOM))
    one = shared.room(5)
    for events in (one, shared.room(0)):
        shared.keep(events)
    for turns in range(3):
        assert np.shares_memory(one, shared.room(5)) == (turns == 2)
        shared.turn()
    shared.room(5)[:] = np.ones(5, EVENT_DTYPE)
    assert not shared.bytes[:9].any()


@pytest.mark.parametrize("suffix", ["raw", "aedat4"])
def test_more_than_an_answer_is_the_same_and_not_copied(tmp_path, suffix):
    events = random_events(700_000, (48, 48), seed=3, start_us=0, stop_us=900_000)
    path = tmp_path / f"x.{suffix}"
    writer_for(path)[1](path, recording_from_arrays(events, sensor_size=(48, 48)))
    with open_recording(path) as here, open_recording(path, isolated=True) as there:
        same(there, here)
        shared = wire.Shared(mmap.mmap(-1, 2 * wire.ROOM))
        for batches in isolated_reader._answers(here, shared, None, None):
            wire.written(batches, shared)   # no byte is free for copies


def test_real_files_are_the_same(data_dir):
    for name, given in (
            ("stereo.aedat4", {"camera": "00000002"}), ("v2e_240x180.aedat", {}),
            ("davis_ros2", {}), ("vfr.mkv", {"layout": "sony"})):
        path = data_dir / "public" / name
        with open_recording(path, **given) as here, open_recording(
                path, isolated=True, **given) as there:
            same(there, here)


def test_an_answer_is_one_batch_and_its_events_are_not_copied():
    """Each batch costs more than what it holds, such as a packet of AEDAT-4."""
    memory = wire.Shared(mmap.mmap(-1, (1 << 20) + 2 * wire.ROOM))
    events = random_events(1000, (12, 16), seed=1)

    def batches(gap):
        for k in range(10):
            room = memory.room(100)
            room[:] = events[100 * k:100 * k + 100]
            yield Batch(room[3:] if k == gap else room, complete_us=k)

    def answer(gap):
        found = []
        for one in batches(gap):
            memory.keep(one.events)
            found.append(one)
        return isolated_reader._as_one(found, memory)

    whole = answer(None)
    np.testing.assert_array_equal(whole.events, events)
    assert memory.place(whole.events) is not None
    assert whole.complete_us == 9
    memory.turn()
    np.testing.assert_array_equal(answer(4).events, np.delete(events, range(400, 403)))


def test_arrays_that_do_not_fit_are_an_error():
    shared = wire.Shared(mmap.mmap(-1, 1000 + 2 * wire.ROOM))
    wire.written([np.zeros(500, "u1")] * 2, shared)
    with pytest.raises(MemoryError):
        wire.written([np.zeros(500, "u1"), np.zeros(501, "u1")], shared)


@pytest.mark.parametrize("text", [
    "[", '{"Batch": [1]}', '{"Batch": [1, [], null, null, 0]}',
    '{"Batch": [{"array": [3, [9], 0, true]}, [], null, null, 0]}',
    '{"Batch": [{"array": [0, [1, 1], 0, true]}, [], null, null, 0]}',
    '{"Batch": [null, [7], null, null, 0]}', '{"Batch": [null, [], null, null, "x"]}',
    '{"array": [0, [1, -1], 0, true]}', '{"array": [99, [1], 0, true]}',
    '{"array": [0, [1000000000000000], 0, true]}', '{"array": 1}', '{"Path": []}',
    '{"Packet": [["x", 1]]}', '{"tuple": [], "dict": []}', '{"dict": [[[], 1]]}', "{}",
    "[" * 100_000, f'{{"array": [0, [{2**70}], 0, true]}}'])
def test_what_is_no_answer_is_refused(text):
    with pytest.raises((ValueError, TypeError, LookupError, ArithmeticError,
                        AttributeError, RecursionError, MemoryError)):
        wire.read(text.encode(), memoryview(bytearray(100)))


def test_memory_is_not_mapped_anew_for_each_packet(tmp_path):
    events = np.zeros(2_000_000, EVENT_DTYPE)
    events["t"] = np.arange(len(events)) // 4
    path = tmp_path / "x.aedat4"
    write_aedat4(path, recording_from_arrays(events, sensor_size=(4, 4)))
    with open_recording(path, isolated=True) as recording:
        before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
        size = sum(packet.events.nbytes for packet in recording.packets())
        pages = resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before
    assert size == events.nbytes
    assert pages < size / resource.getpagesize() / 2


def test_windows_are_read_in_turns(tmp_path):
    write_aedat4(tmp_path / "x.aedat4", small())
    with open_recording(tmp_path / "x.aedat4", isolated=True) as recording:
        whole = joined(recording.packets())[0]
        one, two = recording.packets(), recording.packets()
        parts = [[], []]
        for pair in zip(one, two, strict=True):
            for part, packet in zip(parts, pair, strict=True):
                part.append(packet.events)
        for part in parts:
            np.testing.assert_array_equal(np.concatenate(part), whole)
        next(recording.packets())   # and one that is left


@pytest.mark.parametrize("code", [
    "Path('{outside}/secret').read_text()", "os.listdir('{outside}')",
    "Path('{outside}/made').write_text('x')", "(self._path.parent / 'y').touch()",
    "os.unlink('{outside}/secret')", "socket.create_connection(('127.0.0.1', 9))",
    "socket.socket(socket.AF_UNIX)", "subprocess.run(['/bin/true'])",
    "os.truncate(self._path, 0)"])
def test_it_reaches_nothing_else(reads, tmp_path, code):
    (tmp_path / "outside").mkdir()
    (tmp_path / "outside/secret").write_text("secret")
    with pytest.raises(RecordingError, match=r"ermission denied|not permitted"):
        reads(code.replace("{outside}", str(tmp_path / "outside")))
    assert (tmp_path / "outside/secret").exists()


def test_it_writes_to_temporary_files_which_go_with_it(reads):
    with pytest.warns(PdavisWarning) as caught:
        recording = reads("""
            place = Path(tempfile.mkdtemp()) / "x"
            place.write_bytes(bytes(1000))
            warnings.warn(str(place.parent), PdavisWarning)
            """)
    folder = str(caught[0].message)
    with recording:
        assert os.path.isdir(folder)
    assert not os.path.exists(folder)


@pytest.mark.parametrize(("code", "message"), [
    ("bytearray(4 << 30)", "limit memory="),
    ("while True: pass", "took too much time"),
    ("os.abort()", "died .SIGABRT"),
    ("os._exit(1)", "process that reads it ended"),
    ("1 / 0", "division by zero"),
    ("try: bytearray(4 << 30)\nexcept MemoryError as error:\n"
     "    raise ValueError from error", "limit memory="),
    ("for fd in range(3, 999):\n    try: os.write(fd, bytes([0, 0, 0, 4]) + b'junk')\n"
     "    except OSError: pass", "sent no answer"),
    ("t = b'{\"array\": [0, [%d], 0, true]}' % 2**70\nfor fd in range(3, 999):\n"
     "    try: os.write(fd, bytes(3) + bytes([len(t)]) + t)\n"
     "    except OSError: pass", "sent no answer"),
    ("for fd in range(3, 999):\n    try: os.write(fd, 8 * bytes([127]))\n"
     "    except OSError: pass\nimport time; time.sleep(60)", "it ended")])
def test_a_reader_that_fails_is_an_error(reads, monkeypatch, code, message):
    monkeypatch.setattr(isolated, "_SECONDS", 0.5)
    with pytest.raises(RecordingError, match=message):
        reads(code, limits=Limits(memory=64 << 20))


def test_errors_are_of_their_class(tmp_path):
    write_aedat4(tmp_path / "x.aedat4", small())
    for kind, given in ((TypeError, {"bits": 10}), (LayoutError, {"layout": "x"})):
        with pytest.raises(kind):
            open_recording(tmp_path / "x.aedat4", isolated=True, **given)
    with pytest.raises(RecordingError, match="cannot be opened: No such file"):
        open_recording(tmp_path / "none", isolated=True)
    with pytest.raises(RecordingError, match="without network"):
        open_recording("s3://bucket/x.aedat4", isolated=True)
    recording = open_recording(tmp_path / "x.aedat4", isolated=True)
    recording.close()
    with pytest.raises(ValueError, match="recording is closed"):
        next(recording.packets())


@pytest.mark.parametrize("dead", [False, True])
def test_a_process_that_dies_later_is_an_error(tmp_path, dead):
    write_aedat4(tmp_path / "x.aedat4", small())
    with open_recording(tmp_path / "x.aedat4", isolated=True) as recording:
        os.kill(recording._process.pid, signal.SIGKILL)
        if dead:
            os.waitid(os.P_PID, recording._process.pid, os.WEXITED | os.WNOWAIT)
        with pytest.raises(RecordingError, match=r"died .SIGKILL"):
            recording.events()


@pytest.mark.parametrize("most", ["1e9", "9e17"])
def test_a_command_isolates(tmp_path, capsys, most):
    write_aedat4(tmp_path / "x.aedat4", small())
    assert main(["info", "--isolated", f"--limits=memory={most}",
                 str(tmp_path / "x.aedat4")]) == 0
    assert "AEDAT-4" in capsys.readouterr().out
