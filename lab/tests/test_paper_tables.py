"""Tables S1 and S2: what is measured of a camera is what it was given."""
import math

import numpy as np
import pytest

from lab.paper import command, specification as spec
from pdavis_cv.events import EVENT_DTYPE
from pdavis_cv.reconstruct.methods import make_reconstructor
from pdavis_cv.recording.base import ApsFrame
from pdavis_cv.simulation import PRESETS, Camera


@pytest.mark.gate
@pytest.mark.parametrize("preset", ["nominal", "sony"])
def test_the_extinction_ratio_of_the_specimen_is_found(preset):
    maps = Camera.preset(preset, seed=3, size=(16, 16), dvs=None).maps
    found = spec.extinction_ratio(preset, 3)
    assert found == pytest.approx(np.median(maps["extinction_ratio"]), rel=0.03)


@pytest.mark.gate
@pytest.mark.parametrize("preset", ["nominal", "sony"])
def test_the_range_of_frames_follows_from_noise_and_full_well(preset):
    aps = PRESETS[preset]["aps"]
    # Each read is rounded; the reset level's noise is that of both reads.
    reads = 1 if aps.reset_dn is None else 2
    dark = aps.dark_dn_s * aps.exposure_us / 1e6 / aps.electrons_per_dn
    noise = math.sqrt(reads * (aps.read_noise_dn**2 + 1 / 12) + dark)
    theory = 20 * math.log10(aps.full_well_dn / noise)
    assert spec.frame_range_db(preset, 2) == pytest.approx(theory, abs=0.6)


def test_thresholds_and_the_first_event_are_those_of_the_pixels():
    dvs = PRESETS["nominal"]["dvs"]
    mean, spread = spec.threshold_spread("nominal", 2)
    maps = Camera.preset("nominal", seed=2, size=(16, 16), aps=None).maps
    assert mean == pytest.approx(maps["theta_on"].mean(), rel=0.02)
    assert spread == pytest.approx(maps["theta_on"].std(), rel=0.15)
    theory = -math.log1p(-dvs.theta_on / math.log(2)) / (2 * math.pi * dvs.cutoff_hz)
    assert spec.first_event_us("nominal", 2) == pytest.approx(1e6 * theory, rel=0.03)


def test_a_quantity_agrees_within_15_percent_of_both_cameras():
    def verdict(here, sony):
        return spec.Quantity(quantity="", unit="", paper=10, here=here, paper_sony=100,
                             here_sony=sony, how="").verdict
    assert verdict(11, 90) == verdict(math.nan, 90) == "agrees"
    assert verdict(11, 120) == "differs by 20 %"
    assert verdict(math.nan, math.nan) == "-"


def fed(method, parameters, upto):
    made = make_reconstructor(method, (4, 4), 0.2, 0.2, parameters)
    events = np.zeros(3, EVENT_DTYPE)
    events["t"], events["p"], events["x"] = (1_000, 60_000, 90_000), 1, 1
    if made.needs.frames:
        made.add_frame(ApsFrame(np.full((4, 4), 300.0), -10_000, 10_000))
    made.add_events(events[:upto])
    return made


@pytest.mark.parametrize(("method", "parameters"), [
    ("events", {}), ("cf", {}), ("kalman", {"mode": "causal"})])
def test_an_image_that_waits_for_one_event_shows_it(method, parameters):
    before, after = (fed(method, parameters, upto) for upto in (2, 3))
    assert "1 event" in spec.latency(after)
    with np.errstate(all="ignore"):
        change = after.read(90_000).log_intensity - before.read(90_000).log_intensity
    assert abs(change[0, 1]) > 0.05


def test_an_image_that_waits_longer_says_how_long():
    for method, parameters, said in (
            ("kalman", {}, "50 ms"), ("frames", {}, "1 frame"),
            ("joint", {"window_us": 5000}, "window of 5 ms")):
        made = make_reconstructor(method, (8, 8), 0.2, 0.2, parameters)
        assert spec.latency(made) == said


@pytest.mark.gate
def test_the_command_writes_both_tables(tmp_path, capsys):
    assert command.main(["tables", "-o", str(tmp_path / "tables"),
                           "--methods", "frames", "cf", "firenet"]) == 0
    page = (tmp_path / "tables.md").read_text()
    line = next(line for line in page.splitlines() if "extinction ratio" in line)
    assert line.split("|")[3:4] + line.split("|")[7:8] == [" 40 ", " agrees "]
    assert [line.split("|")[1].strip() for line in page.splitlines()
            if line.split("|")[1:2] in ([" frames "], [" cf "], [" firenet "])] == [
        "frames", "cf", "firenet"]
    assert (tmp_path / "tables.csv").exists()
    assert (tmp_path / "tables-methods.csv").exists()
    assert page.strip() in capsys.readouterr().out


def test_operations_are_those_of_the_kernels_and_of_the_weights():
    # Three by three weights of (in, out) planes: head, two of gates, new and r.
    inside = 2 * (32 * 32 + 16 * 32 + 2 * 16 * 16)
    for name, head, last, pixels in (("firenet", 5, 16, 1), ("joint", 28, 6 * 24, 4)):
        event, image = spec.operations(name)
        assert np.isnan(event)
        assert image == 2 * (9 * (16 * head + inside) + last) / pixels + 11 / 4
    assert spec.operations("cf") == (6, 7 + 11 / 4)
    assert np.isnan(spec.operations("kalman")).all()
