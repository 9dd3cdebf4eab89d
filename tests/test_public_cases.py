"""Public cases: inputs that users bring, with the answers that other readers gave.

They lie in ``public`` beside the test data, which may be absent.
"""
import os
from pathlib import Path

import numpy as np
import pytest

from pdavis_cv import VideoCapture, open_recording
from pdavis_cv.tools.main import main

PUBLIC = Path(os.environ.get("PDAVIS_TEST_DATA", "missing")) / "public"
pytestmark = [pytest.mark.skipif(not PUBLIC.is_dir(), reason="no public test data"),
              pytest.mark.filterwarnings("ignore::pdavis_cv.PdavisWarning")]

# name: (options, (height, width), events, frames)
CASES = {
    "ros2_libcaer": ({}, (480, 640), 334_331, 0),
    "davis_ros2": ({}, (64, 80), 6000, 15),
    "stereo.aedat4": ({"camera": "00000002"}, (260, 346), 2000, 8),
    "v2e_240x180.aedat": ({}, (180, 240), 5000, 0),
    "e2vid_events.txt": ({}, (180, 240), 4000, 0),
    "v2e_text_label1.txt": ({}, (260, 346), 3000, 0),
    "stack_50fps.ome.tif": ({"layout": "sony"}, (64, 80), 0, 100),
    "imagej_single_ifd.tif": ({"layout": "sony"}, (64, 80), 0, 40),
    "slow_stack_500.tif": ({"layout": "sony"}, (16, 16), 0, 500),
    "g12.mkv": ({"layout": "sony"}, (128, 160), 0, 10),
    "vfr.mkv": ({"layout": "sony"}, None, 0, 10),
    "real_mjpg.avi": ({"layout": "sony"}, (1024, 1224), 0, 3),
    "mono10_saturated.png": ({"layout": "sony"}, (128, 160), 0, 1),
    "natural_sort/shot_*.png": ({"layout": "sony"}, (128, 160), 0, 12),
    "100% pol/shot_%04d.png": ({"layout": "sony"}, (128, 160), 0, 1),
    "start3/shot_%04d.png": ({"layout": "sony"}, (128, 160), 0, 2),
}
# name: (first and last time in us, sum of the first frame, sum of the last frame)
FRAMES = {
    "davis_ros2": (1_700_000_000_000_000, 1_700_000_000_462_000, 508_742, 510_038),
    "imagej_single_ifd.tif": (0, 780_000, 3_053_490, 3_088_852),
    "slow_stack_500.tif": (0, 19_960_000, 533_611, 516_105),
    "g12.mkv": (0, 360_000, 12_250_308, None),
    "vfr.mkv": (0, 820_000, 756_016, None),
    "100% pol/shot_%04d.png": (0, 0, 12_248_703, 12_248_703),
    "start3/shot_%04d.png": (0, 40_000, 12_249_188, 12_251_228),
}
ORIGINS = {
    "stack_50fps.ome.tif": ("frame_times", "file"),
    "slow_stack_500.tif": ("frame_times", "assumed"),
    "mono10_saturated.png": ("full_scale_dn", "measured"),
    "v2e_240x180.aedat": ("sensor_size", "assumed"),
    "e2vid_events.txt": ("sensor_size", "file"),
}


@pytest.mark.parametrize("name", CASES)
def test_counts_times_and_depth_are_right(name):
    options, size, events, frames = CASES[name]
    with open_recording(PUBLIC / name, **options) as recording:
        assert size in (None, recording.info.sensor_size)
        found = recording.scan()
        assert (found.event_count, found.frame_count) == (events, frames)
        if name in ORIGINS:
            fact, origin = ORIGINS[name]
            assert recording.info.facts[fact].origin == origin
        if name in FRAMES:
            every = [one for packet in recording.packets() for one in packet.frames]
            start, stop, first, last = FRAMES[name]
            assert [every[i].mid_us for i in (0, -1)] == [start, stop]
            assert int(every[0].dn.sum(dtype=np.float64)) == first
            assert last is None or int(every[-1].dn.sum(dtype=np.float64)) == last


@pytest.mark.parametrize("name", CASES)
def test_a_case_is_shown_exported_and_a_video(name, tmp_path, capsys):
    options = {"layout": "pdavis", **CASES[name][0]}
    flags = [part for key, value in options.items() for part in (f"--{key}", value)]
    path = str(PUBLIC / name)
    assert main(["info", path, *flags]) == 0, capsys.readouterr().err
    out = tmp_path / "x.npy"
    assert main(["export", path, "-o", str(out), *flags, "--stop", "0.1",
                 "--method", "frames" if CASES[name][3] else "events"]) == 0, (
                     capsys.readouterr().err)
    assert np.load(out).shape[1] == 3
    with VideoCapture(path, output="aop_bgr", **options) as capture:
        assert capture.isOpened(), capture.last_error
        assert capture.read()[0], capture.last_error


def test_several_cameras_are_named_in_the_words_of_the_command_line(capsys):
    assert main(["info", str(PUBLIC / "stereo.aedat4")]) == 2
    said = capsys.readouterr().err
    assert "--camera: DAVIS346_00000001, DAVIS346_00000002" in said
    assert said.count("\n") == 1


def test_a_mosaic_of_colours_is_found_and_named(capsys):
    path = str(PUBLIC / "imx250myr_colour.png")
    assert main(["info", path, "--layout", "sony"]) == 0
    said = capsys.readouterr()
    assert "((90, 45), (135, 0)) rggb" in said.out
    assert "IMX250MYR" in said.err
