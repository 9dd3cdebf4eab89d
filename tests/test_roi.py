"""Regions of interest."""
import json

import numpy as np
import pytest
from hypothesis import given, strategies as st

from pdavis_cv.analysis import Roi, parse_roi, read_rois

SENSOR = (260, 346)


def test_a_rectangle_is_the_slice():
    mask = Roi.from_rectangle(10, 20, 32, 16).mask(SENSOR)
    expected = np.zeros(SENSOR, bool)
    expected[20:36, 10:42] = True
    np.testing.assert_array_equal(mask, expected)


def test_a_polygon_over_pixel_corners_is_the_rectangle():
    corners = [(10, 20), (42, 20), (42, 36), (10, 36)]
    for ring in (corners, corners[::-1], corners[2:] + corners[:2]):
        np.testing.assert_array_equal(
            Roi.from_polygon(ring).mask(SENSOR),
            Roi.from_rectangle(10, 20, 32, 16).mask(SENSOR))


def test_a_polygon_of_many_corners_is_that_of_few():
    def along(a, b):
        return np.linspace(a, b, 2_000, endpoint=False)

    few = np.array([(10, 20), (10, 236), (42, 236), (42, 20)])
    ring = np.concatenate([*map(along, few, np.roll(few, -1, axis=0))])
    np.testing.assert_array_equal(
        Roi.from_polygon(ring).mask(SENSOR), Roi.from_polygon(few).mask(SENSOR))


def places(stop):
    return st.integers(0, 100 * stop).map(lambda n: n / 100)


@given(st.lists(st.tuples(places(20), places(12)), min_size=3, max_size=9))
def test_polygons_agree_with_the_winding_of_each_pixel_centre(ring):
    y, x = np.mgrid[:12, :20] + 0.5
    crossings = np.zeros((12, 20), int)
    for (xa, ya), (xb, yb) in zip(ring, ring[1:] + ring[:1], strict=True):
        if ya == yb:
            continue
        spans = (y >= min(ya, yb)) & (y < max(ya, yb))
        crossings += spans & (xa + (y - ya) * (xb - xa) / (yb - ya) <= x)
    expected = crossings % 2 == 1
    if not expected.any():
        with pytest.raises(ValueError, match="must hold a pixel's centre"):
            Roi.from_polygon(ring).mask((12, 20))
        return
    got = Roi.from_polygon(ring).mask((12, 20))
    # An edge through a centre may be rounded to either side.
    assert np.count_nonzero(got != expected) <= 12


def test_a_circle_covers_its_area():
    angle = np.linspace(0, 2 * np.pi, 200, endpoint=False)
    ring = np.stack((100 + 40 * np.cos(angle), 100 + 40 * np.sin(angle)), axis=1)
    assert Roi.from_polygon(ring).mask(SENSOR).sum() == pytest.approx(
        np.pi * 1600, rel=0.01)


def test_a_crop_and_super_pixels_keep_the_place():
    roi = Roi.from_rectangle(12, 22, 30, 16)
    whole = roi.mask(SENSOR)
    np.testing.assert_array_equal(
        roi.mask((100, 120), origin=(10, 20)), whole[20:120, 10:130])
    np.testing.assert_array_equal(roi.mask((130, 173), scale=2), whole[::2, ::2])


@pytest.mark.parametrize(("rectangle", "options", "message"), [
    ((340, 0, 10, 10), {}, r"roi 'a' must lie inside the image \(x 0..346, y 0..260\)"
                           ", got x 340..350"),
    ((0, -1, 4, 4), {}, "must lie inside"),
    ((3, 4, 10, 10), {"scale": 2}, "even x, y, width and height for super-pixel"),
    ((2, 4, 11, 10), {"scale": 2}, "even x, y, width and height for super-pixel"),
])
def test_regions_that_do_not_fit_are_refused(rectangle, options, message):
    shape = (130, 173) if options else SENSOR
    with pytest.raises(ValueError, match=message):
        Roi.from_rectangle(*rectangle, name="a").mask(shape, **options)


def test_empty_regions_are_refused():
    with pytest.raises(ValueError, match="must not be empty, got 0x4"):
        Roi.from_rectangle(3, 4, 0, 4)
    with pytest.raises(ValueError, match="three or more corners"):
        Roi.from_polygon([(0, 0), (1, 1)])
    with pytest.raises(ValueError, match="must hold a pixel's centre"):
        Roi.from_polygon([(3, 3), (3.2, 3), (3.2, 3.2)]).mask(SENSOR)


