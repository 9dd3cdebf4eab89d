"""fuse(): the order of time, the grid, regions, and what it refuses."""
import itertools
import pickle
import warnings
from fractions import Fraction

import numpy as np
import pytest
from ideal import rotating_polarizer

import pdavis_cv
from pdavis_cv import ApsFrame, Layout, fuse, recording_from_arrays
from pdavis_cv.fusion import Fusion

THETA = (0.15, 0.15)


@pytest.fixture(scope="module")
def polarizer():
    """A rotating polarizer at 200 RPM x 1.013, one second, 12x14 pixels."""
    return rotating_polarizer(202.6, 1.0, size=(12, 14))


def arrays(image):
    return image.t_us, image.frame_us, image.quad, image.aop, image.dolp, image.valid


def assert_same(one, other):
    for a, b in zip(arrays(one), arrays(other), strict=True):
        np.testing.assert_array_equal(a, b)


def tiny(events=(), frames=(), size=(4, 4), **kwargs):
    stream = np.zeros(len(events), pdavis_cv.EVENT_DTYPE)
    stream["t"] = events
    return recording_from_arrays(stream, frames, sensor_size=size,
                                 layout=Layout.PDAVIS, **kwargs)


def frame(start, end, value=100.0, available=None, size=(4, 4)):
    return ApsFrame(np.full(size, value), start, end, available_us=available)


# ---- the grid -----------------------------------------------------------------


@pytest.mark.parametrize("fps", [30, 29.97, 1000, 7])
def test_the_grid_is_exact_and_half_open(polarizer, fps):
    recording, _ = polarizer
    times = [image.t_us for image in fuse(
        recording, fps=fps, thresholds=THETA, clock_offset_us=None)]
    start, stop = 10_000, recording.info.stop_us   # mid-exposure of the first frame
    expected = list(itertools.takewhile(
        lambda t: t < stop,
        (start + round(Fraction(k * 1_000_000) / Fraction(fps))
         for k in itertools.count())))
    assert times == expected


def test_without_a_rate_there_is_one_image_per_frame_at_its_mid_exposure(polarizer):
    recording, _ = polarizer
    mids = [f.mid_us for packet in recording.packets() for f in packet.frames]
    for causal in (False, True):
        images = list(fuse(
            recording, thresholds=THETA, causal=causal, clock_offset_us=None))
        assert [image.t_us for image in images] == mids


def test_without_frames_there_are_100_images_per_second_from_the_first_event():
    recording = tiny([5_000, 26_000])
    times = [image.t_us for image in fuse(recording, method="cf")]
    assert times == [5_000, 15_000, 25_000]


def test_an_empty_recording_gives_no_image():
    recording = tiny()
    assert list(fuse(recording)) == []
    assert list(fuse(recording, fps=100)) == []


def test_given_times_are_taken_also_outside_the_recording(polarizer):
    recording, _ = polarizer
    times = [-80_000, 500_000, 9_000_000]
    images = list(fuse(recording, times_us=times))
    assert [image.t_us for image in images] == times
    assert not images[0].valid.any()
    assert images[1].valid.all()


def test_start_and_stop_choose_images_but_do_not_change_them(polarizer):
    recording, _ = polarizer
    whole = {i.t_us: i for i in fuse(recording, fps=200, start_us=0)}
    part = list(fuse(recording, fps=200, start_us=400_000, stop_us=450_000))
    assert [i.t_us for i in part] == list(range(400_000, 450_000, 5_000))
    for image in part:
        assert_same(image, whole[image.t_us])


# ---- time ---------------------------------------------------------------------


