"""Live sources and the session: the same bits as a file, and nothing that waits."""
import dataclasses
import signal
import subprocess
import sys
import tempfile
import threading
import time
import warnings

import numpy as np
import pytest
from link_faults import FaultySource
from streams import METHODS, assert_same, random_events, random_frame, turning_polarizer

import pdavis_cv
from pdavis_cv import (
    EVENT_DTYPE,
    DeviceError,
    Layout,
    Packet,
    RecordingError,
    fuse,
    open_source,
)
from pdavis_cv.data import example_recording
from pdavis_cv.fusion import Fusion
from pdavis_cv.fusion.learning import Learning
from pdavis_cv.live import LiveSource, Session, inbox
from pdavis_cv.live.base import endless
from pdavis_cv.live.clock import HostClock, in_order
from pdavis_cv.live.inbox import Inbox, Waiting
from pdavis_cv.live.replay import PIECE_US, ReplaySource, pieces
from pdavis_cv.live.statistics import Patience
from pdavis_cv.reconstruct.frames import FrameHold
from pdavis_cv.recording.files import ProblemLog

OPTIONS = {"layout": Layout.PDAVIS, "nominal_thresholds": (0.16, 0.18), "fps": 60}
PATIENCE_S = 60     # longer than a loaded machine takes; nothing is asserted of time


@pytest.fixture(scope="module")
def recording():
    return turning_polarizer()


def device(recording, *, speed=0.0, realtime=None, faults=None, **options):
    source = ReplaySource(recording, "test", speed=speed, **options)
    if realtime is not None:
        source.realtime = realtime
    return source if faults is None else FaultySource(source, **faults)


@pytest.mark.filterwarnings("ignore::UserWarning")     # long windows of a network
@pytest.mark.parametrize("method", METHODS, ids=str)
def test_live_images_are_those_of_the_file_to_the_bit(recording, method):
    options = {**OPTIONS, **method}
    expected = list(fuse(recording, causal=True, **options))
    with Session(device(recording), **options) as session:
        assert_same(list(session), expected)
    with Session(recording.info, **options) as session:
        assert_same([image for packet in recording.packets()
                     for image in session.push(packet)], expected)


def test_push_gives_images_as_soon_as_they_are_known(recording):
    with Session(recording.info, **OPTIONS, method="cf") as session:
        for packet in recording.packets():
            for image in session.push(packet):
                known = packet.start_us > 50_000    # the first frame begins it all
                assert not known or packet.start_us - 1e6 / 60 <= image.t_us
                assert image.t_us < packet.stop_us
        assert session.stats.state == "running"
        last = session.latest()[1].t_us
        until = last + 200_000
        dark = session.push(Packet(until_us=until))
        assert [i.t_us for i in dark][-1] > until - 1e6 / 60
    with pytest.raises(ValueError, match="push after close"):
        session.push(Packet())


@pytest.mark.parametrize("pause_s", [600, 10**8])     # three years, of one wrong time
def test_push_after_a_pause_returns_the_last_second(recording, pause_s):
    with Session(recording.info, **OPTIONS, method="cf") as session:
        for packet in recording.packets():
            session.push(packet)
        last = session.latest()[1].t_us
        until = last + pause_s * 10**6
        images = session.push(Packet(until_us=until))
        assert len(images) == 64
        assert images[-1].t_us > until - 1e6 / 60
        assert session.stats.skipped_images + len(images) == pytest.approx(
            pause_s * 60, abs=2)


def test_push_needs_a_session_without_a_source(recording):
    with Session(device(recording), **OPTIONS) as session, pytest.raises(
            ValueError, match="push needs a session made of a RecordingInfo"):
        session.push(Packet())
    with Session(recording.info, **OPTIONS) as session, pytest.raises(
            ValueError, match="images come from push"):
        session.read()