@pytest.mark.parametrize("text", ["1,2,3", "a=1,2", "1;2;3", "x=1.5,2,3,4",
                                  "inf,0,2,2", "nan,0,2,2", "nothing"])
def test_texts_that_name_no_region_are_refused(text):
    with pytest.raises(ValueError, match=r"^roi must"):
        parse_roi(text)


def test_a_polygon_can_be_named_on_a_command_line():
    [roi] = parse_roi("fibre=10,20;42,20;42,36;10,36")
    assert roi.name == "fibre"
    assert roi.mask(SENSOR).sum() == 32 * 16


def test_regions_of_fiji_are_read(tmp_path):
    roifile = pytest.importorskip("roifile")
    polygon = roifile.ImagejRoi.frompoints(
        [(10, 20), (42, 20), (42, 36), (10, 36)], name="fibre")
    rectangle = roifile.ImagejRoi.frompoints(
        [(5, 6), (25, 6), (25, 16), (5, 16)], name="edge")
    rectangle.roitype = roifile.ROI_TYPE.RECT
    rectangle.right, rectangle.bottom = 25, 16
    roifile.roiwrite(tmp_path / "both.zip", [polygon, rectangle])
    polygon.tofile(tmp_path / "fibre.roi")
    fibre, edge = read_rois(tmp_path / "both.zip")
    assert (fibre.name, edge.name) == ("fibre", "edge")
    assert edge.rectangle == (5, 6, 20, 10)
    np.testing.assert_array_equal(
        fibre.mask(SENSOR), Roi.from_rectangle(10, 20, 32, 16).mask(SENSOR))
    [alone] = parse_roi(str(tmp_path / "fibre.roi"))
    np.testing.assert_array_equal(alone.mask(SENSOR), fibre.mask(SENSOR))


def test_polygons_of_geojson_are_read(tmp_path):
    ring = [[2, 1], [6, 1], [6, 5], [2, 5], [2, 1]]
    hole = [[3, 2], [4, 2], [4, 3], [3, 3], [3, 2]]
    polygon = {"type": "Polygon", "coordinates": [ring, hole]}
    path = tmp_path / "cells.geojson"
    path.write_text(json.dumps({"type": "FeatureCollection", "features": [
        {"type": "Feature", "geometry": polygon, "properties": {"name": "fibre"}},
        {"type": "Feature", "geometry": {
            "type": "MultiPolygon", "coordinates": [[ring]]}}]}))
    first, second = parse_roi(str(path))
    assert (first.name, second.name) == ("fibre", "cells 2")
    want = np.zeros((8, 8), bool)
    want[1:5, 2:6] = True
    np.testing.assert_array_equal(second.mask((8, 8)), want)
    want[2, 3] = False
    np.testing.assert_array_equal(first.mask((8, 8)), want)


@pytest.mark.parametrize("text", [
    "", "[]", "{}", "3", "nul", '{"type": "Point", "coordinates": [1, 2]}',
    '{"type": "Polygon", "coordinates": [[1, 2]]}',
    '{"type": "Polygon", "coordinates": [[["a", 2], [3, 4], [5, 6]]]}',
    '{"type": "LineString", "coordinates": [[1, 2], [3, 4], [5, 6]]}'])
def test_geojson_without_polygons_is_refused_by_name(tmp_path, text):
    (tmp_path / "a.geojson").write_text(text)
    with pytest.raises(ValueError, match=r"a\.geojson: "):
        read_rois(tmp_path / "a.geojson")


def test_lines_and_foreign_files_are_refused_by_name(tmp_path):
    roifile = pytest.importorskip("roifile")
    line = roifile.ImagejRoi.frompoints([(1, 1), (5, 5)], name="cut")
    line.roitype = roifile.ROI_TYPE.LINE
    line.tofile(tmp_path / "cut.roi")
    with pytest.raises(ValueError, match=r"cut.roi: roi 'cut' is a line"):
        read_rois(tmp_path / "cut.roi")
    (tmp_path / "no.roi").write_bytes(b"\x89PNG....")
    with pytest.raises(ValueError, match=r"no.roi: not a Fiji ROI file, first bytes"):
        read_rois(tmp_path / "no.roi")
    (tmp_path / "no.zip").write_bytes(b"PK\x03\x04....")
    with pytest.raises(ValueError, match=r"no.zip: not a Fiji ROI file"):
        read_rois(tmp_path / "no.zip")
