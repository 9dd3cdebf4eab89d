from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import reference_image as reference

import pdavis_cv
from pdavis_cv.aps import clip_level, correct
from pdavis_cv.calibration.corrected import FrameCorrection

SHAPES = [(0, 0), (0, 3), (1, 1), (3, 5), (260, 346)]


def reads(shape, seed=0):
    rng = np.random.default_rng(seed)
    pair = rng.integers(300, 1024, shape, np.uint16), rng.integers(
        0, 1024, shape, np.uint16)
    for read in pair:
        read.flags.writeable = False
    return pair


def planes(shape, seed=1):
    rng = np.random.default_rng(seed)
    return (rng.normal(0, 5, shape).astype(np.float32),
            rng.uniform(0.8, 1.2, shape).astype(np.float32))


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("with_dark", [False, True])
@pytest.mark.parametrize("with_gain", [False, True])
def test_cds_equals_its_twin(shape, with_dark, with_gain):
    reset, signal = reads(shape)
    dark, gain = planes(shape)
    options = {"dark": dark} if with_dark else {}
    options |= {"gain": gain} if with_gain else {}
    before = reset.copy(), signal.copy()
    dn, valid = pdavis_cv.cds(reset, signal, **options)
    want = reference.cds(reset, signal, **options)
    np.testing.assert_array_equal(dn, want[0])
    np.testing.assert_array_equal(valid, want[1])
    assert (dn.dtype, valid.dtype) == (np.float32, np.bool_)
    np.testing.assert_array_equal((reset, signal), before)


def test_cds_removes_any_fixed_offset():
    reset, signal = reads((20, 30))
    offset = np.random.default_rng(2).integers(0, 500, reset.shape, np.uint16)
    np.testing.assert_array_equal(
        pdavis_cv.cds(reset + offset, signal + offset)[0],
        pdavis_cv.cds(reset, signal)[0])


def test_cds_keeps_the_mean_of_a_dark_pixel():
    rng = np.random.default_rng(3)
    signal = np.rint(rng.normal(700, 4, (300, 300))).astype(np.uint16)
    dn, _ = pdavis_cv.cds(np.full_like(signal, 700), signal)
    assert abs(dn.mean()) < 0.1  # a clamp at 0 would give 1.6


@pytest.mark.parametrize(("reset", "signal", "usable"), [
    (700, 3, True), (700, 2, False), (700, 0, False), (384, 100, True),
    (383, 100, False), (0, 0, False), (1023, 1023, True)])
def test_a_read_at_its_limit_is_not_valid(reset, signal, usable):
    dn, valid = pdavis_cv.cds(*(np.full((1, 1), v, np.uint16) for v in (reset, signal)))
    assert valid[0, 0] == usable
    assert dn[0, 0] == reset - signal


def test_cds_takes_scalars_and_strides():
    reset, signal = reads((10, 12))
    dn, valid = pdavis_cv.cds(reset[::2, ::-1], signal[::2, ::-1], 10, 0.5)
    want = reference.cds(reset[::2, ::-1], signal[::2, ::-1], 10, 0.5)
    np.testing.assert_array_equal(dn, want[0])
    np.testing.assert_array_equal(valid, want[1])


@pytest.mark.parametrize(("change", "error", "words"), [
    ({"reset": np.zeros((2, 2))}, TypeError, "reset must be uint16, got float64"),
    ({"signal": [[1, 2]]}, TypeError, "signal must be uint16, got list"),
    ({"reset": np.zeros(4, "u2")}, ValueError, r"reset must be \(H, W\)"),
    ({"signal": np.zeros((2, 3), "u2")}, ValueError, r"shape of reset, \(2, 2\)"),
    ({"dark": np.zeros((1, 2))}, ValueError, "dark must be one number or have shape"),
    ({"gain": np.zeros((3, 3))}, ValueError, "gain must be one number or have shape"),
])
def test_a_bad_argument_of_cds_is_named(change, error, words):
    arguments = {name: np.zeros((2, 2), np.uint16) for name in ("reset", "signal")}
    with pytest.raises(error, match=words):
        pdavis_cv.cds(**arguments | change)


