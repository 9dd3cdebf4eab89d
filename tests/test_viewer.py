"""The server: pictures, commands, and who is refused."""
import contextlib
import http.client
import io
import json
import signal
import socket
import struct
import subprocess
import sys
import time
import types

import cv2
import numpy as np
import pytest

import pdavis_cv
from pdavis_cv import Layout, serve
from pdavis_cv.live import Session
from pdavis_cv.live.replay import ReplaySource
from pdavis_cv.simulation import Camera, RotatingPolarizer
from pdavis_cv.viewer import handler, server, site
from pdavis_cv.viewer.panes import NONE, pane, planes
from pdavis_cv.viewer.regions import values

OPTIONS = {"layout": Layout.PDAVIS, "nominal_thresholds": (0.16, 0.18), "method": "cf"}
PATIENCE_S = 60


@pytest.fixture(scope="module")
def recording():
    camera = Camera.preset("realistic", seed=4, size=(8, 12))
    return camera.record(RotatingPolarizer(rpm=202.6, start_angle=0.3), 0.4)[0]


@pytest.fixture
def served(recording):
    with serve(recording, port=0, **OPTIONS) as running:
        yield running


def ask(running, path, *, method="GET", body=None, **headers):
    """Return the status and body of one request."""
    link = http.client.HTTPConnection("127.0.0.1", running.port, timeout=PATIENCE_S)
    with contextlib.closing(link):
        named = {name.replace("_", "-"): value for name, value in headers.items()}
        link.request(method, path, body, named)
        answer = link.getresponse()
        return answer.status, answer.read()


def command(running, what, value=None, **headers):
    status, body = ask(
        running, "/command", method="POST",
        body=json.dumps({"do": what, "value": value}),
        **{"Content_Type": "application/json", **headers})
    return status, json.loads(body)


def frame(running, **asked):
    """Return what the page gets: a JSON text and pictures."""
    link, file, _ = opened(running)
    with link, file:
        sent(link, json.dumps(asked).encode())
        kind, body = message(file)
    assert kind == 2, body
    return parted(body)


def opened(running, path="/images", **headers):
    """Return a connection that asked for a WebSocket, and the answer's first line."""
    link = socket.socket()
    link.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    link.settimeout(PATIENCE_S)
    link.connect(("127.0.0.1", running.port))
    named = {"Host": f"127.0.0.1:{running.port}", "Upgrade": "websocket",
             "Connection": "Upgrade", "Sec-WebSocket-Version": "13",
             "Sec-WebSocket-Key": "dGhlIHNhbXBsZSBub25jZQ==", **headers}
    link.sendall("\r\n".join(
        [f"GET {path} HTTP/1.1", *(f"{n}: {v}" for n, v in named.items()), "", ""]
    ).encode())
    file = link.makefile("rb")
    first = file.readline().decode()
    while (line := file.readline()) not in (b"\r\n", b""):
        if line.lower().startswith(b"sec-websocket-accept"):   # RFC 6455, 1.3
            assert line.split()[1] == b"s3pPLMBiTxaQ9kYGzzhZRbK+xOo="
    return link, file, first


def sent(link, data, kind=1):
    mask = bytes((1, 2, 3, 4))
    size = (bytes((0x80 | len(data),)) if len(data) < 126
            else struct.pack(">BH", 0xFE, len(data)))
    link.sendall(bytes((0x80 | kind,)) + size + mask + bytes(
        byte ^ mask[i % 4] for i, byte in enumerate(data)))


def message(file):
    kind, size = file.read(2)
    if size == 126:
        size, = struct.unpack(">H", file.read(2))
    elif size == 127:
        size, = struct.unpack(">Q", file.read(8))
    return kind & 15, file.read(size)


def parted(body):
    """Return the JSON text and the planes of what the page gets."""
    length, = struct.unpack_from("<I", body)
    told, at, planes = json.loads(body[4:4 + length]), 4 + length, {}
    for name in told["planes"]:
        shape = told["height"], told["width"]
        size = int(np.prod(shape))
        planes[name] = np.frombuffer(body, np.uint8, size, at).reshape(shape)
        at += size
    assert at == len(body)
    return told, planes


def image_at(recording, t_us):
    image, = pdavis_cv.fuse(recording, times_us=[t_us], **OPTIONS)
    return image


# ---- pictures ----------------------------------------------------------------------


