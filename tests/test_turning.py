"""Behind a turning analyser: the regression of events on its angle; fuse()."""
import itertools
import math
import pickle

import numpy as np
import pytest
import reference_turning as reference
from turning_pixels import Still, as_recording, errors, events_of, pulses, rms, turned

import pdavis_cv
from pdavis_cv import _kernels
from pdavis_cv.events import EVENT_DTYPE
from pdavis_cv.reconstruct.turning import TurningRegression
from pdavis_cv.recording.base import ApsFrame
from pdavis_cv.tools.main import main
from pdavis_cv.turning import PulseClock, TurningAnalyser


def regression(scene, events=None, shape=None, **parameters):
    """Return a method that has seen a scene, with the thresholds of a data sheet."""
    known = {"theta_on": 0.23, "theta_off": 0.27, "segments": TurningAnalyser(
        rpm=60 * scene.hz, phase=scene.phase).segments()} | parameters
    method = TurningRegression(shape or (1, len(scene.on)), **known)
    method.add_events(scene.events if events is None else events)
    return method


def at_end(method, scene):
    return method.polarization(scene.stop_us - method.lookahead_us)


@pytest.fixture(scope="module")
def still():
    return Still()


# ---- the regression ------------------------------------------------------------------


@pytest.mark.parametrize(("scene", "aop_deg", "dolp"), [
    ({"spread": 0.035, "logarithmic": False}, 0.8, 0.03),
    ({"spread": 0.045}, 1.0, 0.04),
    ({"spread": 0.045, "jitter": 0.03}, 1.0, 0.04),
])
def test_half_a_turn_gives_angle_and_degree(scene, aop_deg, dolp):
    scene = Still(**scene)
    found = at_end(regression(scene), scene)
    angle, degree = errors(found, scene.dolp, scene.aop)
    assert found.valid.all()
    assert rms(np.rad2deg(angle)) < aop_deg
    assert rms(degree) < dolp


def test_a_second_of_turns_gives_a_quarter_of_a_degree(still):
    angle, degree = errors(at_end(regression(still, half_turns=40), still),
                           still.dolp, still.aop)
    assert rms(np.rad2deg(angle)) < 0.25
    assert rms(degree) < 0.04


def test_thresholds_are_learned_per_pixel(still):
    method = regression(still, theta_on=0.2, theta_off=0.2)
    on, off = method.thresholds[:, 0]
    assert rms(np.log(on / still.on)) < 0.015
    assert rms(np.log(off / still.off)) < 0.015
    assert method.common_sigma < 0.05


@pytest.mark.parametrize("told", [0.2, 0.32])
def test_the_first_estimate_corrects_thresholds_of_a_data_sheet(still, told):
    half_us = 1e6 / (2 * still.hz)
    method = regression(still, theta_on=told, theta_off=told, centred=False,
                        events=still.events[still.events["t"] < 6 * half_us])
    found = method.polarization(round(6 * half_us))
    _, degree = errors(found, still.dolp, still.aop)
    assert rms(degree) < 0.04
    assert np.mean(np.abs(degree) < found.sigmas[1, 0]) > 0.55


def test_pixels_that_know_nothing_follow_the_mean():
    scene = Still(degree=(0.1, 0.6), jitter=0.03)
    method = regression(scene, theta_on=0.2, theta_off=0.2)
    error = np.log(method.thresholds[:, 0] / [scene.on, scene.off])
    assert rms(error.mean(0)) < 0.05


def test_weak_light_is_stated_only_where_it_is_known():
    scene = Still(degree=(0.05, 0.3), jitter=0.02, seconds=1.4)
    found = at_end(regression(scene, half_turns=40, threshold_sigma=0.05), scene)
    angle, degree = errors(found, scene.dolp, scene.aop)
    valid = found.valid[0]
    assert 0.15 < valid.mean() < 0.6    # a swing below a threshold gives no event
    assert rms(np.rad2deg(angle[valid])) < 4
    assert rms(degree[valid]) < 0.03
    assert np.mean(np.abs(degree) < found.sigmas[1, 0], where=valid) > 0.55
    assert np.mean(np.abs(angle) < found.sigmas[0, 0], where=valid) > 0.55


