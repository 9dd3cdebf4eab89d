"""Event and frame pixels, and the bus, against theory and statistics.

Bounds are four or more standard errors of what is counted.
"""
import math
import tracemalloc

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from pdavis_cv import Layout
from pdavis_cv.simulation import (
    Bus,
    Camera,
    Fan,
    FlatLight,
    FunctionScene,
    MalusSweep,
    RotatingPlate,
    RotatingPolarizer,
    noise,
)


def drain(recording):
    packets = list(recording.packets())
    frames = [frame for packet in packets for frame in packet.frames]
    return np.concatenate([packet.events for packet in packets]), frames


def pixel(events, y, x):
    return events[(events["y"] == y) & (events["x"] == x)]


def light(camera, scene, t, y, x):
    return camera.maps["analyser"][y, x] @ np.stack(scene.stokes(t, 0, 0))


@pytest.mark.parametrize("rpm", [101.3, 1013.0])
def test_events_per_cycle_are_log_range_over_threshold(rpm):
    theta = 0.17
    camera = Camera.preset("ideal", size=(4, 4), dvs={
        "theta_on": theta, "theta_off": theta})
    cycles = 6
    seconds = cycles / (2 * rpm / 60)
    events, _ = drain(camera.record(RotatingPolarizer(rpm=rpm), 1.5 * seconds)[0])
    period = 1e6 * seconds / cycles
    for y in range(4):
        for x in range(4):
            mine = pixel(events, y, x)
            counts = [np.histogram(mine["t"][mine["p"] == p],
                                   period * np.arange(2, 8))[0] for p in (1, 0)]
            # Equal thresholds: one step per level of a grid but the first, where the
            # direction turns; where the grid lies decides one more.
            steps = math.log(40) / theta - 1
            assert np.all(np.abs(np.array(counts) - steps) < 1)


def test_event_rate_is_proportional_to_speed_with_the_same_structure():
    # Haessig, figure 3: rate in proportion to RPM, intervals below 1 ms at 1000 RPM,
    # the same ON/OFF structure at 30 and 1000 RPM.
    camera = Camera.preset("ideal", size=(2, 2))
    rates, patterns, intervals = [], [], []
    for rpm in (30, 1000):
        turns = 2
        events, _ = drain(camera.record(
            RotatingPlate(rpm=rpm, polarizer=0.3), turns * 60 / rpm)[0])
        rates.append(len(events) / (turns * 60 / rpm))
        mine = pixel(events, 1, 1)
        patterns.append(mine["p"])
        intervals.append(np.diff(mine["t"]))
    assert rates[1] / rates[0] == pytest.approx(1000 / 30, rel=0.01)
    assert abs(len(patterns[0]) - len(patterns[1])) <= 1
    n = min(map(len, patterns))
    np.testing.assert_array_equal(patterns[0][:n], patterns[1][:n])
    assert np.median(intervals[1]) < 1000 < np.median(intervals[0])


@pytest.mark.parametrize("leak_slope", [0.0, 0.3])
def test_events_equal_an_ode_solver_with_leak_and_cutoff_by_the_light(leak_slope):
    # Independent of the kernel: adaptive Runge-Kutta with event detection.
    scene = RotatingPolarizer(rpm=405.0, start_angle=0.2).flicker(50.0, 0.3)
    camera = Camera.preset("ideal", size=(2, 2), origin=(0, 0), aps=None, dvs={
        "theta_on": 0.17, "theta_off": 0.13, "cutoff_hz": 60.0, "leak_hz": 2.0,
        "cutoff_hz_per_dn_ms": 5.0, "dark_dn_ms": 0.1,
        "leak_hz_per_dn_ms": leak_slope})
    events, _ = drain(camera.record(scene, 0.06)[0])

    for y, x in ((0, 0), (1, 0)):
        def current(t, y=y, x=x):
            return light(camera, scene, t * 1e6, y, x) + 0.1

        def right(t, state, current=current):
            rate = 2 * math.pi * (60.0 + 5.0 * current(t))
            return [rate * (math.log(current(t)) - state[0]),
                    0.17 * (2 + leak_slope * current(t))]

        level = math.log(current(0.0))
        reference, start, want = level, 0.0, []
        while start < 0.06:
            crossings = [
                lambda t, s, r=reference: s[0] + s[1] - r - 0.17,
                lambda t, s, r=reference: s[0] + s[1] - r + 0.13]
            for crossing in crossings:
                crossing.terminal = True
            solved = solve_ivp(right, (start, 0.06), [level, 0.0], events=crossings,
                               rtol=1e-11, atol=1e-12, max_step=2e-4)
            hit = [i for i in (0, 1) if len(solved.t_events[i])]
            if not hit:
                break
            t = solved.t_events[hit[0]][0]
            level = solved.y_events[hit[0]][0][0]
            want.append((t * 1e6, 1 - hit[0]))
            reference, start = level, t
        mine = pixel(events, y, x)
        assert len(want) > 20
        np.testing.assert_array_equal(mine["p"], [p for _, p in want])
        np.testing.assert_allclose(mine["t"], [t for t, _ in want], atol=1.0)