def test_options_are_checked_before_anything_runs(recording):
    before = threading.active_count()
    with pytest.raises(TypeError, match="no parameter 'nonsense'"):
        Session(device(recording), **OPTIONS, nonsense=1)
    with pytest.raises(ValueError, match="method must be one of"):
        Session(device(recording), **OPTIONS, method="magic")
    assert threading.active_count() == before


# ---- faults ----------------------------------------------------------------------


def test_a_device_that_is_gone_is_told_after_the_last_image(recording):
    source = device(recording, faults={"unplug": 0.5})
    with Session(source, **OPTIONS, method="cf") as session:
        images = []
        with pytest.raises(DeviceError, match="the device is gone: plug it in"):
            images.extend(session)
        assert len(images) > 10
        assert (session.stats.state, "gone" in session.stats.error) == ("failed", True)


def test_a_clock_that_is_reset_begins_a_segment(recording):
    shifted = pdavis_cv.recording_from_arrays(
        moved_events(recording.events(), 5_000_000), sensor_size=(8, 8))
    source = device(shifted, faults={"reset": 0.5})
    last = 0
    for packet in source.packets():
        if packet.start_us is not None:
            assert packet.start_us >= last
            last = packet.stop_us - 1
    assert [problem.kind for problem in source.problems] == ["segment"]


def moved_events(events, by_us):
    events = events.copy()
    events["t"] += by_us
    return events


def test_samples_that_come_late_are_dropped_and_counted():
    events = random_events(100, (8, 8), read_only=False)
    log = ProblemLog("test")
    packets = [Packet(events[50:].copy()), Packet(events[:50].copy()),
               Packet(until_us=2_000_000)]
    given = list(in_order(iter(packets), log))
    assert sum(len(packet.events) for packet in given) == 50
    assert [(p.kind, p.count) for p in log.problems] == [("backward time", 50)]


def test_what_no_clock_reaches_is_dropped_and_counted():
    """Behind a wild time that others seem to be a reset of."""
    events = random_events(10, (8, 8), read_only=False)
    far = moved_events(events, 2**61 - 1000 - int(events["t"][-1]))
    frame = pdavis_cv.ApsFrame(np.ones((8, 8), np.float32), 0, 10, available_us=2**60)
    log = ProblemLog("test")
    given = list(in_order(iter([Packet(far), Packet(events, (frame,))]), log))
    assert len(given) == 1
    assert [p.kind for p in log.problems] == ["segment", "backward time"]


def test_a_time_before_all_clocks_is_dropped_and_counted():
    """To move it behind what came before it would need more than 64 bits."""
    events = random_events(10, (8, 8), read_only=False)
    early = events.copy()
    early["t"] = -2**63
    log = ProblemLog("test")
    given = list(in_order(iter([
        Packet(events), Packet(early),
        Packet(moved_events(events, int(events["t"][-1])))]), log))
    assert [len(packet.events) for packet in given] == [10, 10]
    assert [p.kind for p in log.problems] == ["backward time"]


class Flooding(LiveSource):
    """A device whose clock hardly runs for a while."""

    def _arrivals(self):
        yield Packet(frames=(random_frame((8, 8), 0),))
        for time_us in (20_000, 90_000):
            for i in range(1_000):
                events = np.zeros(100, EVENT_DTYPE)
                events["t"] = time_us + i // 400
                yield Packet(events)
        yield Packet(until_us=200_000)