def test_sensitive_pixels_see_weak_light():
    scene = Still(degree=(0.1, 0.3), thetas=(0.1, 0.11), jitter=0.02)
    found = at_end(regression(scene, theta_on=0.1, theta_off=0.11, half_turns=40,
                              threshold_sigma=0.05), scene)
    angle, degree = errors(found, scene.dolp, scene.aop)
    valid = found.valid[0]
    assert valid.mean() > 0.95
    assert rms(np.rad2deg(angle[valid])) < 4
    assert rms(degree[valid]) < 0.03


def test_a_scale_that_weak_light_does_not_tell_is_in_the_sigma():
    scene = Still(degree=(0.1, 0.25), thetas=(0.1, 0.1))
    found = at_end(regression(scene, theta_on=0.15, theta_off=0.15), scene)
    _, degree = errors(found, scene.dolp, scene.aop)
    assert rms(degree) > 0.05
    assert np.mean(np.abs(degree) < 1.5 * found.sigmas[1, 0]) > 0.9


def test_a_moving_scene_is_in_the_sigma():
    n, hz = 600, 20.0
    places = np.arange(-200, n + 10)
    rng = np.random.default_rng(3)

    def texture(period):
        spectrum = np.fft.rfft(rng.standard_normal(len(places)))
        spectrum[np.fft.rfftfreq(len(places)) > 1 / period] = 0
        wave = np.fft.irfft(spectrum, len(places))
        return lambda t: np.interp(np.arange(n) - 2 * hz * t, places, wave / wave.std())

    grey, more, turned = texture(8), texture(16), texture(16)

    def dolp(t):
        return 0.6 + 0.1 * np.tanh(more(t))

    def aop(t):
        return 0.4 * turned(t)

    def light(t):
        return np.exp(0.3 * grey(t)) * (
            1 + dolp(t) * np.cos(2 * (2 * np.pi * hz * t - aop(t))))

    error = np.exp(0.045 * rng.standard_normal((2, n)))
    method = TurningRegression((1, n), theta_on=0.23, theta_off=0.27,
                               segments=TurningAnalyser(rpm=60 * hz).segments())
    method.add_events(events_of(light, 0.23 * error[0], 0.27 * error[1], 1.0))
    t = 1_000_000 - method.lookahead_us
    found = method.polarization(t)
    angle, degree = errors(found, dolp(t / 1e6), aop(t / 1e6))
    valid = found.valid[0]
    for error, sigma in zip((angle, degree), found.sigmas[:2, 0], strict=True):
        assert 0.55 < np.mean(np.abs(error) < sigma, where=valid) < 0.8
    assert rms(angle) > np.deg2rad(0.5)


def test_turning_everything_turns_the_angle_only(still):
    one = at_end(regression(still), still)
    segments = TurningAnalyser(rpm=60 * still.hz, phase=0.7).segments()
    other = at_end(regression(still, segments=segments), still)
    angle, degree = errors(one, still.dolp, still.aop)
    turned, same = errors(other, still.dolp, still.aop + 0.7)
    np.testing.assert_allclose(turned, angle, atol=2e-3)
    np.testing.assert_allclose(same, degree, atol=2e-3)
    np.testing.assert_allclose(other.sigmas, one.sigmas, rtol=0.1, atol=1e-3)


def test_the_other_direction_mirrors_the_angle(still):
    back = TurningAnalyser(rpm=-60 * still.hz).segments()
    angle, _ = errors(at_end(regression(still, segments=back), still),
                      still.dolp, -still.aop)
    assert rms(np.rad2deg(angle)) < 1


def test_a_silence_of_years_costs_no_estimates(few):
    late = few.events[-1:].copy()
    late["t"] = 2**53
    method = regression(few)
    looks, look = [], method._look
    method._look = lambda: looks.append(1) or look()
    method.add_events(late)
    assert len(looks) < 20
    assert method._look_us > 2**53


def test_packets_do_not_change_the_images(still):
    whole = at_end(regression(still), still)
    parts = TurningRegression((1, len(still.on)), theta_on=0.23, theta_off=0.27,
                              segments=TurningAnalyser(rpm=60 * still.hz).segments())
    for i in range(0, len(still.events), 997):
        parts.add_events(still.events[i:i + 997])
    for mine, other in zip(whole, at_end(parts, still), strict=True):
        np.testing.assert_array_equal(mine, other)


