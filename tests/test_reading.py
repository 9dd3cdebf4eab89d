"""Log intensity between a pixel's events, and the store that holds them."""
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from reference_tracks import Pixel, ripple_of, steady
from streams import random_events

from pdavis_cv import _kernels
from pdavis_cv.reconstruct.lamp import BLOCK_US, Lamplight, Wave
from pdavis_cv.reconstruct.model import (
    STATE_DTYPE,
    STORED_DTYPE,
    TRACK_DTYPE,
    TUNING_DTYPE,
    WAVE_DTYPE,
)
from pdavis_cv.reconstruct.tracks import Tracks

SHAPE = (3, 4)
BANDWIDTHS = [(0.0, 0.0), (250.0, 0.0), (20.0, 8.0), (4.0, 0.5)]


def lit(rng, blocks):
    """A lamp's waves of some blocks from -2 on."""
    return [Wave((k - 2) * BLOCK_US, *((
        rng.choice([100, 120.3]), *rng.uniform(-0.2, 0.2, 2), rng.random() < 0.5)
        if rng.random() < 0.8 else ())) for k in range(blocks)]


@settings(max_examples=60)
@given(st.integers(0, 10**6), st.integers(0, 300), st.sampled_from([0.05, 0.4, 3.0]),
       st.sampled_from(BANDWIDTHS), st.sampled_from([0, 0, 1, 40]),
       st.sampled_from([0, 7, 49_000, 400_000]))
def test_reading_equals_float64_evaluation(seed, n, seconds, bandwidth, blocks, wait):
    rng = np.random.default_rng(seed)
    stop = int(1e6 * seconds)
    events = random_events(n, SHAPE, seed=seed, stop_us=stop)
    states = np.zeros(SHAPE, STATE_DTYPE)
    states["theta_on"], states["theta_off"], states["base"] = rng.uniform(
        0.1, 0.3, (3, *SHAPE))
    tuning = np.array([bandwidth], TUNING_DTYPE)
    waves, lamp = lit(rng, blocks), Lamplight()
    for wave in waves:
        lamp.add(wave)
    tracks = Tracks(SHAPE)
    at = 0
    for cut in sorted(rng.integers(0, n + 1, 3)):
        assert tracks.push(events[at:cut], -1) == cut - at
        at = cut
        tracks.commit(int(events["t"][cut // 2]) if cut else 0)
        tracks.chain    # noqa: B018
    tracks.push(events[at:], -1)
    after = int(events["t"][tracks.committed - 1]) if tracks.committed else 0
    t = int(rng.integers(after, stop + 600_000))
    out = np.full(SHAPE, np.nan, np.float32)
    model = tuning, lamp.waves
    _kernels.redundancy_read(t, t + wait, tracks.chain, model, states, (0, 1), out)
    _kernels.redundancy_read(t, t + wait, tracks.chain, model, states, (1, 3), out)
    ripple = ripple_of(waves) if len(lamp.waves) else steady
    for y, x in np.ndindex(SHAPE):
        mine = events[(events["y"] == y) & (events["x"] == x)]
        pixel = Pixel([(int(e["t"]), int(e["p"])) for e in mine],
                      states["theta_on"][y, x], states["theta_off"][y, x], bandwidth,
                      ripple)
        want = pixel.log(states["base"][y, x], t, t + wait)
        assert out[y, x] == pytest.approx(want, abs=4e-3), (y, x)


@pytest.mark.parametrize("seed", range(4))
def test_what_is_moved_out_of_the_store_is_not_missed(seed, monkeypatch):
    monkeypatch.setattr("pdavis_cv.reconstruct.tracks._LEAST", 16)
    rng = np.random.default_rng(seed)
    events = random_events(3000, SHAPE, seed=seed)
    small, other = Tracks(SHAPE), Tracks(SHAPE)
    other.store = np.zeros(4000, STORED_DTYPE)
    states = np.zeros(SHAPE, STATE_DTYPE)
    states["theta_on"] = states["theta_off"] = 0.2
    model = np.zeros(1, TUNING_DTYPE), np.zeros(0, WAVE_DTYPE)
    at = 0
    for cut in [*sorted(rng.integers(0, 3000, 40)), 3000]:
        for one in (small, other):
            one.push(events[at:cut], -1)
        at = cut
        seen = []
        for one in (small, other):
            one.commit(int(events["t"][max(cut - 30, 0)]))
            out = np.zeros(SHAPE, np.float32)
            _kernels.redundancy_read(
                int(events["t"][cut - 1]) if cut else 0, 10**7, one.chain, model,
                states, (0, 3), out)
            seen.append(out)
        np.testing.assert_array_equal(*seen)
        if cut % 3 == 0:
            kept = small.state()
            small = Tracks(SHAPE)
            small.restore(kept)
    assert len(small.store) < 1000
    assert len(other.store) == 4000


def arguments():
    store, tuning = np.zeros(1, STORED_DTYPE), np.zeros(1, TUNING_DTYPE)
    tracks, states = np.zeros(SHAPE, TRACK_DTYPE), np.zeros(SHAPE, STATE_DTYPE)
    tracks["first"] = -1
    return dict(
        t=5, known=5, chain=(store, tracks), model=(tuning, np.zeros(0, WAVE_DTYPE)),
        states=states, rows=(0, 3), log=np.zeros(SHAPE, np.float32))


@pytest.mark.parametrize(("changes", "message"), [
    ({"log": np.zeros((4, 5), np.float32)}, "all images must have one shape"),
    ({"states": np.zeros((2, 4), STATE_DTYPE)}, "all images must have one shape"),
    ({"rows": (0, 5)}, "rows must lie"), ({"rows": (-1, 3)}, "rows must lie"),
    ({"chain": (np.zeros(0, STORED_DTYPE), np.zeros(SHAPE, TRACK_DTYPE))},
     "tuning or store"),
    ({"model": (np.zeros(2, TUNING_DTYPE), np.zeros(0, WAVE_DTYPE))},
     "tuning or store")])
def test_what_does_not_fit_is_refused(changes, message):
    _kernels.redundancy_read(*arguments().values())
    with pytest.raises(ValueError, match=message):
        _kernels.redundancy_read(*{**arguments(), **changes}.values())


def test_an_array_that_is_none_is_refused():
    given_ = arguments()
    given_["chain"] = (*given_["chain"][:-1], None)
    with pytest.raises(TypeError, match="must be arrays, got None"):
        _kernels.redundancy_read(*given_.values())


def test_the_store_takes_events_up_to_a_bad_one():
    store = np.zeros(8, STORED_DTYPE)
    events = random_events(6, SHAPE).copy()
    assert _kernels.store_push(events, 0, 1, store, *SHAPE) == 6
    assert store["t"][1:7].tolist() == events["t"].tolist()
    events["x"][4] = 9
    assert _kernels.store_push(events, 0, 0, store, *SHAPE) == 4
    assert _kernels.store_push(events, 10**9, 0, store, *SHAPE) == 0
    with pytest.raises(ValueError, match="store must have room"):
        _kernels.store_push(events, 0, 3, store, *SHAPE)
    with pytest.raises(ValueError, match="indices must lie in store"):
        _kernels.store_link(store, 0, 9, np.zeros(SHAPE, TRACK_DTYPE))
