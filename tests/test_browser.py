"""The page in a real browser: headless Chromium, through Playwright."""
import csv
import json
import shlex
import shutil

import numpy as np
import pytest
from certificates import Certificates

from pdavis_cv import Layout, serve
from pdavis_cv.analysis import parse_roi
from pdavis_cv.data import example_recording
from pdavis_cv.export import AnimationFile, VideoFile
from pdavis_cv.live import Session, server_context
from pdavis_cv.live.replay import ReplaySource
from pdavis_cv.simulation import Camera, RotatingPolarizer
from pdavis_cv.tools.main import main
from pdavis_cv.viewer.panes import pane

playwright = pytest.importorskip("playwright.sync_api", reason="needs playwright")
CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or (
    shutil.which("google-chrome"))
if CHROMIUM is None:
    pytest.skip("needs a Chromium on the path", allow_module_level=True)

OPTIONS = {"layout": Layout.PDAVIS, "nominal_thresholds": (0.16, 0.18), "method": "cf"}
PATIENCE_MS = 60_000
pytestmark = pytest.mark.gate     # a browser takes seconds to start


@pytest.fixture(scope="module")
def recording():
    camera = Camera.preset("realistic", seed=4, size=(16, 24))
    return camera.record(RotatingPolarizer(rpm=202.6, start_angle=0.3), 0.4)[0]


@pytest.fixture(scope="module")
def browser():
    with playwright.sync_playwright() as run:
        opened = run.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        yield opened
        opened.close()


@pytest.fixture
def served(recording):
    with serve(recording, port=0, **OPTIONS) as running:
        yield running


@pytest.fixture
def page(browser, served):
    """The page of a recording, its first image drawn; nothing foreign is asked for."""
    foreign, errors = [], []
    opened = browser.new_page()
    opened.set_default_timeout(PATIENCE_MS)
    opened.on("request", lambda request: foreign.append(request.url) if not (
        request.url.startswith((served.url, "data:", "blob:"))) else None)
    opened.on("pageerror", lambda error: errors.append(str(error)))
    opened.on("console", lambda message: errors.append(message.text)
              if message.type == "error" else None)
    opened.goto(served.url)
    drawn(opened, 1)
    yield opened
    opened.close()
    assert (foreign, errors) == ([], [])


