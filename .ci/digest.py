"""Print digests of each method's images of a recording, and of a film's events."""
import hashlib
import warnings

import numpy as np

from pdavis_cv import Layout, PdavisWarning, fuse, open_recording
from pdavis_cv.data import example_recording
from pdavis_cv.simulation import Camera, VideoScene

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
    steps = np.random.default_rng(0).integers(-30, 31, (31, 4, 36, 52)).cumsum(0)
    film = VideoScene((900 + steps).astype(np.float32) / 8, fps=1000.0)
    camera = Camera.preset("nominal", size=(36, 52), origin=(0, 0))
    digest, events = hashlib.sha256(), 0
    for packet in camera.stream(film, 0.03).packets():
        digest.update(packet.events)
        events += len(packet.events)
    print(f"{'film':8} {events} events  {digest.hexdigest()[:16]}")


if __name__ == "__main__":
    main()
