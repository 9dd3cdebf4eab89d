"""One recording in many threads; fusing that is interrupted."""
import hashlib
import signal
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

import pytest

from pdavis_cv import Layout, fuse, open_recording
from pdavis_cv.data import example_recording

REGION = (100, 60, 24, 16)


def digest(recording, method):
    """Return a hash of the images that a method makes of a part of the sensor."""
    seen = hashlib.sha256()
    for image in fuse(recording, method=method, layout=Layout.PDAVIS, roi=REGION,
                      fps=100):
        seen.update(image.quad.tobytes())
    return seen.hexdigest()


@pytest.mark.gate
@pytest.mark.parametrize("method", ["events", "cf", "kalman"])
def test_eight_threads_on_one_recording_give_the_bits_of_one(method):
    with open_recording(example_recording()) as recording:
        alone = digest(recording, method)
        with ThreadPoolExecutor(8) as pool:
            found = list(pool.map(lambda _: digest(recording, method), range(8)))
    assert set(found) == {alone}


@pytest.mark.gate
@pytest.mark.skipif(sys.platform == "win32", reason="sends SIGINT")
def test_an_interrupt_ends_fusing():
    program = """
import signal, sys, pdavis_cv
from pdavis_cv.data import example_recording
signal.signal(signal.SIGINT, signal.default_int_handler)
try:
    while True:
        with pdavis_cv.open_recording(example_recording()) as recording:
            for image in pdavis_cv.fuse(recording, method="kalman", fps=1000,
                                        layout=pdavis_cv.Layout.PDAVIS):
                print(flush=True)
except KeyboardInterrupt:
    sys.exit(3)
"""
    with subprocess.Popen([sys.executable, "-P", "-c", program],
                          stdout=subprocess.PIPE) as child:
        assert child.stdout.readline()
        child.send_signal(signal.SIGINT)
        child.communicate(timeout=60)
    assert child.returncode == 3
