"""The ideal camera before a rotating polarizer."""
import numpy as np
import pytest
from ideal import rotating_polarizer

from pdavis_cv import Layout

CHANNELS = np.deg2rad([0, 45, 90, 135])


def drain(recording):
    packets = list(recording.packets())
    frames = [frame for packet in packets for frame in packet.frames]
    return np.concatenate([packet.events for packet in packets]), frames


def log_intensity(truth, t_us, angle, er=40):
    s0, s1, s2 = truth.stokes(t_us)
    k = (er - 1) / (er + 1)
    return np.log(s0 / 2 + k / 2 * (s1 * np.cos(2 * angle) + s2 * np.sin(2 * angle)))


def pixel_angle(layout, y, x):
    return np.deg2rad(layout.angles_deg[y % 2][x % 2])


@pytest.mark.parametrize("rpm", [30.39, -101.3, 1013.0])
@pytest.mark.parametrize("layout", [Layout.PDAVIS, Layout.SONY])
def test_every_event_is_one_threshold_from_the_last(rpm, layout):
    on, off = 0.15, 0.19
    recording, truth = rotating_polarizer(
        rpm, 0.5, size=(3, 4), theta=(on, off), layout=layout, start_angle=0.3)
    events, _ = drain(recording)
    for y in range(3):
        for x in range(4):
            mine = events[(events["y"] == y) & (events["x"] == x)]
            angle = pixel_angle(layout, y, x)
            steps = np.where(mine["p"] == 1, on, -off)
            level = log_intensity(truth, 0, angle) + np.cumsum(steps)
            # Within the rounding of the time stamp: half a microsecond of slope.
            t = mine["t"]
            span = np.abs(log_intensity(truth, t + 0.51, angle)
                          - log_intensity(truth, t - 0.51, angle))
            error = np.abs(log_intensity(truth, t, angle) - level)
            assert len(mine) > 5
            assert np.all(error <= span + 1e-9)


def test_no_crossing_is_missed_between_events():
    recording, truth = rotating_polarizer(203.0, 0.5, size=(2, 2))
    events, _ = drain(recording)
    t = np.arange(0, 500_000, 50)
    for y in range(2):
        for x in range(2):
            mine = events[(events["y"] == y) & (events["x"] == x)]
            angle = pixel_angle(Layout.PDAVIS, y, x)
            summed = np.cumsum(np.where(mine["p"] == 1, 0.15, -0.15))
            behind = np.concatenate(([0], summed))[
                np.searchsorted(mine["t"], t, "right")]
            exact = log_intensity(truth, t, angle) - log_intensity(truth, 0, angle)
            assert np.max(np.abs(exact - behind)) < 0.15 + 2e-3


@pytest.mark.parametrize("rpm", [60.0, 1013.0])
def test_frame_is_the_mean_of_the_light_over_its_exposure(rpm):
    recording, truth = rotating_polarizer(rpm, 0.3, size=(4, 4), start_angle=1.0)
    _, frames = drain(recording)
    assert len(frames) == 6
    for frame in frames:
        t = frame.exposure_start_us + (np.arange(20_000) + 0.5)
        for y in range(2):
            for x in range(2):
                angle = pixel_angle(Layout.PDAVIS, y, x)
                light = np.exp(log_intensity(truth, t, angle))
                assert frame.dn[y, x] == pytest.approx(20 * np.mean(light), rel=1e-6)


def test_parallel_light_gives_dn_and_crossed_light_dn_over_extinction_ratio():
    recording, _ = rotating_polarizer(0.0, 0.1, size=(2, 2), dn=600)
    events, frames = drain(recording)
    assert len(events) == 0
    np.testing.assert_allclose(frames[0].dn[1, 0], 600, rtol=1e-6)  # 0 degrees
    np.testing.assert_allclose(frames[0].dn[0, 1], 15, rtol=1e-6)  # 90 degrees


def test_truth_turns_counter_clockwise_twice_per_turn():
    _, truth = rotating_polarizer(60.0, 1.0, start_angle=0.1)
    t = np.array([0, 125_000, 500_000, 1_000_000])
    np.testing.assert_allclose(
        truth.aop(t), np.mod(0.1 + np.array([0, np.pi / 4, np.pi, 2 * np.pi]), np.pi),
        atol=1e-9)
    np.testing.assert_allclose(truth.dolp(t), 1)


def test_threshold_maps_act_per_pixel():
    on = np.full((4, 4), 0.15)
    on[0, 0] = 0.3
    recording, _ = rotating_polarizer(100.0, 1.0, size=(4, 4), theta=(on, 0.2))
    events, _ = drain(recording)
    counts = np.zeros((4, 4))
    np.add.at(counts, (events["y"], events["x"]), events["p"])
    assert counts[0, 0] == pytest.approx(counts[2, 2] / 2, abs=4)
    assert counts[0, 2] == counts[2, 2]
