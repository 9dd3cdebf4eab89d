"""Sources that are read once, and frames copied with changes."""
import numpy as np
import pytest

import pdavis_cv
from pdavis_cv import (
    EVENT_DTYPE,
    ApsFrame,
    Packet,
    Recording,
    RecordingError,
    RecordingInfo,
    Source,
    source_from_packets,
)

INFO = RecordingInfo(format="test", sensor_size=(4, 6))


def events(*times, x=0, y=0, p=1):
    out = np.zeros(len(times), EVENT_DTYPE)
    out["t"], out["x"], out["y"], out["p"] = times, x, y, p
    return out


def test_a_source_gives_what_a_generator_makes_and_nothing_before_it_is_read():
    made = []

    def generate():
        for t in (5, 10, 10):
            made.append(t)
            yield Packet(events(t))

    source = source_from_packets(INFO, generate())
    assert not made
    got = source.packets()
    assert next(got).events["t"][0] == 5
    assert made == [5], "packets are taken one at a time"
    assert [p.start_us for p in got] == [10, 10]
    assert source.info is INFO
    assert source.path is None
    assert not source.problems


def test_a_source_is_read_once():
    source = source_from_packets(INFO, [Packet(events(1))])
    source.packets()
    with pytest.raises(RecordingError, match=r"once.*a Recording can be read again"):
        source.packets()


def test_a_closed_source_is_not_read_and_its_generator_is_closed():
    ended = []

    def generate():
        try:
            yield Packet(events(1))
            yield Packet(events(2))
        finally:
            ended.append(True)

    with source_from_packets(INFO, generate()) as source:
        next(source.packets())
    assert ended
    with pytest.raises(ValueError, match="closed"):
        source.packets()


@pytest.mark.parametrize(("packets", "message"), [
    ([Packet(events(5)), Packet(events(4))], "packet 1 begins at 4 us"),
    ([Packet(events(5, 4, 6))], "events of packet 0 must be time-ordered"),
    ([Packet(events(5, x=6))], r"event 0 of packet 0 at \(x=6.*6x4 sensor"),
    ([Packet(events(5, y=4))], r"event 0 of packet 0 .*6x4 sensor"),
    ([Packet(events(5, p=2))], r"p=2\) lies outside"),
    ([Packet(events(5, 4, 4, x=6)[::2])], "must be time-ordered"),
    ([Packet(events(5, 5, 5, x=6)[::2])], r"event 0 of packet 0 at \(x=6"),
    ([Packet(frames=(ApsFrame(np.zeros((6, 4)), 0, 1),))], "packet 0 is 4x6"),
])
def test_a_packet_that_breaks_the_rules_is_named(packets, message):
    with pytest.raises(ValueError, match=message):
        list(source_from_packets(INFO, packets).packets())


def test_what_is_not_an_iterable_is_refused():
    with pytest.raises(TypeError, match="iterable of Packet, got int"):
        source_from_packets(INFO, 7)
    with pytest.raises(TypeError, match="packets must be iterable of Packet, got ndar"):
        source_from_packets(INFO, np.array(7))
    with pytest.raises(TypeError, match="info must be a RecordingInfo, got dict"):
        source_from_packets({}, [])


def test_every_recording_is_a_source():
    recording = pdavis_cv.recording_from_arrays(events(1, 2), sensor_size=(4, 6))
    assert issubclass(Recording, Source)
    source = source_from_packets(recording.info, recording.packets())
    assert not isinstance(source, Recording)
    assert sum(len(p.events) for p in source.packets()) == 2


def test_a_frame_is_copied_with_changes():
    valid = np.ones((4, 6), bool)
    frame = ApsFrame(np.arange(24).reshape(4, 6), 10, 20, valid=valid, available_us=30,
                     full_scale_dn=4095)
    dn = np.zeros((4, 6), np.float32)
    other = frame.replace(dn=dn, available_us=40)
    assert other.dn is dn
    assert other.valid is valid
    assert (other.available_us, other.full_scale_dn, other.mid_us) == (40, 4095, 15)
    assert frame.available_us == 30
    with pytest.raises(ValueError, match="must not be before the exposure's end"):
        frame.replace(available_us=19)
    with pytest.raises(TypeError, match="brightness"):
        frame.replace(brightness=1)


def test_a_cropped_frame_is_the_one_that_the_parts_make():
    rng = np.random.default_rng(0)
    starts = np.arange(6)
    planes = {"dn": rng.random((4, 6), np.float32), "valid": rng.random((4, 6)) > 0.5,
              "reset": rng.integers(0, 9, (4, 6), np.uint16),
              "signal": rng.integers(0, 9, (4, 6), np.uint16)}
    rows, columns = slice(1, 3), slice(2, 5)

    def made(planes, starts):
        return ApsFrame(exposure_start_us=starts, exposure_end_us=starts + 7,
                        available_us=20, full_scale_dn=255, **planes)

    whole = made(planes, starts)
    got = whole.cropped(rows, columns)
    wanted = made({name: plane[rows, columns] for name, plane in planes.items()},
                  starts[columns])
    for name in ApsFrame.__slots__:
        np.testing.assert_array_equal(getattr(got, name), getattr(wanted, name))
    assert got.dn.flags.c_contiguous
    assert whole.shape == (4, 6)


def test_read_only_integers_become_dn_when_they_are_used():
    stored = np.arange(24, dtype=np.uint16).reshape(4, 6)
    stored.flags.writeable = False
    frame = ApsFrame(stored, 0, 5)
    assert frame.shape == (4, 6)
    assert frame.replace(full_scale_dn=255).moved(3).exposure_start_us == 3
    for one in frame, frame.moved(3), frame.cropped(slice(0, 4), slice(0, 6)):
        assert one.dn.dtype == np.float32
        np.testing.assert_array_equal(one.dn, stored)
    assert frame.dn is frame.dn


def test_integers_that_can_change_are_copied():
    buffer = np.ones((2, 2), np.uint16)
    frame = ApsFrame(buffer, 0, 5)
    buffer[:] = 9
    np.testing.assert_array_equal(frame.dn, 1)