def test_frames_give_the_level_of_s0(still):
    method = regression(still)
    t = still.stop_us
    seconds = (t + np.linspace(0, 5000, 101)) * 1e-6
    dn = 50 * np.mean([still.light(one) for one in seconds], 0)[None] * 5
    method.add_frame(ApsFrame(dn.astype(np.float32), t, t + 5000))
    found = method.polarization(t + 2500)
    s0 = found.quad[0] + found.quad[2]
    assert np.quantile(np.abs(np.log(s0 / 100)), 0.95) < 0.02


@pytest.mark.parametrize("change", [
    {"half_turns": 0}, {"segments": np.zeros((1, 3))}, {"threshold_sigma": -1},
    {"theta_on": 0}])
def test_bad_parameters_are_named(still, change):
    with pytest.raises(ValueError, match=next(iter(change))):
        regression(still, **change)


def test_an_image_cannot_lie_before_what_was_fed(still):
    method = regression(still)
    with pytest.raises(ValueError, match="t_us must not lie before"):
        method.polarization(still.stop_us - 200_000)


# ---- computations and their twins ----------------------------------------------------


def test_sums_match_the_reference(still):
    method = regression(still, learn=False)
    (_, phase, rate), = method.segments
    tau = 12_500.0
    for x in 3, 17, 40:
        pixel = reference.Pixel(0.23, 0.27)
        for t, _, _, _, p in [(e["t"], 0, 0, 0, e["p"]) for e in still.events
                              if e["x"] == x]:
            pixel.event(float(t), int(p), phase + rate * float(t), rate, tau, 1.0)
        cell = method._cells[0, x]
        for name, value in {
                "a11": pixel.a[0, 0], "a12": pixel.a[0, 1], "a22": pixel.a[1, 1],
                "b1": pixel.b[0], "b2": pixel.b[1], "yy": pixel.yy, "n": pixel.n,
                "s1": pixel.s[0], "s2": pixel.s[1], "rest": pixel.rest}.items():
            assert cell[name] == pytest.approx(value, rel=2e-3, abs=2e-4), name


def test_thresholds_match_the_reference(still):
    method = regression(still, learn=False, events=still.events[:60_000])
    (_, phase, rate), = method.segments
    method._look()
    strong = np.flatnonzero(method._cells["scale"][0] < 0.15)
    assert len(strong) > 100
    for x in strong[:4]:
        pixel = reference.Pixel(0.23, 0.27)
        for event in still.events[:60_000]:
            if event["x"] == x:
                t = float(event["t"])
                pixel.event(t, int(event["p"]), phase + rate * t, rate, 12_500.0, 1.0)
        steps = np.clip(pixel.thresholds(0.23, 0.27, 0.3), -0.2, 0.2)
        np.testing.assert_allclose(
            np.log(method.thresholds[:, 0, x] / [0.23, 0.27]), steps, atol=3e-3)


@pytest.mark.parametrize("later_us", [0, 6000, 60_000])
def test_images_match_the_reference(still, later_us):
    method = regression(still, learn=False, threshold_sigma=0.02)
    (_, phase, rate), = method.segments
    t, tau = still.stop_us + later_us, 12_500.0
    found = method.polarization(t - method.lookahead_us)
    for x in 3, 17, 40:
        pixel = reference.Pixel(0.23, 0.27)
        for event in still.events[still.events["x"] == x]:
            at = float(event["t"])
            pixel.event(at, int(event["p"]), phase + rate * at, rate, tau, 1.0)
        q, along, across, s0 = pixel.read(
            t, tau, method.half_us, 0.06 / 2**0.5, method.common_sigma, 0.5)
        i0, i45, i90, i135 = found.quad[:, 0, x]
        np.testing.assert_allclose([i0 + i90, i0 - i90, i45 - i135],
                                   [s0, *(s0 * q)], rtol=3e-3, atol=1e-3)
        sigmas = found.sigmas[:, 0, x]
        np.testing.assert_allclose(
            sigmas[::2], [across / 2 / np.hypot(*q), across], rtol=0.01)
        assert sigmas[1] == pytest.approx(along, rel=0.06)   # atanh is a short series


