"""pdavis webcam, with a stand-in for the system's virtual camera."""
import sys
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest

import pdavis_cv
from pdavis_cv.data import example_recording
from pdavis_cv.tools.main import main

pytest.importorskip("cv2")
SOURCE = str(example_recording("fan"))


@pytest.fixture
def cameras(monkeypatch):
    made = []

    class Camera:
        def __init__(self, width, height, fps, *, fmt, device):
            if device == "/dev/none":
                raise RuntimeError("no loopback\ndevice found")
            self.lasts = 3 if device == "/dev/gone" else 10**9
            self.size, self.fps, self.fmt = (width, height), fps, fmt
            self.device, self.sent = device or "/dev/video7", []
            made.append(self)

        def send(self, picture):
            self.sent.append(picture.copy())
            if len(self.sent) > self.lasts:
                raise RuntimeError("write failed")

        def sleep_until_next_frame(self):
            pass

        def __enter__(self):
            return self

        def __exit__(self, *exc):
            self.closed = True

    module = ModuleType("pyvirtualcam")
    module.Camera, module.PixelFormat = Camera, SimpleNamespace(BGR="bgr")
    monkeypatch.setitem(sys.modules, "pyvirtualcam", module)
    return made


def test_a_webcam_shows_the_pictures_of_a_capture(cameras, capsys):
    assert main(["webcam", SOURCE, "--fps", "20", "--method", "cf", "--output",
                 "dolp_bgr"]) == 0
    [camera] = cameras
    assert (camera.size, camera.fps, camera.fmt) == ((56, 56), 20, "bgr")
    assert camera.closed
    with pdavis_cv.VideoCapture(
            SOURCE, fps=20, method="cf", output="dolp_bgr") as capture:
        wanted = [picture for ok, picture in iter(capture.read, (False, None))]
    np.testing.assert_array_equal(camera.sent, wanted)
    assert capsys.readouterr().out.splitlines() == [
        "/dev/video7: 56x56, 20 per second", f"{len(wanted)} images"]


def test_a_package_that_cannot_be_imported_is_one_line(tmp_path, monkeypatch, capsys):
    (tmp_path / "pyvirtualcam.py").write_text("raise RuntimeError('of another NumPy')")
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.delitem(sys.modules, "pyvirtualcam", raising=False)
    assert main(["webcam", SOURCE]) == 2
    assert capsys.readouterr().err == ("pdavis: pyvirtualcam is installed, but cannot "
                                       "be imported: of another NumPy\n")


@pytest.mark.parametrize(("arguments", "message"), [
    ((SOURCE, "--device", "/dev/none"), "no loopback device found"),
    ((SOURCE, "--device", "/dev/gone"), "/dev/gone: write failed"),
    (("none.aedat4",), "cannot be opened")])
def test_mistakes_are_one_line(cameras, capsys, arguments, message):
    assert main(["webcam", *arguments]) == 1 + (message != "/dev/gone: write failed")
    said = capsys.readouterr().err
    assert message in said
    assert said.count("\n") == 1
