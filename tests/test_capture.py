"""VideoCapture: outputs, pictures, properties, bad input, threads."""
import math
import os
import pickle
import re
import threading
from concurrent.futures import ThreadPoolExecutor

import cv2
import numpy as np
import pytest
from ideal import rotating_polarizer

import pdavis_cv as p
from pdavis_cv import CaptureStatus, Layout, VideoCapture, fuse
from pdavis_cv.capture.outputs import outputs
from pdavis_cv.capture.picture import tone

POS_FRAMES, WIDTH, HEIGHT, FPS, COUNT, FORMAT, CONVERT_RGB = 1, 3, 4, 5, 7, 8, 16
UNKNOWN = 0.0 if cv2.__version__.startswith("4") else -1.0
NAMES = {p.CAP_PDAVIS_S0: "s0", p.CAP_PDAVIS_S1: "s1", p.CAP_PDAVIS_S2: "s2",
         p.CAP_PDAVIS_AOP: "aop", p.CAP_PDAVIS_DOLP: "dolp"}


@pytest.fixture(scope="module")
def ideal():
    return rotating_polarizer(50, 1.5, size=(14, 18), dolp=0.8)[0]


@pytest.fixture
def cap(ideal):
    with VideoCapture(ideal, fps=100) as made:
        yield made


# ---- outputs -----------------------------------------------------------------


def test_every_plane_is_that_of_fuse(ideal, cap):
    for image in fuse(ideal, fps=100):
        assert cap.grab()
        for flag, name in NAMES.items():
            np.testing.assert_array_equal(
                cap.retrieve(None, flag)[1], getattr(image, name))
        for i, flag in enumerate((p.CAP_PDAVIS_I0, p.CAP_PDAVIS_I45,
                                  p.CAP_PDAVIS_I90, p.CAP_PDAVIS_I135)):
            np.testing.assert_array_equal(cap.retrieve(None, flag)[1], image.quad[i])
        quad = cap.retrieve(None, p.CAP_PDAVIS_QUAD)[1]
        np.testing.assert_array_equal(np.moveaxis(quad, -1, 0), image.quad)
        stokes = cap.retrieve(None, p.CAP_PDAVIS_STOKES)[1]
        np.testing.assert_array_equal(stokes[..., 1], image.s1)
        valid = cap.retrieve(None, p.CAP_PDAVIS_VALID)[1]
        np.testing.assert_array_equal(valid, 255 * image.valid)
    assert not cap.grab()


def test_planes_are_float32_and_pictures_bgr_and_both_belong_to_the_caller(cap):
    cap.grab()
    for flag in range(p.CAP_PDAVIS_BGR, p.CAP_PDAVIS_EVENTS_BGR + 1):
        ok, image = cap.retrieve(None, flag)
        assert ok
        assert image.flags.c_contiguous
        assert image.flags.writeable
        kept = image.copy()
        image[...] = 0
        np.testing.assert_array_equal(cap.retrieve(None, flag)[1], kept)
        picture = flag in (0, 13, 14, 15)
        whole = picture or flag == p.CAP_PDAVIS_VALID
        assert image.dtype == (np.uint8 if whole else np.float32)
        assert image.shape[:2] == (14, 18)
        channels = {11: (4,), 12: (3,)}.get(flag, (3,) if picture else ())
        assert image.shape[2:] == channels


def test_the_valid_plane_is_a_mask_for_cv2(cap):
    cap.grab()
    dolp, valid = (cap.retrieve(None, name)[1] for name in ("dolp", "valid"))
    valid[:5] = 0
    want = dolp[valid > 0].mean()
    assert cv2.mean(dolp, mask=valid)[0] == pytest.approx(want, rel=1e-5)


