"""Which OpenCV is used, and how one that is too old is refused."""
import sys
from types import SimpleNamespace

import pytest

from pdavis_cv._opencv import opencv, set_log_level
from pdavis_cv.export.animation import AnimationFile


def test_an_opencv_for_numpy_1_is_refused_by_name(tmp_path, monkeypatch):
    (tmp_path / "cv2.py").write_text(
        "raise ImportError('numpy.core.multiarray failed to import')")
    monkeypatch.delitem(sys.modules, "cv2", raising=False)
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(ImportError, match=r"before 4\.10.*1\.26, or OpenCV 4\.10"):
        opencv()


def test_an_animation_names_the_opencv_that_it_needs(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "cv2", SimpleNamespace(__version__="4.10.0"))
    with pytest.raises(ImportError, match=r"animation .*needs OpenCV 4\.12.*is 4\.10"):
        AnimationFile(tmp_path / "a.gif", 10)
    assert not list(tmp_path.iterdir())


def test_the_log_level_is_set_and_the_one_before_returned():
    before = set_log_level(0)
    assert set_log_level(before) == 0
    assert set_log_level(before) == before


def test_the_log_level_of_an_opencv_before_4_13_is_set(monkeypatch):
    seen = []

    def set_level(level):
        seen.append(level)
        return 3
    monkeypatch.setitem(sys.modules, "cv2", SimpleNamespace(setLogLevel=set_level))
    assert set_log_level(0) == 3
    assert seen == [0]