def test_the_page_and_its_files_are_there_and_name_no_other_address(served):
    for path, kind in [("/", b"<!doctype html>"), ("/page.js", b"use strict"),
                       ("/pictures.js", b"use strict"), ("/page.css", b":root"),
                       ("/regions.js", b"use strict")]:
        status, body = ask(served, path)
        assert (status, kind in body) == (200, True)
        assert b"//" not in body.replace(b"// ", b"").replace(b"://localhost", b"")


def test_a_frame_holds_the_planes_and_values_of_its_image(served, recording):
    told, found = frame(served, panes=["sigma_aop", "aop", "s0"],
                        regions=[[2, 1, 4, 3], [0, 0, 1, 1]])
    image = image_at(recording, told["t_us"])
    assert list(found) == ["sigma_aop", "aop", "s0", "dolp"]
    low, high = told["levels"]
    np.testing.assert_allclose(
        found["s0"][image.valid],
        254 * ((image.s0 - low) / (high - low)).clip(0, 1)[image.valid], atol=1)
    for name in ("s0", "dolp"):
        np.testing.assert_array_equal(found[name] == NONE, ~image.valid)
    np.testing.assert_array_equal(found["sigma_aop"], NONE)     # cf gives none
    assert told["values"] == json.loads(json.dumps(
        values(image, [(2, 1, 4, 3), (0, 0, 1, 1)])))
    assert told["values"][0]["pixels"] == np.count_nonzero(image.valid[1:4, 2:6])


def test_levels_that_are_asked_for_are_those_of_the_picture(served):
    link, file, _ = opened(served)
    with link, file:
        _, image = served.site.show.latest(0, 1)
        low, high = (float(value) for value in np.quantile(image.s0, (0.3, 0.6)))
        sent(link, json.dumps({"panes": ["s0"], "levels": [low, high]}).encode())
        told, found = parted(message(file)[1])
        assert told["levels"] == [low, high]
        assert set(found["s0"][image.valid & (image.s0 < low)]) == {0}
        assert set(found["s0"][image.valid & (image.s0 > high)]) == {254}


@pytest.mark.parametrize("options", [
    {"roi": (2, 1, 9, 6)}, {"roi": (2, 0, 10, 8), "demosaic": "superpixel"}])
def test_regions_are_in_pixels_of_the_sensor_whatever_is_shown(recording, options):
    whole = OPTIONS | {name: options[name] for name in options.keys() - {"roi"}}
    with serve(recording, port=0, **whole) as running:
        expected = frame(running, regions=[[4, 2, 4, 4]])[0]["values"][0]
        pixels = expected["pixels"]
    with serve(recording, port=0, **whole, roi=options["roi"]) as running:
        told = frame(running, regions=[[4, 2, 4, 4], [1, 2, 4, 4]])[0]
    assert told["status"]["roi"] == list(options["roi"])
    assert pixels == 16 / told["status"]["step"]**2
    for name, value in expected.items():
        assert told["values"][0][name] == pytest.approx(value, rel=1e-5), name
    # Never the values of the part of a region that is inside.
    assert told["values"][1] == {"pixels": 0, "t_us": told["t_us"]}


def test_a_snapshot_holds_all_that_is_known_of_the_image(served, recording):
    status, body = ask(served, "/snapshot.npz")
    assert status == 200
    with np.load(io.BytesIO(body)) as arrays:
        image = image_at(recording, int(arrays["t_us"]))
        np.testing.assert_array_equal(arrays["quad"], image.quad)
        np.testing.assert_array_equal(arrays["aop_rad"], image.aop)


def test_a_file_plays_seeks_and_steps(served, recording):
    told, _ = frame(served, panes=["aop"])
    number, first = told["number"], told["t_us"]
    assert command(served, "seek", 5)[1]["index"] == 5
    told, pictures = frame(served, panes=["aop"], after=number)
    assert told["t_us"] == first + round(5 * 1e6 / 60)
    image = image_at(recording, told["t_us"])
    np.testing.assert_array_equal(
        pictures["aop"], planes(["aop"], served.site.show, image)["aop"])
    assert command(served, "step", 1)[1]["index"] == 6
    assert command(served, "step", -2)[1]["index"] == 4
    assert command(served, "speed", 100)[1]["speed"] == 100
    assert command(served, "play")[1]["playing"]
    number = told["number"]
    while frame(served, after=number)[0]["status"]["playing"]:
        number = frame(served, after=number)[0]["number"]
    status = frame(served)[0]["status"]
    assert status["index"] == status["count"] - 1


