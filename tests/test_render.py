import builtins
import colorsys
import sys
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import reference
from hypothesis import given, strategies as st

from pdavis_cv import _kernels, render
from pdavis_cv._opencv import opencv


@given(st.floats(0, np.pi, exclude_max=True))
def test_hue_of_hsv_is_aop_over_180_degrees(aop):
    blue, green, red = render.aop_bgr(
        np.array([[aop]]), colours="hsv")[0, 0] / 255.0
    hue, saturation, value = colorsys.rgb_to_hsv(red, green, blue)
    assert (saturation, value) == (1, 1)
    turn = (hue - aop / np.pi + 0.5) % 1 - 0.5
    assert abs(turn) <= 0.5001 / (6 * 255)


def test_aop_colour_is_axial():
    aop = np.linspace(0, np.pi, 50).reshape(5, 10)
    np.testing.assert_array_equal(render.aop_bgr(aop), render.aop_bgr(aop + np.pi))
    np.testing.assert_array_equal(render.aop_bgr(aop), render.aop_bgr(aop - np.pi))


def test_the_hue_table_holds_every_saturated_colour_once():
    colours = np.unique(
        render.aop_bgr(np.arange(1530) * np.pi / 1530, colours="hsv"), axis=0)
    assert len(colours) == 1530
    assert np.all(colours.max(axis=1) == 255)
    assert np.all(colours.min(axis=1) == 0)


@pytest.mark.parametrize("radius", [16, 30, 61])
def test_the_wheel_shows_in_each_direction_the_colour_of_that_angle(radius):
    wheel = render.aop_legend(radius)
    assert wheel.shape == (radius, 2 * radius, 3)
    for degrees in range(3, 178, 5):
        a = np.deg2rad(degrees)
        column = int(np.floor(radius + 0.75 * radius * np.cos(a)))
        row = int(np.floor(radius - 0.75 * radius * np.sin(a)))
        centre = np.arctan2(radius - 0.5 - row, column + 0.5 - radius)
        np.testing.assert_array_equal(wheel[row, column], render.aop_bgr(centre))
        assert abs(np.rad2deg(centre) - degrees) < 60 / radius


def test_dolp_colours_rise_in_brightness_and_stop_at_the_ends():
    colours = render.dolp_bgr(np.linspace(0, 1, 256)).astype(float)
    brightness = colours @ [0.114, 0.587, 0.299]
    assert np.all(np.diff(brightness) > -0.6)
    np.testing.assert_array_equal(
        render.dolp_bgr([[-1, 0, 1, 7]])[0, [0, 2]],
        render.dolp_bgr([[0, 1]])[0])
    np.testing.assert_array_equal(render.dolp_bgr([[0.2]], top=0.2),
                                  render.dolp_bgr([[1.0]]))


def test_grey_does_not_depend_on_the_rest_of_the_image():
    small = render.grey_bgr([[1.0]], 4.0)
    large = render.grey_bgr([[1.0, 400.0]], 4.0)
    assert small[0, 0].tolist() == large[0, 0].tolist() == [64, 64, 64]
    assert large[0, 1].tolist() == [255, 255, 255]


def test_an_unknown_map_is_named():
    with pytest.raises(ValueError, match="colours must be one of even, hsv, got 'jet'"):
        render.aop_bgr([[1.0]], colours="jet")


def test_grey_refuses_a_scale_without_extent():
    with pytest.raises(ValueError, match="white must be positive, got 0"):
        render.grey_bgr([[1.0]], 0)


@pytest.mark.parametrize("colour", [
    render.aop_bgr, render.dolp_bgr, lambda a, v=None: render.grey_bgr(a, 1.0, v)])
def test_unusable_pixels_have_their_own_colour(colour):
    image = np.array([[0.5, np.nan, 0.5, 0.5]])
    valid = np.array([[True, True, True, False]])
    before = image.copy()
    picture = colour(image, valid)
    assert picture.dtype == np.uint8
    assert reference.hatched(picture).tolist() == [
        [False, True, False, True]]
    np.testing.assert_array_equal(image, before)
    assert colour(image)[0, 0].tolist() == picture[0, 0].tolist()
    with pytest.raises(ValueError, match=r"valid must have shape \(1, 4\)"):
        colour(image, valid[:, :2])


def test_an_infinite_angle_is_none_and_an_infinite_intensity_is_white():
    infinite = np.array([[np.inf, -np.inf]])
    assert reference.hatched(render.aop_bgr(infinite)).all()
    assert render.grey_bgr(infinite, 1.0)[0, :, 0].tolist() == [255, 0]
    assert render.ToneCurve(1.0).bgr(infinite)[0, :, 0].tolist() == [255, 0]


