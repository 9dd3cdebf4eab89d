"""pdavis export --what aop-events: what AopEvents gives, in files."""
import csv
import json
import signal

import cv2
import numpy as np
import pytest

import pdavis_cv
from pdavis_cv.data import example_recording
from pdavis_cv.render import aop_bgr
from pdavis_cv.tools.main import main

SAMPLE = str(example_recording())
MORE = ["--what", "aop-events", "--layout", "pdavis", "--start", "0.1", "--stop", "0.2",
        "--set", "correct_phase=true"]


@pytest.fixture(scope="module")
def expected():
    with pdavis_cv.open_recording(SAMPLE, layout="pdavis") as recording:
        start = recording.info.start_us or 0
        stream = pdavis_cv.AopEvents(
            recording.info.sensor_size, theta_on=0.2, theta_off=0.2,
            layout="pdavis", correct_phase=True)
        return stream.add(recording.events(start + 100_000, start + 200_000))


def test_the_array_holds_the_stream(tmp_path, expected):
    out = tmp_path / "aop.npy"
    assert main(["export", SAMPLE, "-o", str(out), *MORE]) == 0
    np.testing.assert_array_equal(np.load(out), expected)
    facts = json.loads((tmp_path / "aop.npy.json").read_text())
    assert facts["units"]["aop"] == "rad"
    assert facts["correct_phase"] is True


def test_a_disk_without_room_for_the_last_byte_is_an_error(tmp_path, capsys):
    resource = pytest.importorskip("resource")
    out = tmp_path / "aop.npy"
    assert main(["export", SAMPLE, "-o", str(out), *MORE]) == 0
    size = out.stat().st_size
    out.unlink()
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    previous = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size - 1, hard))
    try:
        code = main(["export", SAMPLE, "-o", str(out), *MORE])
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
        signal.signal(signal.SIGXFSZ, previous)
    assert code == 1
    assert str(out) in capsys.readouterr().err
    assert not out.exists()


def test_the_table_holds_it_in_degrees(tmp_path, expected):
    out = tmp_path / "aop.csv"
    assert main(["export", SAMPLE, "-o", str(out), *MORE]) == 0
    with out.open() as file:
        rows = list(csv.reader(file))
    assert rows[0] == ["t_us", "x", "y", "aop_deg"]
    found = np.array(rows[1:], float)
    for k, name in enumerate("txy"):
        np.testing.assert_array_equal(found[:, k], expected[name])
    np.testing.assert_allclose(found[:, 3], np.rad2deg(expected["aop"]), atol=6e-4)


def test_a_picture_shows_each_pixels_last_angle(tmp_path, expected):
    out = tmp_path / "aop.avi"
    assert main(["export", SAMPLE, "-o", str(out), *MORE, "--fps", "20"]) == 0
    video = cv2.VideoCapture(str(out))
    first = video.read()[1]
    assert video.get(cv2.CAP_PROP_FRAME_COUNT) == 2
    video.release()
    with pdavis_cv.open_recording(SAMPLE, layout="pdavis") as recording:
        shape, start = recording.info.sensor_size, recording.info.start_us or 0
    last = np.full(shape, np.nan, np.float32)
    mine = expected[expected["t"] < start + 150_000]
    last[mine["y"], mine["x"]] = mine["aop"]
    scale = first.shape[0] // shape[0]
    small = cv2.resize(first, shape[::-1], interpolation=cv2.INTER_AREA).astype(float)
    assert scale * shape[1] >= 240
    dark = np.isnan(last)
    # A video codec blurs colours; what is dark and what is not stays apart.
    assert small[~dark].max(-1).mean() > 3 * small[dark].max(-1).mean()
    hue = aop_bgr(last)[~dark].astype(float)
    # .79: colours of sparse pixels blur
    assert np.corrcoef(hue.ravel(), small[~dark].ravel())[0, 1] > 0.7


@pytest.mark.parametrize(("more", "said"), [
    (["-o", "aop.png"], "must end in .csv"),
    (["-o", "aop.npy", "--set", "foo=1"], "takes cutoff_hz, radius"),
])
def test_what_it_cannot_do_is_one_line(more, said, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(["export", SAMPLE, "--what", "aop-events", "--layout", "pdavis",
                 *more]) == 2
    assert said in capsys.readouterr().err
