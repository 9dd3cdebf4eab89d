"""Guided demosaicing: equal to its twin, no worse than it says, deaf to bad samples."""
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import reference_image as reference
from images import DTYPES, LAYOUTS, malus, random_mosaic, sample, scene

import pdavis_cv
from pdavis_cv import Calibration, Layout, fuse
from pdavis_cv.mosaic import GUIDED_DTYPE, REACH, demosaic_valid
from pdavis_cv.simulation import Camera, FlatLight

SHAPES = [(2, 2), (2, 3), (3, 2), (3, 3), (4, 5), (5, 2), (7, 4), (8, 9), (61, 83)]
# The layouts of one sensor turned and mirrored: 0 opposite 90 in the cell.
TURNED = [layout for layout in LAYOUTS
          if (layout.places[0] ^ layout.places[2]) == 3]


def guided(mosaic, layout=Layout.SONY, **options):
    return pdavis_cv.demosaic(mosaic, layout, "guided", **options)


def stepped(shape, angle, layout=Layout.SONY):
    """Intensity steps along a line at this angle, sampled as by an antialiased lens;
    return mosaic and the four channels behind ideal polarizers."""
    y, x = np.indices(shape) - np.array(shape)[:, None, None] / 2
    edge = 0.5 + 0.5 * np.tanh((x * np.cos(angle) + y * np.sin(angle)) / 0.7)
    s0, degree, aop = 100 + 400 * edge, np.full(shape, 0.3), np.full(shape, 0.5)
    truth = np.stack([malus(s0, degree, aop, a)
                      for a in np.deg2rad([0, 45, 90, 135])])
    return sample(layout, s0, degree, aop).astype(np.float32), truth


def dolp(quad):
    return np.hypot(quad[0] - quad[2], quad[1] - quad[3]) / (quad.sum(0) / 2)


def shares(quad):
    return quad / quad.sum(0)


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("shape", [*SHAPES, (6, 1281), (5, 2600)])  # several strips
def test_guided_equals_its_twin(shape, dtype):
    mosaic = random_mosaic(shape, dtype)
    before = mosaic.copy()
    got = guided(mosaic, Layout.PDAVIS)
    np.testing.assert_array_equal(got, reference.guided(mosaic, Layout.PDAVIS))
    np.testing.assert_array_equal(mosaic, before)
    assert got.dtype == np.float32


@pytest.mark.parametrize("layout", LAYOUTS, ids=str)
def test_every_layout_equals_the_twin(layout):
    mosaic = random_mosaic((9, 12), np.uint16)
    np.testing.assert_array_equal(
        guided(mosaic, layout), reference.guided(mosaic, layout))


def test_with_variances_it_equals_its_twin_and_takes_less_of_a_noisy_residual():
    mosaic = random_mosaic((14, 17), np.uint16)
    variance = np.random.default_rng(8).random(mosaic.shape).astype(np.float32)
    got = guided(mosaic, variance=variance)
    np.testing.assert_array_equal(
        got, reference.guided(mosaic, Layout.SONY, variance=variance))
    first = shares(reference.guided(mosaic, Layout.SONY, gain=0))
    steps = [np.abs(shares(guided(mosaic, variance=np.full_like(variance, level)))
                    - first).mean() for level in (0, 1, 1e6)]
    assert steps[0] > 1.2 * steps[1] > 100 * steps[2]


def test_variances_of_unusable_samples_do_not_matter():
    mosaic = random_mosaic((20, 24), np.uint16)
    valid = np.random.default_rng(2).random(mosaic.shape) > 0.03
    variance = np.full(mosaic.shape, 0.01, np.float32)
    want = guided(mosaic, valid=valid, variance=variance)
    got = guided(mosaic, valid=valid,
                 variance=np.where(valid, variance, np.float32(np.nan)))
    np.testing.assert_array_equal(got, want)


@pytest.mark.parametrize(("variance", "error", "match"), [
    (np.zeros((4, 4)), TypeError, "variance must be float32, got float64"),
    (np.zeros((4, 3), np.float32), ValueError, r"variance must have .* got \(4, 3\)")])
def test_variances_that_do_not_fit_are_refused(variance, error, match):
    with pytest.raises(error, match=match):
        guided(np.zeros((4, 4), np.uint8), variance=variance)


