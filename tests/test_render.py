import builtins
import colorsys
import sys

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pdavis_cv import render


@given(st.floats(0, np.pi, exclude_max=True))
def test_hue_is_aop_over_180_degrees(aop):
    blue, green, red = render.aop_bgr(np.array([[aop]]))[0, 0] / 255.0
    hue, saturation, value = colorsys.rgb_to_hsv(red, green, blue)
    assert (saturation, value) == (1, 1)
    turn = (hue - aop / np.pi + 0.5) % 1 - 0.5
    assert abs(turn) <= 0.5001 / (6 * 255)


def test_aop_colour_is_axial():
    aop = np.linspace(0, np.pi, 50).reshape(5, 10)
    np.testing.assert_array_equal(render.aop_bgr(aop), render.aop_bgr(aop + np.pi))
    np.testing.assert_array_equal(render.aop_bgr(aop), render.aop_bgr(aop - np.pi))


def test_the_hue_table_holds_every_saturated_colour_once():
    colours = np.unique(render.aop_bgr(np.arange(1530) * np.pi / 1530), axis=0)
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


def test_grey_refuses_a_scale_without_extent():
    with pytest.raises(ValueError, match="white must be positive, got 0"):
        render.grey_bgr([[1.0]], 0)


@pytest.mark.parametrize("colour", [
    render.aop_bgr, render.dolp_bgr, lambda a, v=None: render.grey_bgr(a, 1.0, v)])
def test_unusable_pixels_are_grey(colour):
    image = np.array([[0.5, np.nan, np.inf, 0.5]])
    valid = np.array([[True, True, True, False]])
    before = image.copy()
    picture = colour(image, valid)
    assert picture.dtype == np.uint8
    assert (picture == render.INVALID).all(axis=-1).tolist() == [
        [False, True, True, True]]
    np.testing.assert_array_equal(image, before)
    assert colour(image)[0, 0].tolist() == picture[0, 0].tolist()


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


def test_without_opencv_the_error_says_how_to_get_it(monkeypatch):
    real = builtins.__import__

    def without_cv2(name, *rest, **more):
        if name == "cv2":
            raise ModuleNotFoundError("No module named 'cv2'")
        return real(name, *rest, **more)

    monkeypatch.setitem(sys.modules, "cv2", None)
    monkeypatch.setattr(builtins, "__import__", without_cv2)
    assert render.aop_bgr(np.zeros((2, 2))).shape == (2, 2, 3)
    with pytest.raises(ImportError, match=r"pip install 'pdavis-cv\[cv2\]'"):
        render.opencv()


def test_pixels_without_an_angle_are_drawn_at_once():
    """np.take's wrap mode counts its way down from the index of a NaN: never ends."""
    aop = np.full((260, 346), np.nan)
    aop[0, 0] = np.inf
    assert (render.aop_bgr(aop) == render.INVALID).all()
