from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import reference_image as reference
from images import DTYPES, LAYOUTS, random_mosaic

import pdavis_cv
from pdavis_cv import Layout
from pdavis_cv.mosaic import DEMOSAIC_METHODS, demosaic_valid, demosaic_variance

SHAPES = [(2, 2), (2, 3), (3, 2), (3, 3), (4, 5), (7, 4), (8, 9), (260, 346)]
EVEN = [(0, 0), (0, 4), (2, 2), (4, 6), (260, 346)]


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("shape", SHAPES)
def test_bilinear_equals_its_twin(shape, dtype):
    mosaic = random_mosaic(shape, dtype)
    before = mosaic.copy()
    got = pdavis_cv.demosaic(mosaic, Layout.PDAVIS)
    np.testing.assert_array_equal(got, reference.bilinear(mosaic, Layout.PDAVIS))
    np.testing.assert_array_equal(mosaic, before)
    assert got.dtype == np.float32
    uncertain = pdavis_cv.demosaic(
        mosaic, Layout.PDAVIS, variance=np.ones(shape, np.float32))
    np.testing.assert_array_equal(
        uncertain, reference.bilinear(mosaic, Layout.PDAVIS, slope=0.5))


def test_uncertain_samples_are_extrapolated_with_the_least_error():
    """Fields whose mean square difference grows as r^1.5, known up to an error of .1.

    For these the weights 5/4 and -1/4 are best (docs/theory/demosaicing.md).
    """
    rng, n = np.random.default_rng(7), 64
    frequency = np.hypot(np.fft.fftfreq(n)[:, None], np.fft.rfftfreq(n))
    frequency[0, 0] = np.inf
    errors = {False: 0.0, True: 0.0}
    for _ in range(40):
        # In two dimensions a spectrum k^-(2 + a) has differences r^a.
        waves = np.fft.rfft2(rng.normal(size=(n, n))) * frequency**-1.75
        truth = np.fft.irfft2(waves, (n, n))
        truth = np.float32(truth / truth.std())
        mosaic = truth + np.float32(0.1) * rng.normal(size=truth.shape)
        for uncertain in errors:
            planes = pdavis_cv.demosaic(
                mosaic.astype(np.float32), Layout.PDAVIS,
                variance=np.full(truth.shape, 0.01, np.float32) if uncertain else None)
            off = (planes - truth)[:, 0]
            errors[uncertain] += np.mean(off**2)
    assert errors[True] < 0.85 * errors[False]


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("shape", EVEN)
def test_superpixel_equals_its_twin(shape, dtype):
    mosaic = random_mosaic(shape, dtype)
    got = pdavis_cv.demosaic(mosaic, Layout.SONY, "superpixel")
    np.testing.assert_array_equal(got, reference.superpixel(mosaic, Layout.SONY))


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("shape", EVEN[2:])
@pytest.mark.parametrize("layout", [Layout.PDAVIS, Layout.SONY.rot90()], ids=str)
def test_binned_equals_its_twin(layout, shape, dtype):
    mosaic = random_mosaic(shape, dtype)
    np.testing.assert_array_equal(
        pdavis_cv.demosaic(mosaic, layout, "binned"), reference.binned(mosaic, layout))


@pytest.mark.parametrize("layout", LAYOUTS, ids=str)
def test_every_layout_equals_the_twin_and_keeps_the_samples(layout):
    mosaic = random_mosaic((6, 7), np.uint16)
    planes = pdavis_cv.demosaic(mosaic, layout)
    np.testing.assert_array_equal(planes, reference.bilinear(mosaic, layout))
    for plane, place in zip(planes, layout.places, strict=True):
        r, c = divmod(place, 2)
        np.testing.assert_array_equal(plane[r::2, c::2], mosaic[r::2, c::2])


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("shape", SHAPES)
def test_a_constant_scene_demosaics_to_itself(shape, dtype):
    mosaic = np.full(shape, 123.45, dtype)
    even = not (shape[0] | shape[1]) & 1
    for method in DEMOSAIC_METHODS if even else ("bilinear", "guided"):
        planes = pdavis_cv.demosaic(mosaic, Layout.SONY, method)
        np.testing.assert_array_equal(planes, mosaic[0, 0].astype(np.float32))


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("shape", [(4, 4), (4, 7), (5, 6), (31, 30)])
def test_a_linear_ramp_demosaics_to_itself_up_to_the_border(shape, dtype):
    y, x = np.indices(shape)
    ramp = (3 * x + 2 * y + 5).astype(dtype)
    planes = pdavis_cv.demosaic(ramp, Layout.PDAVIS)
    np.testing.assert_array_equal(planes, np.broadcast_to(ramp, planes.shape))


