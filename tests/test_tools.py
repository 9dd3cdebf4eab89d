"""The commands, through main() as the console script calls it."""
import functools
import json
import os
import pty
import re
import shlex
import subprocess
import sys
import termios
import time

import cv2
import numpy as np
import pytest
from cv2_manners import needs_animations
from streams import random_events

import pdavis_cv
from pdavis_cv import render
from pdavis_cv.data import example_recording
from pdavis_cv.polarimetry import retimed
from pdavis_cv.tools import _common, _progress, demo, export
from pdavis_cv.tools.main import COMMANDS, main

SAMPLE = str(example_recording())


def run(*arguments):
    return main([str(argument) for argument in arguments])


def frames_of(path):
    reader = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)
    frames = []
    while (got := reader.read())[0]:
        frames.append(got[1])
    rate = reader.get(cv2.CAP_PROP_FPS)
    reader.release()
    return frames, rate


def only_files(folder):
    return sorted(path.name for path in folder.iterdir())


def test_every_command_has_a_help_with_an_example(capsys):
    for name in COMMANDS:
        assert run(name, "--help") == 0
        text = capsys.readouterr().out
        assert f"usage: pdavis {name}" in text
        assert f"example:\n  pdavis {name} " in text


def test_version(capsys):
    assert run("--version") == 0
    assert capsys.readouterr().out == f"pdavis_cv {pdavis_cv.__version__}\n"