def test_pixels_without_events_know_nothing(still):
    alone = at_end(regression(still, learn=False), still)
    shape, n = (40, 256), len(still.on)
    places = np.random.default_rng(1002).permutation(math.prod(shape))[:n]
    events = still.events.copy()
    events["y"], events["x"] = np.divmod(places[still.events["x"]], shape[1])
    method = regression(still, learn=False, events=events, shape=shape)
    found = at_end(method, still)
    seen = np.zeros(shape, bool)
    seen.flat[places] = True
    for name in alone._fields:
        here = getattr(found, name)
        np.testing.assert_array_equal(
            here.reshape(*here.shape[:-2], -1)[..., places],
            getattr(alone, name)[..., 0, :])
    assert np.all(found.quad[:, ~seen] == 0.5)
    assert not found.valid[~seen].any()
    np.testing.assert_allclose(
        found.sigmas[:, ~seen].T - [math.pi / math.sqrt(12), 0.5, 0.5], 0, atol=1e-6)


def test_events_taken_together_are_those_taken_one_by_one():
    rng = np.random.default_rng(1001)
    events = np.zeros(300, EVENT_DTYPE)
    events["t"] = np.sort(rng.integers(0, 300_000, 300))
    events["x"], events["p"] = rng.integers(0, 20, 300), rng.integers(0, 2, 300)
    cells = []
    for size in (300, 7, 1):
        one = TurningRegression(
            (1, 20), theta_on=0.2, theta_off=0.3, learn=False,
            segments=TurningAnalyser(rpm=600).segments())
        for at in range(0, 300, size):
            one.add_events(events[at:at + size])
        cells.append(one._cells.tobytes() + one._lasting.tobytes())
    assert cells[0] == cells[1] == cells[2]


def test_the_kernel_stops_at_the_first_bad_event(still):
    method = regression(still, learn=False)
    cells, lasting, seen = method._cells, method._lasting, method._seen
    events = np.zeros(4, EVENT_DTYPE)
    events["t"] = 10, 20, 15, 30
    take = _kernels.turning_events
    assert take(events, 0, cells, lasting, seen, method.segments, 1e4, 1.0) == 2
    events["t"], events["x"] = 40, (0, len(still.on), 0, 0)
    assert take(events, 0, cells, lasting, seen, method.segments, 1e4, 1.0) == 1
    assert take(events[:0], 0, cells, lasting, seen, method.segments, 1e4, 1.0) == 0
    with pytest.raises(ValueError, match="segments must be"):
        take(events, 0, cells, lasting, seen, np.zeros((0, 3)), 1e4, 1.0)
    with pytest.raises(ValueError, match="lasting and seen must be as many as cells"):
        take(events, 0, cells, lasting[:, 1:], seen, method.segments, 1e4, 1.0)
    planes = np.zeros((8, *cells.shape), np.float32)
    with pytest.raises(ValueError, match="planes must be those of cells"):
        _kernels.turning_images(
            cells, seen, 0.0, 1e4, 1e4, 0.5, 0.1, planes[0], planes[1:],
            np.zeros((1, 1), np.uint8))


# ---- fuse() and the commands ---------------------------------------------------------


def last_image(recording, scene, **options):
    image, = pdavis_cv.fuse(recording, times_us=[scene.stop_us - 40_000], **options)
    return image, (image.aop[0, ::16] - scene.aop + np.pi / 2) % np.pi - np.pi / 2


@pytest.fixture(scope="module")
def few():
    return Still(40, seconds=1.5, degree=(0.35, 0.95))


@pytest.mark.parametrize("causal", [False, True])
def test_fuse_takes_a_stated_speed(few, causal):
    image, angle = last_image(as_recording(few), few, causal=causal,
                              analyser=TurningAnalyser(rpm=1200))
    assert rms(np.rad2deg(angle)) < 1
    assert rms(image.dolp[0, ::16] - few.dolp) < 0.04
    assert image.valid[0, ::16].all()
    assert not image.valid[0, 5::16].any()
    assert image.sigma_aop is not None
    assert (image.sigma_dolp[0, ::16] < 0.1).all()
    assert "relative" in image.provenance["assumed"][0]
    again = pickle.loads(pickle.dumps(image))
    np.testing.assert_array_equal(again.sigma_aop, image.sigma_aop)