@pytest.mark.parametrize("name", ["hue_bgr", "ramp_bgr", "tone_bgr"])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_colour_kernels_match_reference(name, dtype):
    rng = np.random.default_rng(0)
    table = rng.integers(0, 256, (1532, 4), np.uint8)
    kernel, twin = getattr(_kernels, name), getattr(reference, name)
    # beyond 256 pixels a row goes by blocks
    for shape in ((0, 0), (0, 3), (3, 0), (1, 1), (1, 7), (3, 256), (2, 257), (5, 700),
                  (40, 514)):
        plane = rng.normal(20, 30, shape).astype(dtype)
        odd = np.array([np.nan, np.inf, -np.inf, -0.0, 1e30], dtype)
        plane.reshape(-1)[:5] = odd[:plane.size]
        valid = rng.random(shape) < 0.9
        valid.reshape(-1)[:2] = False
        plane.flags.writeable = valid.flags.writeable = table.flags.writeable = False
        for mask in (valid, np.ones(shape, bool)):
            given = mask.view(np.uint8) if mask is valid else np.empty((0, 0), np.uint8)
            for least in (-np.inf, 12.5, np.inf):
                sheet = np.full((shape[0] + 2, shape[1] + 2, 3), 77, np.uint8)
                out = sheet[1:-1, 1:-1]
                kernel(plane, given, 37.5, least, table, out)
                want = twin(plane, mask, 37.5, least, table)
                if name == "hue_bgr":   # 1e30: some colour, and no crash
                    far = plane == dtype(1e30)
                    out[far] = want[far]
                np.testing.assert_array_equal(out, want)
                out[:] = 77
                assert (sheet == 77).all()  # nothing around it was written


@pytest.mark.parametrize("name", ["hue_bgr", "ramp_bgr", "tone_bgr"])
@pytest.mark.parametrize(("change", "message"), [
    ({1: np.zeros((2, 5), np.uint8)}, "valid must be empty or have the size"),
    ({1: np.zeros((3, 3), np.uint8)}, "valid must be empty or have the size"),
    ({4: np.zeros((4, 4), np.uint8)}, r"table must be \(n \+ 4, 4\)"),
    ({4: np.zeros((9, 3), np.uint8)}, r"table must be \(n \+ 4, 4\)"),
    ({5: np.zeros((2, 2, 3), np.uint8)}, "out must be"),
    ({5: np.zeros((1, 3, 3), np.uint8)}, "out must be"),
    ({5: np.zeros((2, 3, 4), np.uint8)}, "out must be"),
    ({5: np.zeros((2, 3, 4), np.uint8)[..., :3]}, "out must be"),
    ({5: np.zeros((2, 3, 3), np.uint8)[..., ::-1]}, "out must be"),
])
def test_colour_kernels_check_sizes_themselves(name, change, message):
    arguments = [np.zeros((2, 3), np.float32), np.empty((0, 0), np.uint8), 1.0, 0.0,
                 np.zeros((9, 4), np.uint8), np.empty((2, 3, 3), np.uint8)]
    getattr(_kernels, name)(*arguments)
    for place, other in change.items():
        arguments[place] = other
    with pytest.raises(ValueError, match=message):
        getattr(_kernels, name)(*arguments)


@pytest.mark.parametrize("ground", [0, 255, 40])
@pytest.mark.parametrize("shape", [(0, 3), (1, 1), (3, 256), (2, 257), (5, 700)])
def test_fading_matches_reference(shape, ground):
    rng = np.random.default_rng(0)
    weight = rng.normal(0.3, 0.4, shape).astype(np.float32)
    weight.reshape(-1)[:4] = np.array([np.nan, np.inf, -np.inf, -0.0])[:weight.size]
    valid = rng.random(shape) < 0.8
    weight.flags.writeable = valid.flags.writeable = False
    for mask in (valid, None):
        sheet = rng.integers(0, 256, (shape[0] + 2, shape[1] + 2, 3), np.uint8)
        before, out = sheet.copy(), sheet[1:-1, 1:-1]
        _kernels.fade_bgr(
            weight, np.empty((0, 0), np.uint8) if mask is None else mask.view(np.uint8),
            2.5, ground, out)
        before[1:-1, 1:-1] = reference.fade_bgr(
            weight, np.ones(shape, bool) if mask is None else mask, 2.5, ground,
            before[1:-1, 1:-1])
        np.testing.assert_array_equal(sheet, before)    # nothing around it either


