"""What is known about one specimen of a camera, and how it is measured."""
from pdavis_cv.calibration.model import Calibration

__all__ = ["Calibration"]
