"""Print a digest of the images that each method makes of the example recording."""
import hashlib
import warnings

import numpy as np

from pdavis_cv import Layout, PdavisWarning, fuse, open_recording
from pdavis_cv.data import example_recording

METHODS = ("frames", "events", "cf", "kalman")


def main() -> None:
    """Print method, number of images and digest of their bits, a line each."""
    warnings.simplefilter("ignore", PdavisWarning)
    recording = open_recording(example_recording(), layout=Layout.PDAVIS)
    for method in METHODS:
        digest, images = hashlib.sha256(), 0
        for image in fuse(recording, method=method, fps=40):
            for plane in (image.quad, image.s0, image.s1, image.s2, image.aop,
                          image.dolp, image.valid):
                digest.update(np.ascontiguousarray(plane))
            images += 1
        print(f"{method:8} {images} images  {digest.hexdigest()[:16]}")


if __name__ == "__main__":
    main()
