"""Figures for print: their size, their pictures and their text."""
import base64
import re
import zlib
from xml.etree import ElementTree

import cv2
import numpy as np
import pytest

from pdavis_cv import export, render
from pdavis_cv._text import shown

pytest.importorskip("matplotlib")

POINTS = 72 / 25.4
SVG = "{http://www.w3.org/2000/svg}"
PICTURES = [np.random.default_rng(i).integers(0, 256, (30, 40, 3), np.uint8)
            for i in range(3)]
PANELS = [render.Panel("intensity S0", "grey", "0", "36 DN/ms"),
          render.Panel("angle of polarization", "faded", end="0.25"),
          render.Panel("degree of linear polarization", "dolp")]


def write(path, *, title="still.png   frames", **more):
    export.write_figure(path, PICTURES, PANELS, width_mm=85, columns=3, title=title,
                        facts={"method": "frames"}, **more)


def test_a_pdf_is_as_wide_as_asked_and_holds_pictures_and_text(tmp_path):
    write(tmp_path / "a.pdf")
    data = (tmp_path / "a.pdf").read_bytes()
    assert data.startswith(b"%PDF")
    box = [float(x) for x in re.search(rb"/MediaBox \[([^]]*)\]", data)[1].split()]
    assert box[2] == pytest.approx(85 * POINTS, abs=0.01)
    sizes = re.findall(rb"/Width (\d+)", data), re.findall(rb"/Height (\d+)", data)
    assert (sizes[0].count(b"40"), sizes[1].count(b"30")) == (3, 3)
    page = b"".join(zlib.decompress(stream) for stream in re.findall(
        rb"stream\n(\x78.*?)endstream", data, re.S)[:1])
    assert page.count(b" Tf") >= 10
    assert b'"method": "frames"' in data


@pytest.mark.parametrize("name", ["\x1b]0;x\x07", "\u202eabc", "<!-- &", "\x9b1m"])
def test_a_name_with_control_characters_leaves_an_svg_that_can_be_read(tmp_path, name):
    write(tmp_path / "a.svg", title=name)
    text = (tmp_path / "a.svg").read_text("utf-8")
    assert text.replace("\n", "").isprintable()
    words = {"".join(one.itertext()) for one in ElementTree.fromstring(text).iter(
        f"{SVG}text")}
    assert any(word.strip() == shown(name) for word in words)


def test_an_svg_holds_its_pictures_pixel_by_pixel_and_text_as_text(tmp_path):
    write(tmp_path / "a.svg")
    root = ElementTree.parse(tmp_path / "a.svg").getroot()
    assert float(root.get("width").removesuffix("pt")) == pytest.approx(
        85 * POINTS, abs=0.01)
    words = {"".join(text.itertext()).strip() for text in root.iter(f"{SVG}text")}
    assert words >= {"intensity S0", "angle of polarization", "not valid", "0°", "90°",
                     "degree of linear polarization", "36 DN/ms", "still.png   frames"}
    embedded = [cv2.imdecode(np.frombuffer(base64.b64decode(
        image.get("{http://www.w3.org/1999/xlink}href").split(",")[1]), np.uint8), 1)
        for image in root.iter(f"{SVG}image")]
    for picture in PICTURES:
        assert any(np.array_equal(one, picture) or np.array_equal(one[::-1], picture)
                   for one in embedded)


def test_a_png_has_the_pixels_of_its_millimetres(tmp_path):
    write(tmp_path / "a.png", dpi=254)
    assert cv2.imread(str(tmp_path / "a.png")).shape[1] == 850
    assert export.read_embedded(tmp_path / "a.png") == {"method": "frames"}


@pytest.mark.parametrize(("given", "said"), [
    *(({"width_mm": one}, "width_mm must lie in 21..5000 for 3 columns, got")
      for one in (0, -5, 20.9, 5001, 1e12, np.inf, np.nan)),
    *(({"dpi": one}, "dpi must be positive and finite, got")
      for one in (0, -1, np.nan, np.inf)),
    *(({"dpi": one}, r"dpi must give 1\.\.65535 pixels a side, .* for 85 x")
      for one in (0.1, 1e5, 1e300)),
    *(({"columns": one}, r"columns must be a whole number of 1\.\.65536, got")
      for one in (0, -1, 1.5)),
    ({"pictures": []}, "pictures must be one or more, got none"),
    ({"panels": PANELS[:2]}, "panels must be as many as pictures, 3, got 2"),
    ({"pictures": [np.zeros((3, 4))] * 3}, "picture must be uint8, got float64"),
    ({"pictures": [*PICTURES[:2], PICTURES[2][:9]]}, "pictures must have one shape")])
@pytest.mark.parametrize("suffix", [".png", ".pdf"])
def test_what_gives_no_figure_is_refused(tmp_path, suffix, given, said):
    with pytest.raises((ValueError, TypeError), match=said):
        export.write_figure(tmp_path / f"a{suffix}", **{
            "pictures": PICTURES, "panels": PANELS, "width_mm": 85, "columns": 3,
            **given})
    assert not list(tmp_path.iterdir())


def test_a_figure_of_another_kind_is_refused(tmp_path):
    with pytest.raises(ValueError, match=r"must end in \.pdf, \.svg, \.png, got '\.p'"):
        write(tmp_path / "a.p")
    assert not list(tmp_path.iterdir())
