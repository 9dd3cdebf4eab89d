"""VideoCapture, a replacement of cv2.VideoCapture, and its constants."""
from pdavis_cv.capture.video import CaptureStatus, VideoCapture

__all__ = ["CaptureStatus", "VideoCapture"]
