"""Writing images and series of images to files that other programs open."""
from pdavis_cv.export.arrays import ArrayFile
from pdavis_cv.export.files import beside, write_json
from pdavis_cv.export.video import PlaneVideo, VideoFile, write_png

__all__ = [
    "ArrayFile",
    "PlaneVideo",
    "VideoFile",
    "beside",
    "write_json",
    "write_png",
]
