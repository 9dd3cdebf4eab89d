"""The commands of docs/tools.md run as they stand."""
import re
import shlex
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from cv2_manners import VERSION

import pdavis_cv
from pdavis_cv import open_recording
from pdavis_cv.data import example_recording
from pdavis_cv.tools.main import main

PAGE = Path(__file__).resolve().parents[1] / "docs" / "tools.md"
LINES = re.findall(r"\| `pdavis ([^`]+)` \|$", PAGE.read_text(), re.M)
RUNS_ON = ("view", "stream", "webcam", "devices")   # servers and cameras
ELSEWHERE = ("weights", "demo")             # tests/test_checkpoint.py, test_tools.py
SIZE = ("--size", "16x16")
WHAT_THE_SHELL_FINDS = ["recording.aedat4"]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Return a folder with the files that the commands name."""
    folder = tmp_path_factory.mktemp("tools")
    for scene, seconds, name in (("polarizer", "2", "recording.aedat4"),
                                 ("dark", "1", "covered.aedat4"),
                                 ("malus", "37", "steps.aedat4")):
        assert main(["simulate", scene, *SIZE, "--seconds", seconds,
                     "-o", str(folder / name)]) == 0
    assert main(["convert", str(example_recording()), str(folder / "old.aedat")]) == 0
    shutil.copy(example_recording("tendon"), folder / "tendon.aedat4")
    with open_recording(example_recording("fan")) as fan:   # a fifth of it
        pdavis_cv.write_aedat4(folder / "fan.aedat4", pdavis_cv.source_from_packets(
            fan.info, fan.packets(None, fan.info.start_us + 200_000)))
    mosaic = np.random.default_rng(0).integers(50, 200, (32, 48), np.uint8)
    cv2.imwrite(str(folder / "still.png"), mosaic)
    return folder


@pytest.mark.gate
def test_the_commands_of_the_page_run(folder, monkeypatch):
    pytest.importorskip("tifffile")
    monkeypatch.chdir(folder)
    ran = []
    for line in LINES:
        command, *arguments = [
            path for word in shlex.split(line)
            for path in (WHAT_THE_SHELL_FINDS if "*" in word else [word])]
        if command not in RUNS_ON + ELSEWHERE:
            refused = VERSION < (4, 12) and "fused.webp" in arguments    # by OpenCV
            assert main([command, *arguments]) == 2 * refused, line
            ran.append(command)
    assert len(ran) > 15