@pytest.mark.parametrize("layout", LAYOUTS, ids=str)
def test_four_unequal_polarizers_before_even_light_come_apart(layout):
    channels = np.array([100, 60, 35, 70], np.float32)  # I0 + I90 is not I45 + I135
    mosaic = np.empty((11, 14), np.float32)
    for value, place in zip(channels, layout.places, strict=True):
        mosaic[place // 2::2, place % 2::2] = value
    np.testing.assert_allclose(
        guided(mosaic, layout), np.broadcast_to(channels[:, None, None], (4, 11, 14)),
        rtol=1e-6)


@pytest.mark.parametrize("layout", TURNED, ids=str)
@pytest.mark.parametrize("angle", np.deg2rad([0, 20, 45, 90, 115]))
def test_an_edge_of_intensity_shows_less_in_dolp_than_bilinearly(layout, angle):
    mosaic, truth = stepped((40, 44), angle, layout)
    inner = np.s_[:, 6:-6, 6:-6]
    error = {method: np.sqrt(np.mean((dolp(pdavis_cv.demosaic(
        mosaic, layout, method)[inner]) - 0.3)**2)) for method in (
            "bilinear", "guided")}
    assert len(TURNED) == 8
    assert error["guided"] < 0.6 * error["bilinear"]
    sharper = [np.sqrt(np.mean((pdavis_cv.demosaic(
        mosaic, layout, method) - truth)[inner]**2)) for method in (
            "guided", "bilinear")]
    assert sharper[0] < 0.7 * sharper[1]


def test_light_behind_a_crossed_polarizer_stays_bounded():
    """The dark channel divides by nothing: fully polarized, textured, noisy light."""
    rng = np.random.default_rng(3)
    s0 = 300 * np.exp(0.3 * rng.standard_normal((64, 64)))
    mosaic = sample(Layout.PDAVIS, s0, np.ones((64, 64)), np.zeros((64, 64)))
    mosaic += rng.normal(0, 3, mosaic.shape)
    quad = guided(mosaic.astype(np.float32), Layout.PDAVIS)
    assert np.abs(quad).max() < 2 * s0.max()
    assert np.abs(dolp(quad) - 1).mean() < 0.1


def test_a_region_equals_the_crop_of_the_whole():
    mosaic = random_mosaic((33, 38), np.uint16)
    valid = np.random.default_rng(2).random(mosaic.shape) > 0.03
    for options in ({}, {"valid": valid}):
        whole = guided(mosaic, Layout.PDAVIS, **options)
        for x, y in ((0, 0), (3, 6), (9, 5), (14, 12)):
            top, left = max(y - REACH["guided"], 0), max(x - REACH["guided"], 0)
            part = np.s_[top:y + 16 + REACH["guided"], left:x + 19 + REACH["guided"]]
            got = guided(mosaic[part], Layout.PDAVIS.crop(left, top),
                         **{name: value[part] for name, value in options.items()})
            got = got[:, y - top:, x - left:][:, :min(16, 33 - y), :19]
            np.testing.assert_array_equal(got, whole[:, y:y + 16, x:x + 19])


@pytest.mark.parametrize("bad", [np.nan, np.inf, 1e30, 65535])
def test_usable_pixels_do_not_depend_on_the_others(bad):
    rng = np.random.default_rng(4)
    s0, degree, angle = scene((40, 46))
    mosaic = sample(Layout.PDAVIS, s0, degree, angle).astype(np.float32)
    valid = rng.random(mosaic.shape) > 0.02
    valid[20:27, 30:39] = False
    spoilt = np.where(valid, mosaic, np.float32(bad))
    got = guided(spoilt, Layout.PDAVIS, valid=valid)
    usable = demosaic_valid(valid, Layout.PDAVIS, "guided")
    np.testing.assert_array_equal(
        got[:, usable], guided(mosaic, Layout.PDAVIS, valid=valid)[:, usable])
    assert np.isfinite(got).all()
    assert usable.mean() > valid.mean() - 0.01  # they do not spread
    # and are still right
    assert np.abs(dolp(got[:, usable]) - degree[usable]).max() < 0.05


def test_fused_images_take_the_calibrated_gain_out_before_they_are_guided():
    """Even light; pixels whose gain and polarizers differ, all known."""
    camera = Camera.preset("nominal", seed=2, size=(20, 22))
    recording, truth = camera.record(FlatLight(dolp=0.4, aop=0.6), 0.2)
    known = Calibration(**camera.exact_calibration())
    errors = {}
    for name, calibration in (("known", known), ("unknown", None)):
        image, = fuse(recording, method="frames", demosaic="guided", times_us=[150_000],
                      calibration=calibration)
        errors[name] = np.sqrt(np.mean((image.dolp - truth.dolp(150_000))**2))
    assert errors["known"] < 0.5 * errors["unknown"]


def test_valid_is_where_the_sample_and_some_square_of_nine_are():
    rng = np.random.default_rng(5)
    for density in (0.02, 0.2, 0.6):
        valid = rng.random((13, 15)) > density
        padded = np.pad(valid, 1, constant_values=True)
        clean = np.lib.stride_tricks.sliding_window_view(padded, (3, 3)).all((2, 3))
        near = np.lib.stride_tricks.sliding_window_view(
            np.pad(clean, 2), (5, 5)).any((2, 3))
        np.testing.assert_array_equal(
            demosaic_valid(valid, Layout.SONY, "guided"), valid & near)


def test_bad_samples_equal_the_twin_on_the_filled_mosaic():
    mosaic = random_mosaic((20, 24), np.float32) + np.float32(5000)
    valid = np.ones(mosaic.shape, bool)
    valid[9, 10] = False
    filled = mosaic.copy()
    filled[9, 10] = (((mosaic[7, 10] + mosaic[9, 8]) + mosaic[9, 12])
                     + mosaic[11, 10]) / np.float32(4)
    clean = np.ones(mosaic.shape, bool)
    clean[8:11, 9:12] = False
    np.testing.assert_array_equal(
        guided(mosaic, valid=valid), reference.guided(filled, Layout.SONY, clean))


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("pattern", ["none", "one of each cell", "one row"])
def test_with_next_to_nothing_usable_there_is_no_nan_and_nothing_valid(dtype, pattern):
    mosaic = random_mosaic((12, 14), dtype)
    valid = np.zeros(mosaic.shape, bool)
    if pattern == "one of each cell":
        valid[::2, 1::2] = True
    elif pattern == "one row":
        valid[5] = True
    assert np.isfinite(guided(mosaic, valid=valid)).all()
    assert not demosaic_valid(valid, Layout.SONY, "guided").any()


@pytest.mark.parametrize("value", [0, -3, 1e-12])
def test_darkness_gives_no_nan(value):
    mosaic = np.full((8, 9), value, np.float32)
    np.testing.assert_allclose(guided(mosaic), np.broadcast_to(mosaic, (4, 8, 9)))


def test_the_unit_does_not_matter():
    mosaic = random_mosaic((16, 18), np.uint8).astype(np.float32)
    np.testing.assert_array_equal(
        guided(mosaic * np.float32(2**-9)), guided(mosaic) * np.float32(2**-9))


def test_strided_mosaics_are_taken():
    mosaic = random_mosaic((16, 20), np.uint8)
    for view in (mosaic[::2, ::-1], mosaic.T):
        np.testing.assert_array_equal(guided(view), reference.guided(view, Layout.SONY))


def test_eight_threads_get_what_one_gets():
    mosaics = [random_mosaic((64, 66), np.uint16, seed) for seed in range(8)]
    want = [guided(m) for m in mosaics]
    with ThreadPoolExecutor(8) as pool:
        for i, planes in enumerate(pool.map(guided, mosaics * 10)):
            np.testing.assert_array_equal(planes, want[i % 8])


def test_the_kernel_checks_sizes_itself():
    kernel = pdavis_cv._kernels.guided
    mosaic, places = np.zeros((4, 4), np.uint8), np.arange(4, dtype=np.intp)
    out, clean = np.zeros((4, 4, 4), np.float32), np.zeros((0, 0), np.uint8)
    noise = np.zeros((0, 0), np.float32)
    scratch = np.zeros(144 * 36 + 32, np.float32)
    constants = np.ones(1, GUIDED_DTYPE)
    with pytest.raises(ValueError, match="sides >= 2"):
        kernel(mosaic[:1], clean, noise, places, constants, scratch, out)
    with pytest.raises(ValueError, match="clean and variance must be empty"):
        kernel(mosaic, np.zeros((4, 3), np.uint8), noise, places, constants, scratch,
               out)
    with pytest.raises(ValueError, match="clean and variance must be empty"):
        kernel(mosaic, clean, np.zeros((3, 4), np.float32), places, constants, scratch,
               out)
    with pytest.raises(ValueError, match="scratch"):
        kernel(mosaic, clean, noise, places, constants, scratch[:900], out)
    with pytest.raises(ValueError, match="constants must be one"):
        kernel(mosaic, clean, noise, places, constants[:0], scratch, out)
    with pytest.raises(ValueError, match="permutation"):
        kernel(mosaic, clean, noise, places * 0, constants, scratch, out)