def test_a_frame_acts_from_mid_exposure_and_causally_from_its_arrival():
    frames = [frame(0, 2_000, 100, 3_000), frame(50_000, 60_000, 400, 70_000)]
    recording = tiny([1_500], frames)
    times = [54_999, 55_000, 69_999, 70_000]
    level = {
        causal: [float(i.quad[0, 2, 2]) for i in fuse(
            recording, times_us=times, method="cf", causal=causal,
            adaptive_gain=False, cutoff_hz=1e5)]
        for causal in (False, True)}
    # DN per ms: 100 / 2 before, 400 / 10 after; the cut-off lets nothing linger.
    np.testing.assert_allclose(level[False], [50, 50, 40, 40], rtol=1e-5)
    np.testing.assert_allclose(level[True], [50, 50, 50, 40], rtol=1e-5)


def test_held_frames_change_when_their_readout_ends():
    frames = [frame(0, 2_000, 100, 3_000), frame(50_000, 60_000, 400, 70_000)]
    recording = tiny(frames=frames)
    times = [2_999, 3_000, 55_000, 69_999, 70_000]
    images = list(fuse(recording, times_us=times))
    assert [i.frame_us for i in images] == [None, 1_000, 1_000, 1_000, 55_000]
    assert [bool(i.valid.any()) for i in images] == [False, True, True, True, True]
    held = list(fuse(recording, times_us=times, hold="mid"))
    assert [i.frame_us for i in held] == [1_000, 1_000, 55_000, 55_000, 55_000]
    np.testing.assert_allclose([i.quad[0, 0, 0] for i in held], [50, 50, 40, 40, 40])


def test_causal_is_what_would_have_been_seen_live(polarizer):
    """Cutting the recording at t leaves causal images up to t as they were."""
    recording, _ = polarizer
    packets = list(recording.packets())
    cut = 500_000
    events = np.concatenate([p.events for p in packets])
    frames = [f for p in packets for f in p.frames]
    past = recording_from_arrays(
        events[events["t"] < cut], [f for f in frames if f.available_us < cut],
        sensor_size=(12, 14), layout=recording.info.layout)
    times = range(300_000, cut - 10_000, 7_001)
    for one, other in zip(
            fuse(recording, times_us=times, causal=True, thresholds=THETA),
            fuse(past, times_us=times, causal=True, thresholds=THETA), strict=True):
        assert_same(one, other)


def test_causal_equals_acausal_between_arrival_and_the_next_exposure(polarizer):
    recording, _ = polarizer
    # Frames: exposed [0, 20) ms, read out by 32 ms, every 50 ms.
    times = [k * 50_000 + 40_000 for k in range(1, 19)]
    for one, other in zip(
            fuse(recording, method="cf", times_us=times, causal=True, thresholds=THETA),
            fuse(recording, method="cf", times_us=times, thresholds=THETA),
            strict=True):
        assert_same(one, other)


def test_a_frame_that_arrives_too_late_is_left_out_with_a_warning():
    frames = [frame(0, 2_000), frame(20_000, 30_000, available=900_000)]
    recording = tiny(range(1_000, 2_000_000, 1_000), frames)
    with pytest.warns(pdavis_cv.ExposureWarning, match="left out"):
        images = list(fuse(recording, fps=10, method="cf"))
    assert images[-1].frame_us == 1_000


# ---- regions and copies ---------------------------------------------------------


@pytest.mark.parametrize("options", [
    {"method": "frames"}, {"method": "cf"}, {"method": "kalman"},
    {"method": "kalman", "mode": "offline"},
    {"method": "kalman", "demosaic": "guided"}])
@pytest.mark.parametrize("roi", [
    (0, 0, 14, 12), (0, 0, 1, 1), (13, 11, 1, 1), (3, 5, 4, 2), (5, 0, 6, 7),
    (1, 1, 12, 10)])
def test_a_region_equals_the_crop_of_the_whole(polarizer, roi, options):
    recording, _ = polarizer
    x, y, w, h = roi
    options = {"times_us": [200_000, 433_333], "thresholds": THETA, **options}
    for whole, part in zip(fuse(recording, **options),
                           fuse(recording, roi=roi, **options), strict=True):
        for name in ("quad", "s0", "s1", "s2", "aop", "dolp", "valid"):
            np.testing.assert_array_equal(
                getattr(part, name), getattr(whole, name)[..., y:y + h, x:x + w])


