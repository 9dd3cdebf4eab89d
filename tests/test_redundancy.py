import math
import pickle

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from reference_redundancy import (
    FAR_ERRORS,
    LINE_ERROR,
    Macropixel,
    saturated_events,
    saturated_fill,
)
from streams import random_events
from truth_errors import errors_of

from pdavis_cv import (
    EVENT_DTYPE,
    Analyser,
    ApsFrame,
    KalmanFilter,
    Layout,
    _kernels,
    fuse,
    recording_from_arrays,
)
from pdavis_cv.pixel.model import PixelModel
from pdavis_cv.reconstruct.lamp import WAVE_DTYPE
from pdavis_cv.reconstruct.redundancy import (
    BALANCE_DTYPE,
    MOMENTS_DTYPE,
    POLICY_DTYPE,
    STATE_DTYPE,
    EventRedundancy,
    null_of,
)
from pdavis_cv.reconstruct.store import EventStore
from pdavis_cv.simulation import (
    FULL,
    Camera,
    Fan,
    FlatLight,
    RotatingPlate,
    RotatingPolarizer,
)

KEEP, SIGMA, PER_EVENT, LOSS = 0.98, 0.06, 1 / 300, 0.006
PULL, LEAST = 1e-3, 8
NUMBERS = PixelModel(theta=np.ones(2)).numbers
POLICY = np.array([(KEEP, SIGMA, PER_EVENT, LOSS, PULL, LEAST, LINE_ERROR, FAR_ERRORS,
                    0.05)], POLICY_DTYPE)


def make(shape=(6, 8), on=0.16, off=0.18, **options):
    return EventRedundancy(shape, theta_on=on, theta_off=off, **options)


@settings(max_examples=20)
@given(st.integers(0, 10**6), st.sampled_from([(2, 2), (5, 4), (4, 7), (8, 10)]),
       st.integers(0, 60), st.sampled_from([0.0, 0.02, 0.5]))
def test_kernels_equal_float64_evaluation(seed, shape, samples, noise):
    rng = np.random.default_rng(seed)
    rows, columns = shape[0] // 2, shape[1] // 2
    null = null_of(None, shape) * rng.uniform(0.9, 1, shape).astype(np.float32)
    prior = rng.uniform(0.1, 0.3, (*shape, 2))
    states, store, balance, moments = arrays(shape)
    for part, theta in zip(("on", "off"), np.moveaxis(prior, -1, 0), strict=True):
        states[f"theta_{part}"] = states[f"prior_{part}"] = theta
    balance["null"] = null

    def of(array, r, c):
        return array[2 * r:2 * r + 2, 2 * c:2 * c + 2].reshape(4, *array.shape[2:])

    twins = {(r, c): Macropixel(of(balance["null"], r, c), of(prior, r, c), KEEP, SIGMA,
                                PER_EVENT, LOSS)
             for r in range(rows) for c in range(columns)}
    phase = np.array([[0, 1], [3, 2]]) * np.pi / 2
    phase = np.tile(phase, (rows + 1, columns + 1))[:shape[0], :shape[1]]
    gains = rng.normal(0, 0.5, shape)
    for k in range(samples):
        log = np.log(1 + 0.8 * np.cos(0.3 * k + phase)) - gains + states["base"]
        log = log + rng.normal(0, noise, shape)
        on, off = rng.poisson(0.6, (2, *shape))
        store.pixels["at"]["count"] += np.stack([-off, on], -1)
        # The base from which these counts lead to that log.
        states["base"] = log - states["theta_on"] * on + states["theta_off"] * off
        for at, twin in twins.items():
            twin.base = of(states["base"], *at).copy()
        _kernels.redundancy_sample(
            k, k, (store.events, store.pixels, 0, states.size),
            (NUMBERS, np.zeros(0, WAVE_DTYPE)), POLICY, (states, balance, moments))
        for at, twin in twins.items():
            twin.sample(of(log, *at), of(on, *at), of(off, *at))
        if k % 5 == 4:
            _kernels.redundancy_solve(POLICY, moments, states)
            for twin in twins.values():
                twin.solve(PULL, LEAST)
    for at, twin in twins.items():
        mine = of(states, *at)
        np.testing.assert_allclose(mine["theta_on"], twin.theta[:, 0], rtol=1e-5)
        np.testing.assert_allclose(mine["theta_off"], twin.theta[:, 1], rtol=1e-5)
        if not twin.definite:
            continue
        np.testing.assert_allclose(mine["base"], twin.base, atol=3e-4)
        got = moments[at]["ratio"], moments[at]["smallest"]
        np.testing.assert_allclose(
            got, (twin.ratio, twin.least), rtol=1e-3, atol=1e-5)


