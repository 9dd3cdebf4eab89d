"""Mosaics of colours and polarizers: layouts, demosaicing, files, pictures, truth."""
import pickle
import warnings
from functools import partial

import cv2
import numpy as np
import pytest
import reference_colours as reference
from images import DTYPES
from reference_image import guided

import pdavis_cv
from pdavis_cv import Layout, LayoutError, LayoutWarning, _kernels, fuse, render
from pdavis_cv.colour_mosaic import COLOUR_REACH, COLOURS, joint
from pdavis_cv.mosaic import REACH, scratch_rows
from pdavis_cv.polarimetry import adopted_colours
from pdavis_cv.recording.images.checks import found_colours
from pdavis_cv.simulation import Camera, Coloured, FunctionScene
from pdavis_cv.tools.main import main

COLOUR = Layout.of("sony-rggb")
ORDERS = ("rggb", "grbg", "gbrg", "bggr")
METHODS = ("bilinear", "guided")
AXES = np.deg2rad([0, 45, 90, 135])
GAINS = np.array([0.6, 1.0, 0.35])


def filters(layout, shape):
    """Colour (0 to 2) and channel (0 to 3) of each pixel."""
    y, x = np.indices(shape)
    cell = np.array(["RGB".index(c) for c in layout.colours]).reshape(4, 4)
    return (cell[y % 4, x % 4], np.array(layout.angles_deg)[y % 2, x % 2] // 45)


def seen(channels, layout):
    """What a sensor measures of channels (3, 4, H, W)."""
    y, x = np.indices(channels.shape[2:])
    return channels[(*filters(layout, y.shape), y, x)].astype(np.float32)


def scene(shape, gains=GAINS, aop_deg=30, dolp=0.5):
    """Channels of light that is the same everywhere."""
    aop = np.deg2rad(np.broadcast_to(aop_deg, 3))
    wave = 1 + np.broadcast_to(dolp, 3)[:, None] * np.cos(2 * (aop[:, None] - AXES))
    return np.broadcast_to((500 * gains[:, None] * wave)[..., None, None],
                           (3, 4, *shape))


def noise(shape, dtype=np.float32):
    """Samples of light with detail, dark places and noise, some below 0 if they can."""
    rng = np.random.default_rng(shape)
    image = rng.uniform(0, 9, shape) * rng.uniform(0, 20, shape[0])[:, None]
    return (image - (dtype == np.float32)).astype(dtype)


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("shape", [(4, 4), (5, 7), (6, 4), (13, 18), (8, 41)])
def test_the_kernel_of_bilinear_colours_equals_its_twin(shape, dtype):
    for layout in (COLOUR, COLOUR.crop(1, 2), COLOUR.crop(2, 3), COLOUR.flip_x()):
        mosaic, cell = noise(shape, dtype), filters(layout, (4, 4))[0]
        out = np.full((3, *shape), np.nan, np.float32)
        _kernels.colour_bilinears(
            mosaic, cell.astype(np.uint8), scratch_rows(2, shape[1]), out)
        np.testing.assert_array_equal(out, reference.bilinear_planes(mosaic, cell))


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("shape", [(4, 4), (8, 4), (4, 20), (24, 44)])
def test_the_kernels_of_guided_colours_equal_their_twins(shape, dtype):
    mosaic, (h, w), spare = noise(shape, dtype), shape, scratch_rows(55, shape[1])
    image = mosaic.astype(np.float32)
    tints, parts, out = (np.full(size, np.nan, np.float32) for size in (
        (3, h // 2, w // 2), (3, 8, h // 4, w // 4), (3, 4, h, w)))
    _kernels.colour_ratios(image, spare, tints, parts)
    ratios = parts[:, :4]
    for got, expected in zip((tints, ratios), reference.colour_ratios(mosaic),
                             strict=True):
        np.testing.assert_array_equal(got, expected)
    _kernels.grey_mosaic(tints, parts, spare, image)
    np.testing.assert_array_equal(image, reference.grey_mosaic(mosaic, tints, ratios))
    out[1] = guided(image, Layout.SONY, noise=20, coarse=5)
    expected = reference.colour_planes(out[1].copy(), COLOUR.places, tints, ratios)
    seen, places = np.empty((3, 3, h, w), np.float32), np.array(COLOUR.places)
    _kernels.colour_planes(out[1], places, tints, parts, 1.25, spare, seen)
    _kernels.colour_planes(out[1], places, tints, parts, 1.25, spare, out)
    np.testing.assert_array_equal(out, expected)
    for quad, planes in zip(out, seen, strict=True):
        image = pdavis_cv.PolarFrame(quad, extinction_ratio=9)
        np.testing.assert_array_equal(planes, (image.s0, image.aop, image.dolp))
    np.testing.assert_array_equal(out, pdavis_cv.demosaic(mosaic, COLOUR, "guided"))


def test_single_bright_pixels_stay_within_what_their_colour_can_be():
    """A tint is at most 3 and at least .02, a polarized part at least .02."""
    rng = np.random.default_rng(6)
    mosaic = np.where(rng.random((40, 44)) < 0.1, 65535, 3).astype(np.float32)
    got = pdavis_cv.demosaic(mosaic, COLOUR, "guided")
    assert np.abs(got).max() < 65535 * 3 / 0.02**2
    tints, parts = np.empty((3, 20, 22), np.float32), np.empty((3, 8, 10, 11), "f4")
    _kernels.colour_ratios(mosaic, scratch_rows(55, 44), tints, parts)
    assert tints.min() == pytest.approx(0.02)
    assert 2.9 < tints.max() <= 3 * (1 + 1e-6)


def test_kernels_refuse_arrays_that_do_not_fit():
    f = partial(np.zeros, dtype=np.float32)
    places, cell = np.arange(4), np.zeros((4, 4), np.uint8)
    mosaic, tints, parts = f((8, 8)), f((3, 4, 4)), f((3, 8, 2, 2))
    for match, wrong in (
            ("sides >= 4", lambda: _kernels.colour_bilinears(
                mosaic[:3], cell, f(9999), f((3, 3, 8)))),
            ("sides >= 4, cell", lambda: _kernels.colour_bilinears(
                mosaic, cell[:3], f(9999), f((3, 8, 8)))),
            ("images must be", lambda: _kernels.colour_ratios(
                mosaic, f(9999), tints[:2], parts)),
            ("images must be", lambda: _kernels.colour_ratios(
                mosaic, f(99), tints, parts)),
            ("images must be", lambda: _kernels.grey_mosaic(
                tints, parts[:, :, :1].copy(), f(9999), mosaic)),
            ("images must be", lambda: _kernels.grey_mosaic(
                tints, parts, f(9999), mosaic[:4])),
            (r"out \(3, 4", lambda: _kernels.colour_planes(
                f((4, 8, 8)), places, tints, parts, 1, f(9999), f((3, 2, 8, 8)))),
            (r"out \(3, 4", lambda: _kernels.colour_planes(
                f((4, 8, 8)), places, tints, parts, 1, f(9999), f((3, 3, 4, 8)))),
            (r"quad must be \(4", lambda: _kernels.colour_planes(
                f((3, 8, 8)), places, tints, parts, 1, f(9999), f((3, 4, 8, 8)))),
            ("permutation", lambda: _kernels.colour_planes(
                f((4, 8, 8)), 2 * places, tints, parts, 1, f(9999), f((3, 4, 8, 8))))):
        with pytest.raises(ValueError, match=match):
            wrong()


# ---- layouts ---------------------------------------------------------------------


def test_a_layout_of_colours_by_name():
    assert COLOUR.colours == "RRGGRRGGGGBBGGBB"
    assert COLOUR == Layout((90, 45), (135, 0), colours="rggb") != Layout.SONY
    assert COLOUR.sensor is Layout.SONY.sensor
    assert str(COLOUR) == "((90, 45), (135, 0)) rggb"
    for layout in (COLOUR, COLOUR.crop(1, 3), Layout.SONY):
        assert Layout.stored(layout.stored_angles, "sony") == layout
        assert pickle.loads(pickle.dumps(layout)) == layout
    with pytest.raises(LayoutError, match="one of rggb, grbg, gbrg, bggr"):
        Layout.of("sony-rgbg")
    with pytest.raises(LayoutError, match="16 of a 4x4 cell"):
        Layout.of("sony-rggbrggbrggbrggb")


@pytest.mark.parametrize("size", [(8, 12), (9, 10), (10, 11), (11, 9)])
def test_moves_of_an_image_move_its_colours(size):
    def moved(layout, image):
        np.testing.assert_array_equal(filters(layout, image.shape)[0], image)

    height, width = size
    for order in ORDERS:
        layout = Layout.of(f"sony-{order}").crop(1, 2)
        image = filters(layout, size)[0]
        moved(layout.flip_x(width), np.fliplr(image))
        moved(layout.flip_y(height), np.flipud(image))
        moved(layout.crop(3, 1), image[1:, 3:])
        for k in range(4):
            moved(layout.rot90(k, size), np.rot90(image, k))


# ---- demosaicing -----------------------------------------------------------------


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("dtype", DTYPES)
def test_even_light_is_returned_whatever_the_crop(method, dtype):
    for x in range(4):
        for y in range(4):
            layout = COLOUR.crop(x, y)
            truth = np.rint(scene((10, 13)) / 5)
            mosaic = seen(truth, layout).astype(dtype)
            mosaic.flags.writeable = False
            got = pdavis_cv.demosaic(mosaic, layout, method)
            np.testing.assert_allclose(got, truth, rtol=1e-4)


@pytest.mark.parametrize("method", METHODS)
def test_every_colour_has_its_own_polarization(method):
    shape, aops = (24, 32), np.array([20, 80, 140])
    mosaic = seen(scene(shape, aop_deg=aops, dolp=np.array([.3, .6, .1])), COLOUR)
    image = pdavis_cv.polarization(mosaic, "sony-rggb", method)
    for name, aop, dolp in zip(COLOURS, aops, (.3, .6, .1), strict=True):
        one = image.colours[name]
        np.testing.assert_allclose(np.rad2deg(one.aop), aop, atol=0.01)
        np.testing.assert_allclose(one.dolp, dolp, atol=1e-3)
    assert image.shape == image.colours["red"].shape == shape
    quads = [image.colours[name].quad for name in COLOURS]
    np.testing.assert_allclose(
        image.quad, (quads[0] + 2 * quads[1] + quads[2]) / 4, rtol=1e-6)
    again = pickle.loads(pickle.dumps(image))
    np.testing.assert_array_equal(again.colours["red"].aop, image.colours["red"].aop)
    assert not image.colours["red"].colours


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("first", ["quad", "s0", "aop", "s1"])
def test_images_are_the_same_whatever_is_asked_for_first(method, first):
    mosaic, layout = noise((13, 18)), COLOUR.crop(1, 2)
    image = pdavis_cv.polarization(mosaic, layout, method, extinction_ratio=50)
    before = mosaic.copy()
    mosaic[:] = 0       # the caller's again
    quads = pdavis_cv.demosaic(before, layout, method)
    for name, quad in zip(COLOURS, quads, strict=True):
        one = image.colours[name]
        assert getattr(one, first).shape[-2:] == one.shape == mosaic.shape
        known = pdavis_cv.PolarFrame(quad, extinction_ratio=50)
        again = pickle.loads(pickle.dumps(one))
        for plane in ("s0", "s1", "s2", "aop", "dolp", "quad", "valid"):
            got = getattr(one, plane)
            np.testing.assert_array_equal(got, getattr(known, plane))
            np.testing.assert_array_equal(got, getattr(again, plane))
            assert not got.flags.writeable
    np.testing.assert_array_equal(image.quad, joint(quads))


@pytest.mark.parametrize("method", METHODS)
def test_mirrors_and_turns_of_the_mosaic_turn_the_result(method):
    """Up to what is made of cells, which begin and end elsewhere."""
    reach = COLOUR_REACH[method] + REACH[method]
    y, x = np.mgrid[:2 * reach + 12, :2 * reach + 16]
    light = (1 + 0.3 * np.sin(x / 3 + y / 5)) * (1 + 0.2 * np.cos(y / 4))
    mosaic = seen(scene(light.shape) * light, COLOUR)
    inside = np.s_[:] if method == "bilinear" else np.s_[reach:-reach, reach:-reach]
    whole = pdavis_cv.polarization(mosaic, COLOUR, method)
    for move, layout, turn in (
            (np.fliplr, COLOUR.flip_x(light.shape[1]), -1),
            (np.flipud, COLOUR.flip_y(light.shape[0]), -1),
            (partial(np.rot90, k=2), COLOUR.rot90(2, light.shape), 1)):
        image = pdavis_cv.polarization(
            np.ascontiguousarray(move(mosaic)), layout, method)
        for name in COLOURS:
            one, other = image.colours[name], whole.colours[name]
            np.testing.assert_allclose(
                one.s0[inside], move(other.s0)[inside], rtol=1e-3)
            np.testing.assert_allclose(
                np.exp(2j * one.aop)[inside],
                np.exp(2j * turn * move(other.aop))[inside], atol=1e-3)


@pytest.mark.parametrize("dolp", [0.1, 0.9])
def test_even_light_has_no_more_noise_of_s0_than_with_bilinear(dolp):
    truth = scene((96, 128), gains=np.array([1, 2, 0.8]), dolp=dolp)
    mosaic = np.random.default_rng(1).poisson(seen(truth, COLOUR)).astype(np.float32)
    noise = {method: np.std(pdavis_cv.demosaic(mosaic, COLOUR, method).sum(1)
                            [:, 16:-16, 16:-16], axis=(1, 2)) for method in METHODS}
    assert (noise["guided"] < 1.03 * noise["bilinear"]).all(), noise


def test_bilinear_keeps_own_samples_of_colour_and_polarizer():
    mosaic = np.random.default_rng(3).uniform(50, 60, (12, 16)).astype(np.float32)
    y, x = np.indices(mosaic.shape)
    got = pdavis_cv.demosaic(mosaic, COLOUR)[(*filters(COLOUR, mosaic.shape), y, x)]
    np.testing.assert_array_equal(got, mosaic)


@pytest.mark.parametrize("method", METHODS)
def test_nothing_beyond_the_reach_matters(method):
    reach = COLOUR_REACH[method] + REACH[method]
    mosaic = noise((8, 4 * reach)) + 20
    for column in range(2 * reach, 2 * reach + 4):
        changed = mosaic.copy()
        changed[:, column] *= 3
        differs = (pdavis_cv.demosaic(mosaic, COLOUR, method)
                   != pdavis_cv.demosaic(changed, COLOUR, method)).any((0, 1, 2))
        affected = np.nonzero(differs)[0]
        assert column - reach <= affected[0] < affected[-1] <= column + reach


@pytest.mark.parametrize("method", METHODS)
def test_unusable_samples_affect_no_valid_pixel(method):
    mosaic = seen(scene((20, 24)), COLOUR)
    valid = np.random.default_rng(4).random(mosaic.shape) > 0.04
    values = [np.where(valid, mosaic, bad).astype(np.float32) for bad in (0, 1e6)]
    quads = [pdavis_cv.demosaic(one, COLOUR, method, valid=valid) for one in values]
    usable = pdavis_cv.mosaic.demosaic_valid(valid, COLOUR, method)
    assert 0.2 < usable.mean() < 1
    np.testing.assert_array_equal(quads[0][..., usable], quads[1][..., usable])


def test_mistakes_are_one_clear_line():
    mosaic = np.ones((8, 8), np.uint16)
    with pytest.raises(ValueError, match="must be one of bilinear, guided, got 'bin"):
        pdavis_cv.demosaic(mosaic, COLOUR, "binned")
    with pytest.raises(ValueError, match=r"at least 4, got .* = \(3, 8\)"):
        pdavis_cv.demosaic(mosaic[:3], COLOUR, "guided")
    with pytest.raises(ValueError, match=r"shape \(3, 4, 8, 8\)"):
        pdavis_cv.demosaic(mosaic, COLOUR, out=np.empty((4, 8, 8), np.float32))
    assert pdavis_cv.demosaic(mosaic[:0], COLOUR).shape == (3, 4, 0, 8)


# ---- files and pictures ----------------------------------------------------------


@pytest.fixture
def shot(tmp_path):
    """Return a file of a neutral scene behind a colour sensor, and its truth."""
    y, x = np.mgrid[:64, :80]
    light = 1 + 0.5 * np.sin(x / 9) * np.cos(y / 7)
    channels = scene(light.shape, dolp=0.4) * light
    path = tmp_path / "shot.png"
    cv2.imwrite(str(path), np.rint(seen(channels, COLOUR)).astype(np.uint16))
    return path


@pytest.mark.parametrize("gains", [(0.6, 1, 0.35), (0.5, 0.8, 1), (0.8, 1, 0.8)])
@pytest.mark.parametrize("order", ORDERS)
def test_colours_are_found_up_to_red_and_blue(gains, order):
    y, x = np.mgrid[:64, :80]
    light = scene(x.shape, np.array(gains)) * (1 + 0.5 * np.sin(x / 9 + y / 7))
    for column in (0, 1):
        layout = Layout.of(f"sony-{order}").crop(column, 1 - column)
        found = found_colours(np.rint(seen(light, layout)).astype(np.uint16))
        assert found in (layout.colours, layout.colours.translate(
            str.maketrans("RB", "BR")))


def test_a_file_is_read_with_its_colours_stated_or_found(shot):
    with pytest.warns(LayoutWarning, match="state layout=.90,45,135,0-rggb"):
        recording = pdavis_cv.open_recording(shot, layout="sony")
    with recording, pdavis_cv.open_recording(shot, layout="sony-rggb") as stated:
        assert recording.info.layout == stated.info.layout == COLOUR
        assert recording.info.sensor is stated.info.sensor is Layout.SONY.sensor
        image, = fuse(recording, layout="sony", demosaic="guided")
        part, = fuse(stated, demosaic="guided", roi=(31, 22, 20, 17))
        for name in COLOURS:
            assert np.median(np.abs(image.colours[name].aop - np.deg2rad(30))) < 1e-3
            np.testing.assert_allclose(
                part.colours[name].quad, image.colours[name].quad[:, 22:39, 31:51],
                rtol=1e-5)
        with pytest.raises(ValueError, match="one of bilinear, guided"):
            fuse(stated, demosaic="superpixel")
    with pytest.raises(LayoutError, match="one of them is wrong"):
        fuse(stated, layout="sony-bggr")


@pytest.mark.parametrize("order", ORDERS)
def test_an_order_in_which_green_is_elsewhere_is_doubted(shot, order):
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        pdavis_cv.open_recording(shot, layout=f"sony-{order}").close()
    doubted = [str(one.message) for one in said]
    assert len(doubted) == (order in ("grbg", "gbrg")), doubted
    assert all("other pixels are green" in one for one in doubted)


@pytest.mark.parametrize("name", ["a.aedat4", "a.h5", "a.mcap"])
def test_copies_keep_the_colours(shot, tmp_path, name):
    copy = str(tmp_path / name)
    assert main(["convert", str(shot), copy, "--layout", "sony-bggr"]) == 0
    with pdavis_cv.open_recording(copy) as recording:
        assert recording.info.layout == Layout.of("sony-bggr")


def test_a_calibration_keeps_the_colours(tmp_path):
    pdavis_cv.Calibration(sensor_size=(8, 8), layout=COLOUR).save(tmp_path / "c.npz")
    assert pdavis_cv.Calibration.load(tmp_path / "c.npz").layout == COLOUR


def test_a_calibrated_analyser_is_for_monochrome_mosaics(shot):
    known = pdavis_cv.Calibration(
        sensor_size=(64, 80), layout=Layout.SONY,
        analyser=np.full((64, 80, 3), 0.5, np.float32))
    with pdavis_cv.open_recording(shot, layout="sony-rggb") as recording, pytest.raises(
            pdavis_cv.CalibrationError, match="is for monochrome mosaics"):
        fuse(recording, calibration=known)


def test_info_tells_the_colours_to_programs(shot, capsys):
    assert main(["info", str(shot), "--layout", "sony-rggb", "--json"]) == 0
    assert "90,45,135,0-rggb" in capsys.readouterr().out


def test_export_draws_s0_in_colour_and_says_the_white_balance(shot, tmp_path, capsys):
    def exported(*flags):
        out = tmp_path / "out.png"
        assert main(["export", str(shot), "--layout", "sony-rggb", "--bare", "--scale",
                     "1", "--quantities", "s0", "-o", str(out), *flags]) == 0
        return cv2.imread(str(out)).astype(int), capsys.readouterr().out

    picture, said = exported()
    assert "white balance 1.083, 0.65, 1.858" in said
    grey = np.ptp(picture[8:-8, 8:-8], axis=2)
    assert grey.max() < 8, "a neutral scene is grey"
    picture, said = exported("--white-balance", "1,1,1")
    assert "white balance 1, 1, 1" in said
    inside = picture[10:-10, 10:-10]
    np.testing.assert_allclose((inside[..., 0] / inside[..., 1]).mean(), 0.35, atol=.01)
    red, _ = exported("--colour", "red")
    assert np.ptp(red, axis=2).max() == 0


@pytest.mark.parametrize(("flags", "said"), [
    (["--layout", "sony-rgbg"], "one of rggb, grbg, gbrg, bggr"),
    (["--layout", "sony-rggb", "--white-balance", "1,0,1"], "must be positive"),
    (["--layout", "sony-rggb", "--quantities", "aop", "--white-balance", "1,1,1"],
     "needs s0"),
    (["--layout", "sony-rggb", "--demosaic", "binned"], "bilinear, guided"),
    (["--layout", "sony-rggb", "--colour", "infrared"], "invalid choice")])
def test_mistakes_of_the_command_line_are_one_line(shot, tmp_path, capsys, flags, said):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("sys.exit", lambda code: None)
        try:
            code = main(["export", str(shot), *flags, "-o", str(tmp_path / "x.png")])
        except SystemExit as stop:
            code = stop.code
    assert code == 2
    error = capsys.readouterr().err
    assert said in error
    assert error.count("\n") == 1


def test_colour_needs_a_sensor_of_colours(tmp_path, capsys):
    path = tmp_path / "grey.png"
    cv2.imwrite(str(path), np.full((8, 8), 90, np.uint8))
    assert main(["export", str(path), "--layout", "sony", "--colour", "red", "-o",
                 str(tmp_path / "x.png")]) == 2
    assert "--colour needs a sensor of colours" in capsys.readouterr().err


# ---- truth -----------------------------------------------------------------------


def blob(at_x, at_y, level, dolp, aop_deg):
    """A scene of smooth blobs, of which one colour sees its own level and angle."""
    def light(t_us, x, y):
        s0 = level * (1.2 + np.sin(x / 11 + at_x) * np.cos(y / 9 + at_y)
                      + 0.2 * np.sin(x / 3.1 + y / 3.7))
        aop = np.deg2rad(aop_deg + 20 * np.sin(x / 23) + 15 * np.cos(y / 19))
        return s0, s0 * dolp * np.cos(2 * aop), s0 * dolp * np.sin(2 * aop)

    return FunctionScene(light, sampling_us=1e5)


@pytest.mark.parametrize(("preset", "level"), [("ideal", 1), ("sony", 1), ("sony", 6)])
def test_a_simulated_colour_camera_measures_each_colour(preset, level):
    """Without noise AoP .3 degrees, DoLP .01; with it S0 as a monochrome camera's."""
    parts = [blob(0.0, 0.3, 10 * level, 0.35, 30), blob(0.4, 0, 18 * level, 0.3, 34),
             blob(0.2, 0.2, 8 * level, 0.25, 26)]

    def image_of(scene, layout):
        camera = Camera.preset(
            preset, size=(96, 128), origin=(0, 0), dvs=None,
            aps={"fps": 50.0, "exposure_us": 20_000, "readout_us": 0},
            optics={"layout": layout, "extinction_ratio": 350.0})
        recording, truth = camera.record(scene, 0.05)
        return list(fuse(recording, layout=layout, demosaic="guided",
                         extinction_ratio=350))[1], truth

    def psnr(s0, true):
        s0, true = s0[8:-8, 8:-8], true[8:-8, 8:-8]
        return 10 * np.log10(true.max()**2 / np.mean((s0 - true)**2))

    image, _ = image_of(Coloured(*parts, layout=COLOUR), COLOUR)
    for name, part in zip(COLOURS, parts, strict=True):
        mono, truth = image_of(part, Layout.SONY)
        one, (s0, s1, s2) = image.colours[name], truth.image(image.t_us)
        off = np.angle(np.exp(2j * one.aop) * (s1 - 1j * s2)) / 2
        if preset == "ideal":
            assert np.median(np.abs(np.rad2deg(off))) < 0.3
            assert np.median(np.abs(one.dolp - np.hypot(s1, s2) / s0)) < 0.01
        else:
            assert psnr(one.s0, s0) > psnr(mono.s0, s0) - 2


def test_a_coloured_scene_needs_scenes_and_a_layout_with_colours():
    with pytest.raises(ValueError, match="red must be"):
        Coloured(1, 2, 3, layout=COLOUR)
    part = blob(0, 0, 1, 0.1, 0)
    with pytest.raises(ValueError, match="layout must have colours"):
        Coloured(part, part, part, layout=Layout.SONY)


def test_pictures_in_colour_hatch_what_is_not_valid():
    quads = np.ones((3, 4, 2, 2), np.float32)
    valid = np.array([[True, False], [True, True]])
    image = adopted_colours(quads, valid=valid)
    picture = render.colour_bgr(image, 4.0, (0.5, 1.0, 2.0))
    assert picture[0, 0].tolist() == [255, 128, 64]
    assert picture[0, 1].tolist() == list(render.INVALID[0]) or (
        picture[0, 1].tolist() == list(render.INVALID[1]))