@pytest.mark.parametrize("shape", SHAPES)
def test_correct_equals_numpy(shape):
    raw, gain = planes(shape)
    dark = gain * 3
    known = np.random.default_rng(4).random(shape) > 0.2
    dn, valid = correct(raw, dark, gain, 4.0, known)
    np.testing.assert_array_equal(dn, (raw - dark) * gain)
    np.testing.assert_array_equal(valid, known & (raw < 4))


def test_correct_without_anything_copies():
    raw, _ = planes((3, 4))
    dn, valid = correct(raw)
    assert not np.shares_memory(dn, raw)
    np.testing.assert_array_equal(dn, raw)
    assert valid.all()


def test_nan_is_not_valid():
    raw = np.array([[1, np.nan]], np.float32)
    assert correct(raw)[1].tolist() == [[True, False]]


@pytest.mark.parametrize(("change", "error", "words"), [
    ({"dn": np.zeros((2, 2))}, TypeError, "dn must be float32, got float64"),
    ({"dn": np.zeros(4, "f4")}, ValueError, r"dn must be \(H, W\)"),
    ({"dark": np.zeros(2)}, ValueError, "dark must be one number or have shape"),
    ({"valid": np.zeros((2, 2), "u1")}, TypeError, "valid must be bool"),
    ({"valid": np.zeros((2, 3), bool)}, ValueError, "valid must have shape"),
])
def test_a_bad_argument_of_correct_is_named(change, error, words):
    with pytest.raises(error, match=words):
        correct(**{"dn": np.zeros((2, 2), np.float32)} | change)


def test_a_corrected_frame_keeps_times_and_marks_saturation():
    frame = pdavis_cv.ApsFrame(
        np.array([[100, 900]]), 1000, 3000, available_us=5000, full_scale_dn=4095)
    got = FrameCorrection(pdavis_cv.Calibration(
        sensor_size=(1, 2), dark=np.full((1, 2), 20), gain=np.full((1, 2), 2),
        clip_dn=900))(frame)
    assert got.dn.tolist() == [[160, 1760]]
    assert got.valid.tolist() == [[True, False]]
    assert (got.mid_us, got.available_us, got.full_scale_dn) == (2000, 5000, 4095)
    assert frame.valid is None


@pytest.mark.parametrize("full_scale_dn", [255, 1020, 1023, 65_535])
@pytest.mark.parametrize("clip_dn", [None, 0.8, 1.0, 2.0])
def test_full_scale_is_never_valid_however_few_pixels(full_scale_dn, clip_dn):
    rng = np.random.default_rng(4)
    dn = np.rint(rng.uniform(0.2, 0.7, (40, 60)) * full_scale_dn).astype(np.float32)
    few = rng.random(dn.shape) < 0.003
    dn[few] = full_scale_dn
    known = clip_dn and pdavis_cv.Calibration(
        sensor_size=dn.shape, clip_dn=clip_dn * full_scale_dn)
    got = FrameCorrection(known)(
        pdavis_cv.ApsFrame(dn, 0, 1000, full_scale_dn=full_scale_dn))
    assert 0 < few.sum() < 20
    np.testing.assert_array_equal(got.valid, ~few)


def gradient(top, noise=2.0, seed=5):
    rng = np.random.default_rng(seed)
    light = np.linspace(20, top, 260 * 346).reshape(260, 346)
    return light + rng.normal(0, noise, light.shape)