@pytest.mark.parametrize("causal", [False, True])
def test_a_recording_without_pulses_has_no_angle(few, causal):
    with pytest.raises(ValueError, match="has no trigger pulses; state rpm"):
        pdavis_cv.fuse(as_recording(few), causal=causal,
                       analyser=TurningAnalyser(triggers=1))


@pytest.mark.parametrize("causal", [False, True])
def test_fuse_takes_pulses(few, causal):
    pulses_us = 50_000 * np.arange(31)
    recording = as_recording(few, np.delete(pulses_us, 12))
    _, angle = last_image(recording, few, causal=causal,
                          analyser=TurningAnalyser(triggers=1))
    assert rms(np.rad2deg(angle)) < 1


def test_a_slow_start_spoils_no_thresholds():
    pulses_us, (at, turns) = pulses(20.0, 2.5, ramp=1.0)

    class Starting(Still):
        def light(self, t):
            angle = 2 * np.pi * np.interp(t * 1e6, at, turns)
            return 1 + self.dolp * np.cos(2 * (angle - self.aop))

    scene = Starting(24, seconds=2.5, degree=(0.35, 0.95), step=2e-4)
    image, _ = last_image(as_recording(scene, pulses_us), scene,
                          analyser=TurningAnalyser(triggers=1))
    error = np.abs(image.dolp[0, ::16] - scene.dolp)
    assert rms(error) < 0.02
    assert np.mean(error < image.sigma_dolp[0, ::16]) > 0.55


@pytest.mark.parametrize(("hz", "n"), [(3, 1), (3, 12), (20, 1), (40, 1), (40, 12)])
def test_a_stream_learns_from_its_first_pulses_on(hz, n):
    """Before them the speed is not known; then window and estimates are as it says."""
    scene = Still(24, hz=hz, seconds=40 / hz + 0.5, degree=(0.35, 0.95), step=1e-4)
    times = np.arange(0, scene.stop_us, 1e6 / (hz * n))
    clock = PulseClock(TurningAnalyser(triggers=n))
    method = TurningRegression((1, 24), theta_on=0.23, theta_off=0.27, centred=False,
                               segments=clock)
    for start, stop in itertools.pairwise(range(0, scene.stop_us + 5000, 5000)):
        clock.add(times[(times >= start) & (times < stop)])
        t = scene.events["t"]
        method.add_events(scene.events[(t >= start) & (t < stop)])
    assert method.half_us == pytest.approx(5e5 / hz, rel=1e-3)
    found = method.polarization(scene.stop_us)
    angle, degree = errors(found, scene.dolp, scene.aop)
    assert rms(np.rad2deg(angle)) < 0.3
    assert rms(degree) < 0.02
    assert np.mean(np.abs(degree) < found.sigmas[1, 0]) > 0.55


def test_a_clock_keeps_the_last_pulses_only():
    clock = PulseClock(TurningAnalyser(triggers=12))
    for start in range(0, 100_000, 1000):
        clock.add(4000 * np.arange(start, start + 1000))
    assert len(clock.kept) < 6000
    assert turned(clock.segments(), 400e6) == pytest.approx(100_000 / 12)


def test_the_thresholds_of_a_short_file_are_learned_from_all_of_it():
    short = Still(40, seconds=0.25, degree=(0.35, 0.95))    # ten half turns
    image, _ = last_image(as_recording(short), short,
                          analyser=TurningAnalyser(rpm=1200))
    error = np.abs(image.dolp[0, ::16] - short.dolp)
    assert rms(error) < 0.012
    assert np.mean(error < image.sigma_dolp[0, ::16]) > 0.55


def test_fuse_finds_the_speed_up_to_the_zero(few):
    image, angle = last_image(as_recording(few), few, analyser=TurningAnalyser())
    zero = np.angle(np.exp(2j * angle).mean()) / 2
    rest = (angle - zero + np.pi / 2) % np.pi - np.pi / 2
    assert rms(np.rad2deg(rest)) < 1
    assert "zero of its angle and its direction are unknown" in (
        image.provenance["assumed"][0])


