"""dv's network protocol, in and out, against dv_processing in a process of its own."""
import contextlib
import itertools
import json
import socket
import struct
import subprocess
import sys
import threading
import types

import numpy as np
import pytest
from streams import random_events

from pdavis_cv import (
    ApsFrame,
    DeviceError,
    Layout,
    Packet,
    open_source,
    recording_from_arrays,
)
from pdavis_cv.live import DvServer
from pdavis_cv.live.dv import DvSource
from pdavis_cv.live.dv_server import MOST_BYTES, _Client
from pdavis_cv.recording.aedat4.writer import EVENTS, FRAMES, StreamEncoder
from pdavis_cv.tools.main import main

pytestmark = pytest.mark.usefixtures("silence_tells_no_time")
SIZE = (12, 16)
PATIENCE_S = 60
SCRIPT = """
import sys, time
import dv_processing as dv
import numpy as np
"""


@pytest.fixture(scope="module")
def recording():
    rng = np.random.default_rng(3)
    events = random_events(20_000, SIZE, seed=2, start_us=5, stop_us=400_000)
    frames = tuple(ApsFrame(
        rng.integers(0, 1024, SIZE), t, t + 10_000, available_us=t + 12_000)
        for t in range(1_000, 380_000, 50_000))
    return recording_from_arrays(
        events, frames, sensor_size=SIZE, layout=Layout.PDAVIS)


@contextlib.contextmanager
def sending(recording, server):
    """Send a recording as soon as there are clients, from another thread."""
    def send():
        with server:
            assert server.wait_for_clients(PATIENCE_S)
            for packet in recording.packets():
                server.add(packet)

    thread = threading.Thread(target=send)
    thread.start()
    yield
    thread.join(PATIENCE_S)
    assert not thread.is_alive()


def arrived(source):
    """Return the events and frames of a source, in the order in which they came."""
    events, frames = [], []
    with source:
        for packet in source.packets():
            events.append(packet.events)
            frames += packet.frames
    return np.concatenate(events), frames


def assert_frames_equal(frames, others):
    assert len(frames) == len(others)
    for one, two in zip(frames, others, strict=True):
        np.testing.assert_array_equal(one.dn, two.dn)
        assert one.exposure_start_us == two.exposure_start_us
        assert one.exposure_end_us == two.exposure_end_us
        assert one.available_us >= two.available_us


def frames_of(recording):
    return [frame for packet in recording.packets() for frame in packet.frames]


def theirs(code, *arguments):
    pytest.importorskip("dv_processing")
    return subprocess.Popen(
        [sys.executable, "-P", "-c", SCRIPT + code, *map(str, arguments)],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)


# ---- ours to ours ----------------------------------------------------------------


@pytest.mark.parametrize("compression", ["none", "lz4"])
def test_what_is_sent_arrives_to_the_bit(recording, compression):
    server = DvServer(recording.info, 0, 0, compression=compression)
    places = server.ports
    with sending(recording, server):
        source = open_source(
            f"dv+tcp://127.0.0.1:{places['events']}?frames={places['frames']}")
        events, frames = arrived(source)
    assert source.info.layout == Layout.PDAVIS
    assert source.info.sensor_size == SIZE
    np.testing.assert_array_equal(events, recording.events())
    assert_frames_equal(frames, frames_of(recording))
    assert not source.problems
    assert server.dropped == 0


@pytest.mark.parametrize("most", [1, 999, 1 << 20])
@pytest.mark.parametrize("compression", ["none", "lz4"])
def test_how_the_bytes_arrive_does_not_matter(compression, most):
    """Byte by byte, many packets at once, and packets larger than the buffer."""
    rng = np.random.default_rng(most)
    sizes = [3, 200, 1, 0, 40] if most < 1000 else [200_000, 5, 90_000, *[50] * 2000]
    events = random_events(sum(sizes), SIZE, stop_us=900_000)
    info = recording_from_arrays(events, (), sensor_size=SIZE).info
    encoder = StreamEncoder(EVENTS, info, compression)
    data = encoder.head + b"".join(
        part for batch in np.split(events, np.cumsum(sizes)[:-1])
        for part in encoder.encoded(Packet(batch)))
    theirs, ours = socket.socketpair()

    def send():
        at = 0
        with theirs:
            while at < len(data):
                n = int(rng.integers(1, most + 1))
                theirs.sendall(data[at:at + n])
                at += n

    thread = threading.Thread(target=send)
    thread.start()
    got, _ = arrived(DvSource("pair", [ours]))
    thread.join(PATIENCE_S)
    np.testing.assert_array_equal(got, events)


