"""What the viewer and its command say: messages, colours, contrast, values."""
import io
import json
import struct
import types

import numpy as np
import pytest

from pdavis_cv import Layout, PolarFrame, demosaic, render
from pdavis_cv.data import example_recording
from pdavis_cv.tools.main import main
from pdavis_cv.viewer import server
from pdavis_cv.viewer.panes import levels_of, palettes, pane, planes
from pdavis_cv.viewer.regions import values
from pdavis_cv.viewer.socket import MOST_REQUEST, received


def test_colours_of_planes_are_those_of_the_pictures():
    quad = np.random.default_rng(3).uniform(1, 100, (4, 20, 30)).astype(np.float32)
    valid = np.random.default_rng(4).random((20, 30)) > 0.1
    image = PolarFrame(
        quad, variance=np.full_like(quad, 30), t_us=7, valid=valid)
    found = planes(["aop", "sigma_aop", "dolp_debiased"], None, image)
    colours = palettes()
    ramp, greys, hues = (np.array(colours["colours"][name], int)
                         for name in ("viridis", "grey", "hue"))
    part = np.minimum(found["dolp"][..., None] / 254 / colours["full_dolp"], 1)
    assert all((found[name][~valid] == 255).all() for name in ("dolp", "aop"))
    assert colours["stripes"] == [[*colour[::-1]] for colour in render.INVALID]
    show = types.SimpleNamespace(white=50.0)
    for drawn, name in ((ramp[found["dolp"]], "dolp"),
                        (ramp[found["dolp_debiased"]], "dolp_debiased"),
                        (greys[found["sigma_aop"]], "sigma_aop"),
                        (hues[found["aop"]] * part, "aop_faded")):
        picture = pane(f"{name}_bgr", show, image)[..., ::-1].astype(int)
        # A part in 255 of a turn of hue is six of its colours.
        assert np.abs(drawn - picture)[valid].max() <= 7, name


def test_levels_are_percentiles_of_known_pixels_or_the_whole_scale():
    quad = np.tile(np.arange(1, 1001, dtype=np.float32).reshape(20, 50) / 2, (4, 1, 1))
    show = types.SimpleNamespace(white=50.0)
    assert levels_of(show, PolarFrame(quad)) == pytest.approx(
        (1 + 999 * 0.005, 1 + 999 * 0.995), rel=1e-4)
    assert levels_of(show, PolarFrame(0 * quad)) == (0, 100)
    low, high = levels_of(show, PolarFrame(0 * quad + 7))
    assert low < high


def test_values_are_those_of_the_mean_stokes_vector():
    quad = np.ones((4, 4, 4), np.float32)
    quad[0], quad[2] = 1.5, 0.5
    variance = np.full_like(quad, 1e-4)
    image = PolarFrame(quad, variance=variance, t_us=7)
    found, one = values(image, [(1, 1, 2, 2), (0, 0, 1, 1)])
    assert found["pixels"] == 4
    assert found["dolp"] == pytest.approx(0.5)
    assert found["aop_deg"] == pytest.approx(0, abs=1e-4)
    # Of one pixel its own sigma, of four that are independent half as much.
    for name, sigma in (("aop_se_deg", np.degrees(image.sigma_aop[1, 1])),
                        ("dolp_se", image.sigma_dolp[1, 1])):
        assert one[name] == pytest.approx(float(sigma), rel=1e-5)
        assert found[name] == pytest.approx(float(sigma) / 2, rel=1e-5)
    # S0 is half the sum of four with a hundredth of 1.5, 1, 0.5 and 1.
    assert one["s0_se"] == pytest.approx(np.sqrt(2.25 + 1 + 0.25 + 1) / 200, rel=1e-5)
    nothing = PolarFrame(quad, valid=np.zeros((4, 4), bool))
    assert values(nothing, [(0, 0, 2, 2)]) == [{"pixels": 0, "t_us": None}]


@pytest.mark.parametrize("method", ["bilinear", "superpixel", "guided", "binned"])
def test_the_error_of_a_region_is_the_scatter_of_its_mean(method):
    """Interpolated pixels are not independent: many are not worth as many samples."""
    random = np.random.default_rng(5)
    size, region, noise = (32, 40), (8, 8, 16, 16), 0.02
    step = 2 if method in ("superpixel", "binned") else 1
    got, expected = [], []
    for _ in range(60):
        mosaic = (100 * (1 + noise * random.standard_normal(size))).astype(np.float32)
        mosaic[0::2, 0::2] *= 0.8      # 135 degrees
        quad = demosaic(mosaic, Layout.PDAVIS, method)
        # A pixel's own variance is its scatter over many such images.
        expected.append(quad)
        got.append(values(_image(quad, None, method), [region])[0])
    variance = np.var(expected, axis=0, ddof=1) / np.square(np.mean(expected, axis=0))
    told = values(_image(np.mean(expected, axis=0), variance, method), [region])[0]
    assert told["pixels"] == 16 * 16 / step**2
    for name, error in (
            ("s0", "s0_se"), ("dolp", "dolp_se"), ("aop_deg", "aop_se_deg")):
        scatter = np.std([one[name] for one in got], ddof=1)
        assert told[error] == pytest.approx(scatter, rel=0.4), name


def _image(quad, variance, method):
    return PolarFrame(
        quad, variance=variance, t_us=7,
        provenance={"demosaic": method, "roi": (0, 0, 40, 32)})


@pytest.mark.parametrize("length", [0, 1, 125, 126, 127, 128, 255, 256, MOST_REQUEST])
def test_a_message_of_any_length_is_received(length):
    head = (bytes((0x80 | length,)) if length < 126
            else struct.pack(">BH", 0xFE, length))
    file = io.BytesIO(b"\x81" + head + bytes(4) + b"x" * length + b"\x81\x81....y")
    assert received(file) == b"x" * length
    assert received(file) == bytes((ord("y") ^ ord("."),))
    with pytest.raises(ValueError, match="at most"):
        received(io.BytesIO(b"\x81\xff" + struct.pack(">Q", MOST_REQUEST + 1)))


def test_the_command_serves_until_it_is_told_to_end(monkeypatch, capsys):
    def interrupted(self):
        raise KeyboardInterrupt

    monkeypatch.setattr(server.Server, "wait", interrupted)
    where = "simulate:polarizer?size=4x4&rpm=600"
    assert main(["view", where, "--layout", "pdavis", "--port", "0", "--no-browser",
                 "--method", "cf"]) == 0
    assert capsys.readouterr().out.startswith("http://127.0.0.1:")
    assert main(["view", where, "--layout", "pdavis", "--port", "0", "--no-browser",
                 "--method", "cf", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["url"].startswith("http://127.0.0.1:")
    assert main(["view", where, "--layout", "pdavis", "--start", "1",
                 "--no-browser"]) == 2
    assert "--start and --stop need a recording" in capsys.readouterr().err
    assert main(["view", str(example_recording()), "--layout", "pdavis", "--record",
                 "x.aedat4", "--no-browser"]) == 2
    assert "--record needs a live source" in capsys.readouterr().err