def test_an_image_of_a_region_is_the_crop(few):
    recording = as_recording(few)
    whole, _ = last_image(recording, few, analyser=TurningAnalyser(rpm=1200))
    part, = pdavis_cv.fuse(recording, times_us=[few.stop_us - 40_000], roi=(
        32, 0, 64, 1), analyser=TurningAnalyser(rpm=1200, phase=0.0))
    assert part.shape == (1, 64)
    np.testing.assert_allclose(
        part.dolp[0, ::16], whole.dolp[0, 32:96:16], atol=0.01)


@pytest.mark.parametrize("options", [
    {"analyser": TurningAnalyser(rpm=1200)}, {"analyser": TurningAnalyser()},
    {"analyser": TurningAnalyser(rpm=1200), "causal": True, "roi": (32, 0, 64, 1)}])
def test_a_capture_goes_to_any_image_exactly(few, options):
    recording = as_recording(few)
    images = list(pdavis_cv.fuse(recording, fps=10, **options))
    cap = pdavis_cv.VideoCapture(recording, fps=10, **options)
    assert (cap.get(7), cap.get(5), cap.get(3)) == (15, 10, images[0].shape[1])
    seen = []
    while cap.grab():
        seen.append(cap.retrieve(flag=pdavis_cv.CAP_PDAVIS_AOP)[1])
    np.testing.assert_array_equal(seen, [image.aop for image in images])
    for i in (9, 3, 12):
        assert cap.set(1, i)
        assert cap.grab()
        assert cap.get(0) == (images[i].t_us - images[0].t_us) / 1000
        for name in ("DOLP", "S0"):
            _, plane = cap.retrieve(flag=getattr(pdavis_cv, f"CAP_PDAVIS_{name}"))
            np.testing.assert_array_equal(plane, getattr(images[i], name.lower()))
    assert cap.retrieve(flag=pdavis_cv.CAP_PDAVIS_EVENTS_BGR)[0]
    cap.release()


def test_a_grid_of_images_has_a_length(few):
    images = pdavis_cv.fuse(as_recording(few), fps=10,
                            analyser=TurningAnalyser(rpm=1200))
    assert len(images) == len(list(images)) == 15


@pytest.mark.parametrize(("options", "match"), [
    ({"method": "cf"}, "excludes method"), ({"layout": "pdavis"}, "excludes layout"),
    ({"causal": True}, "must state rpm or triggers")])
def test_options_that_do_not_fit_are_named(few, options, match):
    with pytest.raises(ValueError, match=match):
        pdavis_cv.fuse(as_recording(few), analyser=TurningAnalyser(), **options)


def test_the_analyser_must_be_one(few):
    with pytest.raises(TypeError, match="of images: analyser_steps of open"):
        pdavis_cv.fuse(as_recording(few), analyser=3)


@pytest.fixture(scope="module")
def file(few, tmp_path_factory):
    path = tmp_path_factory.mktemp("turning") / "turning.aedat4"
    pdavis_cv.write_aedat4(path, as_recording(few, 50_000 * np.arange(31)))
    return path


@pytest.mark.parametrize("given", [
    ["--analyser-rpm", "1200"], ["--trigger", "0"],
    ["--analyser-rpm", "1200", "--trigger", "0", "--trigger-pulses", "1"],
    ["--analyser-found"]])
def test_export_takes_the_analyser(file, few, tmp_path, given):
    out = tmp_path / "out.npy"
    assert main(["export", str(file), "-o", str(out), "--quantities", "dolp", "--at",
                 "1.4", *given]) == 0
    assert rms(np.load(out)[0, 0, 0, ::16] - few.dolp) < 0.04


def test_a_speed_that_cannot_be_is_one_line(file, tmp_path, capsys):
    assert main(["export", str(file), "-o", str(tmp_path / "a.npy"),
                 "--analyser-rpm", "0"]) == 2
    assert "rpm must lie in" in capsys.readouterr().err


def test_info_tells_a_modulation(file, capsys):
    assert main(["info", str(file), "--scan"]) == 0
    said = capsys.readouterr().out
    assert "modulated at 40.0" in said
    assert "flicker" not in said