def test_an_output_may_be_named(ideal, cap):
    cap.grab()
    for number, name in enumerate(outputs()[:16]):
        assert getattr(p, f"CAP_PDAVIS_{name.upper()}") == number
        np.testing.assert_array_equal(
            cap.retrieve(None, name)[1], cap.retrieve(None, number)[1])
    with VideoCapture(ideal, output="AoLP_bgr", layout="pdavis") as other:
        assert other.get(p.CAP_PROP_PDAVIS_OUTPUT) == p.CAP_PDAVIS_AOP_BGR


def test_every_quantity_is_an_output_as_numbers_and_as_a_picture(ideal):
    with VideoCapture(ideal, method="kalman", layout="pdavis") as capture:
        capture.grab()
        for number, name in enumerate(outputs()):
            got, image = capture.retrieve(None, number)
            if name.startswith("quality"):
                assert not got
                assert capture.last_error.startswith("quality needs events with")
                continue
            assert got, capture.last_error
            assert (image.ndim, image.dtype) == (
                (3, np.uint8) if name.endswith("bgr") else
                (3 if name in ("quad", "stokes") else 2,
                 np.uint8 if name == "valid" else np.float32))
            assert capture.set(p.CAP_PROP_PDAVIS_OUTPUT, number)
            assert capture.get(p.CAP_PROP_PDAVIS_OUTPUT) == number
            assert int(capture.get(cv2.CAP_PROP_FORMAT)) % 8 == (
                0 if image.dtype == np.uint8 else 5)
        faded, full = (capture.retrieve(None, f"aop{word}_bgr")[1].astype(int)
                       for word in ("_faded", ""))
        valid, dolp = (capture.retrieve(None, name)[1] for name in ("valid", "dolp"))
        weak = (valid > 0) & (dolp < 0.2)
        assert np.all(faded[weak] <= full[weak])
        np.testing.assert_array_equal(faded[valid == 0], full[valid == 0])
    for name in ("colour", "events", "dolp_faded_bgr", "quad_bgr"):
        with pytest.raises(ValueError, match=f"output must be one of bgr, .*{name}"):
            VideoCapture(ideal, output=name)


def test_output_selects_what_read_gives(ideal):
    for flag in (p.CAP_PDAVIS_DOLP, p.CAP_PDAVIS_QUAD, p.CAP_PDAVIS_AOP_BGR):
        with VideoCapture(ideal, output=flag) as one, VideoCapture(ideal) as other:
            assert other.set(p.CAP_PROP_PDAVIS_OUTPUT, flag)
            image = one.read()[1]
            np.testing.assert_array_equal(image, other.read()[1])
            np.testing.assert_array_equal(image, one.retrieve(None, flag)[1])
            made = getattr(cv2, "CV_MAKETYPE", lambda depth, n: depth + 8 * (n - 1))
            depth = {np.dtype(np.uint8): cv2.CV_8U, np.dtype(np.float32): cv2.CV_32F}
            channels = image.shape[2] if image.ndim == 3 else 1
            assert one.get(FORMAT) == made(depth[image.dtype], channels)


def test_without_conversion_pictures_are_their_float_plane(cap):
    cap.set(CONVERT_RGB, 0)
    cap.grab()
    s0 = cap.retrieve(None, p.CAP_PDAVIS_S0)[1]
    np.testing.assert_array_equal(cap.retrieve()[1], s0 * np.float32(0.5))
    for picture, plane in ((p.CAP_PDAVIS_AOP_BGR, p.CAP_PDAVIS_AOP),
                           (p.CAP_PDAVIS_DOLP_BGR, p.CAP_PDAVIS_DOLP)):
        np.testing.assert_array_equal(
            cap.retrieve(None, picture)[1], cap.retrieve(None, plane)[1])


@pytest.mark.parametrize("keywords", [{}, {"demosaic": "superpixel"},
                                      {"demosaic": "binned"},
                                      {"roi": (3, 2, 9, 11)}])