@pytest.mark.parametrize("full_well", [800, 880, 1010])
@pytest.mark.parametrize("spread", [0.0, 3.0])
def test_clip_level_finds_where_pixels_are_full(full_well, spread):
    light = gradient(1.2 * full_well)
    well = full_well + np.random.default_rng(6).normal(0, spread, light.shape)
    dn = np.rint(np.minimum(light, well))
    level = clip_level(dn)
    assert level is not None
    full, free = light > well + 10, light < full_well - 30
    assert (dn[full] >= level).mean() > 0.98
    assert not (dn[free] >= level).any()


def test_clip_level_is_none_where_nothing_clips():
    for top in (300, 700, 1000):
        assert clip_level(gradient(top)) is None
    assert clip_level(np.full((4, 4), np.nan)) is None
    assert clip_level(np.empty((0, 4))) is None


def test_a_uniform_scene_below_the_upper_quarter_is_not_taken_for_full():
    assert clip_level(np.minimum(gradient(1000), 700)) is None


def test_hot_pixels_do_not_hide_the_pile_up():
    dn = np.minimum(gradient(1000), 880)
    dn.flat[::20_000] = 1023
    level = clip_level(dn)
    assert level is not None
    assert 850 < level <= 880


def test_clip_level_takes_several_frames():
    frames = np.stack([np.minimum(gradient(1000, seed=s), 880) for s in range(3)])
    assert clip_level(frames) == pytest.approx(880, abs=30)


def full_patch(pixels, level=880, seed=0):
    """Return a dim frame of which so many pixels are full, and where."""
    rng = np.random.default_rng(seed)
    dn = rng.integers(50, 300, (60, 80)).astype(np.float32)
    full = np.zeros(dn.shape, bool)
    full.flat[rng.choice(dn.size, pixels, replace=False)] = True
    dn[full] = level
    return dn, full


def corrected_stream(frames):
    correction = FrameCorrection(None)
    return [correction(pdavis_cv.ApsFrame(dn, k, k + 1)).valid
            for k, dn in enumerate(frames)]


def test_full_pixels_stay_invalid_where_a_frame_has_few_of_them():
    # alone, a frame with fewer than 64 full pixels shows no pile-up
    frames = [full_patch(n, seed=n) for n in (10, 400, 10, 300, 1)]
    valid = corrected_stream([dn for dn, _ in frames])
    assert valid[0].all()           # nothing is known yet
    for got, (_, full) in zip(valid[1:], frames[1:], strict=True):
        np.testing.assert_array_equal(got, ~full)


def test_brighter_light_says_that_a_pile_up_was_of_the_scene():
    patch, _ = full_patch(400, level=800)
    beyond, _ = full_patch(40, level=950)    # too few to pile up
    valid = corrected_stream([patch, beyond, patch])
    assert (valid[0] == (patch < 800)).all()
    assert valid[1].all()
    assert valid[2].all()                    # seen to be below what pixels can hold


def test_the_lowest_edge_of_one_pile_up_holds():
    high, low = (full_patch(400, level=level)[0] for level in (885, 875))
    valid = corrected_stream([high, low, high, low])
    for got, dn in zip(valid[1:], (low, high, low), strict=True):
        np.testing.assert_array_equal(got, dn < 875)


def test_frames_of_another_scale_begin_anew():
    correction = FrameCorrection(None)
    correction(pdavis_cv.ApsFrame(full_patch(400)[0], 0, 1))
    assert 875 < correction.clipping.level_dn <= 880
    got = correction(pdavis_cv.ApsFrame(
        np.full((60, 80), 900.0, np.float32), 1, 2, full_scale_dn=4095))
    assert got.valid.all()


def test_eight_threads_get_what_one_gets():
    pairs = [reads((40, 50), seed) for seed in range(8)]
    want = [pdavis_cv.cds(*pair) for pair in pairs]
    with ThreadPoolExecutor(8) as pool:
        for i, (dn, valid) in enumerate(pool.map(
                lambda pair: pdavis_cv.cds(*pair), pairs * 20)):
            np.testing.assert_array_equal(dn, want[i % 8][0])
            np.testing.assert_array_equal(valid, want[i % 8][1])