def test_frames_far_ahead_of_the_events_are_not_kept(monkeypatch):
    monkeypatch.setattr("pdavis_cv.live.dv.MOST_BYTES", 10 * (1024 + 4 * 12 * 14))
    info = recording_from_arrays(
        random_events(9, (12, 14), stop_us=99), [ApsFrame(
            np.ones((12, 14), np.float32), 1, 2)], sensor_size=(12, 14)).info
    pairs = [socket.socketpair() for _ in range(2)]
    for (theirs, _), stream in zip(pairs, (EVENTS, FRAMES), strict=True):
        encoder = StreamEncoder(stream, info, "none")
        theirs.sendall(encoder.head)
        if stream == FRAMES:
            for k in range(100):
                at = 10**12 + 1000 * k
                theirs.sendall(b"".join(encoder.encoded(Packet(frames=(ApsFrame(
                    np.ones((12, 14), np.float32), at, at + 9),)))))
        theirs.shutdown(socket.SHUT_WR)
    source = DvSource("pair", [ours for _, ours in pairs])
    _, frames = arrived(source)
    assert [frame.exposure_start_us for frame in frames] == [
        10**12 + 1000 * k for k in range(90, 100)]
    assert [(one.kind, one.count) for one in source.problems] == [("frames ahead", 90)]
    for theirs, _ in pairs:
        theirs.close()


def test_a_header_that_drips_is_not_waited_for(monkeypatch):
    monkeypatch.setattr("pdavis_cv.live.dv.CONNECT_S", 0.2)
    theirs, ours = socket.socketpair()

    def drip():
        with theirs, contextlib.suppress(OSError):
            theirs.sendall(struct.pack("<I", 100_000))
            for _ in range(PATIENCE_S * 100):
                theirs.sendall(b"x")
                threading.Event().wait(0.01)

    thread = threading.Thread(target=drip, daemon=True)
    thread.start()
    with pytest.raises(DeviceError, match="its header takes too long"):
        DvSource("pair", [ours])
    ours.close()
    thread.join(PATIENCE_S)


def test_a_packet_that_stops_half_way_does_not_stop_time(monkeypatch):
    clock_s = itertools.chain(np.arange(1, 9) * 0.05, itertools.repeat(0.4))
    monkeypatch.setattr("pdavis_cv.live.dv.MARGIN_US", 100_000)
    monkeypatch.setattr("pdavis_cv.live.dv.time", types.SimpleNamespace(
        monotonic=lambda: next(clock_s)))
    info = recording_from_arrays(
        random_events(9, SIZE), (), sensor_size=SIZE).info
    encoder = StreamEncoder(EVENTS, info, "none")
    first, second = (b"".join(encoder.encoded(Packet(random_events(
        9, SIZE, start_us=t, stop_us=t + 99)))) for t in (0, 500_000))
    theirs, ours = socket.socketpair()
    with theirs:
        theirs.sendall(encoder.head + first + second[:50])
        packets = DvSource("pair", [ours]).packets()
        assert len(next(packets).events) == 9
        until = next(packets).until_us
        assert until > 99
        theirs.sendall(second[50:])
        while not len((packet := next(packets)).events):
            assert until <= packet.until_us < 400_000
        assert packet.start_us >= 500_000
    ours.close()


