"""Pictures of `pdavis reproduce`: sizes and letters of print, and what they show."""
import dataclasses

import numpy as np
import pytest

from pdavis_cv.tools import reproduce
from pdavis_cv.tools.reproduce import print_style
from pdavis_cv.tools.reproduce.bound import Bound
from pdavis_cv.tools.reproduce.rotation import SCENES, Comparison, Spectrum, Trace
from pdavis_cv.tools.reproduce.run import SHOWN, Row

pytest.importorskip("matplotlib")

from pdavis_cv.tools.reproduce import plots

RPMS = (30.0, 1000.0)


def a_row(method, rpm, seed, error):
    numbers = {field.name: 0.5 for field in dataclasses.fields(Row)}
    return Row(**{
        **numbers, "scene": "polarizer", "region": "all", "camera": "nominal",
        "seed": seed, "start_deg": 17.0, "rpm": rpm, "method": method,
        "aop_error_deg": error, "dolp_roi": 0.9, "events_per_pixel_s": rpm / 10})


@pytest.fixture(scope="module")
def result():
    t = np.arange(0, 100_000, 1000)
    aop = t / 100_000 * 2 * np.pi % np.pi
    flat = np.full(len(t), 0.7)
    counts = np.arange(60)
    return Comparison(
        SCENES["fig2"][0],
        rows=[a_row(method, rpm, seed, seed * 0.1 * rpm) for method in SHOWN
              for rpm in RPMS for seed in range(1, 12)],
        traces=[Trace(rpm, name, t, aop, flat) for rpm in RPMS
                for name in ("truth", *SHOWN) if "own times" not in name],
        spectra=[Spectrum(rpm, counts, 0.1, np.ones((2, 8), int), (3, 4),
                          (np.array([0.1, 0.4]), np.array([0, 1], np.uint8)))
                 for rpm in RPMS],
        outside_hz=1.0, denoised_hz=0.01,
        bounds=[(rpm, Bound(0.4, 0.007, 0.2, 0.004), Bound(0.2, 0.006, 0.0, 0.0))
                for rpm in RPMS])


@pytest.fixture(autouse=True)
def in_print():
    with print_style.journal():
        yield


def all_text(drawing):
    from matplotlib.text import Text
    return [text for text in drawing.findobj(Text) if text.get_text().strip()]


@pytest.mark.gate
@pytest.mark.parametrize("figure", ["fig2", "fig3", "traces", "range"])
def test_pictures_are_as_wide_as_a_page_and_legible(result, figure):
    drawing = {"traces": lambda: plots.traces_figure(result),
               "range": lambda: plots.range_figure("fig4a", result.rows),
               }.get(figure, lambda: plots.rotation_figure(figure, result))()
    width, height = drawing.get_size_inches()
    assert round(width * 25.4) in (89, 183)
    assert height * 25.4 < 247        # what a journal's page holds
    assert 6.5 <= min(text.get_fontsize() for text in all_text(drawing)) <= 9


def test_errors_are_medians_with_the_spread_of_the_specimens(result):
    from matplotlib.figure import Figure
    axes = Figure().subplots()
    plots.errors(axes, [row for row in result.rows if row.method == "kalman"], "rpm",
                 "aop_error_deg", label="")
    line, = axes.get_lines()
    np.testing.assert_allclose(line.get_ydata(), [18, 600])     # the sixth of eleven
    band, = axes.collections
    y = band.get_paths()[0].vertices[:, 1]
    assert (y.min(), y.max()) == pytest.approx((4.5, 1050))     # 5 and 95 % of them


def test_growth_begins_at_zero_for_each_specimen(result):
    from matplotlib.figure import Figure
    axes = Figure().subplots()
    plots.errors(axes, result.rows, "rpm", "aop_error_deg", label="", scale="linear",
                 growth=True)
    for line in axes.get_lines():
        np.testing.assert_allclose(line.get_ydata(), [0, 100 * 0.6 * (1000 - 30)])


@pytest.mark.gate
def test_the_dolp_itself_is_drawn_beside_the_truth(result):
    drawing = plots.rotation_figure("fig2", result)
    axes, = (each for each in drawing.axes if each.get_ylabel() == "DoLP")
    lines = {line.get_label(): line.get_ydata() for line in axes.get_lines()}
    assert set(lines["truth"]) == {1}
    np.testing.assert_allclose(lines["cf"], 0.9)


@pytest.mark.gate
def test_the_least_errors_are_lines_of_their_own(result):
    for panel, calibrated, frame in ((0, 0.4, 0.2), (1, 0.007, 0.006)):
        axes = plots.rotation_figure("fig3", result).axes[panel]
        lines = {line.get_label(): line.get_ydata() for line in axes.get_lines()}
        np.testing.assert_allclose(lines["bound, not calibrated"], calibrated)
        np.testing.assert_allclose(lines["bound, one frame"], frame)


@pytest.mark.gate
def test_networks_and_the_papers_limits_are_drawn_and_the_legend_is_whole(result):
    drawing = plots.rotation_figure("fig2", result)
    drawing.canvas.draw()
    lines = {line.get_label() for line in drawing.axes[1].get_lines()}
    assert {"firenet", "joint", "paper, with events: less"} <= lines
    box = drawing.legends[0].get_window_extent()
    assert box.x0 >= 0
    assert box.x1 <= drawing.bbox.x1


@pytest.mark.gate
def test_a_trace_per_method_has_the_truth_behind_it(result):
    drawing = plots.traces_figure(result)
    lines = [axes.get_lines() for axes in drawing.axes]
    assert len(lines) == 4 * sum("own times" not in name for name in SHOWN)
    for behind, line in lines:
        np.testing.assert_array_equal(behind.get_ydata(), line.get_ydata())
        assert behind.get_linewidth() > line.get_linewidth()


def test_methods_differ_in_line_or_marker_where_there_is_no_colour():
    looks = [print_style.look(name) for name in SHOWN]
    assert len({(look["linestyle"], look["marker"]) for look in looks}) == len(looks)
    assert print_style.look("a method of someone else") == {}


@pytest.mark.gate
def test_three_files_of_a_picture_are_written(result, tmp_path):
    print_style.save_figure(tmp_path / "fig.2", plots.rotation_figure("fig2", result))
    assert (tmp_path / "fig.2.pdf").read_bytes().startswith(b"%PDF")
    assert b"<text" in (tmp_path / "fig.2.svg").read_bytes()    # text, not outlines
    png = (tmp_path / "fig.2.png").read_bytes()
    assert png.startswith(b"\x89PNG")
    assert int.from_bytes(png[16:20], "big") == round(183 / 25.4 * 300)


@pytest.mark.gate
def test_the_fan_is_shown_by_each_method_beside_the_truth(tmp_path, capsys):
    assert reproduce.main(["fan", "-o", str(tmp_path / "fan"), "--quick",
                           "--rpm", "200", "--methods", "frames", "kalman"]) == 0
    page = capsys.readouterr().out
    cells = {line.split("|")[1].strip(): line.split("|")[2].strip()
             for line in page.splitlines() if line.startswith("|")}
    dark, bright = cells["kalman"].split("; ")
    assert float(dark.split(" / ")[0]) < 2
    assert float(bright.split(" / ")[0]) < 5
    assert float(bright.split(" / ")[1]) > 0.9
    assert cells["frames"].endswith("- / 0.00")     # saturated in the bright half
    for name in ("fan.png", "fan.pdf", "fan-profile.svg", "fan.csv"):
        assert (tmp_path / name).stat().st_size > 1000
