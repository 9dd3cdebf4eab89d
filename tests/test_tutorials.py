"""Every block of docs/start runs in order, and makes the pictures it shows."""
import contextlib
import io
import re
import shlex
import shutil
from pathlib import Path

import cv2
import pytest

import pdavis_cv
from pdavis_cv.data import example_recording
from pdavis_cv.tools.main import main

START = Path(__file__).resolve().parents[1] / "docs" / "start"
PAGES = sorted(START.glob("*.md"))
FAR = 3.0
"""Mean difference of grey levels at which a picture shows something else.

Of means of 8x8 pixels, as OpenCV and matplotlib write with other fonts by version.
"""


def run(page, folder):
    """Run the blocks of a page in a folder; return what they print."""
    printed = io.StringIO()
    names = {"__name__": "tutorial"}
    with contextlib.redirect_stdout(printed):
        for language, block in re.findall(
                r"^```(\w+)\n(.*?)^```", page.read_text(), re.M | re.S):
            if language == "python":
                exec(compile(block, page.name, "exec"), names)
            else:
                for line in block.strip().splitlines():
                    program, *arguments = shlex.split(line)
                    assert program == "pdavis", line
                    assert main(arguments) == 0, line
    return printed.getvalue()


def test_there_is_a_tutorial_for_each_kind_of_user():
    assert {page.stem for page in PAGES} == {
        "opencv", "notebook", "microscopy", "robotics", "sony", "jaer-dv",
        "calibration", "turning", "any-camera"}


@pytest.mark.parametrize("name", ["fan", "tendon"])
def test_simulated_examples_state_their_sensor(name):
    """Else S1 and S2 are not corrected for its extinction ratio."""
    with pdavis_cv.open_recording(example_recording(name)) as recording:
        assert recording.info.sensor is pdavis_cv.Sensor.PDAVIS


@pytest.mark.gate
@pytest.mark.parametrize("page", [
    # its figures show errors, and so how well the camera is learned
    pytest.param(page, id=page.stem, marks=pytest.mark.accuracy if (
        page.stem == "notebook") else ()) for page in PAGES])
def test_a_tutorial_runs_and_makes_its_pictures(page, tmp_path, monkeypatch):
    for module in ("matplotlib", "pandas", "tifffile", "xarray"):
        pytest.importorskip(module)
    (tmp_path / "demo").mkdir()
    for name in ("fan", "tendon"):
        shutil.copy(example_recording(name), tmp_path / "demo" / f"{name}.aedat4")
    monkeypatch.chdir(tmp_path)
    assert run(page, tmp_path)
    for name in re.findall(r"!\[.*?\]\((.*?)\)", page.read_text()):
        made, shown = cv2.imread(str(tmp_path / name)), cv2.imread(str(START / name))
        assert made.shape == shown.shape, name
        size = made.shape[1] // 8, made.shape[0] // 8
        assert cv2.absdiff(*(cv2.resize(one, size, interpolation=cv2.INTER_AREA)
                             for one in (made, shown))).mean() < FAR, name
