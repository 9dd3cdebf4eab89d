"""Cyclic garbage: methods make none, and live sessions search for it less."""
import gc
import types

import pytest

from pdavis_cv import Layout, fuse, open_recording
from pdavis_cv.data import example_recording
from pdavis_cv.live import Session, garbage
from pdavis_cv.live.garbage import ShortSearches

HOLDS_STATES = ("pdavis_cv.fusion", "pdavis_cv.reconstruct", "pdavis_cv._workers")


@pytest.fixture(autouse=True)
def nothing_left_out():
    assert not gc.get_freeze_count()
    yield
    gc.unfreeze()


@pytest.mark.parametrize("options", [
    {}, {"mode": "causal"}, {"mode": "offline"}, {"method": "cf", "denoise": True},
    {"method": "events"}, {"method": "events", "offsets": "redundancy"}])
def test_what_a_method_holds_is_freed_at_once(options):
    with open_recording(example_recording(), layout=Layout.PDAVIS) as recording:
        gc.collect()
        gc.disable()
        try:
            assert sum(1 for _ in fuse(recording, fps=200, threads=2, **options)) > 10
            gc.set_debug(gc.DEBUG_SAVEALL)
            gc.collect()
            ours = [one for one in gc.garbage
                    if type(one).__module__.startswith(HOLDS_STATES)]
        finally:
            gc.set_debug(0)
            gc.garbage.clear()
            gc.enable()
    assert not ours


def test_lasting_objects_are_left_out_in_the_block_only():
    lasting = [[] for _ in range(100_000)]
    with ShortSearches():
        assert gc.get_freeze_count() > len(lasting)
        with ShortSearches():
            pass
        assert gc.get_freeze_count() > len(lasting)
    assert not gc.get_freeze_count()
    assert gc.is_tracked(lasting[0])


def test_what_is_made_until_the_session_settles_is_left_out_once(monkeypatch):
    now_s = [1000.0]
    monkeypatch.setattr(
        garbage, "time", types.SimpleNamespace(monotonic=lambda: now_s[0]))
    with ShortSearches() as searches:
        before = gc.get_freeze_count()
        lasting = [[] for _ in range(1000)]
        searches.go_on()
        assert gc.get_freeze_count() == before
        now_s[0] += garbage.SETTLED_S
        searches.go_on()
        assert gc.get_freeze_count() >= before + len(lasting)
        before = gc.get_freeze_count()
        lasting += [[] for _ in range(1000)]
        searches.go_on()
        assert gc.get_freeze_count() == before


def test_garbage_among_the_objects_left_out_is_freed_after_the_block():
    class Loop:
        pass

    freed = []
    loop = Loop()
    loop.own = loop
    loop.end = type("End", (), {"__del__": lambda _: freed.append(True)})()
    with ShortSearches():
        del loop
        gc.collect()
        assert not freed
    gc.collect()
    assert freed


def test_what_the_program_leaves_out_itself_stays():
    gc.freeze()
    before = gc.get_freeze_count()
    with ShortSearches():
        assert gc.get_freeze_count() <= before
    assert gc.get_freeze_count()


@pytest.mark.parametrize(("speed", "shorter"), [(1, True), (0, False)])
def test_a_session_that_must_not_be_late_searches_less(speed, shorter):
    where = f"replay:{example_recording()}?speed={speed}"
    with Session(where, method="cf", layout=Layout.PDAVIS) as session:
        assert session.read(60) is not None
        assert (gc.get_freeze_count() > 0) == shorter
    assert not gc.get_freeze_count()