def test_four_different_ramps_come_apart():
    shape = (9, 12)
    y, x = np.indices(shape)
    truth = np.stack([10 + 2 * x, 300 - 3 * y, 50 + x + y, 200 + 4 * x - 2 * y])
    mosaic = np.empty(shape, np.uint16)
    for plane, place in zip(truth, Layout.PDAVIS.places, strict=True):
        r, c = divmod(place, 2)
        mosaic[r::2, c::2] = plane[r::2, c::2]
    np.testing.assert_array_equal(pdavis_cv.demosaic(mosaic, Layout.PDAVIS), truth)


@pytest.mark.parametrize("x", [1, 2, 5])
@pytest.mark.parametrize("y", [1, 4, 3])
def test_the_interior_does_not_depend_on_the_crop(x, y):
    mosaic = random_mosaic((20, 24), np.float32)
    whole = pdavis_cv.demosaic(mosaic, Layout.PDAVIS)[:, y:y + 9, x:x + 10]
    part = mosaic[y - 1:y + 10, x - 1:x + 11]
    layout = Layout.PDAVIS.crop(x - 1, y - 1)
    np.testing.assert_array_equal(
        pdavis_cv.demosaic(part, layout)[:, 1:-1, 1:-1], whole)


@pytest.mark.parametrize("shape", SHAPES[:-1])
def test_valid_marks_exactly_the_pixels_that_a_bad_one_reaches(shape):
    rng = np.random.default_rng(1)
    for _ in range(20):
        valid = rng.random(shape) > 0.1
        mosaic = np.where(valid, 1, np.nan).astype(np.float32)
        reached = np.isnan(pdavis_cv.demosaic(mosaic, Layout.SONY)).any(0)
        np.testing.assert_array_equal(~demosaic_valid(valid, Layout.SONY), reached)


def test_a_cell_with_a_bad_pixel_is_bad():
    valid = np.ones((4, 6), bool)
    valid[2, 5] = False
    want = [[True, True, True], [True, True, False]]
    assert demosaic_valid(valid, Layout.SONY, "superpixel").tolist() == want


def test_a_cell_that_a_bad_pixel_reaches_is_bad_when_binned():
    rng = np.random.default_rng(1)
    for _ in range(20):
        valid = rng.random((8, 10)) > 0.05
        mosaic = np.where(valid, 1, np.nan).astype(np.float32)
        reached = np.isnan(pdavis_cv.demosaic(mosaic, Layout.SONY, "binned")).any(0)
        np.testing.assert_array_equal(
            ~demosaic_valid(valid, Layout.SONY, "binned"), reached)


def test_strided_mosaics_and_fortran_order_are_taken():
    mosaic = random_mosaic((16, 20), np.uint8)
    for view in (mosaic[::2, ::-1], mosaic.T):
        want = reference.bilinear(view, Layout.SONY)
        np.testing.assert_array_equal(pdavis_cv.demosaic(view, Layout.SONY), want)


@pytest.mark.parametrize("method", DEMOSAIC_METHODS)
def test_out_is_overwritten_and_returned(method):
    mosaic = random_mosaic((6, 8), np.uint16)
    want = pdavis_cv.demosaic(mosaic, Layout.SONY, method)
    out = np.full_like(want, np.nan)
    assert pdavis_cv.demosaic(mosaic, Layout.SONY, method, out) is out
    np.testing.assert_array_equal(out, want)


