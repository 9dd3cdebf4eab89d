"""What a user may write; .ci/run has a type checker read it, and none runs it."""
from typing import assert_type

import numpy as np

import pdavis_cv
from pdavis_cv.fusion.options import FusionKeywords
from pdavis_cv.live import Session

with pdavis_cv.open_recording("run.aedat4", layout="pdavis") as recording:
    aop = [image.aop.mean() for image in pdavis_cv.fuse(recording, fps=100.0)]

capture = pdavis_cv.VideoCapture("run.aedat4", fps=100, layout="pdavis", output="aop")
capture = pdavis_cv.VideoCapture("run.aedat4", method="cf", cutoff_hz=1.6)
ok, picture = capture.read()
if picture is not None:
    assert_type(picture, np.ndarray)

keywords: FusionKeywords = {"fps": 100, "causal": True}
capture = pdavis_cv.VideoCapture("run.aedat4", **keywords)
with Session("replay:run.aedat4", **keywords) as session:
    assert_type(session.read(), pdavis_cv.PolarFrame | None)


class Mine(pdavis_cv.Reconstructor):
    """A method of a user, which has parameters of its own."""


aop = [image.aop.mean() for image in pdavis_cv.fuse(
    recording, pdavis_cv.FusionOptions(fps=50), cutoff_hz=2.0)]
pdavis_cv.fuse(recording, method=Mine, weight=0.3)
pdavis_cv.fuse(recording, method="smooth", parameters={"weight": 0.3})
pdavis_cv.fuse(recording, fsp=10)  # type: ignore[call-overload]
pdavis_cv.VideoCapture("run.aedat4", fsp=10)  # type: ignore[call-overload]
Session("usb:", fsp=10)  # type: ignore[call-overload]
pdavis_cv.open_recording("run.aedat4", layuot="sony")  # type: ignore[call-arg]
pdavis_cv.open_source("usb:", layuot="sony")  # type: ignore[call-arg]
pdavis_cv.view(recording, fsp=10)  # type: ignore[call-arg]
pdavis_cv.serve(recording, fsp=10)  # type: ignore[call-arg]
pdavis_cv.patched_cv2(fsp=10)  # type: ignore[call-arg]

wrong: FusionKeywords = {"fps": "fast"}  # type: ignore[typeddict-item]
