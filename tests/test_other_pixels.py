"""The methods on event pixels that do not share our simulator's model of a crossing.

``python tests/test_other_pixels.py`` prints the table in lab/docs/reproduced.md.
"""
import importlib.util

import numpy as np
import pytest
from other_pixels import Light, circuit_events, eventcv_events, recording, v2e_events
from truth_errors import errors_of

from pdavis_cv import fuse

PIXELS = {"v2e": v2e_events, "EventCV": eventcv_events, "circuit": circuit_events}
DOLP = 0.8
# AoP in degrees, DoLP; EventCV's pixels make ten noise events per second, the scale of
# the circuit's thresholds is .31 where .2 is assumed.
GOALS = {"v2e": (1.3, 0.05), "EventCV": (2.6, 0.08), "circuit": (3.5, 0.22)}
METHODS = {
    "frames": {"method": "frames"},
    "cf": {"method": "cf"},
    "kalman causal": {"method": "kalman", "causal": True},
    "kalman": {"method": "kalman"},
    "kalman offline": {"method": "kalman", "mode": "offline"},
    "events, redundancy": {"method": "events", "offsets": "redundancy"},
}


def errors(made, rpm, *, step_us=1013, **parameters):
    """AoP in degrees, DoLP, and the part of both within one sigma; super-pixels."""
    times = np.arange(1_000_000, made.info.stop_us - 100_000, step_us)
    found = errors_of(fuse(
        made, times_us=times, demosaic="superpixel", nominal_thresholds=(0.2, 0.2),
        extinction_ratio=40, **parameters), Light(rpm, DOLP))
    return (np.degrees(found.aop), found.dolp, found.aop_coverage, found.dolp_coverage)


@pytest.mark.accuracy
@pytest.mark.gate
@pytest.mark.parametrize("rpm", [60.78, 1013])
@pytest.mark.parametrize("pixel", list(PIXELS))
def test_kalman_is_accurate_on_pixels_that_are_not_ours(pixel, rpm):
    if pixel == "EventCV":
        pytest.importorskip("eventcv")
    made = recording(PIXELS[pixel], rpm, seconds=2.0, dolp=DOLP)
    got = {name: errors(made, rpm, step_us=5077, **METHODS[name])
           for name in ("frames", "cf", "kalman")}
    aop, dolp, _, _ = got["kalman"]
    assert aop < GOALS[pixel][0]
    assert dolp < GOALS[pixel][1]
    assert aop < got["cf"][0] / 2
    assert got["frames"][0] > 10


@pytest.mark.accuracy
@pytest.mark.gate
@pytest.mark.parametrize(("pixel", "seed", "method", "rpm", "goal"), [
    ("v2e", 1, "kalman", 506.5, 0.9), ("v2e", 1, "kalman causal", 506.5, 3.2),
    ("v2e", 1, "kalman causal", 1013, 5.6), ("EventCV", 3, "kalman", 30.39, 1.9)])
def test_a_lag_is_not_taken_for_stamps_that_are_off(pixel, seed, method, rpm, goal):
    """Dim pixels lag by milliseconds; a clock 1 ms off is 3 degrees at 506 RPM."""
    if pixel == "EventCV":
        pytest.importorskip("eventcv")
    made = recording(PIXELS[pixel], rpm, seed=seed, seconds=1.8, dolp=DOLP)
    assert errors(made, rpm, step_us=5077, **METHODS[method])[0] < goal


@pytest.mark.accuracy
@pytest.mark.gate
def test_no_black_level_is_found_where_there_is_none():
    """v2e's dim pixels are linear, which looks like 10 DN that frames lack."""
    made = recording(v2e_events, 202.6, seed=3, seconds=2.0, dolp=DOLP)
    assert errors(made, 202.6, step_us=5077, method="kalman")[1] < 0.015


@pytest.mark.gate
def test_redundancy_finds_thresholds_that_are_far_from_equal():
    made = recording(v2e_events, 202.6, dolp=DOLP)   # ON and OFF differ by 21 % rms
    aop, dolp, _, _ = errors(made, 202.6, step_us=5077, **METHODS["events, redundancy"])
    assert aop < 4.5
    assert dolp < 0.08


if __name__ == "__main__":
    speeds = (30.39, 60.78, 101.3, 202.6, 506.5, 1013.0)
    for name, pixel in PIXELS.items():
        if name == "EventCV" and importlib.util.find_spec("eventcv") is None:
            continue
        made = {rpm: [recording(pixel, rpm, seed=seed, dolp=DOLP) for seed in (1, 2)]
                for rpm in speeds}
        print(f"\n| {name} | " + " | ".join(f"{rpm / 1.013:g}" for rpm in speeds)
              + " | mean | within one sigma |\n" + "|---" * (len(speeds) + 3) + "|")
        for method, parameters in METHODS.items():
            scores = np.array([[errors(one, rpm, **parameters) for one in ones]
                               for rpm, ones in made.items()]).mean(1)
            cells = [f"{aop:.2f} / {dolp:.3f}" for aop, dolp in scores[:, :2]]
            aop, dolp, a, d = scores.mean(0)
            print("| " + " | ".join([method, *cells, f"{aop:.2f} / {dolp:.3f}",
                                     f"{a:.2f} / {d:.2f}"]) + " |", flush=True)