def test_a_seek_that_follows_the_last_image_is_not_played_on_from(served):
    show = served.site.show
    number, _ = show.latest(0, PATIENCE_S)
    last = number + show.status()["count"] - 1
    show.command("speed", 0.5)              # 33 ms after the last image: none is due
    show.command("play", None)
    while number < last:
        number, image = show.latest(number, PATIENCE_S)
        assert image is not None
    show.command("seek", 3)
    assert not show.status()["playing"]
    assert show.status()["index"] == 3


def test_method_and_rate_can_be_changed(served):
    assert command(served, "method", "frames")[1]["method"] == "frames"
    assert command(served, "fps", 30)[1]["fps"] == 30


@pytest.mark.parametrize(("what", "value", "message"), [
    ("fly", None, "do must be one of"), ("seek", "x", "seek must be a number"),
    ("seek", 1e300, "seek must be finite"), ("speed", 0, "speed must lie in"),
    ("method", 7, "method must be a name"),
    ("method", "magic", "method must be one of"),
    ("roi", [0, 0, 4, 4], "do must be one of"), ("fps", -1, "fps must lie in")])
def test_a_command_that_cannot_be_is_refused(served, what, value, message):
    status, told = command(served, what, value)
    assert status == 400
    assert message in told["error"]
    assert frame(served)[0]["status"]["method"] == "cf"


def test_a_live_source_is_shown_and_recorded(recording, tmp_path):
    source = ReplaySource(recording, "test", speed=1, loop=True)
    with Session(source, **OPTIONS) as session, serve(
            session, port=0, record_to=tmp_path) as running:
        told, pictures = frame(running, panes=["aop", "events"])
        assert told["status"]["live"]
        assert pictures["events"].shape == (8, 12)
        told = command(running, "record", True)[1]
        name = told["stats"]["recording"]
        assert "/" not in name
        frame(running, after=told["stats"]["skipped_images"])
        assert command(running, "record", False)[1]["stats"]["recording"] is None
        assert command(running, "record", "../x")[0] == 400
    assert [path.name for path in tmp_path.iterdir()] == [name]


# ---- the stream --------------------------------------------------------------------


def test_cv2_reads_the_stream(served, recording):
    url = f"http://127.0.0.1:{served.port}/stream.mjpg?output=aop_bgr"
    capture = cv2.VideoCapture(url, cv2.CAP_FFMPEG)
    assert capture.isOpened()
    ok, picture = capture.read()
    capture.release()
    shown = pane("aop_bgr", served.site.show, served.site.show.latest(0, 1)[1])
    assert ok
    assert picture.shape == shown.shape
    # 4:4:4: colours at half the size would be far off on this picture.
    rms = np.sqrt(np.mean((picture.astype(float) - shown) ** 2))
    assert rms < 25


def test_the_stream_repeats_its_last_picture_where_none_comes(served, monkeypatch):
    monkeypatch.setattr(handler, "POLL_S", 0.01)
    link = http.client.HTTPConnection("127.0.0.1", served.port, timeout=PATIENCE_S)
    with contextlib.closing(link):
        link.request("GET", "/stream.mjpg?output=dolp_bgr")
        answer = link.getresponse()
        parts = []
        for _ in range(3):
            assert answer.readline() == b"--pdavis\r\n"
            assert answer.readline() == b"Content-Type: image/jpeg\r\n"
            length = int(answer.readline().removeprefix(b"Content-Length: "))
            assert answer.readline() == b"\r\n"
            parts.append(answer.read(length))
            assert answer.readline() == b"\r\n"
    assert parts[0] == parts[1] == parts[2]
    assert parts[0].startswith(b"\xff\xd8")


# ---- who is refused ----------------------------------------------------------------


def test_a_socket_gives_an_image_for_each_message(served):
    link, file, first = opened(served)
    with link, file:
        assert " 101 " in first
        sent(link, b'{"after": 0, "panes": ["s0", "dolp"], "id": 1}')
        kind, body = message(file)
        told, found = parted(body)
        assert (kind, told["id"], list(found)) == (2, 1, ["s0", "dolp"])
        # While it waits for the next image it is asked for the newest again.
        sent(link, json.dumps({"after": told["number"], "id": 2}).encode())
        sent(link, b"hello", kind=9)
        sent(link, b'{"panes": ["aop"], "regions": [[1, 1, 2, 2]], "id": 3}')
        told, found = parted(message(file)[1])
        assert (told["id"], list(found)) == (3, ["aop", "dolp"])
        assert len(told["values"]) == 1
        sent(link, b"", kind=8)
        assert file.read() == b""


