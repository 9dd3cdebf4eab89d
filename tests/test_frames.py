import pickle

import numpy as np
import pytest
import reference
from streams import feed, random_events, random_frame

from pdavis_cv import ApsFrame
from pdavis_cv.reconstruct.frames import FrameHold, log_exposure, log_samples

SHAPE = (6, 8)


@pytest.mark.parametrize("shape", [(0, 0), (1, 1), (3, 5), (260, 346)])
@pytest.mark.parametrize("marked", [True, False])
def test_log_samples_match_reference(shape, marked):
    frame = random_frame(shape, 50_000)
    if not marked:
        frame = ApsFrame(frame.dn, frame.exposure_start_us, frame.exposure_end_us)
    frame.dn.flags.writeable = False
    log, valid = log_samples(frame)
    usable = frame.valid if marked else np.ones(shape, bool)
    want, want_valid = reference.log_frame(frame.dn, usable, np.log(10))
    np.testing.assert_allclose(log, want, atol=1e-6)
    np.testing.assert_array_equal(valid, want_valid)


def test_log_is_accurate_over_the_whole_range():
    dn = np.geomspace(1, 1e6, 20_000, dtype=np.float32).reshape(100, 200)
    log, _ = log_samples(ApsFrame(dn, 0, 0))
    np.testing.assert_allclose(log, np.log(dn.astype(float)), rtol=2e-7, atol=1e-9)


def test_exposure_is_known_per_column():
    start = np.array([0, 10, 20])
    frame = ApsFrame(np.ones((2, 3)), start, start + np.array([1000, 0, 20_000]))
    np.testing.assert_allclose(log_exposure(frame), np.log([1, 1, 20]), rtol=1e-6)


@pytest.mark.parametrize(("hold", "at"), [("readout", 57_000), ("mid", 50_000)])
def test_a_frame_is_shown_from_the_moment_that_hold_says(hold, at):
    method = FrameHold(SHAPE, hold=hold)
    frame = random_frame(SHAPE, 50_000)
    assert (frame.mid_us, frame.available_us) == (50_000, 57_000)
    method.add_frame(frame)
    assert not FrameHold(SHAPE).read(0).valid.any()
    log, valid = log_samples(frame)
    if at > frame.mid_us:
        assert not method.read(at - 1).valid.any()
    estimate = method.read(at)
    np.testing.assert_array_equal(estimate.log_intensity, log)
    np.testing.assert_array_equal(estimate.valid, valid)


def test_frames_queue_until_their_readout_has_ended():
    # Exposures overlap with the readouts of the frames before.
    frames = [ApsFrame(np.full(SHAPE, 10.0 + i), t, t, available_us=t + 250)
              for i, t in enumerate(range(0, 1000, 100))]
    method = FrameHold(SHAPE)
    seen = []
    for frame in frames:
        method.add_frame(frame)
        value = method.read(frame.mid_us).log_intensity[0, 0]
        seen.append(round(float(np.exp(value))))
    assert seen == [1, 1, 1, *range(10, 17)]
    assert round(float(np.exp(method.read(5000).log_intensity[0, 0]))) == 19


def test_events_change_nothing_but_the_time():
    method = FrameHold(SHAPE)
    events = random_events(100, SHAPE, stop_us=200_000)
    feed(method, events, [random_frame(SHAPE, 50_000)])
    np.testing.assert_array_equal(
        method.read(200_000).log_intensity, log_samples(random_frame(SHAPE, 50_000))[0])
    with pytest.raises(ValueError, match="t_us must not lie before"):
        method.read(int(events["t"][-1]) - 1)
    bad = events.copy()
    bad["x"][3] = 8
    with pytest.raises(ValueError, match=r"event 3 at \(x=8"):
        FrameHold(SHAPE).add_events(bad)


def test_a_snapshot_restores_the_queue():
    frames = [random_frame(SHAPE, t, seed=t) for t in (10_000, 20_000, 30_000)]
    method = FrameHold(SHAPE)
    method.add_frame(frames[0])
    method.add_frame(frames[1])
    snapshot = pickle.loads(pickle.dumps(method.snapshot()))
    method.add_frame(frames[2])
    other = FrameHold(SHAPE)
    other.restore(snapshot)
    np.testing.assert_array_equal(other.read(26_999).log_intensity,
                                  log_samples(frames[0])[0])
    np.testing.assert_array_equal(other.read(27_000).log_intensity,
                                  log_samples(frames[1])[0])
    other.add_frame(frames[2])
    np.testing.assert_array_equal(other.read(99_000).log_intensity,
                                  method.read(99_000).log_intensity)
    with pytest.raises(ValueError, match="other parameters: hold"):
        FrameHold(SHAPE, hold="mid").restore(snapshot)


def test_what_was_read_does_not_change_later():
    method = FrameHold(SHAPE)
    method.add_frame(random_frame(SHAPE, 0))
    estimate = method.read(10_000)
    estimate.log_intensity[:] = 0
    estimate.valid[:] = False
    again = method.read(10_000)
    assert again.log_intensity.any()
    assert again.valid.any()


def test_the_same_object_stands_for_the_same_estimate():
    method = FrameHold(SHAPE, hold="mid")
    assert method.shows(0) is None
    for mid in (100, 200):
        method.add_frame(random_frame(SHAPE, mid))
    first, again = (method.shows(t) for t in (200, 250))
    assert first is again
    method.add_frame(random_frame(SHAPE, 400))
    assert method.shows(500) is not first


def test_an_unknown_hold_is_refused():
    with pytest.raises(ValueError, match="hold must be 'readout' or 'mid', got 'end'"):
        FrameHold(SHAPE, hold="end")
