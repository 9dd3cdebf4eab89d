"""fuse() on a source that is read once: the same bits, bounded memory, no look back."""
import itertools
import warnings

import numpy as np
import pytest

from pdavis_cv import (
    ApsFrame,
    Layout,
    Packet,
    RecordingInfo,
    fuse,
    recording_from_arrays,
    source_from_packets,
)
from pdavis_cv.events import EVENT_DTYPE
from pdavis_cv.fusion import Fusion
from pdavis_cv.pixel.model import PixelModel
from pdavis_cv.reconstruct.base import nbytes
from pdavis_cv.simulation import Camera, RotatingPolarizer

NOMINAL = (0.16, 0.18)
MODEL = PixelModel(theta=np.array([0.18, 0.16]))
METHODS = [
    {"method": "frames"}, {"method": "cf"}, {"method": "kalman"},
    {"method": "kalman", "model": MODEL},
    {"method": "kalman", "denoise": True}, {"method": "kalman", "roi": (2, 2, 4, 4)},
    {"method": "events"}, {"method": "events", "offsets": "redundancy"},
    {"method": "firenet"}, {"method": "joint"},
]


@pytest.fixture(scope="module")
def recording():
    camera = Camera.preset("realistic", seed=4, size=(8, 8))
    return camera.record(RotatingPolarizer(rpm=202.6, start_angle=0.3), 0.55)[0]


def once(recording, packets=None):
    """The packets of a recording, from a generator, of which nothing else is known."""
    info = RecordingInfo(format="live", sensor_size=recording.info.sensor_size,
                         sensor=recording.info.sensor, layout=recording.info.layout)
    return source_from_packets(
        info, (p for p in packets or recording.packets()))


def cut_otherwise(recording, seed):
    """The same samples in other packets."""
    rng = np.random.default_rng(seed)
    for packet in recording.packets():
        events, start = packet.events, 0
        for stop in [*sorted(rng.integers(0, len(events) + 1, 3)), len(events)]:
            before = None if not packet.frames else np.searchsorted(
                events["t"], packet.frames[0].available_us, "right")
            if before is not None and start <= before <= stop:
                yield Packet(events=events[start:before].copy())
                yield Packet(frames=packet.frames)
                packet.frames, start = (), before
            yield Packet(events=events[start:stop].copy())
            start = stop
        if packet.frames:
            yield Packet(frames=packet.frames)


def assert_same(images, others):
    images, others = list(images), list(others)
    assert len(images) == len(others) > 5
    for one, two in zip(images, others, strict=True):
        assert (one.t_us, one.frame_us) == (two.t_us, two.frame_us)
        np.testing.assert_array_equal(one.quad, two.quad)
        np.testing.assert_array_equal(one.valid, two.valid)
        if one.variance is not None:
            np.testing.assert_array_equal(one.variance, two.variance)


@pytest.mark.parametrize("grid", [
    {"fps": 23}, pytest.param({}, marks=pytest.mark.gate)])
@pytest.mark.parametrize("options", METHODS, ids=lambda options: " ".join(
    str(value) for key, value in options.items() if key != "model"))
@pytest.mark.parametrize("causal", [True, False])
def test_one_pass_gives_the_bits_of_the_recording(recording, options, grid, causal):
    if "denoise" in options and not causal:
        pytest.skip("the same path as without")
    options = {**options, **grid, "causal": causal, "nominal_thresholds": NOMINAL}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)   # windows too long for a network
        assert_same(fuse(recording, **options), fuse(once(recording), **options))


@pytest.mark.parametrize("seed", [1, 2])
@pytest.mark.parametrize("options", [{"method": "cf"}, {"method": "kalman"}], ids=str)
def test_how_the_stream_is_cut_into_packets_does_not_matter(recording, options, seed):
    options = {**options, "fps": 23, "causal": True, "nominal_thresholds": NOMINAL}
    packets = list(cut_otherwise(recording, seed))
    assert_same(fuse(recording, **options), fuse(once(recording, packets), **options))


def test_calls_do_not_matter_either(recording):
    """An image is the same whichever images were asked for before it."""
    options = {"method": "kalman", "causal": True, "nominal_thresholds": NOMINAL}
    times = np.arange(100_000, 500_000, 39_777)
    many = {image.t_us: image for image in fuse(recording, times_us=times, **options)}
    for t in times[4::9]:
        alone, = fuse(once(recording), times_us=[t], **options)
        np.testing.assert_array_equal(alone.quad, many[t].quad)


def test_in_situ_thresholds_of_a_source_are_those_of_the_recording(recording):
    options = {"method": "cf", "thresholds": "in-situ", "fps": 20,
               "nominal_thresholds": NOMINAL}
    assert_same(fuse(recording, **options), fuse(once(recording), **options))