@pytest.mark.parametrize(("data", "message_"), [
    (b"no", "Expecting value"), (b"[]", "must be {"), (b'{"panes": 7}', "panes"),
    (b'{"panes": ["no"]}', "quantity must be one"), (b'{"after": 1.5}', "after"),
    (b'{"regions": [[1, 2, 3]]}', "regions"),
    (b'{"regions": [[1, 2, 3, 0]]}', "regions must not be empty"),
    (b'{"regions": 7}', "regions must be a list"),
    (b'{"levels": [2, 1]}', "black below white"), (b'{"levels": 3}', "levels"),
    (b'{"levels": [NaN, 1]}', "levels"), (b"[" * 3000, ""), (b"x" * 5000, "at most"),
    (b'{"panes": [' + b'"s0", ' * 99 + b'"s0"]}', "at most")])
def test_what_a_socket_does_not_take_ends_it(served, data, message_):
    link, file, _ = opened(served)
    with link, file:
        sent(link, data)
        kind, body = message(file)
        assert kind == 8
        assert body[:2] == struct.pack(">H", 1008)
        assert message_ in body.decode("latin-1")
        assert file.read() == b""


@pytest.mark.parametrize("data", [b"\x81\x02{}", b"\x01\x82....{}", b"\xc1\x80....",
                                  b"\x81\xff" + b"\xff" * 12, b"\x82\x80...."])
def test_a_socket_takes_whole_plain_masked_text_only(served, data):
    link, file, _ = opened(served)
    with link, file:
        link.sendall(data)
        assert message(file)[0] == 8


@pytest.mark.parametrize(("headers", "status"), [
    ({"Origin": "http://evil.example"}, 403), ({"Host": "evil.example"}, 403),
    ({"Upgrade": "h2c"}, 400), ({"Sec-WebSocket-Version": "8"}, 400),
    ({"Sec-WebSocket-Key": "short"}, 400)])
def test_strangers_get_no_socket(served, headers, status):
    link, file, first = opened(served, **headers)
    with link, file:
        assert f" {status} " in first


def test_a_silent_socket_is_closed(served, monkeypatch):
    monkeypatch.setattr("pdavis_cv.viewer.handler.PATIENCE_S", 0.2)
    link, file, _ = opened(served)
    with link, file:
        assert file.read() == b""


@pytest.mark.parametrize(("path", "headers", "status"), [
    ("/", {"Host": "evil.example"}, 403), ("/", {"Host": "evil.example:8346"}, 403),
    ("/status", {"Origin": "http://evil.example"}, 403),
    ("/stream.mjpg", {"Sec_Fetch_Site": "cross-site"}, 403),
    ("/status", {"Sec_Fetch_Site": "same-origin"}, 200),
    ("/../pyproject.toml", {}, 404), ("/%2e%2e/%2e%2e/etc/passwd", {}, 404),
    ("/page.html", {}, 404), ("/stream.mjpg?output=no", {}, 400),
    ("/images", {}, 400)])
def test_strangers_and_nonsense_are_refused(served, path, headers, status):
    got, body = ask(served, path, **headers)
    assert got == status, body
    assert ask(served, "/status")[0] == 200


def test_an_address_that_is_none_is_refused(served):
    with socket.create_connection(("127.0.0.1", served.port), PATIENCE_S) as link:
        link.sendall(b"GET http://[::1/ HTTP/1.1\r\nHost: localhost\r\n\r\n")
        assert link.recv(100).startswith(b"HTTP/1.1 400 ")


def test_bodies_are_bounded_json(served):
    for body, kind, status in [
            (b"{}", "text/plain", 415), (b"{", "application/json", 400),
            (b"[" * 60_000, "application/json", 400),
            (b'"do"', "application/json", 400)]:
        assert ask(served, "/command", method="POST", body=body,
                   Content_Type=kind)[0] == status
    with socket.create_connection(("127.0.0.1", served.port)) as link:
        link.sendall(b"POST /command HTTP/1.1\r\nHost: localhost\r\n"
                     b"Content-Type: application/json\r\n"
                     b"Content-Length: 104857600\r\n\r\n")
        assert link.recv(100).startswith(b"HTTP/1.1 413")
    assert ask(served, "/command", method="PUT")[0] == 501
    assert ask(served, "/status")[0] == 200


