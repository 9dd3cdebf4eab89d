"""The supplementary videos: what is shown, and how far it is from the truth."""
import math

import numpy as np
import pytest

pytest.importorskip("cv2")

import cv2

from lab.paper import command, videos
from lab.paper.run import METHODS
from pdavis_cv import PolarFrame


def light(aop, dolp, valid=None):
    i = np.arange(4) * math.pi / 4
    quad = 10 * (1 + dolp * np.cos(2 * (aop - i)))
    return PolarFrame(np.broadcast_to(quad[:, None, None], (4, 6, 8)), valid=valid)


def moment(*images):
    return videos.Moment(0, images, np.empty(0))


@pytest.mark.parametrize("turn", [0.0, 0.2, -0.4, math.pi - 0.1])
def test_errors_are_those_of_malus_law(turn):
    seen = [moment(light(a, 0.8), light(a + turn, 0.5)) for a in (0.0, 1.0, 3.0)]
    aop, dolp = videos.error_of(seen, 1)
    expected = math.degrees(abs(math.remainder(turn, math.pi)))
    assert aop == pytest.approx(expected, abs=1e-3)
    assert dolp == pytest.approx(0.3, abs=1e-5)


def test_what_is_not_valid_or_not_polarized_does_not_count():
    half = np.arange(48).reshape(6, 8) % 2 == 0
    mixed = PolarFrame(np.where(half, light(1.0, 0.8).quad, light(2.0, 0.1).quad),
                       valid=half)
    seen = [moment(light(0.3, 0.8), mixed),
            moment(light(0.3, 0.05), light(2.0, 0.8))]
    aop, dolp = videos.error_of(seen, 1)
    assert aop == pytest.approx(math.degrees(0.7), abs=1e-3)    # of the first alone
    assert dolp == pytest.approx(0.75 / 2, abs=1e-5)
    nothing = [moment(light(0.3, 0.8), light(1.0, 0.8, valid=np.zeros((6, 8), bool)))]
    assert all(math.isnan(value) for value in videos.error_of(nothing, 1))


def test_each_shows_the_truth_first_and_methods_that_there_are():
    assert {name.partition("-")[0] for name in videos.VIDEOS} == set("12345")
    for video in videos.VIDEOS.values():
        assert video.shown[0].method == "truth"
        assert {one.method for one in video.shown[1:]} <= set(METHODS)


@pytest.mark.gate
def test_the_command_writes_videos_that_play_and_a_page(tmp_path, monkeypatch):
    monkeypatch.setattr(videos, "VIDEOS", {
        name: videos.VIDEOS[name] for name in ("1", "5-10Hz")})
    assert command.main(["videos", "-o", str(tmp_path / "v"), "--quick"]) == 0
    page = (tmp_path / "v.html").read_text()
    for name in videos.VIDEOS:
        path = tmp_path / f"v-{name}.webm"
        assert path.name in page
        assert path.stat().st_size < 10e6
        pictures, capture = [], cv2.VideoCapture(str(path))
        while (found := capture.read())[0]:
            pictures.append(found[1])
        capture.release()
        assert len(pictures) == 24
        assert np.std([p.mean() for p in pictures]) > 0.1     # it moves
    lines = (tmp_path / "v.csv").read_text().splitlines()
    rows = [line.split(",") for line in lines[1:]]
    aop = {(name, method): float(error) for name, method, error, _ in rows}
    assert aop["1", "kalman"] < 1 < aop["1", "PDAVIS frames"] / 10
    assert aop["5-10Hz", "kalman"] < aop["5-10Hz", "frames"]


def test_the_papers_words_on_a_video_are_judged_by_the_errors():
    frames, kalman = ("PDAVIS frames", 30.0, 0.02), ("kalman", 1.0, 0.01)
    pages = {}
    for name, rows in (("1", [frames, kalman]), ("5-1Hz", [frames, kalman]),
                       ("5-10Hz", [("frames", 1.0, 0.3), kalman]),
                       ("4", [("Sony 75 fps", 1.5, 0.1), kalman])):
        page = videos.videos_page("v", {name: rows}, {name: 10})
        pages[name] = page[-2]
    assert pages["1"].endswith("| 30.0 / 1.0 degrees | agrees: events only |")
    assert pages["5-1Hz"].endswith("| 0.020 / 0.010 | agrees: both |")
    assert pages["5-10Hz"].endswith("| agrees: events only |")
    assert pages["4"].endswith("| 1.5 / 1.0 degrees | differs |")