def test_what_needs_a_second_look_says_so(recording):
    fusion = Fusion(once(recording), method="cf", fps=20, thresholds=NOMINAL)
    fusion.rewind()                       # nothing has been read yet
    next(fusion)
    with pytest.raises(ValueError, match="got a Source that is read once"):
        fusion.restore(fusion.snapshot())


def endless(fps=20, size=(8, 8)):
    """A stream without an end, and how much of it has been taken."""
    rng = np.random.default_rng(0)
    taken = [0]

    def packets():
        for k in itertools.count():
            start = k * 10_000
            events = np.zeros(200, EVENT_DTYPE)
            events["t"] = start + np.sort(rng.integers(0, 9_000, 200))
            events["y"], events["x"] = rng.integers(0, size[0], (2, 200))
            events["p"] = rng.integers(0, 2, 200)
            frames = ()
            if fps and k % (100 // fps) == 0:
                frames = (ApsFrame(rng.uniform(50, 60, size), start - 9_000,
                                   start + 1_000, available_us=start + 9_500),)
            taken[0] = start
            yield Packet(events=events, frames=frames)

    info = RecordingInfo(format="endless", sensor_size=size, layout=Layout.PDAVIS)
    return source_from_packets(info, packets()), taken


@pytest.mark.parametrize(("options", "wait_us"), [
    ({"causal": True, "method": "cf"}, 20_000),
    ({"causal": True}, 20_000),
    ({"method": "cf"}, 220_000),
    ({"clock_offset_us": None, "model": MODEL}, 280_000),
    ({"mode": "offline", "clock_offset_us": None, "model": MODEL}, 800_000),
], ids=str)
def test_no_image_waits_for_more_than_it_needs(options, wait_us):
    source, taken = endless()
    for image in itertools.islice(fuse(source, fps=50, **options), 100):
        assert taken[0] - image.t_us <= wait_us


@pytest.mark.parametrize("options", [
    {"method": "cf", "causal": True},
    pytest.param({"method": "kalman", "causal": True}, marks=pytest.mark.gate),
    pytest.param({"method": "kalman", "model": MODEL}, marks=pytest.mark.gate),
    {"method": "cf"}], ids=str)
def test_what_is_held_does_not_grow_with_the_stream(options):
    source, _ = endless()
    fusion = Fusion(source, fps=1, **options)
    held = []
    for k in range(60):
        assert fusion.advance()
        if k in (20, 59):         # after what is learned has been learned
            held.append(nbytes([fusion._state, fusion._feed, fusion._lamp,
                                fusion._online, fusion._frames]))
    assert held[1] < 1.3 * held[0]


def test_where_frames_stay_away_nothing_piles_up():
    """One image per frame, and then no frame any more: events are still taken in."""
    source, taken = endless(fps=20)

    def frames_stop(packets):
        for packet in packets:
            yield packet if taken[0] < 300_000 else Packet(events=packet.events)
            if taken[0] > 30_000_000:
                return

    stopping = source_from_packets(source.info, frames_stop(source.packets()))
    fusion = Fusion(stopping, causal=True, method="cf")
    most = 0
    while fusion.advance():
        most = max(most, nbytes(fusion._feed))
    assert nbytes(fusion._feed) < 2_200_000 / 10_000 * 200 * EVENT_DTYPE.itemsize + most


def test_without_frames_the_grid_begins_at_the_first_event():
    source, _ = endless(fps=0)
    times = [image.t_us for image in itertools.islice(
        fuse(source, method="events", causal=True), 3)]
    assert np.diff(times).tolist() == [10_000, 10_000]
    assert times[0] < 9_000


def test_a_learned_parameter_changes_at_its_time_and_not_before(recording):
    options = {"method": "kalman", "causal": True, "nominal_thresholds": NOMINAL}
    first = Fusion(recording, fps=10, **options).start_us
    # Of a look after .1 s, an eighth later.
    times = [first + 112_499, first + 112_500]
    before, after = fuse(once(recording), times_us=times, **options)
    known = [image.provenance["parameters"]["model"] for image in (before, after)]
    assert known[0] != known[1]


def test_short_recordings_do_not_fail():
    """A polarizer that hardly turns makes few events; learning says so and goes on."""
    camera = Camera.preset("nominal", seed=1, size=(8, 8))
    for rpm, seconds in ((10, 0.6), (30, 0.3), (100, 0.25)):
        made, _ = camera.record(RotatingPolarizer(rpm=rpm, start_angle=0.785), seconds)
        for causal in (True, False):
            images = list(fuse(made, fps=100, causal=causal))
            assert len(images) > 10


def test_an_empty_source_gives_no_image():
    info = RecordingInfo(format="live", sensor_size=(4, 4), layout=Layout.PDAVIS)
    for options in ({}, {"causal": True}, {"fps": 10}):
        assert list(fuse(source_from_packets(info, []), **options)) == []
    nothing = recording_from_arrays(None, sensor_size=(4, 4), layout=Layout.PDAVIS)
    assert list(fuse(nothing)) == []