def arrays(shape):
    """States, a store with an event of each pixel that tells nothing of what follows,
    balance and moments of a sensor that has seen nothing."""
    store = EventStore(shape)
    store.events["pixel"][:shape[0] * shape[1]] = np.arange(shape[0] * shape[1])
    store.pixels["at"]["run"] = 1
    moments = np.zeros((shape[0] // 2, shape[1] // 2), MOMENTS_DTYPE)
    moments["ratio"] = moments["smallest"] = 1
    return (np.zeros(shape, STATE_DTYPE), store, np.zeros(shape, BALANCE_DTYPE),
            moments)


def test_kernels_refuse_arrays_that_do_not_fit():
    shape = (4, 4)
    states, store, balance, moments = arrays(shape)
    waves = np.zeros(0, WAVE_DTYPE)

    def sample(numbers, policy, states, balance, moments, last=16):
        _kernels.redundancy_sample(
            0, 0, (store.events, store.pixels, 0, last), (numbers, waves), policy,
            (states, balance, moments))

    shaped = [NUMBERS, POLICY, states, balance, moments]
    sample(*shaped)
    for i in range(5):
        wrong = [*shaped]
        wrong[i] = np.concatenate([wrong[i], wrong[i]])
        with pytest.raises(ValueError, match=r"redundancy_sample: |numbers must"):
            sample(*wrong)
    with pytest.raises(ValueError, match="redundancy_sample: an array has a wrong"):
        sample(*shaped, last=10**6)
    with pytest.raises(TypeError, match="must be arrays, got None"):
        sample(*shaped[:-1], None)
    solved = [POLICY, moments, states]
    for i in range(3):
        wrong = [*solved]
        wrong[i] = np.concatenate([wrong[i], wrong[i]])
        with pytest.raises(ValueError, match="redundancy_solve: "):
            _kernels.redundancy_solve(*wrong)
    out = np.zeros(shape, np.float32)
    for recent, of, rows, message in (
            ((store.events, store.pixels), states[:2], (0, 2), "one shape"),
            ((store.events[:0], store.pixels), states, (0, 4), "hold records"),
            ((store.events, store.pixels), states, (0, 5), "lie in the image")):
        with pytest.raises(ValueError, match=f"redundancy_read: .*{message}"):
            _kernels.redundancy_read(0, 0, recent, (NUMBERS, waves), of.copy(), rows,
                                     np.ones(shape, np.uint8), out)


def test_macropixels_that_are_solved_together_do_not_depend_on_each_other():
    """More than one group, with ones that are dark or have nothing new in between."""
    rng = np.random.default_rng(5)
    shape = (10, 26)
    states, _, _, moments = arrays(shape)
    upper = np.triu_indices(4)
    places = np.array([0, 1, 3, 2]) * np.pi / 2
    for cell in moments.ravel():
        turns = rng.uniform(0, 2 * np.pi, (rng.integers(2, 40), 1))
        seen = (1 + 0.8 * np.cos(turns + places)) * rng.uniform(0.3, 3, 4)
        seen = seen * [1, -1, -1, 1] + rng.normal(0, 0.1, seen.shape)
        cell["product"] = (seen.T @ seen)[upper]
        cell["weight"], cell["since"] = rng.uniform(LEAST - 2, 40), rng.integers(0, 3)
        if rng.random() < 0.2:
            cell["product"][[1, 4, 5, 6]] = 0
    states["base"] = rng.normal(size=shape)
    alone = [one.copy() for one in (moments, states)]
    for r, c in np.ndindex(moments.shape):
        parts = [alone[0][r:r + 1, c:c + 1].copy(), *(
            one[2 * r:2 * r + 2, 2 * c:2 * c + 2].copy() for one in alone[1:])]
        _kernels.redundancy_solve(POLICY, *parts)
        alone[0][r:r + 1, c:c + 1] = parts[0]
        for whole, part in zip(alone[1:], parts[1:], strict=True):
            whole[2 * r:2 * r + 2, 2 * c:2 * c + 2] = part
    before = moments.copy()
    _kernels.redundancy_solve(POLICY, moments, states)
    for got, want in zip((moments, states), alone, strict=True):
        assert got.tobytes() == want.tobytes()
    due = (before["since"] > 0) & (before["weight"] >= LEAST)
    np.testing.assert_array_equal(moments[~due], before[~due])
    solved = moments["smallest"] < 1
    assert solved.sum() > 16
    assert (due & ~solved).sum() > 5        # dark, or gains of both signs


@pytest.mark.parametrize("columns", [1, 3, 128])
@pytest.mark.parametrize("shape", [(1, 1), (2, 2), (7, 9)])
def test_events_of_macropixels_move_to_the_sensor_that_they_make_up(shape, columns):
    rng = np.random.default_rng(columns)
    rows, wide = (side // 2 for side in shape)
    cell_of = rng.permutation(rows * wide).reshape(rows, wide).astype(np.int32)
    cell_of[rng.random(cell_of.shape) < 0.4] = -1
    events = random_events(300, shape, stop_us=9_000)
    out = np.zeros(len(events), EVENT_DTYPE)
    n = _kernels.saturated_events(events, cell_of, columns, out)
    np.testing.assert_array_equal(out[:n], saturated_events(events, cell_of, columns))
    assert _kernels.saturated_events(events[:0], cell_of, columns, out) == 0
    with pytest.raises(ValueError, match="saturated_events: out is too short"):
        _kernels.saturated_events(events, cell_of, columns, out[:-1])
    with pytest.raises(ValueError, match="saturated_events: columns must be positive"):
        _kernels.saturated_events(events, cell_of, 0, out)


def test_more_macropixels_may_saturate_than_a_sensor_has_columns():
    shape = (260, 510)      # 33150 macropixels
    method = KalmanFilter(shape, theta_on=0.2, theta_off=0.2, mode="causal")
    full = np.full(shape, 1023, np.float32)
    method.add_frame(ApsFrame(full, 0, 4000, valid=np.zeros(shape, bool)))
    method.add_events(random_events(100, shape, start_us=5_000, stop_us=9_000))
    log = method.read(10_000).log_intensity
    np.testing.assert_allclose(log, np.log(1023 / 4), rtol=1e-6)


def saturated(seed=0, shape=(6, 8)):
    """Arguments of saturated_fill: three macropixels in two rows."""
    rng = np.random.default_rng(seed)
    grid = np.arange(shape[0] * shape[1]).reshape(shape)
    pixels = np.stack([grid[i // 2::2, i % 2::2].ravel()[[1, 6, 9]] for i in range(4)])
    missing = (rng.random(pixels.shape) < 0.6).astype(np.uint8)
    missing[:, 0] = 1
    seen = [rng.normal(size=(4, 4)).astype(np.float32) for _ in range(4)]
    seen[2] = (rng.random((4, 4)) < 0.7).astype(np.uint8)
    seen[1], seen[3] = abs(seen[1]), abs(seen[3])
    shown = [rng.normal(size=shape).astype(np.float32),
             rng.uniform(0.01, 1, shape).astype(np.float32), np.zeros(shape, "u1")]
    return [(pixels.astype(np.intp), missing), tuple(seen),
            rng.normal(size=shape).astype(np.float32), 0.09, 1.2, 1.0, 0.25,
            tuple(shown)]


@pytest.mark.parametrize("seed", range(8))
def test_frames_and_events_are_weighed_as_the_definition_says(seed):
    given = saturated(seed)
    want = saturated_fill(*given)
    _kernels.saturated_fill(*given)
    for plane, expected in zip(given[-1], want, strict=True):
        np.testing.assert_allclose(plane, expected, rtol=1e-5, atol=1e-6)


def test_a_sample_of_long_ago_makes_nothing_invalid():
    """A pixel that saturates but once is as good as one that always does."""
    (pixels, missing), seen, *others, shown = saturated()
    missing[:], seen[2][:] = 1, 1
    seen[1][:] = seen[3][:] = 0.01
    others[0][:] = 0.5

    def filled():
        out = tuple(plane.copy() for plane in shown)
        _kernels.saturated_fill((pixels, missing), seen, *others, out)
        return [plane.ravel()[pixels] for plane in out]

    log, variance, valid = filled()
    assert valid.all()
    missing[1, 0], shown[1].ravel()[pixels[1, 0]] = 0, 30.0
    for before, now in zip((log, variance, valid), filled(), strict=True):
        np.testing.assert_array_equal(now, before)
    shown[1].ravel()[pixels[1, 0]] = 0.01
    now = filled()
    assert now[2].all()
    assert abs(now[0][0, 0] - log[0, 0]) > 0.1


def test_frames_count_where_four_pixels_see_no_one_polarization():
    cells, seen, *others, shown = saturated()
    cells[1][:], seen[2][:], seen[1][:], seen[3][:] = 0, 1, 0.01, 0
    shown[1][:] = 0.01

    def moved(dim):
        out = tuple(plane.copy() for plane in shown)
        others[3] = dim
        _kernels.saturated_fill(cells, seen, *others, out)
        return np.abs(out[0] - shown[0]).ravel()[cells[0]].max()

    assert moved(-math.inf) > 0.3
    assert moved(math.inf) < 0.3 * moved(-math.inf)


def test_filling_refuses_what_does_not_fit():
    cells, seen, bound, *_, shown = saturated()
    pixels, missing = cells
    for at, wrong, message in (
            (0, (pixels[:3], missing), "must be"),
            (0, (pixels, missing[:, :1].copy()), "must be"),
            (0, (pixels + 99, missing), "pixels must lie"),
            (1, (*seen[:3], seen[3][:1]), "planes of one shape"),
            (1, tuple(plane[:2].copy() for plane in seen), "all macropixels"),
            (2, bound[:1], "one shape"),
            (7, (*shown[:2], shown[2][:1]), "one shape")):
        given = saturated()
        given[at] = wrong
        with pytest.raises(ValueError, match=f"saturated_fill: .*{message}"):
            _kernels.saturated_fill(*given)


@pytest.mark.parametrize(("rpm", "aop_deg", "dolp"), [
    (60, 3, .06), (200, 4, .06), (1000, 5, .1)])
def test_aop_and_dolp_of_a_rotating_plate_follow_from_events_alone(rpm, aop_deg, dolp):
    recording, truth = Camera.preset("nominal", seed=2, aps=None).record(
        RotatingPlate(rpm=rpm * 1.013), 1.6)
    times = np.arange(1_000_000, 1_540_000, 3_000)
    off, degree = [], []
    for image in fuse(recording, times_us=times, demosaic="superpixel",
                      offsets="redundancy", nominal_thresholds=(0.16, 0.18)):
        true = truth.dolp(image.t_us)
        degree.append(np.abs(image.dolp - true).mean())
        if true > 0.2:
            turn = image.aop - truth.aop(image.t_us) + np.pi / 2
            off.append(np.abs(turn % np.pi - np.pi / 2).mean())
        assert image.quality.shape == image.shape
        assert image.valid.mean() > 0.9
    assert np.degrees(np.mean(off)) < aop_deg
    assert np.mean(degree) < dolp


def test_light_that_only_flickers_tells_nothing_about_the_gains():
    light = FlatLight(dolp=0.3, aop=0.4).flicker(mains_hz=5, depth=0.9)
    recording, _ = Camera.preset("nominal", seed=2, aps=None).record(light, 1.0)
    for image in fuse(recording, times_us=[900_000], offsets="redundancy",
                      nominal_thresholds=(0.16, 0.18)):
        assert np.median(image.quality) > 0.9
        assert image.valid.mean() < 0.2


@pytest.mark.parametrize("options", [
    {"method": "events", "offsets": "redundancy"},
    {"method": "events", "offsets": "redundancy", "causal": True},
    {"method": "kalman"}])
@pytest.mark.parametrize("roi", [
    pytest.param((0, 0, 6, 5), marks=pytest.mark.gate), (9, 3, 7, 4)])
def test_a_region_equals_the_crop_of_the_whole(options, roi):
    camera = Camera.preset("nominal", seed=3, size=(8, 20), origin=(54, 162))
    recording, _ = camera.record(Fan(rpm=203), 0.7)
    options = {"nominal_thresholds": (0.16, 0.18), "fps": 60, **options}
    x, y, width, height = roi
    rows, columns = slice(y, y + height), slice(x, x + width)
    some = 0
    for whole, part in zip(fuse(recording, **options),
                           fuse(recording, roi=roi, **options), strict=True):
        for name in ("aop", "dolp", "valid", "quality"):
            mine, all_ = getattr(part, name), getattr(whole, name)
            if all_ is not None:
                np.testing.assert_array_equal(mine, all_[rows, columns])
        some += part.valid.sum()
    assert some > 0


@pytest.mark.gate
def test_light_that_saturates_every_frame_is_measured_by_its_events():
    camera = Camera.preset("nominal", seed=3, size=(8, 12), origin=(54, 156))
    scene = Fan(rpm=203)
    recording, truth = camera.record(scene, 1.6)
    frames = [frame.dn for packet in recording.packets() for frame in packet.frames]
    assert np.ptp(frames, axis=0).max() < 30        # nothing of the scene is in them
    y, x = np.mgrid[:8:2, :12:2] + 0.5
    errors = []
    # Of the first period, of .3 s, thresholds take no trend: all goes on being valid.
    for image in fuse(recording, times_us=np.arange(153_000, 1_540_000, 7_000),
                      method="kalman", demosaic="superpixel",
                      nominal_thresholds=(0.16, 0.18)):
        assert image.valid.mean() > 0.9
        if image.t_us < 1_000_000:
            continue
        turn = image.aop - truth.aop(image.t_us, x, y) + np.pi / 2
        errors.append(np.median(np.abs(turn % np.pi - np.pi / 2)))
    assert np.degrees(np.mean(errors)) < 3


@pytest.mark.parametrize("mode", ["buffered", "causal", "offline"])
def test_light_that_is_too_bright_and_still_is_shown_by_its_bound(mode):
    recording, _ = Camera.preset("nominal", seed=3, size=(6, 8)).record(
        FlatLight(s0=2000.0), 0.7)
    frame = next(f for packet in recording.packets() for f in packet.frames)
    image = next(fuse(recording, times_us=[500_000], method="kalman", mode=mode))
    usable = frame.valid
    assert usable is not None
    assert not usable.any()
    assert not image.valid.any()
    np.testing.assert_allclose(image.quad, frame.dn.mean() / frame.exposure_ms,
                               rtol=0.08)


def test_dim_light_is_told_by_frames_and_redundancy_together():
    """Frames of at most 21 DN: neither is thrown away."""
    recording, truth = Camera.preset("nominal", seed=1, size=(12, 12)).record(
        RotatingPolarizer(rpm=61, start_angle=0.3, s0=1.08), 2.0)

    def errors(**options):
        return np.array(errors_of(fuse(
            recording, times_us=range(1_000_000, 1_900_000, 9_000),
            demosaic="superpixel", nominal_thresholds=(0.16, 0.18), **options),
            truth)[:2])

    assert np.all(errors(method="kalman") < errors(
        method="events", offsets="redundancy"))


def test_a_macropixel_that_is_partly_saturated_keeps_the_scale_of_its_frames():
    recording, truth = Camera.preset(
        "nominal", seed=4, size=(4, 4)).record(RotatingPlate(rpm=203), 1.2)
    packets = list(recording.packets())
    events = np.concatenate([packet.events for packet in packets])
    frames = []
    for frame in (frame for packet in packets for frame in packet.frames):
        usable = np.ones(frame.shape, bool)
        usable[::2, ::2] = False        # one pixel of each macropixel
        frames.append(ApsFrame(
            frame.dn, frame.exposure_start_us, frame.exposure_end_us, valid=usable,
            available_us=frame.available_us))
    cut = recording_from_arrays(events, frames, sensor_size=(4, 4),
                                layout=recording.info.layout)
    s0 = []
    for image in fuse(cut, times_us=[1_000_000, 1_040_000, 1_090_000],
                      method="kalman", demosaic="superpixel",
                      nominal_thresholds=(0.16, 0.18)):
        assert image.valid.all()
        s0.append(image.s0.mean() / truth.s0(image.t_us))
    np.testing.assert_allclose(s0, 1, atol=0.1)


@pytest.mark.parametrize("ahead", [0, 50_000])
def test_packets_reads_and_snapshots_do_not_change_the_result(ahead):
    shape = (6, 8)
    events = random_events(30_000, shape, stop_us=1_500_000)
    # A gap, in which nothing is compared.
    late = events["t"] > 700_000
    events = events.copy()
    events["t"][late] += 20_000_000
    whole, cut = (make(shape, lookahead_us=ahead) for _ in range(2))
    whole.add_events(events)
    rng = np.random.default_rng(1)
    while len(events):
        n = rng.integers(1, 900)
        cut.add_events(events[:n])
        if rng.random() < 0.2:
            cut.read(cut._clock.last_us + 7_000)
            other = make(shape, lookahead_us=ahead)
            other.restore(pickle.loads(pickle.dumps(cut.snapshot())))
            cut = other
        events = events[n:]
    mine, other = whole.read(21_500_000), cut.read(21_500_000)
    for a, b in zip(mine, other, strict=True):
        np.testing.assert_array_equal(a, b)
    np.testing.assert_array_equal(whole.quality, cut.quality)


def test_a_null_vector_sums_to_zero_for_all_light():
    rng = np.random.default_rng(4)
    shape = (4, 6)
    angle = np.deg2rad(np.tile(Layout.PDAVIS.angles_deg, (2, 3)))
    response = np.stack([np.ones(shape), np.cos(2 * angle), np.sin(2 * angle)], -1) / 2
    response *= rng.uniform(0.8, 1.2, (*shape, 1))
    response[..., 1:] += rng.normal(0, 0.05, (*shape, 2))
    null = null_of(response, shape)
    light = response @ np.array([3.0, 0.7, -1.1])
    seen = (null * light).reshape(2, 2, 3, 2).sum((1, 3))
    np.testing.assert_allclose(seen, 0, atol=1e-6)
    np.testing.assert_allclose(
        np.abs(null).reshape(2, 2, 3, 2).max((1, 3)), 1, rtol=1e-6)


def test_ideal_polarizers_of_any_layout_share_the_diagonals():
    cell = np.empty((4, 3))
    cell[list(Layout.SONY.places)] = Analyser.ideal().response
    np.testing.assert_allclose(
        np.abs(null_of(cell.reshape(2, 2, 3), (5, 4))),
        np.abs(null_of(None, (5, 4))), atol=1e-6)


@pytest.mark.parametrize(("options", "message"), [
    ({"lookahead_us": -1}, "lookahead_us must be a whole number of 0"),
    ({"bandwidth": (-1, 0)}, "bandwidth must hold"),
    ({"cutoff_hz": 0}, "cutoff_hz must be positive"),
    ({"response": np.ones((3, 3))}, r"response must have shape \(2, 2, 3\) or"),
    ({"response": np.ones((2, 2, 3))}, "response must tell the four channels apart"),
])
def test_impossible_parameters_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        make(**options)


def test_parameters_of_the_other_kind_are_refused():
    recording, _ = Camera.preset("ideal", size=(4, 4), aps=None).record(
        RotatingPlate(rpm=60), 0.1)
    with pytest.raises(TypeError, match="radius has no meaning with offsets='redund"):
        fuse(recording, offsets="redundancy", radius=2)
    with pytest.raises(TypeError, match="bandwidth has no meaning with offsets='mean'"):
        fuse(recording, bandwidth=(250, 0))
    with pytest.raises(ValueError, match="offsets must be 'mean' or 'redundancy'"):
        fuse(recording, offsets="zero")


def test_at_the_end_of_a_recording_comparisons_go_on_up_to_the_time_read():
    """Reading changes nothing, and gives what a later event elsewhere would bring."""
    recording, _ = Camera.preset("ideal", size=(2, 4), aps=None).record(
        RotatingPlate(rpm=600), 0.4)
    events = recording.events()
    at, ahead = 390_000, 100_000
    late = np.zeros(1, EVENT_DTYPE)
    late["t"], late["x"], late["y"] = at + ahead + 1, 6, 4
    ended, goes_on = (make(lookahead_us=ahead) for _ in range(2))
    for method in (ended, goes_on):
        method.add_events(events)
    goes_on.add_events(late)
    before = ended.snapshot().state
    found, expected = ended.read(at + 1), goes_on.read(at + 1)
    for mine, other in zip(found, expected, strict=True):
        np.testing.assert_array_equal(mine, other)
    np.testing.assert_array_equal(ended.quality, goes_on.quality)
    assert (ended.quality < 1).any()
    assert pickle.dumps(before) == pickle.dumps(ended.snapshot().state)
    ended.add_events(late)
    np.testing.assert_array_equal(ended.read(at + 1).log_intensity,
                                  expected.log_intensity)


def test_a_late_first_frame_that_saturates_loses_no_event_since_its_exposure():
    """Where frames say nothing, redundancy begins with the first, late or not."""
    recording, _ = Camera.preset("nominal", seed=1, size=(4, 4)).record(
        RotatingPolarizer(rpm=202.6, s0=300 * FULL), 0.6)
    events = recording.events()
    full = next(frame for packet in recording.packets() for frame in packet.frames)
    assert not full.valid.any()
    assert full.available_us > full.mid_us + 20_000

    turn = 2 * np.deg2rad(np.array(Layout.PDAVIS.angles_deg))
    response = np.stack([np.ones((2, 2)), np.cos(turn), np.sin(turn)], -1) / 2

    def read(arrives, forget=False):
        made = KalmanFilter((4, 4), theta_on=0.16, theta_off=0.18, mode="causal",
                            response=response)
        end = int(np.searchsorted(events["t"], arrives, "right"))
        for part in np.array_split(events[:0 if forget else end], 5):
            made.add_events(part)
        made.add_frame(full)
        made.add_events(events[end:])
        return made.read(600_000).log_intensity

    in_time = read(full.mid_us)
    np.testing.assert_array_equal(read(full.available_us), in_time)
    assert not np.array_equal(read(full.available_us, forget=True), in_time)