def test_the_event_picture_counts_events_since_the_image_before(ideal, keywords):
    events = np.concatenate([packet.events for packet in ideal.packets()])
    x, y, w, h = keywords.get("roi", (0, 0, 18, 14))
    step = 2 if "demosaic" in keywords else 1
    with VideoCapture(ideal, fps=80, **keywords) as cap:
        cap.set(CONVERT_RGB, 0)
        last, most = None, 0
        while cap.grab():
            t = cap.get(p.CAP_PROP_PDAVIS_POS_US)
            since = t - 12_500 if last is None else last
            now = events[(events["t"] > since) & (events["t"] <= t)]
            expected = np.zeros((14, 18), np.float32)
            np.add.at(expected, (now["y"], now["x"]), 2.0 * now["p"] - 1)
            expected = expected[y:y + h, x:x + w]
            expected = sum(expected[i::step, j::step]
                           for i in range(step) for j in range(step))
            got = cap.retrieve(None, p.CAP_PDAVIS_EVENTS_BGR)[1]
            np.testing.assert_array_equal(got, expected)
            last, most = t, max(most, np.abs(got).max())
        assert most > 0


# ---- the grey picture --------------------------------------------------------


def test_grey_is_a_fixed_function_of_intensity(ideal, cap):
    white = cap.get(p.CAP_PROP_PDAVIS_WHITE)
    assert white == 1023 / 20   # DN full scale over 20 ms of exposure
    same = []
    while cap.grab():
        grey = cap.retrieve(None, p.CAP_PDAVIS_S0)[1].astype(float) / 2
        expected = np.rint(255 * np.clip(grey / white, 0, 1))
        got = cap.retrieve()[1]
        assert np.abs(got[..., 0] - expected).max() <= 1   # the table has 65536 steps
        same.append(np.mean(got[..., 0] == expected))
        np.testing.assert_array_equal(got[..., 0], got[..., 2])
    assert np.mean(same) > 0.98


@pytest.mark.parametrize(("gain", "gamma", "log"), [
    (2.0, 1.0, False), (1.0, 2.2, False), (0.5, 0.8, False), (1.0, 1.0, True),
    (3.0, 2.0, True)])
def test_gain_gamma_and_log_are_as_documented(gain, gamma, log):
    value = np.geomspace(1e-4, 100, 999).astype(np.float32)[None]
    got = tone(40, gain, gamma, log).bgr(value)[0, :, 1].astype(int)

    def documented(x):
        x = np.clip(x, 0, 1)
        if log:
            with np.errstate(divide="ignore"):
                x = np.clip(1 + np.log(x) / math.log(1023), 0, 1)
        return 255 * x ** (1 / gamma)
    root, step = np.sqrt(gain * value[0].astype(float) / 40), 0.501 / 65535
    assert np.all(got >= documented(np.maximum(root - step, 0) ** 2) - 0.5)
    assert np.all(got <= documented((root + step) ** 2) + 0.5)
    assert got[-1] == 255


@pytest.mark.parametrize(("keywords", "error"), [
    ({"gain": 0}, ValueError), ({"gamma": -1}, ValueError), ({"gain": math.inf},
     ValueError), ({"gamma": math.nan}, ValueError), ({"gain": "2"}, TypeError),
    ({"gamma": None}, TypeError), ({"gain": True}, TypeError)])
def test_a_tone_that_is_none_is_refused(ideal, keywords, error):
    with pytest.raises(error, match=next(iter(keywords))):
        VideoCapture(ideal, **keywords)


# ---- properties --------------------------------------------------------------


def test_properties_describe_the_recording(ideal, cap):
    expected = {
        WIDTH: 18, HEIGHT: 14, FPS: 100, COUNT: len(list(fuse(ideal, fps=100))),
        p.CAP_PROP_PDAVIS_FPS: 100, p.CAP_PROP_PDAVIS_CAPTURE_FPS: 20,
        p.CAP_PROP_PDAVIS_EXPOSURE_US: 20_000, p.CAP_PROP_PDAVIS_START_US: 10_000,
        p.CAP_PROP_PDAVIS_GAIN: 1, p.CAP_PROP_PDAVIS_GAMMA: 1, p.CAP_PROP_PDAVIS_LOG: 0,
        p.CAP_PROP_PDAVIS_OUTPUT: 0, p.CAP_PROP_PDAVIS_POS_US: UNKNOWN,
        42: p.CAP_PDAVIS}
    assert {prop: cap.get(prop) for prop in expected} == expected
    assert cap.getBackendName() == "PDAVIS"
    cap.grab()
    assert cap.get(p.CAP_PROP_PDAVIS_POS_US) == 10_000


