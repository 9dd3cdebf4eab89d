import dataclasses
import pickle
import warnings

import numpy as np
import pytest
from images import LAYOUTS

from pdavis_cv import CHANNELS, Layout, LayoutError, LayoutWarning, Sensor
from pdavis_cv.sensor import resolve_layout

SIZES = [(4, 6), (5, 6), (4, 7), (5, 7)]


def angles(layout, shape):
    """The angle in degrees before each pixel."""
    y, x = np.indices(shape) % 2
    return np.array(layout.angles_deg)[y, x]


def test_the_two_named_layouts():
    assert Layout.PDAVIS == Layout((135, 90), (0, 45))
    assert Layout.SONY == Layout((90, 45), (135, 0))
    assert Layout.PDAVIS.flip_x() == Layout.SONY
    assert Layout.PDAVIS.rot90(-1) == Layout.SONY


def test_a_layout_by_its_name_or_angles():
    assert Layout.of("PDAVIS") is Layout.PDAVIS
    assert Layout.of(" sony ") is Layout.SONY
    assert Layout.of("45,0,90,135") == Layout((45, 0), (90, 135))
    assert Layout.of(Layout.SONY) is Layout.SONY
    for text in ("", "pdavis346", "0,45,90", "0,45,90,x", "0,45,90,90"):
        with pytest.raises(LayoutError, match="layout must"):
            Layout.of(text)
    with pytest.raises(TypeError, match="a Layout or its name, got tuple"):
        Layout.of(((135, 90), (0, 45)))


def test_half_a_turn_swaps_places_and_keeps_angles():
    assert Layout.PDAVIS.rot90(2) == Layout((45, 0), (90, 135))


@pytest.mark.parametrize("layout", LAYOUTS, ids=str)
@pytest.mark.parametrize("size", SIZES)
def test_operations_do_to_the_layout_what_they_do_to_the_image(layout, size):
    height, width = size
    pixels = angles(layout, size)
    for got, want in (
            (layout.flip_x(width), -np.fliplr(pixels)),
            (layout.flip_y(height), -np.flipud(pixels)),
            (layout.crop(3, 1), pixels[1:, 3:]),
            (layout.crop(-1, -3), pixels[1:, 1:])):
        np.testing.assert_array_equal(angles(got, want.shape), want % 180)
    for k in range(-3, 5):
        want = (np.rot90(pixels, k) + 90 * k) % 180
        np.testing.assert_array_equal(
            angles(layout.rot90(k, size), want.shape), want)


@pytest.mark.parametrize("layout", LAYOUTS, ids=str)
def test_operations_undo_themselves(layout):
    assert layout.flip_x().flip_x() == layout
    assert layout.flip_y(5).flip_y(5) == layout
    assert layout.rot90().rot90(-1) == layout
    assert layout.crop(1, 1).crop(1, 1) == layout
    assert layout.flip_x().flip_y() == layout.rot90(2)


@pytest.mark.parametrize("layout", LAYOUTS, ids=str)
def test_places_say_where_each_channel_is(layout):
    cell = np.ravel(layout.angles_deg)
    assert tuple(cell[list(layout.places)]) == CHANNELS


def test_layouts_hash_pickle_and_read():
    assert len(set(LAYOUTS)) == 24
    assert pickle.loads(pickle.dumps(Layout.SONY)) == Layout.SONY
    assert str(Layout.PDAVIS) == "((135, 90), (0, 45))"
    assert Layout(np.array([90, 45]), [135.0, 0]) == Layout.SONY
    with pytest.raises(dataclasses.FrozenInstanceError):
        Layout.SONY.row0 = (0, 45)


@pytest.mark.parametrize("rows", [
    ((0, 45), (90, 90)), ((0, 45), (90, 180)), ((0, 45, 90), (135,)),
    ((0, 45), (90, 135.5)), ((0, 45), None), ("ab", "cd"), ((0, 45), ())])
def test_a_layout_must_hold_each_angle_once(rows):
    with pytest.raises(LayoutError, match="each of 0, 45, 90, 135 degrees once"):
        Layout(*rows)


def test_sensors_have_the_published_facts():
    assert Sensor.PDAVIS.size == (260, 346)
    assert Sensor.PDAVIS.layout == Layout.PDAVIS
    assert (Sensor.PDAVIS.extinction_ratio, Sensor.SONY.extinction_ratio) == (40, 350)
    assert Sensor.SONY.layout == Layout.SONY


@pytest.mark.parametrize("place", range(3))
def test_the_one_known_layout_is_taken(place):
    given = [None] * 3
    given[place] = Layout.SONY
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert resolve_layout(*given) == Layout.SONY
        assert resolve_layout(*[Layout.SONY] * 3) == Layout.SONY


@pytest.mark.parametrize(("given", "words"), [
    ((Layout.SONY, Layout.PDAVIS, None), "the layout argument says .* the calibration"),
    ((Layout.SONY, None, Layout.PDAVIS), "the layout argument says .* the recording"),
    ((None, Layout.SONY, Layout.PDAVIS), "the calibration says .* the recording says"),
])
def test_two_layouts_that_disagree_are_an_error(given, words):
    with pytest.raises(LayoutError, match=words):
        resolve_layout(*given)


def test_an_unknown_layout_is_assumed_with_a_warning_at_the_caller():
    def public_function():
        return resolve_layout()

    with pytest.warns(LayoutWarning, match="SONY.*unknown zero") as caught:
        assert public_function() == Layout.PDAVIS
    assert caught[0].filename == __file__
