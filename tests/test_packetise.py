"""Packets: where they end does not depend on how a reader divides its samples."""
from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from pdavis_cv.events import EVENT_DTYPE
from pdavis_cv.recording.base import (
    IMU_DTYPE,
    MAX_PACKET_EVENTS,
    MAX_PACKET_US,
    ApsFrame,
)
from pdavis_cv.recording.packetise import END_OF_TIME, Batch, packetise


def samples_at(times, dtype):
    samples = np.zeros(len(times), dtype)
    samples["t"] = times
    return samples


def expected(events, imu, frames):
    """Return events and times of frames by packets, sample by sample."""
    shut = np.array([frame.available_us for frame in frames])

    def packet(t):
        return t // MAX_PACKET_US, int(np.sum(shut < t))

    found = {}
    for kind, times in enumerate((events["t"], imu["t"], shut)):
        for i, t in enumerate(times.tolist()):
            found.setdefault(packet(t), ([], [], []))[kind].append(i)
    return [found[key] for key in sorted(found)]


@pytest.mark.parametrize("own", [True, False])
@pytest.mark.parametrize("rate", [2e-5, 3e-4, 5e-3], ids="{:g}/us".format)
@pytest.mark.parametrize("seed", [1001, 1002, 1003])
def test_packets_do_not_depend_on_batches(seed, rate, own):
    rng = np.random.default_rng(seed)
    span = 900_000
    events = samples_at(np.sort(rng.integers(0, span, int(rate * span))), EVENT_DTYPE)
    events["x"] = np.arange(len(events)) % 60_000
    imu = samples_at(np.sort(rng.integers(0, span, 20)), IMU_DTYPE)
    frames = [ApsFrame(np.zeros((2, 2)), t, t)
              for t in np.unique(rng.integers(0, span, 6)).tolist()]
    ends = [0, *np.sort(rng.integers(0, span, 4)).tolist(), span]
    batches = []
    for a, b in pairwise(ends):
        inside = [s[(s["t"] >= a) & (s["t"] < b)] for s in (events, imu)]
        # A decoder's memory is of the most that it may have to hold.
        room = np.empty(30 * len(inside[0]) + 1, EVENT_DTYPE)
        room[:len(inside[0])] = inside[0]
        batches.append(Batch(
            room[:len(inside[0])], [f for f in frames if a <= f.available_us < b],
            inside[1], complete_us=b))
    packets = list(packetise(batches, own=own))
    for packet, (which, turns, shut) in zip(
            packets, expected(events, imu, frames), strict=True):
        np.testing.assert_array_equal(packet.events, events[which])
        np.testing.assert_array_equal(packet.imu, imu[turns])
        assert packet.frames == tuple(frames[i] for i in shut)
        for array in (packet.events, packet.imu):
            assert array.flags.writeable
            if len(array) and array.base is not None:
                assert own
                assert array.base.nbytes <= 64 * array.nbytes


def test_a_burst_among_sparse_events_is_divided():
    burst = np.full(MAX_PACKET_EVENTS + 5, 500_000)
    times = np.sort(np.concatenate((np.arange(0, 1_000_000, 3_000), burst)))
    events = samples_at(times, EVENT_DTYPE)
    lengths = [len(p.events) for p in packetise([Batch(events)], own=True)]
    assert max(lengths) == MAX_PACKET_EVENTS
    assert sum(lengths) == len(events)
    assert len(lengths) == 101


def test_what_comes_is_waited_for():
    early = samples_at(np.arange(0, 100_000, 1_000), EVENT_DTYPE)
    late = samples_at([95_500, 130_000], EVENT_DTYPE)
    batches = iter((Batch(early, complete_us=55_000), Batch(complete_us=95_000),
                    Batch(late, complete_us=END_OF_TIME)))
    packets = list(packetise(batches, own=True))
    assert [p.start_us for p in packets] == [*range(0, 100_000, 10_000), 130_000]
    assert [len(p.events) for p in packets] == 9 * [10] + [11, 1]