def test_noiseless_reconstruction_stays_within_one_threshold():
    scene = RotatingPolarizer(rpm=600.0, start_angle=0.4)
    camera = Camera.preset("ideal", size=(2, 2), origin=(0, 0))
    events, _ = drain(camera.record(scene, 0.3)[0])
    t = np.arange(0, 299_000, 100)
    for y in (0, 1):
        for x in (0, 1):
            mine = pixel(events, y, x)
            summed = np.concatenate(
                ([0], np.cumsum(np.where(mine["p"] == 1, 0.15, -0.15))))
            exact = np.log(light(camera, scene, t, y, x))
            behind = summed[np.searchsorted(mine["t"], t, "right")]
            assert np.max(np.abs(exact - exact[0] - behind)) < 0.15 + 2e-3


@pytest.mark.parametrize("hz", [50.0, 250.0])
def test_cutoff_is_the_3_db_frequency(hz):
    # A weak modulation of light at the cutoff: log intensity loses 3 dB, 45 degrees.
    depth = 0.2

    def lamp(t, x, y):
        wave = 30 * np.exp(depth * np.sin(2e-6 * np.pi * hz * t))
        return wave + 0 * x, np.zeros_like(wave), np.zeros_like(wave)

    theta = 0.002
    camera = Camera.preset("ideal", size=(2, 2), aps=None, dvs={
        "theta_on": theta, "theta_off": theta, "cutoff_hz": hz})
    scene = FunctionScene(lamp, sampling_us=0.02e6 / (2 * math.pi * hz), uniform=True)
    seconds = 12 / hz
    events, _ = drain(camera.record(scene, seconds)[0])
    mine = pixel(events, 0, 0)
    t = np.linspace(6e6 / hz, 12e6 / hz, 6000, endpoint=False)
    steps = np.concatenate(([0], np.cumsum(np.where(mine["p"] == 1, theta, -theta))))
    seen = steps[np.searchsorted(mine["t"], t, "right")]
    phasor = 2 * np.mean(seen * np.exp(-2e-6j * np.pi * hz * t)) * 1j / depth
    assert abs(phasor) == pytest.approx(math.sqrt(0.5), rel=0.01)
    assert np.rad2deg(np.angle(phasor)) == pytest.approx(-45, abs=1)


@pytest.mark.parametrize("uniform", [True, False])
def test_two_poles_lose_what_each_loses_alone(uniform):
    # Weak modulation at 100 Hz behind 100 and 200 Hz: -45 and -26.6 degrees.
    hz, depth, theta = 100.0, 0.1, 0.002

    def wave(t, x, y):
        lamp = 30 * np.exp(depth * np.sin(2e-6 * np.pi * hz * t))
        return lamp + 0 * x, np.zeros_like(lamp), np.zeros_like(lamp)

    scene = FunctionScene(wave, sampling_us=100.0, uniform=uniform)
    camera = Camera.preset("ideal", size=(1, 1), origin=(0, 0), aps=None, dvs={
        "theta_on": theta, "theta_off": theta, "cutoff_hz": 100.0,
        "second_pole_hz": 200.0})
    events, _ = drain(camera.record(scene, 0.1)[0])
    t = np.linspace(40_000, 100_000, 6000, endpoint=False)
    steps = np.concatenate((
        [0], np.cumsum(np.where(events["p"] == 1, theta, -theta))))
    seen = steps[np.searchsorted(events["t"], t, "right")]
    phasor = 2 * np.mean(seen * np.exp(-2e-6j * np.pi * hz * t)) * 1j / depth
    assert abs(phasor) == pytest.approx(math.sqrt(0.5 * 0.8), rel=0.015)
    assert np.rad2deg(np.angle(phasor)) == pytest.approx(-71.6, abs=1.2)