def test_a_head_is_answered_as_a_get_without_its_body(served):
    for path in ("/", "/status", "/snapshot.npz", "/stream.mjpg"):
        assert ask(served, path, method="HEAD") == (200, b"")
    assert ask(served, "/images", method="HEAD") == (404, b"")


def test_a_client_that_goes_on_sending_is_told_why_it_is_refused(served):
    # A connection that is closed with bytes unread is reset.
    size = 8 << 20
    with socket.create_connection(("127.0.0.1", served.port), timeout=20) as link:
        link.sendall(b"POST /command HTTP/1.1\r\nHost: localhost\r\nContent-Type: "
                     b"application/json\r\nContent-Length: %d\r\n\r\n" % size
                     + bytes(size))
        assert link.recv(100).startswith(b"HTTP/1.1 413")


def test_every_answer_forbids_what_comes_from_elsewhere(served):
    link = http.client.HTTPConnection("127.0.0.1", served.port, timeout=PATIENCE_S)
    with contextlib.closing(link):
        link.request("GET", "/")
        answer = link.getresponse()
        answer.read()
    assert "default-src 'none'" in answer.headers["Content-Security-Policy"]
    assert answer.headers["X-Content-Type-Options"] == "nosniff"
    assert answer.headers["Referrer-Policy"] == "no-referrer"


def test_other_machines_need_the_token(recording):
    with serve(recording, host="0.0.0.0", port=0, **OPTIONS) as running:
        token = running.url.partition("token=")[2]
        assert len(token) > 20
        assert ask(running, "/status")[0] == 403
        assert ask(running, "/status?token=wrong")[0] == 403
        assert ask(running, f"/status?token={token}")[0] == 200
        assert ask(running, "/status", Authorization=f"Bearer {token}")[0] == 200
        assert ask(running, f"/status?token={token}", Origin="http://evil")[0] == 403


def test_a_request_a_byte_at_a_time_ends_at_its_deadline(served, monkeypatch):
    """A socket's own timeout would begin anew with each byte."""
    monkeypatch.setattr(handler, "PATIENCE_S", 0.1)
    with socket.create_connection(("127.0.0.1", served.port), PATIENCE_S) as link:
        closed = False
        while not closed:
            try:
                link.sendall(b"G")
                link.settimeout(0.02)
                closed = link.recv(1) == b""
            except TimeoutError:
                continue
            except ConnectionError:
                closed = True
    assert ask(served, "/status")[0] == 200


@pytest.mark.parametrize("count", [70, 1000])
@pytest.mark.parametrize("said", [b"", b"GET /images HTTP/1.1\r\nHost: 127"])
def test_silent_connections_lock_nobody_out(served, count, said):
    resource = pytest.importorskip("resource")
    most = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (min(4096, most[1]), most[1]))
    with contextlib.ExitStack() as stack:
        player = stack.enter_context(contextlib.closing(
            http.client.HTTPConnection("127.0.0.1", served.port, PATIENCE_S)))
        player.request("GET", "/stream.mjpg")
        stream = player.getresponse()
        links = []
        for _ in range(count):
            links.append(stack.enter_context(socket.create_connection(
                ("127.0.0.1", served.port), PATIENCE_S)))
            with contextlib.suppress(ConnectionError):
                links[-1].sendall(said)
        for path in ("/", "/status", "/snapshot.npz"):
            assert ask(served, path)[0] == 200
        assert b"image/jpeg" in stream.read(200)        # it was never closed
        assert len(served._listener._open) <= server.MOST_CONNECTIONS
        for link in links[:count - server.MOST_CONNECTIONS]:
            with contextlib.suppress(ConnectionError):
                assert link.recv(1) == b""      # the oldest are closed