def until(page, expression):
    """Wait until an expression holds; wait_for_function would need eval in the page."""
    for _ in range(PATIENCE_MS // 20):
        if page.evaluate(expression):
            return
        page.wait_for_timeout(20)
    raise AssertionError(f"never true: {expression}")


def drawn(page, least):
    until(page, f"Number(document.body.dataset.drawn || 0) >= {least}")
    return int(page.evaluate("document.body.dataset.drawn"))


def shown_us(page):
    return int(page.evaluate("document.body.dataset.t"))


def test_a_recording_plays_to_its_end_and_seeks_back(page):
    first = shown_us(page)
    count = int(page.get_attribute("#seek", "max")) + 1
    page.keyboard.press(" ")
    until(page, f"Number(document.querySelector('#seek').value) >= {count - 1}")
    page.evaluate("""() => { const seek = document.querySelector('#seek');
        seek.value = 3; seek.dispatchEvent(new Event('input')); }""")
    until(page, f"Number(document.body.dataset.t) === {first + round(3 * 1e6 / 60)}")
    page.click("#on")
    until(page, f"Number(document.body.dataset.t) === {first + round(4 * 1e6 / 60)}")
    assert int(page.input_value("#seek")) == 4


def test_colours_on_the_page_are_those_of_the_pictures(page, served):
    page.keyboard.press("4")
    until(page, "document.querySelector('#pane-events')?.width === 24")
    _, image = served.site.show.latest(0, 1)
    for name, output in (("aop", "aop_faded_bgr"), ("dolp", "dolp_bgr"),
                         ("events", "events_bgr")):
        found = page.evaluate("""name => {
            const canvas = document.getElementById('pane-' + name);
            return [...canvas.getContext('2d').getImageData(
                0, 0, canvas.width, canvas.height).data];
        }""", name)
        shown = np.array(found).reshape(16, 24, 4)
        picture = pane(output, served.site.show, image)[..., ::-1].astype(int)
        # A part in 255 of a turn of hue is six of its colours, of the ramp at most 7.
        most = 7 if name in ("aop", "dolp") else 0
        seen = image.valid if most else np.ones_like(image.valid)
        np.testing.assert_array_equal(shown[..., 3] > 0, seen)  # else hatched, behind
        assert np.abs(shown[..., :3] - picture)[seen].max() <= most


def test_the_rate_of_events_is_drawn_over_time(page, served, recording):
    page.keyboard.press(" ")
    until(page, "rates.length >= 5")
    page.keyboard.press(" ")
    for one in page.evaluate("rates"):
        t_us = one["t_us"]
        events = recording.events(t_us - round(1e6 / 60) + 1, t_us + 1)
        assert one["rate"] == pytest.approx(len(events) / round(1e6 / 60))
    # It is drawn when the browser paints next.
    until(page, """() => { const plot = document.getElementById('plot');
        return plot.getContext('2d').getImageData(0, 0, plot.width, plot.height).data
            .some(value => value > 0); }""")


def region(page, left, top, right, bottom):
    """Drag a region over parts of the AoP picture; return its row of the list."""
    box = page.locator("#grid .window:has(#pane-aop)").bounding_box()
    before = page.locator("#regions .angle small").count()
    for k, (x, y) in enumerate(((left, top), (right, bottom))):
        page.mouse.move(box["x"] + x * box["width"], box["y"] + y * box["height"])
        (page.mouse.up if k else page.mouse.down)()
    page.mouse.move(0, 0)
    until(page, "regions.at(-1)?.values?.aop_deg !== undefined")
    assert page.evaluate("regions.length") > before
    return page.evaluate("({...regions.at(-1).values, box: regions.at(-1).box})")


def test_a_marked_region_keeps_its_pixels_when_the_view_changes(page, served):
    first = region(page, 0.3, 0.3, 0.7, 0.6)
    assert first["box"] == [7, 4, 10, 6]
    for key in ("z", "ArrowRight"):             # zoom, and the next image
        before = drawn(page, 1)
        page.keyboard.press(key)
    drawn(page, before + 1)
    assert float(page.evaluate("document.body.dataset.zoom")) == pytest.approx(1.92)
    until(page, "regions[0].trace.length === 2")
    again = page.evaluate("regions[0].trace")
    assert [point["t_us"] for point in again] == [
        first["t_us"], first["t_us"] + round(1e6 / 60)]
    assert again[0]["aop_deg"] == first["aop_deg"]
    # In the zoomed view the same part of the window is another part of the sensor.
    second = region(page, 0.05, 0.05, 0.95, 0.95)
    assert second["box"] == [6, 3, 12, 8]
    assert page.evaluate("regions[0].trace.length") == 2
    page.keyboard.down("Shift")
    box = page.locator("#grid .window:has(#pane-aop)").bounding_box()
    page.mouse.move(box["x"] + 10, box["y"] + 10)
    page.mouse.down()           # and two pixels to the right
    page.mouse.move(box["x"] + 10 + 1.92 * box["width"] / 12, box["y"] + 10)
    page.mouse.up()
    page.keyboard.up("Shift")
    assert region(page, 0.05, 0.05, 0.95, 0.95)["box"] == [4, 3, 12, 8]
    page.keyboard.press("w")
    assert region(page, 0.3, 0.3, 0.7, 0.6)["box"] == first["box"]
    assert page.evaluate("regions.map(one => one.name).join('')") == "ABCD"


@pytest.mark.parametrize("roi", [(4, 2, 18, 12)])
def test_coordinates_of_a_part_are_the_sensor_s(browser, recording, roi):
    with serve(recording, port=0, roi=roi, **OPTIONS) as running, (
            browser.new_page()) as page:
        page.set_default_timeout(PATIENCE_MS)
        page.goto(running.url)
        drawn(page, 1)
        found = region(page, 0.01, 0.01, 0.49, 0.49)
        assert found["box"] == [4, 2, 9, 6]
        _, image = running.site.show.latest(0, 1)
        s1, s2 = (plane[:6, :9][image.valid[:6, :9]].mean() for plane in (
            image.s1, image.s2))
        assert found["aop_deg"] == pytest.approx(
            np.degrees(np.arctan2(s2, s1) / 2) % 180, abs=1e-3)


def test_regions_are_exported(page):
    region(page, 0.3, 0.3, 0.7, 0.6)
    page.fill("#regions input", "left, wing")
    page.keyboard.press("Tab")
    page.keyboard.press("ArrowRight")
    until(page, "regions[0].trace.length === 2")
    with page.expect_download() as waiting:
        page.click("#csv")
    with waiting.value.path().open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 2
    assert rows[0]["region"] == "left, wing"
    assert [rows[0][name] for name in ("x", "y", "width", "height")] == [
        "7", "4", "10", "6"]
    assert 0 <= float(rows[0]["aop_deg"]) < 180
    assert rows[0]["method"] == "cf"
    with page.expect_download() as waiting:
        page.click("#geojson")
    feature, = json.loads(waiting.value.path().read_text())["features"]
    assert feature["properties"] == {"name": "left, wing"}
    assert feature["geometry"]["coordinates"] == [
        [[7, 4], [17, 4], [17, 10], [7, 10], [7, 4]]]
    tendon, fan = page.text_content("#commands").splitlines()
    words = shlex.split(tendon)
    assert words[:2] == ["pdavis", "tendon"]
    roi, = parse_roi(words[words.index("--region") + 1])
    assert (roi.name, roi.rectangle) == ("left, wing", (7, 4, 10, 6))
    assert "--centre 12,7 --radius 3" in fan


def test_contrast_is_fixed_until_it_is_changed(page):
    opened = page.evaluate("levels")
    assert opened[0] < opened[1]
    before = drawn(page, 1)
    page.evaluate("command('seek', 9)")
    drawn(page, before + 1)
    assert page.evaluate("levels") == opened
    white = round(2 * opened[1], 1)
    page.fill("#white", str(white))
    page.keyboard.press("Enter")
    until(page, f"levels[1] === {white} && newest.told.levels[1] === {white}")
    page.keyboard.press("a")
    until(page, f"levels !== null && levels[1] !== {white}")
    assert page.evaluate("levels") != opened        # those of the tenth image


def test_a_snapshot_shows_legend_and_time(page):
    with page.expect_download() as data, page.expect_download() as picture:
        page.keyboard.press("s")
    names = {data.value.suggested_filename, picture.value.suggested_filename}
    assert {name.rpartition(".")[2] for name in names} <= {"npz", "png"}
    texts = page.evaluate("""() => {
        const texts = [], drawn = CanvasRenderingContext2D.prototype.fillText;
        CanvasRenderingContext2D.prototype.fillText = text => texts.push(text);
        snapshotPicture('at 0.010 s');
        CanvasRenderingContext2D.prototype.fillText = drawn;
        return texts;
    }""")
    assert {"S0", "AoP", "DoLP", "0\u00b0", "180\u00b0", "at 0.010 s",
            "not valid"} <= set(texts)
    assert any(text.endswith("DN/ms") for text in texts)


def test_keys_are_listed(page):
    page.keyboard.press("?")
    assert "fit contrast" in page.inner_text("#keys")
    page.keyboard.press("Escape")
    assert page.is_hidden("#keys")


@pytest.mark.parametrize(("width", "height", "least"), [
    (390, 844, 0.9), (800, 1000, 0.9), (1400, 900, 0.9), (2560, 1300, 0.9)])
def test_pictures_use_the_window_and_play_is_at_hand(
        browser, served, width, height, least):
    with browser.new_page(viewport={"width": width, "height": height}) as page:
        page.set_default_timeout(PATIENCE_MS)
        page.goto(served.url)
        drawn(page, 1)
        boxes = [page.locator(f"#grid .window:has(#pane-{name})").bounding_box()
                 for name in ("s0", "aop", "dolp")]
        right = max(box["x"] + box["width"] for box in boxes)
        assert right - min(box["x"] for box in boxes) > least * width
        assert page.evaluate("document.documentElement.scrollWidth") <= width
        for control in ("#play", "#seek"):
            box = page.locator(control).bounding_box()
            assert 0 <= box["y"] < box["y"] + box["height"] <= height


def test_method_and_pictures_are_changed(page):
    page.select_option("#method", "frames")
    until(page, "document.querySelector('#stats').textContent.includes('frames')")
    page.keyboard.press("5")
    until(page, "document.querySelector('#pane-sigma_aop')?.width === 24")
    page.keyboard.press("z")
    until(page, "document.querySelector('#said').textContent === 'drag a region first'")
    assert page.input_value("#method") == "frames"


def test_two_pages_and_a_narrow_screen(page, browser, served):
    with browser.new_page(viewport={"width": 320, "height": 640}) as other:
        other.set_default_timeout(PATIENCE_MS)
        other.goto(served.url)
        drawn(other, 1)
        assert other.evaluate("document.documentElement.scrollWidth") <= 320
        before = int(page.evaluate("document.body.dataset.drawn"))
        other.click("#on")
        drawn(page, before + 1)


def test_a_live_source_is_shownwith_its_statistics(browser, recording):
    source = ReplaySource(recording, "test", loop=True)
    with Session(source, **OPTIONS) as session, serve(session, port=0) as running, (
            browser.new_page()) as page:
        page.set_default_timeout(PATIENCE_MS)
        page.goto(running.url)
        drawn(page, 10)
        assert "Mev/s" in page.text_content("#stats")
        assert page.is_hidden("#timeline")


def test_without_its_token_the_page_is_refused(browser, recording, threads_ended):
    with serve(recording, host="0.0.0.0", port=0, **OPTIONS) as running, (
            browser.new_page()) as page:
        page.set_default_timeout(PATIENCE_MS)
        here = f"http://127.0.0.1:{running.port}/"
        assert page.goto(here).status == 403
        page.goto(here + "?token=" + running.site.token)
        drawn(page, 1)
    # What a refused client still sends is received for up to a second.
    assert threads_ended(10)


def test_the_page_works_over_tls(browser, recording, tmp_path):
    made = Certificates(tmp_path)
    context = server_context(made.pem("server"), made.key("server"), None)
    with serve(recording, host="0.0.0.0", port=0, context=context, **OPTIONS
               ) as running, browser.new_page(ignore_https_errors=True) as page:
        page.set_default_timeout(PATIENCE_MS)
        assert page.goto(
            f"https://127.0.0.1:{running.port}/?token={running.site.token}").ok
        drawn(page, 1)
        page.keyboard.press("ArrowRight")
        drawn(page, 2)


PLAY = """async () => {
    const video = document.querySelector('video');
    const until = event => new Promise(done => video.addEventListener(event, done));
    if (video.readyState < 2) await Promise.race([until('loadeddata'), until('error')]);
    if (video.error) return video.error.message;
    const ended = until('seeked');
    video.currentTime = video.duration * 0.9;
    await ended;
    return [video.videoWidth, video.videoHeight, video.duration];
}"""


@pytest.mark.parametrize("suffix", [".webm", ".mp4"])
def test_videos_play_in_a_browser(browser, tmp_path, suffix):
    with VideoFile(tmp_path / f"clip{suffix}", 25, {"method": "none"}) as video:
        for k in range(10):
            video.add(np.full((48, 64, 3), 20 * k, np.uint8))
    page = browser.new_page()
    (tmp_path / "page.html").write_text(f"<video muted src='clip{suffix}'></video>")
    page.goto(f"file://{tmp_path}/page.html")
    assert page.evaluate(PLAY) == [64, 48, pytest.approx(0.4, abs=0.041)]
    page.close()


@pytest.mark.parametrize("suffix", [".gif", ".webp"])
def test_animations_are_shown_in_a_browser(browser, tmp_path, suffix):
    with AnimationFile(tmp_path / f"clip{suffix}", 25, {"method": "none"}) as file:
        for k in range(5):
            file.add(np.full((48, 64, 3), 50 * k, np.uint8))
    (tmp_path / "page.html").write_text(f"<img src='clip{suffix}'>")
    with browser.new_page() as page:
        page.goto(f"file://{tmp_path}/page.html")
        size = page.evaluate("""async () => {
            const image = document.querySelector('img');
            await image.decode();
            return [image.naturalWidth, image.naturalHeight];
        }""")
    assert size == [64, 48]


def test_pointing_at_the_tendon_s_traces_tells_their_values(browser, tmp_path):
    pytest.importorskip("matplotlib")
    assert main([
        "tendon", str(example_recording("tendon")), "-o", str(tmp_path), "--no-video",
        "--fps", "50", "--method", "cf", "--load-hz", "4.3"]) == 0
    trace = np.genfromtxt(tmp_path / "traces.csv", delimiter=",", names=True,
                          dtype=None, encoding="utf-8")
    errors = []
    with browser.new_page(viewport={"width": 1000, "height": 1200}) as page:
        page.on("pageerror", lambda error: errors.append(str(error)))
        page.goto(f"file://{tmp_path}/report.html")
        box, pane = page.locator("#traces").bounding_box(), page.evaluate("PANES[0]")
        middle = len(trace) // 2
        share = (trace["t_s"][middle] - pane["span"][0]) / (
            pane["span"][1] - pane["span"][0])
        page.mouse.move(
            box["x"] + box["width"] * (
                pane["left"] + share * (pane["right"] - pane["left"])),
            box["y"] + box["height"] * (pane["top"] + pane["bottom"]) / 2)
        told = page.locator(".traces pre").inner_text()
        page.mouse.move(box["x"] + 1, box["y"] + 1)
        assert not page.locator(".traces pre").is_visible()
    assert errors == []
    assert told.splitlines()[0].endswith("DoLP")
    value = float(f"{trace['dolp'][middle]:.5g}")
    assert f"all: {value}" in told
    assert "frames, all: " in told