@pytest.mark.parametrize(("prop", "value", "keywords"), [
    (p.CAP_PROP_PDAVIS_GAIN, 3, {"gain": 3.0}),
    (p.CAP_PROP_PDAVIS_GAMMA, 2.2, {"gamma": 2.2}),
    (p.CAP_PROP_PDAVIS_LOG, 1, {"log": True}),
    (p.CAP_PROP_PDAVIS_OUTPUT, p.CAP_PDAVIS_S1, {"output": p.CAP_PDAVIS_S1})])
def test_setting_a_property_equals_opening_with_it(ideal, prop, value, keywords):
    base = {"fps": 50, "method": "cf"}
    with (VideoCapture(ideal, **base) as changed,
          VideoCapture(ideal, **{**base, **keywords}) as opened,
          VideoCapture(ideal, p.CAP_PDAVIS, [prop, value], **base) as by_params):
        for _ in range(30):
            changed.grab()
        assert changed.set(prop, value), changed.last_error
        assert changed.get(prop) == value
        assert changed.get(POS_FRAMES) == 30
        opened.set(POS_FRAMES, 30)
        by_params.set(POS_FRAMES, 30)
        rest = list(opened)
        np.testing.assert_array_equal(list(changed), rest)
        np.testing.assert_array_equal(list(by_params), rest)


def test_a_change_of_the_rate_keeps_the_time(ideal):
    with VideoCapture(ideal, fps=50) as cap:
        for _ in range(31):
            cap.grab()
        before = cap.get(p.CAP_PROP_PDAVIS_POS_US)
        assert cap.set(p.CAP_PROP_PDAVIS_FPS, 200)
        assert cap.get(p.CAP_PROP_PDAVIS_POS_US) == before
        assert cap.get(FPS) == 200
        cap.grab()
        assert cap.get(p.CAP_PROP_PDAVIS_POS_US) == before + 5_000


@pytest.mark.parametrize(("prop", "value"), [
    (p.CAP_PROP_PDAVIS_FPS, 0),
    (p.CAP_PROP_PDAVIS_FPS, -3), (p.CAP_PROP_PDAVIS_FPS, math.nan),
    (p.CAP_PROP_PDAVIS_GAIN, 0), (p.CAP_PROP_PDAVIS_OUTPUT, 999),
    (p.CAP_PROP_PDAVIS_OUTPUT, -1), (p.CAP_PROP_PDAVIS_OUTPUT, math.inf),
    (p.CAP_PROP_PDAVIS_START_US, 0), (p.CAP_PROP_PDAVIS_WHITE, 1)])
def test_a_value_that_cannot_be_is_refused_and_changes_nothing(cap, prop, value):
    cap.grab()
    before = cap.get(prop)
    assert cap.set(prop, value) is False
    assert cap.last_error
    assert cap.get(prop) == before
    assert cap.read()[0]


def test_a_long_property_number_is_unknown(cap):
    assert cap.get(93_999) == cap.get(94_999) == UNKNOWN


# ---- bad input ---------------------------------------------------------------


def sources(folder):
    text = folder / "text.aedat4"
    text.write_text("no recording")
    empty = folder / "empty.aedat4"
    empty.touch()
    half = folder / "half.aedat4"
    half.write_bytes(b"#!AER-DAT4.0\r\n\x10\0\0")
    return {
        "missing": (folder / "missing.aedat4", "cannot be opened"),
        "folder": (folder, "cannot open|cannot be opened|a folder that is not"),
        "text": (text, "not a recording"),
        "empty": (empty, "empty"),
        "half": (half, "half.aedat4"),
        "null": ("a\0.aedat4", "null"),
    }