def test_a_fast_second_pole_and_threads_leave_the_events():
    scene = RotatingPolarizer(rpm=500.0)
    without = Camera.preset("nominal", seed=2, size=(4, 4))
    fast = Camera.preset("nominal", seed=2, size=(4, 4), dvs={"second_pole_hz": 3e4})
    a, b = (drain(camera.record(scene, 0.1)[0])[0] for camera in (without, fast))
    assert len(a) == pytest.approx(len(b), rel=0.01)
    slow = Camera.preset("realistic", seed=2, size=(34, 4), dvs={
        "second_pole_hz": 200.0, "dark_dn_ms": 0.1})
    c, d = (drain(slow.record(scene, 0.02, threads=n)[0])[0] for n in (1, 2))
    np.testing.assert_array_equal(c, d)


def test_cutoff_in_proportion_to_light():
    camera = Camera.preset("realistic")
    assert camera.dvs.cutoff_hz_per_dn_ms * 600 / 20 == pytest.approx(252)
    # A step of light settles with the time constant of the light after it.
    def step(t, x, y):
        s = np.clip(t / 100, 0, 1)
        wave = 20 * np.exp(0.3 * s**3 * (10 - s * (15 - 6 * s)))
        return wave + 0 * x, np.zeros_like(wave), np.zeros_like(wave)

    theta = 0.003
    camera = Camera.preset("ideal", size=(1, 1), aps=None, dvs={
        "theta_on": theta, "theta_off": theta, "cutoff_hz_per_dn_ms": 8.4})
    events, _ = drain(camera.record(
        FunctionScene(step, sampling_us=2.0, uniform=True), 0.03)[0])
    tau = 1e6 / (2 * math.pi * 8.4 * 10 * math.exp(0.3))
    left = 0.3 - theta * np.arange(1, len(events) + 1)
    late = events["t"] > 1000
    slope = np.polyfit(events["t"][late], np.log(left[late] + 1e-12), 1)[0]
    assert -1 / slope == pytest.approx(tau, rel=0.03)


def test_leak_makes_on_events_at_its_rate():
    camera = Camera.preset("ideal", size=(40, 40), aps=None, dvs={
        "leak_hz": 3.0, "leak_sigma": 0.1})
    events, _ = drain(camera.record(FlatLight(), 10.0)[0])
    assert np.all(events["p"] == 1)
    # 30 per pixel, cut to an integer below: half an event on average.
    assert len(events) / 1600 == pytest.approx(29.5, rel=0.02)


def test_shot_noise_has_its_rate_polarity_and_statistics():
    # Only first events: later ones include those that undo a noise event.
    rate, seconds = 5.0, 0.2
    camera = Camera.preset("ideal", size=(100, 100), aps=None,
                           dvs={"shot_noise_hz": rate, "dark_dn_ms": 0.01})
    events, _ = drain(camera.record(FlatLight(s0=0.0), seconds)[0])
    place = events["y"].astype(int) * 100 + events["x"]
    _, first = np.unique(place, return_index=True)
    seen, chance = len(first) / 1e4, 1 - math.exp(-rate * seconds)
    assert seen == pytest.approx(chance, abs=4 * math.sqrt(chance * (1 - chance) / 1e4))
    assert np.mean(events["p"][first]) == pytest.approx(
        0.5, abs=4 * 0.5 / math.sqrt(len(first)))
    early = np.mean(events["t"][first] < 1e6 * seconds / 2)
    assert early == pytest.approx(
        (1 - math.exp(-rate * seconds / 2)) / chance, abs=0.025)