@pytest.mark.parametrize("how", ["fuse", "session", "push"])
def test_what_no_camera_sends_in_its_time_is_dropped_and_counted(
        recording, monkeypatch, how):
    monkeypatch.setattr(inbox, "MOST_BYTES", 200_000)
    info = dataclasses.replace(endless(recording.info), sensor_size=(8, 8))
    with Flooding(info, "test") as source:
        if how == "fuse":
            images = list(fuse(source, **OPTIONS, method="cf", causal=True))
            found = source.problems
        elif how == "session":
            with Session(source, **OPTIONS, method="cf") as session:
                images = list(session)
            found = source.problems
        else:
            with Session(info, **OPTIONS, method="cf") as session:
                images = [image for packet in source._arrivals()
                          for image in session.push(packet)]
                found = session.problems
        [flood] = [one for one in found if one.kind == "flood"]
    # Of 2,300 bytes each, with its objects; a microsecond makes room for 1,000.
    assert flood.count == 100 * 2 * (1_000 - (200_000 + 2 * 1_000) // 2_300)
    assert images[-1].t_us > 150_000    # a busy machine skips some of a session


def test_a_stream_s_problems_are_counted_and_not_kept():
    late = [Packet(random_events(20, (8, 8), seed=seed)) for seed in range(50)]
    log = ProblemLog("test")
    given = sum(len(packet.events) for packet in in_order(iter(late), log))
    [problem] = log.problems
    assert (problem.kind, problem.count) == ("backward time", 1000 - given)
    assert not log._seen            # a stream may last for days


def test_darkness_does_not_stop_images(recording):
    source = device(recording, speed=5, faults={"dark": 0.4})
    with Session(source, **OPTIONS, method="cf") as session:
        times = [image.t_us for image in session]
    assert times[-1] > 800_000


def test_lost_packets_and_bursts_are_survived(recording):
    faults = {"drop": 0.3, "burst": 0.5}
    arrived = sum(len(p.events) for p in device(recording, faults=faults).packets())
    assert arrived > 1_000_000
    source = device(recording, faults={"drop": 0.3})
    with Session(source, **OPTIONS, method="cf") as session:
        assert len(list(session)) > 10


# ---- late ------------------------------------------------------------------------


def test_what_waits_too_long_is_dropped_but_for_its_last_frame():
    log = ProblemLog("test")
    inbox = Inbox(True, log, waits=False)
    events = random_events(1000, (8, 8))
    for start in range(0, 1000, 100):
        part = events[start:start + 100]
        t = int(part["t"][-1])
        inbox.put(Packet(part, (random_frame((8, 8), t - 7_000),)))
    given = []
    with pytest.raises(Waiting):
        given.extend(inbox)
    kept = sum(len(packet.events) for packet in given)
    assert inbox.jumps == 1
    assert kept + inbox.dropped_events == 1000
    assert len(given[0].frames) == 1
    assert not len(given[0].events)
    assert [(p.kind, p.count) for p in log.problems] == [
        ("too slow", inbox.dropped_events)]


class Stuck(FrameHold):
    """A method that takes its first frame only when it is allowed to."""

    go = threading.Event()

    def add_frame(self, frame):
        assert self.go.wait(PATIENCE_S)
        super().add_frame(frame)


def test_reading_never_waits_for_fusing(recording, tmp_path):
    """A stuck method loses events; the recording has them all, and time goes on."""
    Stuck.go.clear()
    source = device(recording, realtime=True)
    path = tmp_path / "all.aedat4"
    with Session(source, **OPTIONS, method=Stuck, record=path) as session:
        for thread in session._threads[:1]:
            thread.join(PATIENCE_S)            # the reader has read everything
            assert not thread.is_alive()
        assert session.stats.jumps >= 1
        Stuck.go.set()
        images = list(session)
        assert session.stats.dropped_events > 0
    assert images[-1].t_us > 900_000
    with pdavis_cv.open_recording(path, layout=Layout.PDAVIS) as written:
        np.testing.assert_array_equal(written.events(), recording.events())


def test_images_go_on_while_the_camera_is_being_estimated(recording, monkeypatch):
    done, asked = threading.Event(), threading.Event()
    estimate, thread = Learning.estimate, []

    def slow(learning, *given):
        thread.append(threading.current_thread().name)
        asked.set()
        assert done.wait(PATIENCE_S)
        return estimate(learning, *given)

    monkeypatch.setattr(Learning, "estimate", slow)
    source = device(recording, speed=1.0, loop=True)
    with Session(source, **OPTIONS, method="kalman") as session:
        first = session.read(PATIENCE_S).t_us
        # It is due .56 s after the first frame.
        while session.read(PATIENCE_S).t_us < first + 1_500_000:
            assert not done.is_set()
        assert asked.is_set()
        done.set()
    assert set(thread) == {"pdavis-learning_0"}


def test_nothing_is_read_before_the_method_is_ready(recording, monkeypatch):
    order = []

    class Watched(ReplaySource):
        def packets(self):
            order.append("read")
            return super().packets()

    prepare = Fusion.prepare
    monkeypatch.setattr(Fusion, "prepare", lambda fusion: (
        prepare(fusion), order.append("ready"))[0])
    with Session(Watched(recording, "test", speed=0.0), **OPTIONS) as session:
        assert session.read(PATIENCE_S) is not None
    assert order[:2] == ["ready", "read"]


def test_jumps_count_where_they_come_soon_after_each_other():
    patience = Patience()
    patience.image_at(100.0)
    assert not patience.spent(3, 101.0)     # the camera is being learned
    times = [110.0, 125.0, 141.0, 142.0, 143.0, 144.0]
    assert [patience.spent(4 + i, t) for i, t in enumerate(times)] == [
        False, False, False, True, False, False]
    assert not patience.spent(9, 150.0)


def test_a_method_of_our_choice_is_exchanged_for_one_that_keeps_up(
        recording, monkeypatch):
    late = iter([False, True])      # after the first image, whatever the machine does
    monkeypatch.setattr("pdavis_cv.live.statistics.Patience.spent",
                        lambda *_: next(late, False))
    with Session(device(recording, realtime=True), **OPTIONS) as session:
        list(session)
        assert session.stats.method == "cf"
        assert "cheaper method" in [problem.kind for problem in session.problems]


def test_closing_ends_everything_at_once(recording):
    source = device(recording, speed=0.01)
    session = Session(source, **OPTIONS, method="cf")
    with pytest.raises(TimeoutError, match="no image for 0 s"):
        session.read(timeout=0)
    reader = threading.Thread(target=session.read)
    reader.start()
    session.close()
    reader.join(PATIENCE_S)
    assert not reader.is_alive()
    assert not any(thread.is_alive() for thread in session._threads)
    assert session.read() is None
    session.close()


def test_options_can_be_changed_while_it_runs(recording):
    with Session(device(recording), **OPTIONS, method="cf") as session:
        session.read()
        with pytest.raises(ValueError, match="roi"):
            session.change(roi=(0, 0, 99, 2))
        session.change(method="frames", roi=(0, 0, 4, 2))
        assert [image.s0.shape for image in session][-1] == (2, 4)
        assert session.stats.method == "frames"


def test_events_of_an_image_are_kept_for_a_picture_of_them(recording):
    with Session(recording.info, **OPTIONS, method="events") as session:
        for packet in recording.packets():
            session.push(packet)
        np.testing.assert_array_equal(
            session.events(900_000, 950_000), recording.events(900_001, 950_001))


def test_latency_is_of_real_time_whatever_the_speed(recording):
    with Session(device(recording, speed=4), **OPTIONS, method="cf") as session:
        list(session)
        last_us = recording.events()["t"][-1]
        assert session.clock.host_s(int(last_us) // 4) <= time.monotonic()


# ---- clocks ----------------------------------------------------------------------


def test_the_clock_is_that_of_the_least_delayed_packet():
    rng = np.random.default_rng(0)
    clock = HostClock(window_s=1.0)
    for k in range(5000):
        device_s = k * 1e-3
        host_s = 7.0 + device_s * (1 + 50e-6) + rng.exponential(2e-3)
        clock.saw(round(device_s * 1e6), host_s)
    assert clock.host_s(4_999_000) == pytest.approx(7.0 + 4.999, abs=5e-4)
    assert clock.drift_ppm == pytest.approx(50, abs=10)


# ---- recording -------------------------------------------------------------------


def test_what_arrives_is_recorded_to_the_last_sample(recording, tmp_path):
    path = tmp_path / "live.aedat4"
    with Session(device(recording), record=path, **OPTIONS, method="frames") as session:
        list(session)
    with pdavis_cv.open_recording(path, layout=Layout.PDAVIS) as written:
        np.testing.assert_array_equal(written.events(), recording.events())
        for one, two in zip(frames_of(written), frames_of(recording), strict=True):
            np.testing.assert_array_equal(one.dn, np.maximum(np.rint(two.dn), 0))


@pytest.mark.parametrize("span_us", [1, 2_000, 2_001, 9_000, 10**12])
def test_pieces_hold_what_falls_into_each_two_milliseconds(span_us):
    for seed in range(20):
        events = random_events(seed, (8, 8), seed=seed, start_us=5, stop_us=5 + span_us)
        frames = tuple(
            random_frame((8, 8), t - 7_000) for t in (5 + span_us // 3,) * (seed % 2))
        packet = Packet(events, frames)
        found = list(pieces(packet))
        times = [*events["t"].tolist(), *(frame.available_us for frame in frames)]
        numbers = sorted({(t - min(times)) // PIECE_US for t in times})
        assert len(found) == len(numbers)
        for number, piece in zip(numbers, found, strict=True):
            own = (events["t"] - min(times, default=0)) // PIECE_US == number
            np.testing.assert_array_equal(piece.events, events[own])
            assert piece.frames == tuple(
                frame for frame in frames
                if (frame.available_us - min(times)) // PIECE_US == number)


def test_packets_that_wait_are_handed_out_as_one_of_ten_milliseconds():
    events = random_events(900, (8, 8), stop_us=30_000)
    parts = [events[i:i + 30] for i in range(0, 900, 30)]
    inbox = Inbox(True, ProblemLog("test"), waits=False)
    for part in parts:
        inbox.put(Packet(part, (random_frame((8, 8), 1_000),) if part is parts[1]
                         or part is parts[2] else ()))
    inbox.put(Packet(until_us=31_000))
    given = []
    with pytest.raises(Waiting):
        given.extend(inbox)
    np.testing.assert_array_equal(
        np.concatenate([packet.events for packet in given]), events)
    assert len(given) <= 6
    assert all(len(packet.frames) <= 1 for packet in given)
    assert max(packet.stop_us - packet.start_us
               for packet in given if len(packet.events)) <= 10_000
    assert given[-1].until_us == 31_000


def frames_of(recording):
    return [frame for packet in recording.packets() for frame in packet.frames]


def test_a_killed_process_leaves_a_recording_that_can_be_read(tmp_path):
    script = f"""
import os, signal
from pdavis_cv import Layout, open_source
from pdavis_cv.live import Session
source = open_source({f'replay:{example_recording()}?speed=0'!r})
session = Session(source, method="frames", layout=Layout.PDAVIS,
                  record={str(tmp_path / 'run.aedat4')!r})
list(session)
while session.stats.recorded_events < 2000:
    pass
os.kill(os.getpid(), signal.SIGKILL)
"""
    ended = subprocess.run([sys.executable, "-P", "-c", script], check=False)
    assert ended.returncode == -signal.SIGKILL
    left, = tmp_path.iterdir()
    with warnings.catch_warnings():   # the last packet may be half there
        warnings.simplefilter("ignore", pdavis_cv.DamagedFileWarning)
        with pdavis_cv.open_recording(left, layout=Layout.PDAVIS) as written:
            events = written.events()
    with pdavis_cv.open_recording(example_recording(), layout=Layout.PDAVIS) as whole:
        np.testing.assert_array_equal(events, whole.events()[:len(events)])
    assert len(events) >= 2000


def test_a_full_disk_is_a_problem_and_images_go_on(recording, tmp_path, monkeypatch):
    path = tmp_path / "full.aedat4"
    session = Session(device(recording), record=path, **OPTIONS, method="cf")
    flushed = []

    def full():
        flushed.append(1)
        if len(flushed) > 3:
            raise OSError(28, "No space left on device")

    monkeypatch.setattr(session._recorder._writer, "flush", full)
    with session:
        assert len(list(session)) > 50
        session.record(None)
        assert "No space left" in session.stats.recording_error
        assert session.stats.unrecorded_events > 0
        assert "not recorded" in [problem.kind for problem in session.problems]
    left, = tmp_path.iterdir()
    with pdavis_cv.open_recording(left, layout=Layout.PDAVIS) as written:
        assert 0 < len(written.events()) < len(recording.events())


# ---- addresses -------------------------------------------------------------------


def test_a_simulated_camera_repeats_one_turn_with_times_that_go_on():
    where = "simulate:polarizer?size=2x2&rpm=600&seconds=0.5&speed=0"
    with open_source(where) as source:
        events = [packet.events for packet in source.packets()]
    turn = [np.concatenate(events)["t"] // 100_000]
    counts = np.bincount(turn[0], minlength=5)
    assert len(counts) == 5
    assert np.all(counts == counts[0])


def test_an_address_that_is_not_understood_says_why(tmp_path):
    example = example_recording()
    for where, message in [
            ("replay:", "a file must follow the colon"),
            (f"replay:{example}?speed=x", "speed must be a number, got 'x'"),
            (f"replay:{example}?speed=-1", "speed must not be negative"),
            (f"replay:{example}?seconds=0", "seconds must be positive"),
            (f"replay:{example}?sped=1", "there is no 'sped'"),
            ("simulate:sun", "scene must be one of polarizer"),
            ("simulate:fan?size=4", "size must be WIDTHxHEIGHT"),
            ("simulate:fan?camera=mine", "mine")]:
        with pytest.raises(DeviceError, match=message):
            open_source(where)
    with pytest.raises(RecordingError):
        open_source(f"replay:{tmp_path / 'none.aedat4'}")


def test_a_recording_and_a_source_open_as_what_they_are(recording):
    assert open_source(recording) is recording
    with open_source(example_recording()) as opened:
        assert isinstance(opened, pdavis_cv.Recording)


def test_a_live_source_is_read_once(recording):
    source = device(recording)
    list(source.packets())
    with pytest.raises(RecordingError, match="can be called once"):
        source.packets()
    source.close()
    with pytest.raises(ValueError, match="source is closed"):
        source.packets()


def test_fuse_takes_a_live_source(recording):
    images = list(fuse(device(recording), method="cf", **OPTIONS))
    assert_same(images, list(fuse(recording, method="cf", **OPTIONS)))


def test_commands_take_an_address(capsys, tmp_path, monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    from pdavis_cv.tools.main import main
    where = f"replay:{example_recording()}?speed=0"
    assert main(["info", where, "--scan"]) == 0
    said = capsys.readouterr().out
    assert main(["info", str(example_recording()), "--scan"]) == 0
    of_file = capsys.readouterr().out
    for word in ("events", "frames"):
        line, = (line for line in of_file.splitlines() if line.split()[0] == word)
        assert line.split()[1] in said
    assert not list(tmp_path.iterdir())


@pytest.mark.accuracy
def test_a_simulated_fan_is_all_seen_and_measured_in_most_pixels():
    with pdavis_cv.open_source("simulate:fan?rpm=600&seconds=.2&speed=0") as source:
        images = list(pdavis_cv.fuse(source, fps=50))
    assert images[-1].valid.mean() > 0.9
    wheel = images[-1].dolp[2:-2, 2:-2] > 0.5     # polarized left, right, above, below
    assert wheel[18:30, :12].any()
    assert wheel[18:30, -12:].any()
    assert wheel[:12].any()
    assert wheel[-12:].any()
