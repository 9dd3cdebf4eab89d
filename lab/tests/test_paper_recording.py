"""Figure 2 from recordings of the user."""
import numpy as np
from ideal import rotating_polarizer

import pdavis_cv
from lab.paper.recording import fit_files
from pdavis_cv import Calibration, Layout
from pdavis_cv.fusion.engine import Fusion


def test_a_calibration_is_cropped_with_the_recording_it_is_scored_on(tmp_path):
    made, _ = rotating_polarizer(202.6, 2.5, size=(16, 16), theta=(0.17, 0.17))
    path = tmp_path / "run.aedat4"
    pdavis_cv.write_aedat4(path, made)
    plane = np.full((16, 16), 0.17, np.float32)
    known = Calibration(sensor_size=(16, 16), theta_on=plane, theta_off=plane,
                        layout=Layout.PDAVIS)
    fitted, = fit_files([path], layout=Layout.PDAVIS, roi=(2, 4, 8, 6), seconds=3.0,
                        nominal=None, calibration=known)
    part = fitted.case.options["calibration"]
    assert part.sensor_size == (6, 8)
    assert part.theta_on.shape == (6, 8)
    assert part.layout == Layout.PDAVIS
    Fusion(fitted.case.existing.recording, calibration=part)
