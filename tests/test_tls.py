"""Streams and the viewer beyond this machine: TLS, with certificates of both sides."""
import contextlib
import http.client
import json
import socket
import ssl
import time

import numpy as np
import pytest
from certificates import Certificates, openssl
from streams import random_events, random_frame
from test_dv import PATIENCE_S, SIZE, arrived, frames_of, sending, theirs

from pdavis_cv import Layout, open_source, recording_from_arrays, serve
from pdavis_cv.errors import DeviceError
from pdavis_cv.live import DvServer, server_context
from pdavis_cv.live.dv_server import MOST_CLIENTS
from pdavis_cv.live.tls import client_context
from pdavis_cv.tools.main import main

pytestmark = pytest.mark.usefixtures("silence_tells_no_time")


@pytest.fixture(scope="module")
def certificates(tmp_path_factory):
    return Certificates(tmp_path_factory.mktemp("certificates"))


@pytest.fixture(scope="module")
def recording():
    events = random_events(20_000, SIZE, seed=2, start_us=5, stop_us=400_000)
    frames = [random_frame(SIZE, t, low=0) for t in range(9_000, 380_000, 50_000)]
    return recording_from_arrays(
        events, frames, sensor_size=SIZE, layout=Layout.PDAVIS)


@pytest.fixture
def context(certificates):
    return server_context(certificates.pem("server"), certificates.key("server"),
                          certificates.pem("authority"))


@pytest.mark.parametrize("compression", ["none", "lz4"])
def test_what_is_sent_encrypted_arrives_to_the_bit(
        recording, certificates, context, compression):
    server = DvServer(recording.info, 0, 0, compression=compression, context=context)
    places = server.ports
    with sending(recording, server):
        source = open_source(
            f"dv+tls://127.0.0.1:{places['events']}?frames={places['frames']}&"
            + certificates.query("client"))
        events, frames = arrived(source)
    np.testing.assert_array_equal(events, recording.events())
    assert len(frames) == len(frames_of(recording))


@pytest.mark.parametrize(("query", "message"), [
    ("certificate=client&key=client&authority=stranger", "self.signed|unable to get"),
    ("certificate=impostor&key=impostor&authority=authority", "refused|broke"),
    ("certificate=client&key=client", "authority=FILE is needed"),
    ("key=client&authority=authority", "certificate=FILE is needed"),
    ("certificate=client&key=server&authority=authority", "belong together"),
    ("certificate=none&key=client&authority=authority", "certificate must be a file"),
    ("certificate=client&key=client&authority=client.key", "authority must be a PEM")])
def test_who_does_not_trust_the_other_is_told_in_a_line(
        recording, certificates, context, query, message):
    values = [one.split("=") for one in query.split("&")]
    folder = certificates.folder
    query = "&".join(f"{name}={folder}/{value}" + (
        "" if "." in value else ".key" if name == "key" else ".pem")
        for name, value in values)
    with DvServer(recording.info, 0, context=context) as server:
        with pytest.raises(DeviceError, match=message) as found:
            open_source(f"dv+tls://127.0.0.1:{server.ports['events']}?{query}")
        assert "\n" not in str(found.value)
        assert not server.wait_for_clients(0.05)


def test_a_certificate_must_name_the_host_unless_told_otherwise(
        recording, certificates):
    context = server_context(
        certificates.pem("elsewhere"), certificates.key("elsewhere"),
        certificates.pem("authority"))
    with DvServer(recording.info, 0, context=context) as server:
        where = (f"dv+tls://127.0.0.1:{server.ports['events']}?"
                 + certificates.query("client"))
        with pytest.raises(DeviceError, match="IP address mismatch"):
            open_source(where)
        with open_source(where + "&check_name=0") as source:
            assert source.info.sensor_size == recording.info.sensor_size