@pytest.mark.parametrize("demosaic", ["superpixel", "binned"])
def test_a_region_of_cells_equals_the_crop_of_the_whole(polarizer, demosaic):
    recording, _ = polarizer
    whole, = fuse(recording, times_us=[433_333], demosaic=demosaic)
    part, = fuse(recording, times_us=[433_333], demosaic=demosaic, roi=(2, 4, 6, 8))
    assert whole.aop.shape == (6, 7)
    np.testing.assert_array_equal(part.aop, whole.aop[2:6, 1:4])


def test_images_are_different_and_read_only(polarizer):
    recording, _ = polarizer
    images = list(fuse(recording, fps=100, thresholds=THETA))
    assert len({image.quad.tobytes() for image in images}) == len(images)
    with pytest.raises(ValueError, match="read-only"):
        images[0].quad[0, 0, 0] = 1


def test_images_of_one_held_frame_share_their_arrays(polarizer):
    recording, _ = polarizer
    images = [image for image in fuse(recording, method="frames", fps=400)
              if image.frame_us is not None]
    assert len({image.t_us for image in images}) == len(images)
    by_frame = {}
    for image in images:
        shared = by_frame.setdefault(image.frame_us, image)
        for name in ("quad", "s0", "aop"):
            assert np.shares_memory(getattr(image, name), getattr(shared, name))
    assert len(by_frame) > 2


@pytest.mark.parametrize("causal", [False, True])
@pytest.mark.parametrize("options", [
    {"method": "frames"}, {"method": "cf"}, {"method": "kalman"},
    {"method": "kalman", "mode": "offline"}])
def test_a_snapshot_continues_with_the_same_images(polarizer, options, causal):
    recording, _ = polarizer
    arguments = {"fps": 43, "causal": causal, "thresholds": THETA, **options}
    if causal and options.get("mode") == "offline":
        with pytest.raises(ValueError, match="kalman needs 500000 us"):
            fuse(recording, **arguments)
        return
    images = list(fuse(recording, **arguments))
    for stop in (1, 21, len(images)):
        fusion = Fusion(recording, **arguments)
        for _ in range(stop):
            assert fusion.advance()
        other = Fusion(recording, **arguments)
        other.restore(pickle.loads(pickle.dumps(fusion.snapshot())))
        assert_same(other.image(), images[stop - 1])
        rest = list(other)
        assert len(rest) == len(images) - stop
        for one, two in zip(rest, images[stop:], strict=True):
            assert_same(one, two)


# ---- accuracy: bounds are in test_accuracy.py ---------------


@pytest.mark.parametrize("options", [
    {"method": "frames"}, {"method": "kalman", "fps": 37},
    {"method": "kalman", "fps": 37, "causal": True}, {"method": "cf", "causal": True}])
def test_what_frames_tell_of_full_pixels_goes_with_the_stream(options):
    rng = np.random.default_rng(8)
    frames = []
    for k in range(8):
        dn = rng.normal(200, 2, (24, 24)).astype(np.float32)
        dn[:6 if k == 2 else 2, :20] = 900    # only this one shows a pile-up
        frames.append(ApsFrame(dn, 40_000 * k, 40_000 * k + 10_000))
    recording = tiny(range(0, 320_000, 1000), frames, size=(24, 24))
    options |= {"thresholds": THETA}
    images = list(fuse(recording, **options))
    if options["method"] == "frames":  # others go on from what frames said before
        clear = [bool(image.valid[0, 4:12].all()) for image in images]
        assert clear == [False, True, True, False, False, False, False, False]

    middle = len(images) // 2 + 1
    fusion = Fusion(recording, **options)
    for _ in range(middle):
        next(fusion)
    other = Fusion(recording, **options)
    other.restore(pickle.loads(pickle.dumps(fusion.snapshot())))
    for want, got in zip(images[middle:], other, strict=True):
        assert_same(want, got)
    late = list(fuse(recording, times_us=[images[-1].t_us], **{
        **options, "fps": None}))
    assert_same(late[0], images[-1])