def test_an_empty_mosaic_gives_empty_planes():
    for shape in ((0, 0), (0, 5), (3, 0)):
        for method in ("bilinear", "guided"):
            assert pdavis_cv.demosaic(
                np.empty(shape, np.uint8), Layout.SONY, method).shape == (4, *shape)
            assert demosaic_valid(
                np.ones(shape, bool), Layout.SONY, method).shape == shape
    assert pdavis_cv.demosaic(
        np.empty((0, 4), np.uint8), Layout.SONY, "binned").shape == (4, 0, 2)
    assert demosaic_valid(np.ones((0, 4), bool), Layout.SONY, "binned").shape == (0, 2)


@pytest.mark.parametrize(("mosaic", "options", "error", "words"), [
    (np.zeros((4, 4)), {}, TypeError, "mosaic must be uint8, .* got float64"),
    (np.zeros((4, 4), ">u2"), {}, TypeError, "mosaic must be uint8, .* got >u2"),
    ([[1, 2], [3, 4]], {}, TypeError, "mosaic must be an ndarray, got list"),
    (np.zeros((4, 4, 3), "u1"), {}, ValueError, r"mosaic must be \(H, W\)"),
    (np.zeros((1, 4), "u1"), {}, ValueError, r"at least 2.* got .*\(1, 4\)"),
    (np.zeros((1, 1), "u1"), {}, ValueError, r"at least 2.* got .*\(1, 1\)"),
    (np.zeros((4, 3), "u1"), {"method": "superpixel"}, ValueError,
     r"even height and width.* got .*\(4, 3\)"),
    (np.zeros((3, 4), "u1"), {"method": "binned"}, ValueError,
     r"binned needs an even height and width.* got .*\(3, 4\)"),
    (np.zeros((1, 4), "u1"), {"method": "guided"}, ValueError,
     r"guided needs .* at least 2.* got .*\(1, 4\)"),
    (np.zeros((4, 4), "u1"), {"valid": np.ones((4, 5), bool)}, ValueError,
     r"valid must have the mosaic's shape \(4, 4\), got \(4, 5\)"),
    (np.zeros((4, 4), "u1"), {"valid": np.ones((4, 4))}, TypeError,
     "valid must be bool, got float64"),
    (np.zeros((4, 4), "u1"), {"method": "cubic"}, ValueError,
     "one of bilinear, superpixel, binned, guided, got 'cubic'"),
    (np.zeros((4, 4), "u1"), {"layout": ((90, 45), (135, 0))}, TypeError,
     "layout must be a Layout or its name, got tuple"),
    (np.zeros((4, 4), "u1"), {"out": np.zeros((4, 4, 4))}, TypeError,
     "out must be float32"),
    (np.zeros((4, 4), "u1"), {"out": np.zeros((4, 2, 2), "f4")}, ValueError,
     r"out must have shape \(4, 4, 4\)"),
])
def test_a_bad_argument_is_named(mosaic, options, error, words):
    with pytest.raises(error, match=words):
        pdavis_cv.demosaic(mosaic, **{"layout": Layout.SONY} | options)


def test_out_must_not_overlap_the_mosaic():
    block = np.zeros((4, 8, 8), np.float32)
    with pytest.raises(ValueError, match="out must not overlap"):
        pdavis_cv.demosaic(block[0], Layout.SONY, out=block)


def test_valid_must_be_bool_and_flat():
    with pytest.raises(TypeError, match="valid must be bool, got uint8"):
        demosaic_valid(np.ones((4, 4), np.uint8), Layout.SONY)
    with pytest.raises(ValueError, match=r"valid must be \(H, W\)"):
        demosaic_valid(np.ones(4, bool), Layout.SONY)


def test_eight_threads_get_what_one_gets():
    mosaics = [random_mosaic((64, 66), np.uint16, seed) for seed in range(8)]
    want = [pdavis_cv.demosaic(m, Layout.PDAVIS) for m in mosaics]
    with ThreadPoolExecutor(8) as pool:
        got = pool.map(lambda m: pdavis_cv.demosaic(m, Layout.PDAVIS), mosaics * 20)
        for i, planes in enumerate(got):
            np.testing.assert_array_equal(planes, want[i % 8])