@pytest.mark.parametrize(("arguments", "word"), [
    (["fuze"], "no command 'fuze'"),
    (["exprot"], "no command 'exprot'; did you mean export?"),
    (["export", SAMPLE, "-o", "x.mp4", "--metod", "cf"], "did you mean --method?"),
    (["export", SAMPLE, "-o", "x.mp4", "--range", "0,1"], "of which quantity?"),
    (["export", SAMPLE, "-o", "x.mp4", "--range", "aop=0,1"], "colours of the angle"),
    (["export", SAMPLE, "-o", "x.mp4", "--range", "s1=0,1"], "not among --quant"),
    (["export", SAMPLE, "-o", "x.mp4", "--range", "dolp=1,0"], "LOW must be below"),
    (["export", SAMPLE, "-o", "x.npy", "--range", "dolp=0,1"], "holds the numbers"),
    (["export", SAMPLE, "-o", "x.gif", "--fps", "200"], "0.01..50 for .gif, got 200"),
    (["info"], "required: file"),
    (["info", "nowhere.aedat4"], "nowhere.aedat4"),
    (["info", __file__], "test_tools.py"),
    (["export", SAMPLE], "required: -o"),
    (["export", SAMPLE, "-o", "x.bmp"], "-o must end in .webm"),
    (["export", SAMPLE, "-o", "x.mp4", "--fps", "0"], "must be positive, got 0"),
    (["export", SAMPLE, "-o", "x.mp4", "--roi", "1,2,3"], "4 numbers"),
    (["export", SAMPLE, "-o", "x.mp4", "--roi", "340,0,20,20"], "roi"),
    (["export", SAMPLE, "-o", "x.mp4", "--layout", "0,0,45,90"], "layout must hold"),
    (["export", SAMPLE, "-o", "x.mp4", "--method", "magic"], "method"),
    (["export", SAMPLE, "-o", "x.mp4", "--quantities", "aop,q"], "valid, got 'q'"),
    (["export", SAMPLE, "-o", "x.mp4", "--start", "100"], "no image at 100 s"),
    (["export", SAMPLE, "-o", "x.png", "--at", "100"],
     "no image at 100 s or later: the recording covers 0 .. "),
    (["export", SAMPLE, "-o", "x.png", "--at", "-1"], "must not be negative, got -1"),
    (["export", SAMPLE, "-o", "x.png", "--at", "0.1", "--fps", "5"], "--at is one"),
    (["export", SAMPLE, "-o", "x.mp4", "--set", "cutoff_hz"], "NAME=VALUE"),
    (["export", SAMPLE, "-o", "x.mp4", "--set", "no_such=1"], "no_such"),
    (["export", SAMPLE, "-o", "nowhere/x.mp4"], "nowhere"),
])
def test_a_mistake_is_one_line_and_2(arguments, word, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    more = ["--layout", "pdavis"] if "--layout" not in arguments else []
    assert main([*arguments, *(more if arguments[0] == "export" else [])]) == 2
    text = capsys.readouterr()
    assert text.out == ""
    assert text.err.startswith("pdavis: ")
    assert text.err.count("\n") == 1
    assert word in text.err
    assert not only_files(tmp_path)


def test_without_opencv_export_says_so_in_one_line(capsys, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "cv2", None)
    assert run("export", SAMPLE, "-o", tmp_path / "x.mp4") == 2
    text = capsys.readouterr().err
    assert "pip install opencv-contrib-python-headless" in text
    assert text.count("\n") == 1
    assert run("export", SAMPLE, "-o", tmp_path / "x.npy", "--fps", "20",
               "--layout", "pdavis") == 0


@pytest.fixture
def as_hdf5(tmp_path):
    path = tmp_path / "in.h5"
    assert run("convert", SAMPLE, path) == 0
    return path


@pytest.mark.parametrize("backend", [0, pdavis_cv.CAP_PDAVIS])
def test_a_capture_says_which_package_is_missing(as_hdf5, backend, monkeypatch):
    monkeypatch.setitem(sys.modules, "h5py", None)
    capture = pdavis_cv.VideoCapture(str(as_hdf5), backend)
    assert not capture.isOpened()
    assert "pip install h5py" in capture.last_error
    assert capture.read() == (False, None)
    imageio = pytest.importorskip("imageio.v3")
    from pdavis_cv.adapters.imageio_plugin import register
    register()
    with pytest.raises(OSError, match="can not handle") as failure:
        imageio.imread(as_hdf5, plugin="pdavis")
    assert "pip install h5py" in str(failure.value.__cause__)


@pytest.mark.parametrize("more", [{}, {"layout": pdavis_cv.Layout.SONY}])
def test_a_capture_without_opencv_says_so(more, tmp_path, monkeypatch):
    path = tmp_path / "shot.png"
    cv2.imwrite(str(path), np.full((8, 8), 90, np.uint8))
    monkeypatch.setitem(sys.modules, "cv2", None)
    capture = pdavis_cv.VideoCapture(str(path), **more)
    assert not capture.isOpened()
    assert "pip install opencv" in capture.last_error


def test_info_counts_the_sample(capsys):
    assert run("info", SAMPLE, "--scan") == 0
    text = capsys.readouterr().out
    for word in ("AEDAT-4", "346x260 (file)", "sensor      DAVIS346 (file)",
                 "polarizers  unknown", "thresholds  unknown", "6,676",
                 "frames      4 "):
        assert word in text
    assert "PDAVIS" not in text.replace(SAMPLE, "")


def test_info_json_is_json_and_equals_the_scan(capsys):
    assert run("info", SAMPLE, "--scan", "--json") == 0
    facts = json.loads(capsys.readouterr().out)
    with pdavis_cv.open_recording(SAMPLE) as recording:
        report = recording.scan()
    assert facts["scan"]["event_count"] == report.event_count == 6676
    assert facts["scan"]["start_us"] == report.start_us
    assert facts["info"]["sensor_size"] == [260, 346]
    assert facts["problems"] == []


def test_export_video_holds_one_picture_per_image(tmp_path, capsys):
    path = tmp_path / "x.avi"
    assert run("export", SAMPLE, "-o", path, "--fps", 200, "--slow", 8,
               "--layout", "pdavis", "--stop", 0.12, "--method", "cf") == 0
    frames, rate = frames_of(path)
    with pdavis_cv.open_recording(SAMPLE) as recording:
        start = recording.info.start_us or recording.scan().start_us
        images = list(pdavis_cv.fuse(recording, fps=200, layout=pdavis_cv.Layout.PDAVIS,
                                     method="cf", stop_us=start + 120_000))
    assert len(frames) == len(images) > 10
    assert rate == pytest.approx(25)
    assert all(side % 2 == 0 for side in frames[0].shape[:2])
    text = capsys.readouterr()
    assert text.out.startswith(f"wrote {path}: {len(images)} pictures")
    assert text.err == ""


def test_export_warns_in_one_line_that_the_layout_is_unknown(tmp_path, capsys):
    assert run("export", SAMPLE, "-o", tmp_path / "x.npy", "--at", 0.1) == 0
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1
    assert lines[0].startswith("pdavis: warning: polarizer layout unknown")


def test_export_npy_holds_the_images_of_fuse(tmp_path):
    path = tmp_path / "x.npy"
    assert run("export", SAMPLE, "-o", path, "--fps", 100, "--layout", "sony",
               "--quantities", "aop,i45", "--roi", "11,20,41,33") == 0
    with pdavis_cv.open_recording(SAMPLE) as recording:
        images = list(pdavis_cv.fuse(recording, fps=100, layout=pdavis_cv.Layout.SONY,
                                     roi=(11, 20, 41, 33)))
    got = np.load(path)
    assert got.shape == (len(images), 2, 33, 41)
    for planes, image in zip(got, images, strict=True):
        np.testing.assert_array_equal(
            planes, np.where(image.valid, [image.aop, image.quad[1]], np.nan))
    facts = json.loads((tmp_path / "x.npy.json").read_text())
    assert facts["quantities"] == ["aop", "i45"]
    assert facts["units"] == ["rad", "DN/ms"]
    assert facts["t_us"] == [image.t_us for image in images]
    assert facts["provenance"]["method"] == images[0].provenance["method"]


def test_export_png_at_a_time_is_one_picture(tmp_path):
    path = tmp_path / "x.png"
    assert run("export", SAMPLE, "-o", path, "--at", 0.1, "--bare", "--aop", "full",
               "--layout", "pdavis", "--quantities", "aop") == 0
    assert only_files(tmp_path) == ["x.png"]
    picture = cv2.imread(str(path))
    assert picture.shape == (260, 346, 3)
    with pdavis_cv.open_recording(SAMPLE) as recording:
        start = recording.info.start_us or recording.scan().start_us
        image, = pdavis_cv.fuse(recording, times_us=[start + 100_000],
                                layout=pdavis_cv.Layout.PDAVIS)
    np.testing.assert_array_equal(
        picture, pdavis_cv.render.aop_bgr(image.aop, image.valid))


def test_one_image_is_one_picture_and_several_are_numbered(tmp_path):
    common = ("--layout", "pdavis", "--quantities", "s0", "--bare", "--method",
              "frames")
    assert run("export", SAMPLE, "-o", tmp_path / "x.png", "--stop", 0.02, *common) == 0
    assert only_files(tmp_path) == ["x.png"]
    assert run("export", SAMPLE, "-o", tmp_path / "y.png", "--stop", 0.06,
               *common) == 0
    assert only_files(tmp_path)[:3] == ["x.png", "y-00000.png", "y-00001.png"]


def test_figures_and_scaled_pictures_have_the_sizes_asked_for(tmp_path, capsys):
    pytest.importorskip("matplotlib")
    common = ("--layout", "pdavis", "--quantities", "s0", "--method", "frames", "--at",
              "0.1")
    for name in ("x.pdf", "x.svg", "x.png"):
        assert run("export", SAMPLE, "-o", tmp_path / name, *common,
                   "--width-mm", "85", "--pixel-um", "0.7") == 0
    assert cv2.imread(str(tmp_path / "x.png")).shape[1] == int(85 / 25.4 * 300)
    assert run("export", SAMPLE, "-o", tmp_path / "x.png", *common, "--scale", "3",
               "--bare") == 0
    assert cv2.imread(str(tmp_path / "x.png")).shape == (780, 1038, 3)
    assert only_files(tmp_path) == ["x.pdf", "x.png", "x.svg"]
    for options, message in ((("x.webm", "--width-mm", "85"), "are for .pdf, .svg"),
                             (("x.pdf", "--scale", "2"), "a figure has a width")):
        assert run("export", SAMPLE, "-o", tmp_path / options[0], *common,
                   *options[1:]) == 2
        assert message in capsys.readouterr().err


def test_a_video_fills_a_screen(tmp_path):
    assert run("export", example_recording("fan"), "-o", tmp_path / "x.mp4", "--stop",
               "0.1", "--method", "frames", "--quantities", "aop,dolp") == 0
    video = cv2.VideoCapture(str(tmp_path / "x.mp4"))
    assert video.get(cv2.CAP_PROP_FRAME_HEIGHT) >= 504     # 9 x 56, and text
    video.release()


def test_the_top_of_dolp_colours_the_same_numbers_otherwise(tmp_path):
    path = tmp_path / "dolp.png"
    assert run("export", SAMPLE, "-o", path, "--layout", "pdavis", "--at", "0.1",
               "--method", "frames", "--quantities", "dolp", "--bare",
               "--range", "dolp=0,0.25") == 0
    with pdavis_cv.open_recording(SAMPLE, layout="pdavis") as recording:
        image, = pdavis_cv.fuse(recording, method="frames", times_us=[
            recording.info.start_us + 100_000])
    want = render.dolp_bgr(image.dolp, image.valid, top=0.25)
    np.testing.assert_array_equal(cv2.imread(str(path)), want)
    assert (want != render.dolp_bgr(image.dolp, image.valid)).any()


@functools.cache
def image_of_fan():
    with pdavis_cv.open_recording(example_recording("fan")) as recording:
        image, = pdavis_cv.fuse(
            recording, method="kalman", mode="offline", clock_offset_us=None,
            times_us=[recording.info.start_us + 300_000])
    return image


def exported(path, *options):
    """Return AoP of the fan as `pdavis export --bare` shows it, and its image."""
    assert run("export", example_recording("fan"), "-o", path, "--at", "0.3", "--bare",
               "--method", "kalman", "--set", "mode=offline", "--clock-offset", "none",
               "--quantities", "aop", *options) == 0
    return cv2.imread(str(path)), image_of_fan()


def test_angles_fade_by_dolp_unless_asked_otherwise(tmp_path):
    shown, image = exported(tmp_path / "x.png", "--range", "dolp=0.1,0.5")
    want = render.aop_bgr(image.aop, image.valid)
    assert (shown != want).any()
    render.fade_aop(want, image, low=0.1, top=0.5)
    np.testing.assert_array_equal(shown, want)
    shown, _ = exported(tmp_path / "x.png", "--aop", "hsv", "--background", "light")
    want = render.aop_bgr(image.aop, image.valid, colours="hsv")
    render.fade_aop(want, image, ground=255)
    np.testing.assert_array_equal(shown, want)


def test_angles_are_masked_by_dolp_and_by_their_uncertainty(tmp_path):
    shown, image = exported(
        tmp_path / "x.png", "--mask-dolp", "0.5", "--mask-sigma", "1", "--aop", "full")
    good = image.valid & (image.dolp >= 0.5) & (image.sigma_aop <= np.deg2rad(1))
    assert 0 < np.count_nonzero(good) < good.size
    want = render.aop_bgr(image.aop, image.valid)
    want[image.valid & ~good] = render.MASKED
    np.testing.assert_array_equal(shown, want)


def test_pictures_have_a_scale_bar_and_a_light_background(tmp_path):
    options = ("export", SAMPLE, "-o", tmp_path / "x.png", "--layout", "pdavis", "--at",
               "0.1", "--method", "frames", "--quantities", "s0,dolp")
    assert run(*options) == 0
    plain = cv2.imread(str(tmp_path / "x.png"))
    assert run(*options, "--pixel-um", "0.74") == 0
    barred = cv2.imread(str(tmp_path / "x.png"))
    changed = np.argwhere((barred != plain).any(-1))
    assert len(changed) > 100
    # in the lower right part of either picture: 260 rows from row 48 on
    assert changed[:, 0].min() > 48 + 260 - 40
    assert (np.diff(np.unique(changed[:, 1])) > 200).sum() == 1
    assert run(*options, "--background", "light") == 0
    light = cv2.imread(str(tmp_path / "x.png"))
    assert light.shape == plain.shape
    assert np.median(light[:20]) == 255


def test_a_title_that_grows_leaves_the_size_of_a_video(tmp_path):
    args = export._parser().parse_args(
        [str(SAMPLE), "-o", str(tmp_path / "x.webm"), "--quantities", "s0", "--scale",
         "1", "--title", "wider than its picture is " * 3])
    with pdavis_cv.open_recording(SAMPLE, layout="pdavis") as recording:
        image = next(pdavis_cv.fuse(recording, method="frames"))
        sheet = export.Sheet(args, recording, image)
        shapes = {sheet.picture(retimed(
            image, sheet.origin_us + seconds * 1_000_000, None, image.provenance)).shape
            for seconds in (1, 9, 10, 1234)}
    assert len(shapes) == 1


@pytest.mark.parametrize(("arguments", "images"), [
    (("export", SAMPLE, "-o", "x.npy", "--layout", "pdavis", "--method", "frames"), 4),
    pytest.param(("export", SAMPLE, "-o", "x.webp", "--layout", "pdavis", "--method",
                  "frames", "--quantities", "s0"), 4, marks=needs_animations),
    (("convert", SAMPLE, "x.aedat"), None),
    (("simulate", "polarizer", "-o", "x.aedat4", "--seconds", ".1", "--size", "4x4"),
     None)])
def test_json_says_what_was_written(arguments, images, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert run(*arguments, "--json") == 0
    told = json.loads(capsys.readouterr().out)
    assert told["wrote"]
    assert set(told["wrote"]) <= set(only_files(tmp_path))
    assert told.get("images") == images


def test_progress_is_told_to_a_log_only_when_asked_for(tmp_path, capsys):
    for more, silent in (((), True), (("--progress",), False), ((), True)):
        assert run("export", SAMPLE, "-o", tmp_path / "x.npy", "--layout", "pdavis",
                   "--method", "frames", *more) == 0
        text = capsys.readouterr().err
        assert (text == "") == silent
    assert run("simulate", "polarizer", "-o", tmp_path / "x.aedat4", "--seconds", ".1",
               "--size", "4x4", "--progress") == 0
    assert re.search(r"\d+%\|.*\[.*<.*\]", capsys.readouterr().err)   # time left


def test_a_stage_tells_for_how_long_it_goes_on(capsys, monkeypatch):
    monkeypatch.setattr(_progress, "_EVERY_S", 0.01)

    @_common.command
    def slow(argv=None):
        _common.Parser("slow", "", "").parse_args(argv)
        _progress.stage("learning")
        deadline = time.monotonic() + 30
        while "learning: " not in "".join(said) and time.monotonic() < deadline:
            said.append(capsys.readouterr().err)
            time.sleep(0.005)
        return 0

    said = []
    assert slow(["--progress"]) == 0
    assert said[0].startswith("pdavis: learning ...\n")
    assert "pdavis: learning: 0.01 s" in "".join(said)
    assert _progress._Stage.now is None


def test_export_png_without_a_time_is_a_series(tmp_path, capsys):
    assert run("export", SAMPLE, "-o", tmp_path / "x.png", "--fps", 50,
               "--layout", "pdavis") == 0
    names = only_files(tmp_path)
    assert names[0] == "x-00000.png"
    assert len(names) > 3
    assert f"x-00000.png .. {names[-1]}" in capsys.readouterr().out


@pytest.mark.parametrize("more", [
    [], ["--at", "0"], ["--start", "0", "--stop", "1", "--fps", "5"]])
def test_an_empty_recording_gives_no_picture(more, tmp_path, capsys):
    with pdavis_cv.Aedat4Writer(tmp_path / "none.aedat4", sensor_size=(4, 6)):
        pass
    assert run("export", tmp_path / "none.aedat4", "-o", tmp_path / "x.png", *more,
               "--layout", "pdavis") == 2
    error = capsys.readouterr().err
    assert "none.aedat4: holds no frame and no event" in error
    assert error.count("\n") == 1
    assert only_files(tmp_path) == ["none.aedat4"]


def _written(path, dn, event_count):
    """Write a recording of frames of one DN (none if it is None) and events."""
    with pdavis_cv.Aedat4Writer(path, sensor_size=(20, 30)) as writer:
        for k in range(0 if dn is None else 5):
            writer.add(pdavis_cv.Packet(frames=(pdavis_cv.ApsFrame(
                np.full((20, 30), dn, np.float32), 40_000 * k, 40_000 * k + 10_000),)))
        events = random_events(event_count, (20, 30), start_us=200_000)
        writer.add(pdavis_cv.Packet(events=events))


@pytest.mark.parametrize(("dn", "method", "why"), [
    (1023, "kalman", "100% of the pixels of its frames are saturated"),
    (1023, "frames", "100% of the pixels of its frames are saturated"),
    (None, "kalman", "method 'kalman' needs frames, and there are none"),
    (None, "cf", "method 'cf' needs frames, and there are none"),
])
@pytest.mark.parametrize("name", ["x.npy", "x.png", "x.mp4", "x.npz"])
def test_images_without_a_valid_pixel_say_why(dn, method, why, name, tmp_path, capsys):
    _written(tmp_path / "in.aedat4", dn, 500)
    assert run("export", tmp_path / "in.aedat4", "-o", tmp_path / name, "--fps", 10,
               "--method", method, "--layout", "pdavis",
               "--thresholds", "nominal") == 0
    text = capsys.readouterr().err
    assert text.count("no image has a valid pixel") == 1
    assert why in text


@pytest.mark.parametrize("dn", [1023, None])
def test_a_turning_analyser_without_a_valid_pixel_says_why(dn, tmp_path, capsys):
    _written(tmp_path / "in.aedat4", dn, 50)
    assert run("export", tmp_path / "in.aedat4", "-o", tmp_path / "x.npy", "--fps", 10,
               "--analyser-rpm", 600, "--thresholds", "nominal") == 0
    assert "a pixel needs some events within the turns" in capsys.readouterr().err


@pytest.mark.parametrize(("dn", "why"), [
    (1023, "100% of the pixels of its frames are saturated"),
    (None, "needs frames, and there are none")])
@pytest.mark.parametrize("command", ["fan", "tendon"])
def test_other_commands_say_why_no_pixel_is_valid(command, dn, why, tmp_path, capsys):
    _written(tmp_path / "in.aedat4", dn, 500)
    out = tmp_path / ("out" if command == "tendon" else "out.mp4")
    run(command, tmp_path / "in.aedat4", "-o", out, "--fps", 10, "--method", "cf",
        "--layout", "pdavis", "--thresholds", "nominal")
    assert f"no image has a valid pixel: {'method' * (dn is None)}" in (
        text := capsys.readouterr().err)
    assert why in text


@pytest.mark.parametrize("command", ["fan", "tendon", "export"])
def test_a_time_outside_the_recording_names_its_range(command, tmp_path, capsys):
    out = tmp_path / ("out" if command == "tendon" else "out.mp4")
    assert run(command, SAMPLE, "-o", out, "--start", 100, "--layout", "pdavis") == 2
    assert "the recording covers 0 .. " in capsys.readouterr().err


def test_images_with_valid_pixels_warn_of_nothing(tmp_path, capsys):
    _written(tmp_path / "in.aedat4", 500, 500)
    assert run("export", tmp_path / "in.aedat4", "-o", tmp_path / "x.npy",
               "--method", "frames", "--layout", "pdavis") == 0
    assert capsys.readouterr().err == ""


def test_every_command_opens_images_with_a_layout(tmp_path, capsys):
    rows, columns = np.mgrid[:40, :60]
    path = tmp_path / "shot.png"
    cv2.imwrite(str(path), (100 + rows + columns % 2 * 40).astype(np.uint8))
    assert run("info", path) == 2
    assert "--layout" in capsys.readouterr().err
    assert run("info", path, "--layout", "sony", "--json") == 0
    assert json.loads(capsys.readouterr().out)["info"]["frame_count"] == 1
    assert run("export", path, "-o", tmp_path / "x.npy", "--layout", "sony") == 0
    with pdavis_cv.open_recording(path, layout=pdavis_cv.Layout.SONY) as recording:
        image, = pdavis_cv.fuse(recording)
    np.testing.assert_array_equal(np.load(tmp_path / "x.npy")[0, 1], image.aop)
    assert run("convert", path, tmp_path / "x.aedat4", "--layout", "sony") == 0
    with pdavis_cv.open_recording(tmp_path / "x.aedat4") as recording:
        assert recording.info.layout == pdavis_cv.Layout.SONY


def test_no_command_opens_a_recording_past_the_one_way(root):
    for path in (root / "tools").rglob("*.py"):
        calls = len(re.findall(r"\bopen_(?:recording|source)\(", path.read_text()))
        # fan's second camera has options of its own
        assert calls == {"_options.py": 1, "fan.py": 1}.get(path.name, 0), path


def test_progress_shows_on_a_terminal_only(tmp_path):
    command = [sys.executable, "-P", "-m", "pdavis_cv.tools.main", "export", SAMPLE,
               "-o", str(tmp_path / "x.npy"), "--layout", "pdavis", "--method", "cf"]
    piped = subprocess.run(command, capture_output=True, text=True, check=True)
    assert piped.stderr == ""
    main_end, child_end = pty.openpty()
    termios.tcsetwinsize(child_end, (24, 80))
    subprocess.run(command, stdout=subprocess.DEVNULL, stderr=child_end, check=True)
    os.set_blocking(main_end, False)
    shown = os.read(main_end, 4096)
    os.close(child_end)
    os.close(main_end)
    assert b"images" in shown


@pytest.mark.accuracy
@pytest.mark.gate
def test_demo_reports_small_errors_and_large_ones_for_frames(
        tmp_path, capsys, monkeypatch):
    shorter = [*demo._FAN[:-1], "0.3", "--scale", "1"]
    monkeypatch.setattr(demo, "_FAN", shorter)
    called = tmp_path / "bin" / "pdavis"    # not on the PATH
    monkeypatch.setattr(sys, "argv", [str(called), "demo"])
    assert run("demo", "-o", tmp_path, "--json") == 0
    printed = capsys.readouterr()
    told = json.loads(printed.out)
    aop = told["polarizer_aop_error_deg"]
    assert aop["frames"] > 25
    assert aop["kalman"] < 1
    dolp = told["tendon_dolp_error"]
    assert dolp["kalman"] < 0.03 < 0.1 < dolp["frames"]
    assert f"AoP error {aop['frames']:.1f} degrees" in printed.err
    assert only_files(tmp_path) == [
        "davis346_short.webm", "fan.aedat4", "fan.png", "fan.webm",
        "polarizer_1000rpm.png", "tendon.aedat4", "tendon.png"]
    assert sorted(told["wrote"]) == [
        str(tmp_path / name) for name in only_files(tmp_path)]
    assert len(frames_of(tmp_path / "fan.webm")[0]) == 5
    program, *next_line = shlex.split(printed.err.splitlines()[-1])
    assert program == str(called)
    next_line[next_line.index("-o") + 1] = str(tmp_path / "more.webm")
    assert main(next_line) == 0


def test_without_fps_every_way_gives_one_image_for_each_frame(tmp_path, capsys):
    path = pdavis_cv.data.example_recording("tendon")
    with pdavis_cv.open_recording(path) as recording:
        times = [image.t_us for image in pdavis_cv.fuse(recording, method="cf")]
    assert len(times) == 20
    with pdavis_cv.VideoCapture(path, method="cf") as capture:
        assert capture.get(cv2.CAP_PROP_FRAME_COUNT) == 20
    assert run("export", path, "-o", tmp_path / "x.npz", "--method", "cf",
               "--quantities", "s0") == 0
    assert "one image for each frame; --fps" in capsys.readouterr().out
    with np.load(tmp_path / "x.npz") as arrays:
        assert arrays["t_us"].tolist() == times


def test_a_recording_is_replaced_by_force_only_and_never_by_its_own_images(
        tmp_path, capsys):
    flat = ["simulate", "flat", "--seconds", "0.1", "--size", "4x4"]
    path = tmp_path / "a.aedat4"
    assert run(*flat, "-o", path) == 0
    old = path.read_bytes()
    for command in (flat, ["convert", SAMPLE]):
        out = ["-o", path] if command is flat else [path]
        assert run(*command, *out) == 2
        assert "--force replaces it" in capsys.readouterr().err
    assert path.read_bytes() == old
    assert run(*flat, "--seed", 1, "--force", "-o", path) == 0
    e2p = tmp_path / "a.h5"
    assert run("convert", path, e2p) == 0
    old = e2p.read_bytes()
    assert run("export", e2p, "-o", e2p) == 2
    assert "is the recording that is read" in capsys.readouterr().err
    assert e2p.read_bytes() == old


def test_the_samples_index_without_counts_is_not_believed():
    with pdavis_cv.open_recording(SAMPLE) as recording:
        assert recording.info.event_count is None
        assert recording.info.stop_us is None
        report = recording.scan()
        assert 0 < report.stop_us - recording.info.start_us < 300_000
        assert report.problems == ()


def test_pictures_of_a_video_keep_their_width_when_a_title_gets_shorter(
        tmp_path, monkeypatch):
    titles = iter(["a title that is wider than its picture " * 10])
    monkeypatch.setattr(export.Sheet, "_title", lambda self, frame: next(titles, "t"))
    assert run("export", SAMPLE, "-o", tmp_path / "x.avi", "--fps", "20") == 0