def test_shot_noise_falls_with_light():
    rates = []
    for s0 in (0.0, 102.0):  # the bright level, behind an analyser half of it
        camera = Camera.preset("ideal", size=(100, 100), aps=None, dvs={
            "shot_noise_hz": 5.0, "dark_dn_ms": 0.001})
        events, _ = drain(camera.record(FlatLight(s0=s0), 0.2)[0])
        place = events["y"].astype(int) * 100 + events["x"]
        rates.append(-math.log(1 - len(np.unique(place)) / 1e4) / 0.2)
    assert rates[1] / rates[0] == pytest.approx(0.25, rel=0.12)


def test_refractory_period_keeps_events_apart():
    camera = Camera.preset("ideal", size=(2, 2), aps=None,
                           dvs={"refractory_us": 700.0})
    events, _ = drain(camera.record(RotatingPolarizer(rpm=1013.0), 0.3)[0])
    for y in (0, 1):
        gaps = np.diff(pixel(events, y, 0)["t"])
        assert len(gaps) > 50
        assert gaps.min() >= 700


def test_hot_pixels_and_bursts_come_as_often_as_set():
    camera = Camera.preset("ideal", size=(100, 100), aps=None, dvs={
        "hot_fraction": 0.02, "hot_hz": 200.0})
    events, _ = drain(camera.record(FlatLight(), 0.1)[0])
    counts = np.zeros((100, 100))
    np.add.at(counts, (events["y"], events["x"]), 1)
    assert np.count_nonzero(counts) == pytest.approx(200, abs=60)
    assert np.all(np.isin(counts, (0, 19, 20)))

    camera = Camera.preset("ideal", size=(100, 100), dvs={"burst_chance": 0.1})
    events, frames = drain(camera.record(FlatLight(), 0.2)[0])
    # 4 frames: 8 edges, within 200 us of each.  With equal thresholds, rounding decides
    # whether an event is undone at once, and so a second one.
    edges = np.array([t for f in frames for t in (
        f.exposure_start_us, f.exposure_end_us)])
    near = np.searchsorted(edges, events["t"], "right") - 1
    first = events["t"] - edges[near] <= 201
    assert np.mean(first) > 0.999
    bursts = np.unique(np.stack((near, events["x"], events["y"])), axis=1).shape[1]
    assert bursts == pytest.approx(8000, abs=4 * math.sqrt(8000 * 0.9))


def test_chips_differ_in_the_mean_of_a_polarizer_by_chance_alone():
    index = noise.pixel_index((12, 12), (124, 166))
    drawn = np.stack([
        noise.normal(seed, "theta_off", index) - noise.normal(seed, "theta_on", index)
        for seed in range(1, 1001)])
    # Differences of the means of 36 pixels each, in their standard deviation.
    means = drawn.reshape(-1, 6, 2, 6, 2).mean((1, 3)).reshape(-1, 4).T
    for one, other in ((0, 3), (1, 2), (0, 1)):
        z = (means[one] - means[other]) / np.sqrt(2 * 2 / 36)
        assert abs(z.mean()) < 0.13
        assert abs(z.std() - 1) < 0.09
        assert np.count_nonzero(abs(z) > 3) <= 10  # 2.7 are to be expected


def test_thresholds_spread_as_set():
    relative = Camera.preset("nominal", size=(100, 100)).maps
    absolute = Camera.preset("hard", size=(100, 100)).maps
    for name, theta in (("theta_on", 0.16), ("theta_off", 0.18)):
        assert np.std(relative[name]) == pytest.approx(0.035 * theta, rel=0.04)
        assert np.mean(relative[name]) == pytest.approx(theta, rel=0.002)
        assert np.std(absolute[name]) == pytest.approx(0.035, rel=0.04)
    spread = np.corrcoef(relative["theta_on"].ravel(), relative["theta_off"].ravel())
    assert abs(spread[0, 1]) < 0.05


