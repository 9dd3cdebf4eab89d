"""Cyclic garbage: methods make none."""
import gc

import pytest

from pdavis_cv import Layout, fuse, open_recording
from pdavis_cv.data import example_recording

HOLDS_STATES = ("pdavis_cv.fusion", "pdavis_cv.reconstruct", "pdavis_cv._workers")


@pytest.mark.parametrize("options", [
    {}, {"mode": "causal"}, {"mode": "offline"}, {"method": "cf", "denoise": True},
    {"method": "events"}, {"method": "events", "offsets": "redundancy"}])
def test_what_a_method_holds_is_freed_at_once(options):
    with open_recording(example_recording(), layout=Layout.PDAVIS) as recording:
        gc.collect()
        gc.disable()
        try:
            assert sum(1 for _ in fuse(recording, fps=30, threads=2, **options)) > 5
            gc.set_debug(gc.DEBUG_SAVEALL)
            gc.collect()
            ours = [one for one in gc.garbage
                    if type(one).__module__.startswith(HOLDS_STATES)]
        finally:
            gc.set_debug(0)
            gc.garbage.clear()
            gc.enable()
    assert not ours
