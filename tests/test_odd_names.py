"""Names that are no text, and names of what is no file."""
import os

import cv2
import numpy as np
import pytest

import pdavis_cv as p
from pdavis_cv import Layout, RecordingError, VideoCapture, open_recording
from pdavis_cv.tools import main

SONY = Layout.SONY


@pytest.mark.skipif(os.name != "posix", reason="names are text elsewhere")
def test_names_that_are_no_utf8_are_read_or_refused(tmp_path):
    picture = np.arange(1024, dtype=np.uint16).reshape(32, 32)
    data = cv2.imencode(".png", picture)[1].tobytes()
    for name in (b"\xff1.png", b"\xff2.png"):
        path = os.fsdecode(os.fsencode(tmp_path) + b"/" + name)
        with open(path, "wb") as file:
            file.write(data)
    with open_recording(path, layout=SONY) as recording:
        frames = next(recording.packets()).frames
    np.testing.assert_array_equal(frames[0].dn, picture)
    with open_recording(str(tmp_path / "*.png"), layout=SONY) as recording:
        assert recording.info.frame_count == 2
    with pytest.raises(OSError, match="OpenCV opens only names in UTF-8"):
        p.export.VideoFile(path.replace("png", "avi"), 25)
    capture = VideoCapture(path)
    assert not capture.isOpened()
    assert "UTF-8" in capture.last_error


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="of POSIX")
@pytest.mark.parametrize("name", ["a.aedat4", "a.csv", "a.png", "a.h5", "a.npz"])
def test_a_pipe_is_no_recording_and_is_not_waited_for(tmp_path, name):
    os.mkfifo(tmp_path / name)
    for source in (tmp_path / name, [tmp_path / name, tmp_path / name],
                   *([tmp_path / "*.png"] if name == "a.png" else [])):
        with pytest.raises(RecordingError, match="neither a file nor a folder"):
            open_recording(source, layout=SONY)
    assert main.main(["info", str(tmp_path / name)]) == 2
    os.rename(tmp_path / name, tmp_path / "a.geojson")
    for read_other in (p.analysis.read_rois, p.Calibration.load,
                       p.analysis.read_load):
        with pytest.raises(p.PdavisError, match="neither a file nor a folder"):
            read_other(tmp_path / "a.geojson")