def test_who_says_nothing_or_shows_nothing_keeps_nobody_waiting(
        recording, certificates, context, monkeypatch):
    monkeypatch.setattr("pdavis_cv.live.dv_server.GREET_S", 1.0)
    with DvServer(recording.info, 0, context=context) as server:
        place = "127.0.0.1", server.ports["events"]
        silent = [socket.create_connection(place) for _ in range(MOST_CLIENTS - 1)]
        with pytest.raises(DeviceError, match=r"no dv stream|closed|broke|reset"):
            open_source(f"dv+tcp://127.0.0.1:{place[1]}")
        none = ssl.create_default_context(cafile=certificates.pem("authority"))
        # The end of the connection may reach the client before its reason does; who is
        # let in gets the head of the stream.
        with contextlib.suppress(ssl.SSLError, ConnectionError), (
                none.wrap_socket(socket.create_connection(place),
                                 server_hostname="127.0.0.1")) as link:
            assert link.recv(1) == b""
        time.sleep(1.2)
        with open_source("dv+tls://{}:{}?{}".format(
                *place, certificates.query("client"))):
            assert server.wait_for_clients(PATIENCE_S)
        for one in silent:
            one.close()


def test_beyond_this_machine_a_certificate_is_needed(
        recording, certificates):
    with pytest.raises(ValueError, match="beyond this machine"):
        DvServer(recording.info, 0, host="0.0.0.0")
    trusting = server_context(
        certificates.pem("server"), certificates.key("server"), None)
    with pytest.raises(ValueError, match="beyond this machine"):
        DvServer(recording.info, 0, host="0.0.0.0", context=trusting)


@pytest.mark.parametrize(("command", "options", "message"), [
    ("stream", ["--host", "0.0.0.0"], "--host beyond this machine needs"),
    ("stream", ["--certificate", "x.pem"], "--certificate needs --key"),
    ("stream", ["--key", "x.pem"], "--key needs --certificate"),
    ("stream", ["--certificate", "none.pem", "--key", "none.pem"],
     "certificate must be a file"),
    ("view", ["--certificate", "none.pem", "--key", "none.pem"],
     "certificate must be a file"),
    ("view", ["--authority", "none.pem"], "--authority needs --certificate")])
def test_mistakes_are_one_line(command, options, message, capsys):
    assert main([command, "simulate:fan", *options]) == 2
    said = capsys.readouterr().err
    assert message in said
    assert said.count("\n") == 1


def test_a_key_with_a_passphrase_is_refused_and_not_asked_for(
        certificates, tmp_path):
    openssl("ec", "-in", certificates.key("server"), "-aes128", "-passout", "pass:1234",
            "-out", tmp_path / "locked.key")
    with pytest.raises(ValueError, match="no passphrase"):
        server_context(certificates.pem("server"), tmp_path / "locked.key", None)


# ---- the viewer --------------------------------------------------------------------


def asked(running, context, path="/status"):
    link = http.client.HTTPSConnection(
        "127.0.0.1", running.port, context=context, timeout=PATIENCE_S)
    try:
        link.request("GET", path)
        answer = link.getresponse()
        return answer.status, answer.read()
    finally:
        link.close()