def test_frame_noise_is_photon_plus_read_noise_and_cds_removes_reset_levels():
    camera = Camera.preset("nominal", size=(80, 80), dvs=None, aps={
        "fps": 40.0, "readout_us": 2_000})
    light_dn, n = 200.0, 60
    _, frames = drain(camera.record(FlatLight(s0=2 * light_dn / 20), 1.6)[0])
    stack = np.stack([f.dn for f in frames[:n]])
    # Photons (and dark current), two reads, two roundings.
    photons = (light_dn + 0.3) / 80
    expected = photons + 2 * 1.5**2 + 2 / 12
    assert np.mean(stack.var(0, ddof=1)) == pytest.approx(expected, rel=0.02)
    resets = np.stack([f.reset for f in frames[:n]]).astype(float)
    assert np.mean(resets.var(0, ddof=1)) == pytest.approx(
        3.0**2 + 1.5**2 + 1 / 12, rel=0.02)
    assert np.std(resets.mean(0)) == pytest.approx(24.0, rel=0.04)
    # What is left over pixels: gain 2 %, offset 2 DN, and the mean's own noise.
    expected = math.sqrt((0.02 * light_dn) ** 2 + 2.0**2 + expected / n)
    assert np.std(stack.mean(0)) == pytest.approx(expected, rel=0.04)
    for frame in frames:
        np.testing.assert_array_equal(
            frame.dn, frame.reset.astype(float) - frame.signal)


def test_frame_saturates_at_full_well_before_the_converter_ends():
    camera = Camera.preset("nominal", size=(20, 20), dvs=None)
    _, frames = drain(camera.record(FlatLight(s0=200.0), 0.1)[0])
    assert np.all(frames[0].dn < 780)
    assert np.all(frames[0].signal > 0)
    assert not frames[0].valid.any()
    _, frames = drain(camera.record(FlatLight(s0=40.0), 0.1)[0])
    assert frames[0].valid.all()


@pytest.mark.parametrize("preset", ["nominal", "ideal"])
def test_frames_read_the_black_level_less_and_events_do_not(preset):
    scene = RotatingPolarizer(rpm=120.0)
    with_, without = (
        drain(Camera.preset(preset, size=(6, 6), aps={"black_level_dn": c}).record(
            scene, 0.3)[0]) for c in (60.0, 0.0))
    np.testing.assert_array_equal(with_[0], without[0])
    for less, full in zip(with_[1], without[1], strict=True):
        bright = full.dn > 70
        np.testing.assert_allclose(less.dn[bright], full.dn[bright] - 60, atol=1e-4)
        assert np.all(np.abs(less.dn[~bright]) < 20)
    assert any((full.dn < 50).any() for full in without[1])


def test_a_full_well_is_invalid_with_a_black_level_too():
    camera = Camera.preset("nominal", size=(20, 20), dvs=None,
                           aps={"black_level_dn": 50.0})
    _, frames = drain(camera.record(FlatLight(s0=200.0), 0.1)[0])
    assert np.all(frames[0].dn < 730)
    assert not frames[0].valid.any()


def test_rolling_shutter_exposes_columns_one_after_the_other():
    scene = RotatingPolarizer(rpm=300.0, start_angle=0.1)
    camera = Camera.preset("ideal", size=(4, 30), dvs=None, origin=(0, 0),
                           aps={"shutter": "rolling"})
    _, frames = drain(camera.record(scene, 0.2)[0])
    frame = frames[1]
    assert frame.exposure_start_us.shape == (30,)
    assert np.all(np.diff(frame.exposure_start_us) == 400)
    for x in (0, 7, 29):
        t = frame.exposure_start_us[x] + np.arange(20_000) + 0.5
        mean = np.mean(light(camera, scene, t, 2, x))
        assert frame.dn[2, x] == pytest.approx(20 * mean, rel=1e-6)


def test_malus_fit_recovers_the_extinction_ratio():
    # As the paper measures it: 5 degree steps, frames at rest, cosine fit per pixel.
    camera = Camera.preset("nominal", size=(60, 60), dvs=None,
                           aps={"fps": 40.0, "readout_us": 2_000})
    sweep = MalusSweep(step=math.radians(5), hold_us=500_000, move_us=20_000)
    recording, truth = camera.record(sweep, 18.0)
    rows, readings = [], []
    for packet in recording.packets():
        for frame in packet.frames:
            if frame.exposure_start_us % 500_000 >= 20_000:
                angle = float(truth.aop(frame.mid_us))
                rows.append([1, math.cos(2 * angle), math.sin(2 * angle)])
                readings.append(frame.dn - camera.maps["dark_dn"])
    fitted, *_ = np.linalg.lstsq(
        np.array(rows), np.stack(readings).reshape(len(rows), -1), rcond=None)
    swing = np.hypot(fitted[1], fitted[2])
    ratio = (fitted[0] + swing) / (fitted[0] - swing)
    assert np.median(ratio) == pytest.approx(40.0, rel=0.01)
    true = camera.maps["extinction_ratio"].ravel()
    assert np.median(np.abs(ratio / true - 1)) < 0.02
    angle = np.arctan2(fitted[2], fitted[1]) / 2
    error = (angle - camera.maps["angle"].ravel() + math.pi / 2) % math.pi - math.pi / 2
    assert np.rad2deg(np.std(error)) < 0.1


