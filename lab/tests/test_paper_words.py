"""Pages of figures 2 and 3 say whether the paper's words hold, from the numbers."""
import dataclasses
import math

import pytest

from lab.paper.bound import Bound, Limits
from lab.paper.rotation import SCENES, Comparison
from lab.paper.rotation_page import page
from lab.paper.run import Row, Settings

NOTHING = Bound(0.0, 0.0, 0.0, 0.0)


def a_row(method, rpm, aop, dolp, rate=math.nan):
    numbers = dict.fromkeys(Row.__dataclass_fields__, math.nan)
    return Row(**{**numbers, "scene": "", "region": "all", "camera": "nominal",
                  "seed": 1, "start_deg": 0.0, "rpm": rpm, "method": method,
                  "aop_error_deg": aop, "aop_error_roi_deg": aop,
                  "dolp_error": dolp, "dolp_error_roi": dolp,
                  "events_per_pixel_s": rate})


def words(figure, rows, limits=()):
    """Return quantity -> verdict."""
    scene = SCENES[figure][0]
    result = Comparison(scene, rows, limits=list(limits), outside_hz=1.2,
                        denoised_hz=0.01)
    lines = page(figure, [result], Settings())
    table = lines[lines.index("## Beside the paper"):]
    cells = [line.strip("|").split("|") for line in table if line.startswith("|")]
    return {row[0].strip(): row[-1].strip() for row in cells[2:]}


@pytest.fixture
def rows():
    return [a_row("frames", 30.0, 8.0, 0.01, 40.0), a_row("frames", 1000.0, 40, 0.6),
            a_row("kalman", 30.0, 0.5, 0.01, 40.0),
            a_row("kalman", 1000.0, 0.6, 0.02, 1310.0)]


def test_what_lies_within_the_stated_limits_agrees_and_the_rest_says_why(rows):
    said = words("fig2", rows)
    assert said["AoP error to 60 RPM, both cameras, region's mean"] == (
        "agrees, but for frames: held frames are late; at their own times they agree")
    assert said["AoP error to 1000 RPM with events, region's mean"] == "agrees"
    assert said["frames above 100 RPM"] == "agrees"
    assert said["DoLP to 1000 RPM"] == "agrees"
    assert said["event rate"] == "agrees"
    assert said["event rate outside the polarizer"] == "agrees"
    rows[3] = dataclasses.replace(rows[3], aop_error_roi_deg=12.0, dolp_error_roi=0.5,
                                  events_per_pixel_s=3000.0)
    said = words("fig2", rows)
    assert said["AoP error to 1000 RPM with events, region's mean"] == (
        "agrees, but for kalman")
    assert said["DoLP to 1000 RPM"] == said["event rate"] == "differs"


def test_what_was_not_done_is_not_judged(rows):
    said = words("fig2", rows[:1])
    assert said["frames above 100 RPM"] == said["DoLP to 1000 RPM"] == "-"


def test_growth_in_points_is_set_beside_theory():
    rows = [a_row("Sony 50 fps", 30.0, 3.0, 0.08), a_row("firenet", 30.0, 3.0, 0.1),
            a_row("Sony 50 fps", 1000.0, 50.0, 0.42), a_row("firenet", 1000.0, 4, 0.2)]
    limits = [Limits("Sony 50 fps", rpm, NOTHING, NOTHING, (1.0, held), 0.64, 36)
              for rpm, held in ((30.0, 0.08), (1000.0, 0.43))]
    said = words("fig3", rows, limits)
    assert said["growth of the DoLP error from the lowest speed, worst speed, rotating "
                "plate"] == "firenet differs: our weights"
    assert said["the same of frames, rotating plate"] == (
        "differs in points; theory of 20 ms and of delay alone: +35.0 points; of the "
        "light's mean DoLP, 0.64, it is 53 %, if that is the paper's measure")
    rows[2] = dataclasses.replace(rows[2], dolp_error_roi=0.7)
    assert words("fig3", rows, limits)["the same of frames, rotating plate"] == "agrees"