@pytest.mark.parametrize("name", ["missing", "folder", "text", "empty", "half", "null"])
@pytest.mark.parametrize("backend", [0, p.CAP_PDAVIS])
def test_a_bad_source_does_not_raise_and_says_why(tmp_path, name, backend):
    source, reason = sources(tmp_path)[name]
    with VideoCapture(source, backend) as cap:
        assert not cap.isOpened()
        assert cap.status == CaptureStatus.ERROR
        assert re.search(reason, cap.last_error)
        assert cap.read() == (False, None)
        assert cap.open(source, backend) is False


def test_an_unreadable_file_says_why(tmp_path):
    path = tmp_path / "closed.aedat4"
    path.write_bytes(b"#!AER-DAT4.0\r\n")
    path.chmod(0)
    root = os.geteuid() == 0   # may read everything
    if root:
        os.seteuid(65534)
    try:
        cap = VideoCapture(path)
    finally:
        if root:
            os.seteuid(0)
    assert not cap.isOpened()
    assert "permission denied" in cap.last_error.lower()


def test_a_recording_is_known_by_its_content(data_dir, tmp_path):
    path = tmp_path / "recording.avi"
    path.symlink_to(data_dir / "davis346.aedat4")
    with VideoCapture(path, layout=Layout.PDAVIS, method="cf") as cap:
        assert cap.getBackendName() == "PDAVIS"
        assert cap.read()[0]


def test_parameters_that_no_method_has_raise_even_if_the_source_is_bad():
    for source in (None, "missing.aedat4", "missing.avi", 0):
        with pytest.raises(TypeError, match="no parameter 'cuttof_hz'"):
            VideoCapture(source, cuttof_hz=3)


@pytest.mark.parametrize(("keywords", "error", "reason"), [
    ({"method": "frames", "cutoff_hz": 3}, TypeError, "cutoff_hz"),
    ({"method": "magic"}, ValueError, "method must be one of"),
    ({"fps": 0}, ValueError, "fps must lie in"),
    ({"fps": "fast"}, (TypeError, ValueError), "fps must lie in"),
    ({"roi": (0, 0, 99, 99)}, ValueError, "roi"),
    ({"start_us": 1.5}, TypeError, "start_us must be integer"),
    ({"layout": 3201}, TypeError, "layout must be a Layout"),
    ({"output": "angle"}, ValueError, "output must be one of bgr, i0, .* got 'angle'")])
def test_parameters_that_do_not_fit_raise(ideal, keywords, error, reason):
    with pytest.raises(error, match=reason):
        VideoCapture(ideal, **keywords)


def test_a_foreign_source_with_parameters_is_not_opened_and_says_why(tmp_path):
    path = tmp_path / "a.avi"
    path.write_bytes(b"RIFF")
    cap = VideoCapture(path, method="frames")
    assert not cap.isOpened()
    assert "needs layout=" in cap.last_error


def test_status_tells_the_end_from_an_error(ideal):
    cap = VideoCapture()
    assert cap.status == CaptureStatus.CLOSED
    cap.open(ideal)
    assert (cap.status, cap.last_error) == (CaptureStatus.OK, None)
    while cap.read()[0]:
        assert cap.status == CaptureStatus.OK
    assert (cap.status, cap.last_error) == (CaptureStatus.EOF, "the recording ended")
    cap.set(POS_FRAMES, 0)
    assert cap.status == CaptureStatus.OK
    cap.release()
    assert cap.status == CaptureStatus.CLOSED
    assert cap.read() == (False, None)
    assert cap.last_error == "the capture is not open"


def test_an_error_while_reading_is_not_the_end(data_dir):
    with VideoCapture(data_dir / "davis346.aedat4", layout=Layout.PDAVIS,
                      method="cf") as cap:
        assert cap.read()[0]
        cap._session.recording.close()
        results = [cap.read()[0] for _ in range(59)]
        assert not all(results)
        assert cap.status == CaptureStatus.ERROR
        assert "closed" in cap.last_error
        assert cap.isOpened()
        cap.setExceptionMode(True)
        with pytest.raises(cv2.error, match="closed"):
            cap.read()