def test_the_viewer_encrypts_and_still_asks_for_its_token(
        recording, certificates):
    context = server_context(
        certificates.pem("server"), certificates.key("server"), None)
    browser = ssl.create_default_context(cafile=certificates.pem("authority"))
    with serve(recording, host="0.0.0.0", port=0, context=context) as running:
        assert running.url.startswith("https://0.0.0.0:")
        assert asked(running, browser)[0] == 403
        status, body = asked(running, browser, f"/status?token={running.site.token}")
        assert (status, json.loads(body)["live"]) == (200, False)
        # Who speaks no TLS, or says nothing, is hung up on and keeps nobody waiting.
        with socket.create_connection(("127.0.0.1", running.port)) as silent, (
                socket.create_connection(("127.0.0.1", running.port))) as plain:
            plain.sendall(b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n")
            plain.settimeout(PATIENCE_S)
            with contextlib.suppress(ConnectionResetError):
                assert b"HTTP" not in plain.recv(100)
            page = asked(running, browser, f"/status?token={running.site.token}")
            assert page[0] == 200
            assert silent.fileno() >= 0
        with pytest.raises(ssl.SSLError, match="certificate verify failed"):
            asked(running, ssl.create_default_context(
                cafile=certificates.pem("stranger")))


def test_the_viewer_can_ask_for_a_certificate(
        recording, certificates, context):
    mine = client_context(certificates.pem("client"), certificates.key("client"),
                          certificates.pem("authority"), True)
    none = ssl.create_default_context(cafile=certificates.pem("authority"))
    with serve(recording, port=0, context=context) as running:
        assert asked(running, mine)[0] == 200
        # The end of the connection may reach the client before its reason does.
        with pytest.raises((ssl.SSLError, ConnectionError)):
            asked(running, none)


# ---- with dv_processing ------------------------------------------------------------

READER = """
import os
reader = dv.io.NetworkReader("127.0.0.1", int(sys.argv[1]),
                             dv.Path(sys.argv[4]), dv.Path(sys.argv[5]))
events, end = [], time.monotonic() + 15
while sum(map(len, events)) < int(sys.argv[2]):
    if time.monotonic() > end:      # on a busy machine its reader can lose a packet
        print(sum(map(len, events)), "events", flush=True)
        os._exit(1)
    batch = reader.getNextEventBatch()
    if batch is not None and len(batch):
        events.append(batch.numpy().copy())
np.save(sys.argv[3], np.concatenate(events))
os._exit(0)
"""


def test_dv_processing_reads_what_we_encrypt(
        recording, certificates, context, tmp_path):
    sent = recording.events()
    for _ in range(3):
        server = DvServer(recording.info, 0, context=context)
        with sending(recording, server), theirs(
                READER, server.ports["events"], len(sent), tmp_path / "got.npy",
                certificates.pem("client"), certificates.key("client")) as process:
            if process.wait(PATIENCE_S) == 0:
                break
    got = np.load(tmp_path / "got.npy")
    for name, other in (("t", "timestamp"), ("x", "x"), ("y", "y"), ("p", "polarity")):
        np.testing.assert_array_equal(sent[name], got[other])


WRITER = """
import os, select
events = np.load(sys.argv[1])
store = dv.EventStore()
for t, x, y, p in events.tolist():
    store.push_back(t, x, y, bool(p))
writer = dv.io.NetworkWriter("127.0.0.1", int(sys.argv[2]), dv.io.Stream.EventStream(
    0, "events", "DAVIS346_00001234", (16, 12)), *map(dv.Path, sys.argv[3:6]))
print("ready", flush=True)
while writer.getClientCount() < 1:
    time.sleep(0.001)
while True:         # what is written just when a client has come is sometimes lost
    writer.writeEvents(store)
    if select.select([sys.stdin], [], [], 1)[0]:
        break
os._exit(0)         # destroying the writer after its client has gone hangs
"""


def test_we_read_what_dv_processing_encrypts(certificates, tmp_path):
    events = random_events(3_000, SIZE, seed=5, start_us=10, stop_us=90_000)
    np.save(tmp_path / "events.npy", events)
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    process = theirs(WRITER, tmp_path / "events.npy", port, certificates.pem("server"),
                     certificates.key("server"), certificates.pem("authority"))
    assert process.stdout.readline() == "ready\n"
    with pytest.raises(DeviceError, match=r"refused|closed|broke"):
        open_source(f"dv+tls://127.0.0.1:{port}?"
                    + certificates.query("impostor"))
    got = []
    with open_source(f"dv+tls://127.0.0.1:{port}?"
                     + certificates.query("client")) as source:
        for packet in source.packets():
            got.append(packet.events)
            if sum(map(len, got)) >= len(events):
                break
    process.communicate()
    np.testing.assert_array_equal(np.concatenate(got), events)