def test_the_extinction_ratio_is_divided_out(polarizer):
    recording, _ = polarizer
    t = [360_000]          # mid-exposure of a frame
    plain, = fuse(recording, times_us=t, method="cf", extinction_ratio=None)
    corrected, = fuse(recording, times_us=t, method="cf")
    np.testing.assert_allclose(corrected.dolp, plain.dolp * 41 / 39, rtol=1e-5)


def test_thresholds_from_biases_are_those_of_the_shipped_davis346_settings():
    from pdavis_cv.calibration.thresholds import thresholds_from_biases

    def current(coarse, fine):      # formats: I = 389 nA * 8^(b-5) * fine/256, b = 7-c
        return 389e-9 * 8.0 ** (7 - coarse - 5) * fine / 256
    on, off = thresholds_from_biases({
        "DiffBn": current(3, 138), "OnBn": current(1, 45), "OffBn": current(5, 225)})
    assert (round(on, 3), round(off, 3)) == (0.217, 0.262)


# ---- refusals -------------------------------------------------------------------


@pytest.mark.parametrize(("arguments", "error", "message"), [
    ({"method": "magic"}, ValueError, "method must be one of frames, "),
    ({"method": "cf", "cutof_hz": 1.0}, TypeError,
     "no parameter 'cutof_hz'; it takes cutoff_hz"),
    ({"fps": 0}, ValueError, "fps must lie in"),
    ({"fps": float("nan")}, ValueError, "fps must lie in"),
    ({"fps": "fast"}, ValueError, "fps must lie in"),
    ({"fps": 5, "times_us": [1]}, TypeError, "excludes"),
    ({"times_us": [1.5]}, TypeError, "integer microseconds"),
    ({"times_us": [2, 2]}, ValueError, "must increase"),
    ({"start_us": 1.5}, TypeError, "start_us must be integer"),
    ({"roi": (0, 0, 15, 12)}, ValueError, "inside the 14x12 sensor"),
    ({"roi": (0, 0, 1.5, 2)}, TypeError, "four integers"),
    ({"roi": (1, 0, 2, 2), "demosaic": "superpixel"}, ValueError, "even numbers"),
    ({"demosaic": "magic"}, ValueError, "demosaic must be"),
    ({"layout": 3201}, TypeError, "must be a Layout or its name, got int"),
    ({"layout": "sonny"}, pdavis_cv.LayoutError, "pdavis, sony or four angles"),
    ({"layout": Layout.SONY}, pdavis_cv.LayoutError, "one of them is wrong"),
    ({"extinction_ratio": 1}, ValueError, "must exceed 1"),
    ({"thresholds": (0.1, -0.1)}, ValueError, "positive magnitudes"),
    ({"thresholds": (0.1, np.ones((3, 3)))}, ValueError, r"shape \(12, 14\)"),
    ({"thresholds": "guess"}, ValueError, "thresholds must be"),
    ({"thresholds": "bias"}, ValueError, "DiffBn"),
    ({"thresholds": "calibration"}, ValueError, "needs a calibration"),
    ({"calibration": pdavis_cv.Calibration(sensor_size=(4, 4))},
     pdavis_cv.CalibrationError, "sensor"),
    ({"calibration": "file"}, TypeError, "must be a Calibration"),
])
def test_bad_arguments_are_refused_at_the_call(polarizer, arguments, error, message):
    with pytest.raises(error, match=message):
        fuse(polarizer[0], **arguments)


def test_an_unknown_layout_is_assumed_with_one_warning():
    recording = recording_from_arrays(
        None, [frame(0, 2_000)], sensor_size=(4, 4))
    with pytest.warns(pdavis_cv.LayoutWarning, match="SONY"):
        list(fuse(recording))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        list(fuse(recording))
        list(fuse(recording, layout=Layout.SONY))
