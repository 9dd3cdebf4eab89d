"""What kernels that read all pixels refuse."""
import numpy as np
import pytest

from pdavis_cv import _kernels
from pdavis_cv.reconstruct.model import (
    GAP_DTYPE,
    LANE_VALUES,
    LANES,
    REST_PLANES,
    STATE_DTYPE,
    STORED_DTYPE,
    TRACK_DTYPE,
    TUNING_DTYPE,
    WAVE_DTYPE,
)

SHAPE = (4, 6)
SIZE = SHAPE[0] * SHAPE[1]


def shown(shape=SHAPE):
    return tuple(np.zeros(shape, kind) for kind in (np.float32, np.float32, np.uint8))


def arguments(kernel):
    store, tuning = np.zeros(1, STORED_DTYPE), np.zeros(1, TUNING_DTYPE)
    tracks, states = np.zeros(SHAPE, TRACK_DTYPE), np.zeros(SHAPE, STATE_DTYPE)
    tracks["first"] = -1
    gaps, flags = np.zeros((0, 0), GAP_DTYPE), np.zeros(SHAPE, np.uint8)
    pixels = np.arange(SIZE, dtype=np.int32)
    planes = np.zeros((REST_PLANES, *SHAPE), np.float32)
    return {
        _kernels.kalman_read: dict(
            t=5, known=5, epoch=0, chain=(store, tracks),
            model=(tuning, np.zeros(0, WAVE_DTYPE)), states=states, rows=(0, 4),
            shown=shown()),
        _kernels.kalman_rest: dict(
            now=5, epoch=0, every=True, tuning=tuning, tracks=tracks, states=states,
            gaps=gaps, listing=(pixels, flags), planes=planes),
        _kernels.kalman_show: dict(
            t=5, known=5, epoch=0, chain=(store, tracks), tuning=tuning, states=states,
            gaps=gaps, listing=(
                pixels[:3], 2, flags, np.zeros((1, LANE_VALUES, LANES), np.float32)),
            planes=planes, rows=(0, 4), shown=shown()),
        _kernels.store_mark: dict(
            store=store, start=0, stop=1, pixels=pixels, listed_before=0,
            listed=flags),
    }[kernel]


def listing(pixels=(0, 1, 2), ordered=2, shape=SHAPE, lanes=(1, LANE_VALUES, LANES)):
    return (np.array(pixels, np.int32), ordered, np.zeros(shape, np.uint8),
            np.zeros(lanes, np.float32))


@pytest.mark.parametrize(("kernel", "changes", "message"), [
    (_kernels.kalman_read, {"shown": shown((4, 5))}, "kalman_read: all images"),
    (_kernels.kalman_read, {"rows": (0, 5)}, "kalman_read: rows must lie"),
    (_kernels.kalman_read, {"chain": (np.zeros(0, STORED_DTYPE), np.zeros(
        SHAPE, TRACK_DTYPE))}, "kalman_read: tuning or store"),
    (_kernels.kalman_rest, {"planes": np.zeros((6, *SHAPE), np.float32)},
     "kalman_rest: all images"),
    (_kernels.kalman_rest, {"tuning": np.zeros(2, TUNING_DTYPE)},
     "kalman_rest: tuning"),
    (_kernels.kalman_show, {"listing": listing(pixels=(0, 1, SIZE))},
     "kalman_show: pixels must lie"),
    (_kernels.kalman_show, {"listing": listing(pixels=(-1, 1, 2))},
     "kalman_show: pixels must lie"),
    (_kernels.kalman_show, {"listing": listing(ordered=4)},
     "kalman_show: an array has"),
    (_kernels.kalman_show, {"listing": listing(lanes=(0, LANE_VALUES, LANES))},
     "kalman_show: lanes must have room"),
    (_kernels.kalman_show, {"listing": listing(lanes=(1, LANE_VALUES - 1, LANES))},
     "kalman_show: lanes must have room"),
    (_kernels.kalman_show, {"gaps": np.zeros(SHAPE, GAP_DTYPE)},
     "kalman_show: all images"),
    (_kernels.kalman_show, {"rows": (-1, 4)}, "kalman_show: rows must lie"),
    (_kernels.store_mark, {"stop": 2}, "store_mark: indices"),
    (_kernels.store_mark, {"pixels": np.zeros(3, np.int32)}, "store_mark: pixels"),
])
def test_what_does_not_fit_is_refused(kernel, changes, message):
    kernel(*arguments(kernel).values())
    with pytest.raises(ValueError, match=message):
        kernel(*{**arguments(kernel), **changes}.values())


def test_an_array_that_is_none_is_refused():
    for kernel, name in ((_kernels.kalman_read, "shown"), (
            _kernels.kalman_rest, "listing"), (_kernels.kalman_show, "listing")):
        given = arguments(kernel)
        given[name] = (*given[name][:-1], None)
        with pytest.raises(TypeError, match="must be arrays, got None"):
            kernel(*given.values())


def test_pixels_of_stored_events_are_listed_once_and_marked():
    store, flags = np.zeros(3, STORED_DTYPE), np.zeros(SHAPE, np.uint8)
    store["x"], store["y"] = (1, 5, 1), (0, 3, 0)
    pixels = np.full(SIZE, -1, np.int32)
    flags[3, 5], pixels[0] = 5, 23
    assert _kernels.store_mark(store, 0, 3, pixels, 1, flags) == 2
    assert pixels[:3].tolist() == [23, 1, -1]
    # Only the new one has no lane yet (16).
    assert flags[0, 1] == 19
    assert flags[3, 5] == 3
    assert flags.sum() == 22


def test_pixels_that_keep_their_place_in_the_list_keep_their_lanes():
    given = arguments(_kernels.kalman_rest)
    given["now"], given["every"] = 5_000_000, False
    given["tracks"]["last"] = 2 * given["now"]      # all of them may be moving
    given["tracks"]["last"][0, 2] = 0
    pixels, flags = given["listing"]
    pixels[:] = -1
    pixels[:6] = 0, 1, 2, 4, 3, 5
    flags.flat[:6] = 1, 3, 1, 1, 1, 1
    assert _kernels.kalman_rest(*given.values()) == 5
    assert pixels[:5].tolist() == [0, 1, 3, 4, 5]
    # 3 and 5 have moved up, 4 was there already; 2 has come to rest.
    assert flags.flat[:6].tolist() == [1, 3, 0, 19, 1, 19]
    flags.flat[:6] = 1, 3, 0, 1, 1, 1
    assert _kernels.kalman_rest(*given.values()) == 5
    assert flags.flat[:6].tolist() == [1, 3, 0, 1, 1, 1]
    given["every"] = True
    assert _kernels.kalman_rest(*given.values()) == SIZE - 1
    assert set(np.delete(flags.ravel(), 2).tolist()) == {19}