def test_sony_camera_is_12_bit_with_its_dynamic_range():
    camera = Camera.preset("sony", size=(64, 64))
    _, frames = drain(camera.record(FlatLight(s0=100.0), 1.0)[0])
    assert len(frames) == 49  # the fiftieth arrives at the very end
    assert frames[0].full_scale_dn == 4095
    assert camera.layout == Layout.SONY
    assert camera.optics.extinction_ratio == 350
    dark = np.stack([f.dn for f in drain(camera.record(FlatLight(s0=0.0), 1.0)[0])[1]])
    noise = 0.8  # DN, before rounding and the floor at 0
    assert 20 * math.log10(4095 / noise) == pytest.approx(74, abs=2.5)
    assert dark.max() < 8


def test_bus_loses_what_exceeds_its_rate():
    rate = 1e5
    camera = Camera.preset("ideal", size=(60, 60), aps=None,
                           bus=None).stream(RotatingPolarizer(rpm=600.0), 0.1)
    offered, _ = drain(camera)
    busy = Camera.preset("ideal", size=(60, 60), aps=None,
                         bus=Bus(rate_hz=rate, row_us=0.0))
    recording, truth = busy.record(RotatingPolarizer(rpm=600.0), 0.1)
    passed, _ = drain(recording)
    assert len(offered) > 2 * rate * 0.1
    assert len(passed) == pytest.approx(rate * 0.1, rel=0.01)
    waiting = len(offered) - len(passed) - truth.bus_lost.sum()
    assert 0 <= waiting <= 3600
    assert truth.bus_load.mean() > 0.97  # a row at a time, across the pieces' ends
    assert np.all(np.diff(passed["t"]) >= 0)
    # Events that leave together are of one row.
    together = passed["t"][1:] == passed["t"][:-1]
    assert np.all((passed["y"][1:] == passed["y"][:-1])[together])


def test_idle_bus_loses_nothing_and_hardly_delays():
    scene = RotatingPolarizer(rpm=60.0)
    quiet = {"size": (8, 8), "dvs": {"shot_noise_hz": 0.0}}
    free, _ = drain(Camera.preset("nominal", **quiet).record(scene, 0.3)[0])
    recording, truth = Camera.preset(
        "nominal", bus=Bus(), **quiet).record(scene, 0.3)
    passed, _ = drain(recording)
    assert truth.bus_lost.sum() == 0
    assert len(passed) == len(free)
    free, passed = (e[np.lexsort((e["t"], e["x"], e["y"]))] for e in (free, passed))
    assert np.max(np.abs(passed["t"] - free["t"])) <= 10
    np.testing.assert_array_equal(passed["p"], free["p"])


def test_saturated_preset_is_the_full_chip_and_loses_events():
    camera = Camera.preset("saturated", size=(120, 160), aps=None,
                           bus={"rate_hz": 1e6})
    _, truth = camera.record(
        Fan(rpm=1013.0, radius=70.0, edge=6.0), 0.02, step_us=100.0)
    assert Camera.preset("saturated", aps=None, dvs={}).size == (260, 346)
    assert truth.bus_load.max() > 0.95
    assert truth.bus_lost.sum() > 1000


@pytest.mark.gate
def test_long_streams_stay_flat_in_memory():
    camera = Camera.preset("nominal", size=(16, 16))
    packets = camera.stream(RotatingPolarizer(rpm=30.0), 3600.0).packets()
    for _ in range(50):
        next(packets)
    tracemalloc.start()
    for _ in range(50):
        next(packets)
    before = tracemalloc.get_traced_memory()[0]
    for _ in range(600):
        next(packets)
    after = tracemalloc.get_traced_memory()[0]
    tracemalloc.stop()
    assert after - before < 300_000