@pytest.mark.parametrize(("change", "message"), [
    ({1: np.zeros((2, 5), np.uint8)}, "valid must be empty or have the size"),
    ({4: np.zeros((2, 2, 3), np.uint8)}, "out must be"),
    ({4: np.zeros((2, 3, 4), np.uint8)[..., :3]}, "out must be")])
def test_fading_checks_sizes_itself(change, message):
    arguments = [np.zeros((2, 3), np.float32), np.empty((0, 0), np.uint8), 1.0, 0,
                 np.empty((2, 3, 3), np.uint8)]
    for place, other in change.items():
        arguments[place] = other
    with pytest.raises(ValueError, match=message):
        _kernels.fade_bgr(*arguments)


def test_eight_threads_colour_at_once():
    value = np.random.default_rng(2).random((260, 346)) * np.pi
    want = render.aop_bgr(value)
    with ThreadPoolExecutor(8) as pool:
        for got in pool.map(lambda _: render.aop_bgr(value), range(8)):
            np.testing.assert_array_equal(got, want)


def test_what_saturates_is_white_and_what_is_too_dark_is_no_data():
    value = np.array([[1.0, 30.0, 30.0, np.nan]], np.float32)
    valid = np.array([[False, False, True, False]])
    seen = render.grey_bgr(value, 60.0, valid, saturated=18.0)[0]
    assert seen[1:3, 0].tolist() == [255, 128]
    assert reference.hatched(seen[None])[0].tolist() == [True, False, False, True]


@pytest.mark.parametrize("shape", [(2, 4), (3, 4, 3), (1, 1), (173, 131, 3)])
def test_even_pads_and_keeps_what_was_there(shape):
    picture = np.random.default_rng(0).integers(0, 255, shape).astype(np.uint8)
    padded = render.even(picture)
    assert padded.shape[0] % 2 == padded.shape[1] % 2 == 0
    np.testing.assert_array_equal(padded[:shape[0], :shape[1]], picture)


def test_a_sheet_of_panels_holds_the_pictures_and_has_even_sides():
    picture = render.aop_bgr(np.linspace(0, 3, 35).reshape(7, 5))
    one = render.panel(picture, "AoP", legend="aop", scale=3)
    big = picture.repeat(3, axis=0).repeat(3, axis=1)
    np.testing.assert_array_equal(one[20:41, :15], big)
    sheet = render.tile([one, one, one], columns=2, title="three")
    assert sheet.shape[0] % 2 == sheet.shape[1] % 2 == 0
    assert sheet.shape[0] > 2 * one.shape[0]
    found = [np.array_equal(sheet[y:y + 21, x:x + 15], big)
             for y in range(sheet.shape[0] - 21) for x in range(sheet.shape[1] - 15)]
    assert sum(found) == 3


@pytest.mark.parametrize("zoom", [1, 2, 3])
def test_no_text_of_a_wheel_is_cut_or_covers_it(zoom):
    """OpenCV 4 writes wider than OpenCV 5."""
    style = render.DARK._replace(zoom=zoom)
    sheet = render.panel(np.zeros((2, 2, 3), np.uint8), "", legend="aop", style=style)
    assert not sheet[:, -2:].any()
    wheel = render.aop_legend(30 * zoom)
    height, width = wheel.shape[:2]
    top = 20 * zoom + 2 + 16 * zoom
    assert any(
        np.array_equal(sheet[top:top + height, x:x + width][wheel.any(2)],
                       wheel[wheel.any(2)]) for x in range(sheet.shape[1] - width))


def test_without_opencv_the_error_says_how_to_get_it(monkeypatch):
    real = builtins.__import__

    def without_cv2(name, *rest, **more):
        if name == "cv2":
            raise ModuleNotFoundError("No module named 'cv2'")
        return real(name, *rest, **more)

    monkeypatch.setitem(sys.modules, "cv2", None)
    monkeypatch.setattr(builtins, "__import__", without_cv2)
    assert render.aop_bgr(np.zeros((2, 2))).shape == (2, 2, 3)
    with pytest.raises(ImportError, match="pip install opencv"):
        opencv()


def test_pixels_without_an_angle_are_drawn_at_once():
    """np.take's wrap mode counts its way down from the index of a NaN: never ends."""
    aop = np.full((260, 346), np.nan)
    aop[0, 0] = np.inf
    assert reference.hatched(render.aop_bgr(aop)).all()