def test_a_recording_that_the_caller_opened_stays_open(data_dir):
    with p.open_recording(data_dir / "davis346.aedat4") as recording:
        VideoCapture(recording, layout=Layout.PDAVIS).release()
        assert next(recording.packets()).start_us is not None


def test_cv2_errors_carry_what_cv2s_do():
    with pytest.raises(cv2.error) as ours:
        VideoCapture(1.5)
    with pytest.raises(cv2.error) as theirs:
        cv2.VideoCapture(1.5)
    for name in ("code", "func"):
        assert getattr(ours.value, name) == getattr(theirs.value, name)
    assert "Overload resolution failed" in str(ours.value)


# ---- foreign sources ---------------------------------------------------------


@pytest.fixture(scope="module")
def clip(tmp_path_factory):
    path = tmp_path_factory.mktemp("foreign") / "clip.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 25, (64, 48))
    for k in range(12):
        writer.write(np.full((48, 64, 3), 20 * k, np.uint8))
    writer.release()
    return path


def test_a_foreign_video_goes_to_cv2_unchanged(clip):
    theirs = cv2.VideoCapture(str(clip))
    with VideoCapture(clip) as cap:
        assert cap.getBackendName() == theirs.getBackendName()
        for prop in range(60):
            assert cap.get(prop) == theirs.get(prop)
        while True:
            ok, image = theirs.read()
            mine = cap.read()
            assert mine[0] == ok
            np.testing.assert_array_equal(mine[1], image)
            assert cap.get(0) == theirs.get(0)
            if not ok:
                break
        assert cap.set(POS_FRAMES, 5)
        assert cap.grab()
        assert cap.retrieve()[1].mean() == pytest.approx(100, abs=2)
        assert len(list(cap)) == 6
        with pytest.raises(TypeError, match="cannot pickle"):
            pickle.dumps(cap)
        cap.setExceptionMode(True)
        with pytest.raises(cv2.error):
            cap.read()
    theirs.release()


def test_a_backend_of_cv2_makes_a_source_cv2s(clip):
    with VideoCapture(clip, cv2.CAP_FFMPEG, [cv2.CAP_PROP_HW_ACCELERATION, 0]) as cap:
        assert cap.getBackendName() == "FFMPEG"
    with VideoCapture(clip, p.CAP_PDAVIS) as cap:
        assert not cap.isOpened()
        assert "not a recording" in cap.last_error


# ---- threads -----------------------------------------------------------------


def test_two_threads_share_out_the_images(ideal):
    with VideoCapture(ideal, fps=100) as cap:
        expected = [image.tobytes() for image in cap]
        cap.set(POS_FRAMES, 0)
        got, start = [], threading.Barrier(2)

        def read():
            start.wait()
            while True:
                ok, image = cap.read()
                if not ok:
                    return
                got.append(image.tobytes())
        threads = [threading.Thread(target=read) for _ in range(2)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        assert sorted(got) == sorted(expected)


def test_release_in_another_thread_ends_reading_quietly(ideal):
    cap = VideoCapture(ideal, fps=1000)
    with ThreadPoolExecutor(1) as pool:
        reading = pool.submit(lambda: sum(1 for _ in cap))
        cap.release()
        assert 0 <= reading.result(30) < cap.get(COUNT) + 1500
    assert cap.read() == (False, None)


def test_captures_of_one_recording_do_not_disturb_each_other(ideal):
    expected = [image.tobytes() for image in VideoCapture(ideal, fps=60)]

    def read(_):
        with VideoCapture(ideal, fps=60) as cap:
            return [image.tobytes() for image in cap]
    with ThreadPoolExecutor(4) as pool:
        assert all(found == expected for found in pool.map(read, range(4)))
