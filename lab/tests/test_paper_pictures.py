"""What the pictures of `python -m lab.paper` show."""
import dataclasses

import numpy as np
import pytest

from lab.paper import command, denoise, fan_images, network, print_style
from lab.paper.bound import Bound, Limits
from lab.paper.rotation import SCENES, Comparison, Spectrum, Trace
from lab.paper.run import SHOWN, Row, Settings
from pdavis_cv import render

pytest.importorskip("matplotlib")

from lab.paper import plots

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
        limits=[Limits(camera, rpm, Bound(least, 0.007, 0.2, 0.004),
                       Bound(0.2, 0.006, 0.0, 0.0), (30.0, 0.4), 1.0, 36)
                for rpm in RPMS
                for camera, least in (("event camera", 0.4), ("Sony 50 fps", 0.1))])


@pytest.fixture(autouse=True)
def in_print():
    with print_style.journal():
        yield


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
        sony = 0.1 if panel == 0 else calibrated
        np.testing.assert_allclose(lines["bound, Sony not calibrated"], sony)


@pytest.mark.gate
def test_the_mean_of_a_region_has_a_bound_of_its_own_with_its_standard_error(result):
    axes = plots.rotation_figure("fig2", result).axes[1]
    lines = {line.get_label(): line.get_ydata() for line in axes.get_lines()}
    np.testing.assert_allclose(lines["bound, not calibrated"], 0.4 / 6)
    tops = [band.get_paths()[0].vertices[:, 1].max() for band in axes.collections]
    # Of eleven specimens, each of which has one draw of a region.
    assert any(np.isclose(top, 0.4 / 6 + 0.2 / 6 / 11**0.5) for top in tops)


@pytest.mark.gate
def test_a_trace_per_method_has_the_truth_behind_it(result):
    drawing = plots.traces_figure(result)
    lines = [axes.get_lines() for axes in drawing.axes]
    assert len(lines) == 4 * sum("own times" not in name for name in SHOWN)
    for behind, line in lines:
        np.testing.assert_array_equal(behind.get_ydata(), line.get_ydata())
        assert behind.get_linewidth() > line.get_linewidth()


@pytest.mark.gate
def test_the_fan_is_shown_by_each_method_beside_the_truth(tmp_path, capsys):
    assert command.main(["fan", "-o", str(tmp_path / "fan"), "--quick",
                           "--rpm", "200", "--methods", "frames", "events",
                           "kalman"]) == 0
    page = capsys.readouterr().out
    cells = {line.split("|")[1].strip(): line.split("|")[2].strip()
             for line in page.splitlines() if line.startswith("|")}
    dark, bright = cells["kalman"].split("; ")
    assert float(dark.split(" / ")[0]) < 2
    assert float(bright.split(" / ")[0]) < 5
    assert float(bright.split(" / ")[1]) > 0.9
    assert cells["frames"].endswith("- / 0.00")     # saturated in the bright half
    beside = page.split("Beside the paper")[1]
    assert "Sony" not in beside     # which was not asked for
    assert beside.strip().endswith("| agrees |")
    for name in ("fan.png", "fan.pdf", "fan-profile.svg", "fan-uncertainty.png",
                 "fan.csv"):
        assert (tmp_path / name).stat().st_size > 1000


def test_a_methods_dolp_that_means_nothing_is_not_shown_and_its_angle_does_not_fade():
    view = fan_images.View("events", 200.0, np.ones((4, 4)), np.full((4, 4), 0.4),
                           np.full((4, 4), np.nan), *np.zeros((3, 8)))
    shown = fan_images._faded(view)
    np.testing.assert_array_equal(
        shown, render.aop_bgr(np.full((4, 4), 0.4))[..., ::-1])


def test_uncertainty_is_drawn_for_methods_that_state_it():
    sigma, off = np.full((4, 4), 2.0), np.full((4, 4), 1.0)
    off[0], off[1] = 3.0, np.nan
    plain = fan_images.View("cf", 200.0, sigma, sigma, sigma, *np.zeros((3, 8)))
    assert fan_images.uncertainty_figure([plain]) is None
    drawing = fan_images.uncertainty_figure([plain, dataclasses.replace(
        plain, method="kalman", sigma_deg=sigma, error_deg=off)])
    labels = [axes.get_xlabel() for axes in drawing.axes]
    assert "67 % within sigma" in labels        # eight of the twelve that count


def test_the_network_picture_has_a_mark_for_each_method_and_scene():
    def row(scene, method, aop, dolp):
        return network.NetworkRow(
            scene=scene, setting="", region="all", camera="nominal", seed=1,
            window_us=1000, method=method, images=1, aop_error_deg=aop,
            dolp_error=dolp, s0_error=0.1, aop_error_roi_deg=1.0, dolp_error_roi=0.1,
            aop_range_deg=180.0)

    rows = [row("fan", "joint", 1.0, 0.1), row("fan", "joint", 4.0, 0.3),
            row("fan", "joint", 2.0, 0.2), row("texture", "events", 7.0, np.nan)]
    aop, dolp = network.network_figure(rows).axes
    marks = [line for line in aop.get_lines() if line.get_marker() not in ("", "None")]
    assert [float(line.get_xdata()[0]) for line in marks] == [2.0, 7.0]
    reach = [tuple(line.get_xdata()) for line in dolp.get_lines()
             if line.get_marker() == "None"]
    assert reach == [(0.1, 0.3)]                # no DoLP where it means nothing


@pytest.mark.gate
def test_denoised_events_are_shown_with_what_made_them():
    shown = denoise.example(Settings(quick=True))
    assert shown.kept[shown.true].mean() > 0.95
    assert shown.kept[~shown.true].mean() < 0.7
    middle = (denoise.SIZE[0] - 1) / 2
    true = shown.events[shown.true]
    assert np.hypot(true["x"] - middle, true["y"] - middle).max() < 0.37 * 48
    one = denoise.Denoised("nominal", 1, 17.0, 30.0, 2.6, 0.06, 42.0, 0.99)
    drawing = denoise.denoise_figure(
        [one, dataclasses.replace(one, rpm=1000.0)], shown)
    before, after, rates = drawing.axes
    assert sum(len(line.get_xdata()) for line in before.get_lines()) == len(
        shown.events)
    assert sum(len(line.get_xdata()) for line in after.get_lines()) == shown.kept.sum()
    assert [line.get_ydata()[0] for line in rates.get_lines()] == [42.0, 2.6, 0.06]
