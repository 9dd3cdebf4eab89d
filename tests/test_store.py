"""The store of recent events, and log intensity between a pixel's events."""
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from reference_increments import Pixel
from streams import random_events

from pdavis_cv import _kernels
from pdavis_cv.pixel.model import PixelModel
from pdavis_cv.pixel.silences import table_of
from pdavis_cv.reconstruct.lamp import WAVE_DTYPE
from pdavis_cv.reconstruct.redundancy import STATE_DTYPE
from pdavis_cv.reconstruct.store import EventStore

NUMBERS = PixelModel(theta=np.ones(2)).numbers


@settings(max_examples=60)
@given(st.integers(0, 10**6), st.integers(0, 300), st.sampled_from([0.05, 0.4, 3.0]),
       st.sampled_from([(0.0, 0.0), (250.0, 0.0), (20.0, 8.0), (4.0, 0.5)]),
       st.sampled_from([0, 7, 49_000, 400_000]))
def test_reading_equals_float64_evaluation(seed, n, seconds, bandwidth, wait):
    rng = np.random.default_rng(seed)
    shape, stop = (3, 4), int(1e6 * seconds)
    events = random_events(n, shape, seed=seed, stop_us=stop)
    states = np.zeros(shape, STATE_DTYPE)
    for name in ("theta_on", "theta_off", "base"):
        states[name] = rng.uniform(0.1, 0.3, shape)
    end, bow = table_of(wait)
    model = PixelModel(theta=np.ones(2), bandwidth=bandwidth, end=end, bow=bow)
    store = EventStore(shape)
    at = 0
    for cut in sorted(rng.integers(0, n + 1, 3)):
        assert store.push(events[at:cut], -1, model.numbers) == cut - at
        at = cut
        store.commit(int(events["t"][cut // 2]) if cut else 0)
    store.push(events[at:], -1, model.numbers)
    after = int(store.events["t"][store.committed - 1]) if store.committed else 0
    t = int(rng.integers(after, stop + 600_000))
    out = np.full(shape, np.nan, np.float32)
    recent = store.events, store.pixels
    for rows in ((0, 1), (1, 3)):
        _kernels.redundancy_read(t, t + wait, recent, (
            model.numbers, np.zeros(0, WAVE_DTYPE)), states, rows,
            np.ones(shape, np.uint8), out)
    for y, x in np.ndindex(shape):
        mine = events[(events["y"] == y) & (events["x"] == x)]
        twin = Pixel(mine["t"], 2 * mine["p"].astype(int) - 1,
                     events["t"][0] if n else 0, model)
        theta = np.array([states["theta_off"][y, x], states["theta_on"][y, x]])
        counts, rates = twin.y(t, t + wait)
        want = states["base"][y, x] + theta @ counts
        want += twin.lead(theta @ rates, np.exp(want))
        assert out[y, x] == pytest.approx(want, abs=4e-3), (y, x)


@pytest.mark.parametrize("seed", range(4))
def test_what_is_moved_out_of_the_store_is_not_missed(seed, monkeypatch):
    shape = (3, 4)
    rng = np.random.default_rng(seed)
    events = random_events(3000, shape, seed=seed)
    large = EventStore(shape)
    monkeypatch.setattr("pdavis_cv.reconstruct.store._LEAST", 16)
    small = EventStore(shape)
    states = np.zeros(shape, STATE_DTYPE)
    states["theta_on"] = states["theta_off"] = 0.2
    at = 0
    for cut in [*sorted(rng.integers(0, 3000, 40)), 3000]:
        seen = []
        for one in (small, large):
            one.push(events[at:cut], -1, NUMBERS)
            one.commit(int(events["t"][max(cut - 30, 0)]))
            out = np.zeros(shape, np.float32)
            _kernels.redundancy_read(
                int(events["t"][cut - 1]) if cut else 0, 10**7,
                (one.events, one.pixels), (NUMBERS, np.zeros(0, WAVE_DTYPE)), states,
                (0, 3), np.ones(shape, np.uint8), out)
            seen.append(out)
        at = cut
        np.testing.assert_array_equal(*seen)
        if cut % 3 == 0:
            kept = small.state()
            small = EventStore(shape)
            small.restore(kept)
    assert len(small.events) < 1000
    assert len(large.events) > 10_000


def test_the_first_event_that_does_not_fit_stops_the_store():
    events = random_events(6, (3, 4), seed=1, stop_us=60).copy()
    events["x"][4] = 4
    store = EventStore((3, 4))
    assert store.waiting_us is None
    assert store.push(events, 10**9, NUMBERS) == 0
    assert store.push(events, 0, NUMBERS) == 4
    assert store.waiting_us == events["t"][0]
    store.commit(int(events["t"][3]))
    assert store.waiting_us is None