def test_a_slow_client_loses_packets_and_delays_nobody():
    ours, other = socket.socketpair()
    with other:
        client = _Client(ours, b"head")
        for _ in range(5):
            client.put(bytes(MOST_BYTES // 2))
        assert client.dropped >= 1
    client.end()


@pytest.mark.parametrize(("data", "message"), [
    (b"HTTP/1.1 400 Bad Request\r\n\r\n", "its header cannot be"),
    (struct.pack("<I", 64) + bytes(64), "this is no dv stream"),
    (b"\x10", "the sender closed the connection")])
def test_what_is_no_dv_stream_is_refused(data, message):
    with socket.create_server(("127.0.0.1", 0)) as listener:
        port = listener.getsockname()[1]
        with socket.create_connection(("127.0.0.1", port)):
            first, _ = listener.accept()
            first.close()
        def answer():
            link, _ = listener.accept()
            with link, contextlib.suppress(OSError):    # the source hangs up
                link.sendall(data)
                link.shutdown(socket.SHUT_WR)
                link.recv(1)

        thread = threading.Thread(target=answer)
        thread.start()
        with pytest.raises(DeviceError, match=message):
            open_source(f"dv+tcp://127.0.0.1:{port}")
        thread.join(PATIENCE_S)


def test_nobody_there_is_a_device_error():
    with socket.create_server(("127.0.0.1", 0)) as listener:
        port = listener.getsockname()[1]
    with pytest.raises(DeviceError, match="cannot be reached"):
        open_source(f"dv+tcp://127.0.0.1:{port}")
    with pytest.raises(DeviceError, match="//HOST:PORT is needed"):
        open_source("dv+tcp://host")


# ---- with dv_processing ------------------------------------------------------------

READER = """
import os
reader = dv.io.NetworkReader("127.0.0.1", int(sys.argv[1]))
frames = dv.io.NetworkReader("127.0.0.1", int(sys.argv[2]))
events, images = [], []
end = time.monotonic() + 15
while sum(map(len, events)) < int(sys.argv[3]) or len(images) < int(sys.argv[4]):
    if time.monotonic() > end:      # on a busy machine its reader can lose a packet
        print(sum(map(len, events)), "events and", len(images), "images", flush=True)
        os._exit(1)
    batch = reader.getNextEventBatch()
    if batch is not None and len(batch):
        events.append(batch.numpy().copy())
    frame = frames.getNextFrame()
    if frame is not None:
        images.append(frame.image.copy())
np.savez(sys.argv[5], events=np.concatenate(events), images=np.stack(images))
os._exit(0)
"""


@pytest.mark.parametrize("compression", ["none", "lz4"])
def test_dv_processing_reads_what_we_send(recording, tmp_path, compression):
    frames = frames_of(recording)
    for _ in range(3):
        server = DvServer(recording.info, 0, 0, compression=compression)
        with sending(recording, server), theirs(
                READER, *server.ports.values(), len(recording.events()),
                len(frames), tmp_path / "got.npz") as process:
            if process.wait(PATIENCE_S) == 0:
                break
    with np.load(tmp_path / "got.npz") as got:
        for name, other in (
                ("t", "timestamp"), ("x", "x"), ("y", "y"), ("p", "polarity")):
            np.testing.assert_array_equal(
                recording.events()[name], got["events"][other])
        assert got["images"].dtype == np.uint16
        np.testing.assert_array_equal(got["images"], [frame.dn for frame in frames])


WRITER = """
import os, select
events = np.load(sys.argv[1])
store = dv.EventStore()
for t, x, y, p in events.tolist():
    store.push_back(t, x, y, bool(p))
writer = dv.io.NetworkWriter("127.0.0.1", int(sys.argv[2]), dv.io.Stream.EventStream(
    0, "events", "DAVIS346_00001234", (16, 12)))
print("ready", flush=True)
while writer.getClientCount() < 1:
    time.sleep(0.001)
while True:         # what is written just when a client has come is sometimes lost
    writer.writeEvents(store)
    if select.select([sys.stdin], [], [], 1)[0]:
        break
os._exit(0)         # destroying the writer after its client has gone hangs
"""


def test_we_read_what_dv_processing_sends(tmp_path):
    events = random_events(3_000, SIZE, seed=5, start_us=10, stop_us=90_000)
    np.save(tmp_path / "events.npy", events)
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    process = theirs(WRITER, tmp_path / "events.npy", port)
    assert process.stdout.readline() == "ready\n"
    got = []
    with open_source(f"dv+tcp://127.0.0.1:{port}") as source:
        assert source.info.camera == "DAVIS346_00001234"
        for packet in source.packets():
            got.append(packet.events)
            if sum(map(len, got)) >= len(events):
                break
    process.communicate()
    np.testing.assert_array_equal(np.concatenate(got), events)


@pytest.mark.parametrize("for_programs", [False, True])
def test_the_command_sends_a_recording(
        recording, tmp_path, capsys, monkeypatch, for_programs):
    from pdavis_cv import write_aedat4
    write_aedat4(tmp_path / "x.aedat4", recording)
    got = []
    wait = DvServer.wait_for_clients

    def connect(server, timeout):
        got.append(open_source(f"dv+tcp://127.0.0.1:{server.ports['events']}"))
        return wait(server, PATIENCE_S)

    monkeypatch.setattr(DvServer, "wait_for_clients", connect)
    assert main(["stream", str(tmp_path / "x.aedat4"), "--port", "0",
                 "--no-frames", *["--json"][:for_programs]]) == 0
    np.testing.assert_array_equal(arrived(got[0])[0], recording.events())
    said = capsys.readouterr().out.splitlines()
    if for_programs:
        places, end = map(json.loads, said)
        assert places["events"] > 0
        assert end == {"dropped": 0}
    else:
        assert len(said) == 1
        assert said[0].startswith("events: ")


@pytest.mark.parametrize("option", ["--port", "--frames-port"])
def test_a_port_that_there_is_not_is_refused(option, capsys):
    assert main(["stream", "replay:x.aedat4", option, "99999"]) == 2
    assert "must lie in 0..65535, got 99999" in capsys.readouterr().err