def test_a_ninth_client_is_told_that_there_is_no_place(served):
    with contextlib.ExitStack() as stack:
        for _ in range(site.MOST_CLIENTS):
            link = stack.enter_context(contextlib.closing(
                http.client.HTTPConnection("127.0.0.1", served.port)))
            link.request("GET", "/stream.mjpg")
            assert link.getresponse().status == 200
        assert ask(served, "/stream.mjpg")[0] == 503
        assert ask(served, "/status")[0] == 200
        # Players that read nothing keep no page from its images.
        link, file, first = opened(served)
        with link, file:
            assert " 101 " in first
            sent(link, b'{"panes": ["aop"]}')
            assert message(file)[1]


def places(running):
    free = []
    for of in (running.site.pages, running.site.players):
        while of.acquire(blocking=False):
            free.append(of)
    for of in free:
        of.release()
    return len(free)


@pytest.mark.parametrize("how", ["gone", "slow"])
def test_a_client_that_is_gone_or_takes_nothing_gives_its_place_back(
        recording, how, monkeypatch):
    monkeypatch.setattr("pdavis_cv.viewer.handler.PATIENCE_S", 1.0)
    monkeypatch.setattr("pdavis_cv.viewer.handler.POLL_S", 0.01)
    all_of_them = b'{"panes": ["s0", "aop", "dolp", "events"]}'
    with serve(recording, port=0, **OPTIONS) as running:
        link, file, _ = opened(running)
        player = socket.create_connection(("127.0.0.1", running.port), PATIENCE_S)
        player.sendall(b"GET /stream.mjpg HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n")
        assert player.recv(1)
        assert places(running) == 14
        if how == "gone":
            for one in (file, link, player):
                one.close()
        else:               # until what it is sent fills the buffers between
            player.close()
            link.settimeout(0.05)
            with contextlib.suppress(OSError):
                while True:
                    sent(link, all_of_them)
        until_s = time.monotonic() + PATIENCE_S
        while places(running) < 16:
            assert time.monotonic() < until_s
            time.sleep(0.05)
        for one in (file, link, player):
            one.close()
        assert ask(running, "/status")[0] == 200


@pytest.mark.gate
def test_a_thousand_connections_leave_the_server_alive(served):
    links = [socket.create_connection(("127.0.0.1", served.port), PATIENCE_S)
             for _ in range(250)]
    for _ in range(3):          # a thousand, a quarter of them open at a time
        for link in links:
            link.close()
        links = [socket.create_connection(("127.0.0.1", served.port), PATIENCE_S)
                 for _ in range(250)]
    for link in links:
        link.close()
    until_s = time.monotonic() + PATIENCE_S
    while True:
        with contextlib.suppress(ConnectionError, http.client.HTTPException):
            assert ask(served, "/status")[0] == 200
            break
        assert time.monotonic() < until_s


def test_closing_ends_streams_and_threads(recording, threads_ended):
    running = serve(recording, port=0, **OPTIONS)
    link = http.client.HTTPConnection("127.0.0.1", running.port, timeout=PATIENCE_S)
    with contextlib.closing(link):
        link.request("GET", "/stream.mjpg")
        answer = link.getresponse()
        running.close()
        while answer.read(65_536):
            pass
    # What the client still sends is received for up to a second.
    assert threads_ended(PATIENCE_S)


def test_a_port_that_is_taken_is_an_error(served, recording):
    with pytest.raises(OSError, match="in use"):
        serve(recording, port=served.port, **OPTIONS)


def test_a_notebook_shows_the_page(recording):
    with pdavis_cv.view(recording, **OPTIONS) as running:
        assert f'src="{running.url}"' in running._repr_html_()


def test_a_signal_ends_the_command_and_finishes_its_recording(tmp_path):
    path = tmp_path / "run.aedat4"
    with subprocess.Popen(
            [sys.executable, "-P", "-m", "pdavis_cv.tools.main", "view",
             "simulate:polarizer?size=4x4&rpm=600", "--layout", "pdavis", "--port", "0",
             "--no-browser", "--method", "cf", "--record", path],
            stdout=subprocess.PIPE, text=True) as process:
        url = process.stdout.readline().strip()
        running = types.SimpleNamespace(port=int(url.rstrip("/").rpartition(":")[2]))
        while frame(running)[0]["status"]["stats"]["recorded_events"] < 100:
            pass
        process.send_signal(signal.SIGTERM)
        assert process.wait(PATIENCE_S) == 0
    assert [left.name for left in tmp_path.iterdir()] == [path.name]
    with pdavis_cv.open_recording(path, layout=Layout.PDAVIS) as recording:
        assert recording.info.event_count >= 100