def test_the_kernels_check_sizes_themselves():
    kernels = pdavis_cv._kernels
    mosaic, places = np.zeros((4, 4), np.uint8), np.arange(4, dtype=np.intp)
    out, scratch = np.zeros((4, 4, 4), np.float32), np.zeros(104, np.float32)
    with pytest.raises(ValueError, match="sides >= 2"):
        kernels.bilinear(mosaic[:1], places, False, scratch, out)
    with pytest.raises(ValueError, match="scratch"):
        kernels.bilinear(mosaic, places, False, scratch[:90], out)
    with pytest.raises(ValueError, match="permutation"):
        kernels.bilinear(mosaic, places + 1, False, scratch, out)
    with pytest.raises(ValueError, match="binned: mosaic"):
        kernels.binned(mosaic, places, scratch, out)
    with pytest.raises(ValueError, match="binned: scratch"):
        kernels.binned(mosaic, places, scratch, out[:, :2, :2].copy())
    variance = mosaic.astype(np.float32)
    with pytest.raises(ValueError, match="sides >= 2"):
        kernels.bilinear_variance(variance[:1], places, scratch, out[:, :1].copy())
    with pytest.raises(ValueError, match="bilinear_variance: scratch"):
        kernels.bilinear_variance(variance, places, scratch[:4], out)
    valid, row = np.ones((4, 4), np.uint8), np.zeros(4, np.uint8)
    for rows, image, message in (((0, 4), valid[:1], "sides >= 2"),
                                 ((-1, 4), valid, "rows"), ((0, 5), valid, "rows")):
        with pytest.raises(ValueError, match=message):
            kernels.reached(image, rows, row, valid.copy())


@pytest.mark.parametrize("layout", LAYOUTS, ids=str)
@pytest.mark.parametrize("shape", [(2, 2), (2, 3), (3, 2), (5, 4), (9, 12)])
def test_variances_equal_their_twin(shape, layout):
    variance = np.random.default_rng(5).random(shape).astype(np.float32)
    got = demosaic_variance(variance, layout, valid=np.ones(shape, bool))
    np.testing.assert_array_equal(got, reference.bilinear_variance(variance, layout))


@pytest.mark.parametrize("method", DEMOSAIC_METHODS)
@pytest.mark.parametrize("layout", LAYOUTS, ids=str)
def test_variances_stay_among_those_of_their_channel(layout, method):
    variance = 10 ** np.random.default_rng(1).uniform(-4, 0, (6, 10))
    variance = variance.astype(np.float32)
    planes = demosaic_variance(
        variance, layout, method, valid=np.ones(variance.shape, bool))
    assert planes.shape == pdavis_cv.demosaic(variance, layout, method).shape
    for plane, place in zip(planes, layout.places, strict=True):
        samples = variance[place // 2::2, place % 2::2]
        assert samples.min() <= plane.min() <= plane.max() <= samples.max()


def test_variances_at_a_border_are_those_of_the_channel_beside_it():
    variance = np.arange(20, dtype=np.float32).reshape(4, 5)
    got = demosaic_variance(variance, Layout.PDAVIS, valid=np.ones((4, 5), bool))
    by_place = dict(zip(Layout.PDAVIS.places, got, strict=True))
    np.testing.assert_array_equal(by_place[0][:, 0], [0, 5, 10, 10])
    np.testing.assert_array_equal(by_place[0][0], [0, 1, 2, 3, 4])
    np.testing.assert_array_equal(by_place[3][0], [6, 6, 7, 8, 8])
    np.testing.assert_array_equal(by_place[3][:, 4], [8, 8, 13, 18])
    assert demosaic_variance(np.empty((0, 4), np.float32), Layout.SONY, "binned",
                             valid=np.ones((0, 4), bool)).shape == (4, 0, 2)
