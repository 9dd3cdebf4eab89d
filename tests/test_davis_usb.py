"""Words of a DAVIS346: the kernel, its twin, and what becomes of damage."""
import davis_usb_bytes
import numpy as np
import pytest
import reference_usb
from davis_words import DavisEncoder
from streams import random_events

from pdavis_cv import _kernels
from pdavis_cv.recording import davis
from pdavis_cv.recording.base import ApsFrame, Packet, joined
from pdavis_cv.recording.davis import DavisDecoder, Orientation
from pdavis_cv.recording.files import ProblemLog

SIZE = (4, 6)


def random_words(rng, count):
    """Return words of all kinds, those of a frame often in their order."""
    frames = []
    for k in range(90):
        frames.append([8 + k % 2])
        for code in (11, 12):
            for _ in range(6):
                frames[-1] += [code, *[0x4001] * (4 + (rng.random() < 0.02)), 13]
        frames[-1].append(10)
    pool = [*frames, *[[5, 0x53E5, *range(0x5078, 0x5086), 7]] * 9,
            *[[5, 0x5380, *[0x5080] * 6, 7]] * 9,
            *([int(word)] for word in rng.integers(0x1000, 0x1005, 9)),
            *([int(word)] for word in rng.integers(0x2000, 0x2007, 20)),
            *([int(word)] for word in rng.integers(0x3000, 0x3007, 20)),
            *([int(word)] for word in rng.integers(0x8000, 0x10000, 20)),
            *([int(word)] for word in rng.integers(0, 40, 9)),
            *([int(word)] for word in rng.integers(0, 0x10000, 20)), [0x7001], [0x7000]]
    words = []
    while len(words) < count:
        words += pool[rng.integers(len(pool))]
    return np.array(words[:count], np.uint16)


def decoded(words, cuts=(), *, turned=False, room=50):
    """Decode words with the kernel, in pieces; return what the twin holds."""
    state = np.zeros(29, np.int64)
    state[[5, 6, 12, 14]] = -1
    reads = np.zeros((2, *SIZE[::-1]), np.uint16)
    times = np.zeros((2, SIZE[1]), np.int64)
    found = {"events": [], "imu": [], "triggers": [], "frames": [], "resets": 0}
    for part in np.split(words, cuts):
        begin = 0
        while begin < len(part):
            out = np.empty(room, davis.EVENT_DTYPE)
            imu, triggers = np.empty((2, 9), np.int64), np.empty((2, 2), np.int64)
            state[:3] = 0
            begin, why = _kernels.davis_words(
                part, begin, turned, *SIZE, state, reads, times, out, imu, triggers)
            for name, rows, n in zip(("events", "imu", "triggers"),
                                     (out, imu, triggers), state, strict=False):
                found[name] += [tuple(row.tolist()) if name != "events" else row.item()
                                for row in rows[:n]]
            if why == 1:
                found["frames"].append((
                    int(state[6]), reads.swapaxes(1, 2).tolist(), times.tolist(),
                    int(state[4])))
                state[6] = -1
            found["resets"] += why == 2
    found["counts"] = dict(zip(
        ("outside", "backward", "unknown", "columns", "frames", "imu"),
        state[23:].tolist(), strict=True))
    return found


@pytest.mark.parametrize("seed", range(4))
def test_words_of_all_kinds_are_decoded_as_by_the_twin_whatever_the_cut(seed):
    rng = np.random.default_rng(seed)
    words, turned = random_words(rng, 6000), bool(seed % 2)
    words.flags.writeable = False
    twin = reference_usb.Stream(SIZE, turned)
    twin.decode(words)
    found = decoded(words, turned=turned)
    assert len(twin.frames) > 3
    assert len(twin.imu) > 3
    for name, value in found.items():
        assert value == getattr(twin, name), name
    cuts = np.sort(rng.integers(0, len(words) + 1, 300))
    assert decoded(words, cuts, turned=turned, room=3) == found


@pytest.mark.parametrize("change", [
    {"state": np.zeros(28, np.int64)}, {"reads": np.zeros((1, 6, 4), np.uint16)},
    {"times": np.zeros((2, 5), np.int64)}, {"begin": 3}, {"begin": -1},
    {"out": np.zeros(0, davis.EVENT_DTYPE)}, {"imu": np.zeros((2, 8), np.int64)},
    {"triggers": np.zeros((0, 2), np.int64)}, {"state": np.full(29, 99)}], ids=str)
def test_arrays_of_the_wrong_shape_are_refused(change):
    arguments = {
        "words": np.zeros(2, np.uint16), "begin": 0, "turned": False,
        "height": SIZE[0], "width": SIZE[1], "state": np.zeros(29, np.int64),
        "reads": np.zeros((2, 6, 4), np.uint16), "times": np.zeros((2, 6), np.int64),
        "out": np.empty(4, davis.EVENT_DTYPE), "imu": np.empty((2, 9), np.int64),
        "triggers": np.empty((2, 2), np.int64)} | change
    with pytest.raises(ValueError, match="davis_words: "):
        _kernels.davis_words(*arguments.values())


def decoder(size=SIZE, **orientation):
    log = ProblemLog("test")
    return DavisDecoder(size, Orientation(**orientation), log), log


def test_everything_that_is_sent_arrives():
    rng = np.random.default_rng(0)
    words, events = davis_usb_bytes.Words(), random_events(300, SIZE, stop_us=90_000)
    reset, signal = rng.integers(400, 1024, (2, *SIZE), np.uint16)
    for event in events[:200].tolist():
        words.event(*event)
    t = words.time
    words.imu(t + 1, 0b11100101, [8192, -8192, 0, 340, 131, -131, 1])
    words.special(3, t + 2)
    words.global_frame(reset, signal, t + 200, t + 900, t + 1900)
    words.imu(t + 2000, 0b10001100, [2048, 1, 2, 3, 4, 5, 6])
    words.special(1)
    for event in events[200:].tolist():     # the clock begins at 0
        if event[0] < 32768:
            words.event(*event)
    decode, log = decoder()
    packets = list(decode.feed(words.bytes()))
    got = joined([packet.events for packet in packets])
    np.testing.assert_array_equal(got[:200], events[:200])
    assert np.all(np.diff(got["t"]) >= 0)
    frame, = (frame for packet in packets for frame in packet.frames)
    np.testing.assert_array_equal(frame.reset, reset)
    np.testing.assert_array_equal(frame.signal, signal)
    np.testing.assert_array_equal(frame.dn, reset.astype(float) - signal)
    assert (frame.exposure_start_us, frame.exposure_end_us, frame.available_us) == (
        t + 200, t + 900, t + 1900)
    imu = joined([packet.imu for packet in packets])
    assert imu["t"].tolist() == [t + 1, t + 2000]
    np.testing.assert_allclose(imu["accel"], [[1, -1, 0], [1, 1 / 2048, 1 / 1024]])
    np.testing.assert_allclose(
        imu["gyro"], [np.array([131, -131, 1]) / 65.536, [np.nan] * 3], rtol=1e-6)
    np.testing.assert_allclose(imu["temperature"], [36, np.nan])
    triggers = joined([packet.triggers for packet in packets])
    assert triggers["type"].tolist() == [1, 6, 8, 9, 7, 0]
    assert {problem.kind for problem in log.problems} == {"segment"}


@pytest.mark.parametrize("flips", [
    {}, {"frames_flipped_x": True}, {"frames_flipped_y": True}, {"frames_turned": True},
    {"frames_turned": True, "frames_flipped_x": True, "frames_flipped_y": True}])
def test_frames_are_turned_as_the_chip_is_mounted(flips):
    picture = np.arange(24, dtype=np.uint16).reshape(SIZE) + 400
    sent = picture
    if flips.get("frames_flipped_x"):
        sent = sent[:, ::-1]
    if flips.get("frames_flipped_y"):
        sent = sent[::-1]
    if flips.get("frames_turned"):
        sent = sent.T
    words = davis_usb_bytes.Words()
    words.global_frame(sent + 100, sent, 500, 900, 1000)
    decode, _ = decoder(**flips)
    frame, = next(decode.feed(words.bytes())).frames
    np.testing.assert_array_equal(frame.signal, picture)


def test_a_rolling_shutter_has_exposures_of_its_own_for_each_column():
    starts, ends = np.arange(1000, 1060, 10), np.arange(1035, 1095, 10)
    read = np.full(SIZE, 500, np.uint16)
    words = davis_usb_bytes.Words()
    words.rolling_frame(read, read, starts, ends, 2000)
    for flipped in (False, True):
        decode, _ = decoder(frames_flipped_x=flipped)
        frame, = next(decode.feed(words.bytes())).frames
        order = slice(None, None, -1 if flipped else 1)
        np.testing.assert_array_equal(frame.exposure_start_us, starts[order])
        np.testing.assert_array_equal(frame.exposure_end_us, ends[order])


def test_a_missing_sample_costs_its_column_and_a_missing_column_the_frame():
    read = np.full(SIZE, 500, np.uint16)
    words = davis_usb_bytes.Words()
    words.global_frame(read, read, 500, 900, 1000)
    samples = [i for i, word in enumerate(words.words) if word >> 12 == 4]
    without = np.delete(words.words, samples[5]).astype("<u2")      # of column 1
    decode, log = decoder()
    (frame,), = (packet.frames for packet in decode.feed(without.tobytes()))
    assert frame.valid.all(axis=0).tolist() == [True, False, True, True, True, True]
    assert [(p.kind, p.count) for p in log.problems] == [("cut columns", 1)]
    column = words.words.index(11)
    without = np.delete(words.words, range(column, column + 6)).astype("<u2")
    decode, log = decoder()
    assert not any(packet.frames for packet in decode.feed(without.tobytes()))
    assert [(p.kind, p.count) for p in log.problems] == [("cut frames", 1)]


def test_time_goes_on_beyond_32_bits_and_over_long_darkness():
    words = davis_usb_bytes.Words()
    words.words += [0x7FFF] * 40        # 90 minutes
    words.time = 40 * 4095 * 32768
    words.event(words.time + 5, 1, 2, 1)
    decode, log = decoder()
    packet, = decode.feed(words.bytes())
    assert packet.events["t"].tolist() == [40 * 4095 * 32768 + 5]
    assert not log.problems


def test_lost_words_cost_what_they_held_and_time_goes_on():
    events = random_events(2000, SIZE, stop_us=400_000)
    words = davis_usb_bytes.Words()
    for event in events.tolist():
        words.event(*event)
    data = words.bytes()
    for begin in range(1000, len(data) - 4000, 371):
        decode, log = decoder()
        head = list(decode.feed(data[:begin], 7.0))
        after = data[begin + 2801 + begin % 2:]
        after = after[len(after) % 2:]
        end = int(events["t"][-1])      # by the host's clock, at the last word
        expected = decode.time_us + round(
            (end - decode.time_us) * 2800 / (len(data) - begin))
        told = 7.0 + (expected - decode.time_us) * 1e-6
        got = joined([p.events for p in (
            *head, *decode.feed(after, told, lost=True))])
        # One event may have kept its column only: rows are forgotten.
        assert set(got.tolist()) <= set(events.tolist())
        assert len(got) > 1000
        assert {p.kind for p in log.problems} <= {"outside sensor", "overflow"}


def test_bytes_that_end_within_a_word_wait_for_the_rest():
    events = random_events(50, SIZE)
    words = davis_usb_bytes.Words()
    for event in events.tolist():
        words.event(*event)
    decode, _ = decoder()
    data = words.bytes()
    got = [p.events for i in range(0, len(data), 3) for p in decode.feed(data[i:i + 3])]
    np.testing.assert_array_equal(joined(got), events)


def test_the_encoder_says_what_the_decoder_hears():
    rng = np.random.default_rng(3)
    events = random_events(2000, SIZE, start_us=0, stop_us=300_000)
    frames = [ApsFrame(rng.integers(0, 600, SIZE), t, t + 10_000,
                       available_us=t + 20_000) for t in (3000, 50_000, 150_000)]
    frames.append(frames[2].replace(
        exposure_start_us=200_000 + 50 * np.arange(6),
        exposure_end_us=201_000 + 50 * np.arange(6), available_us=210_000))
    packets, low = [], 0
    for until in range(5000, 300_001, 5000):
        high = int(np.searchsorted(events["t"], until))
        packets.append(Packet(events[low:high], tuple(
            f for f in frames if until - 5000 <= f.available_us < until)))
        low = high
    decode, log = decoder()
    got = []
    for time, words in DavisEncoder().chunks(iter(packets)):
        got += decode.feed(words.tobytes())
        assert decode.time_us == time
    np.testing.assert_array_equal(joined([p.events for p in got]), events)
    heard = [frame for packet in got for frame in packet.frames]
    for one, two in zip(heard, frames, strict=True):
        np.testing.assert_array_equal(one.dn, two.dn)
        np.testing.assert_array_equal(one.exposure_start_us, two.exposure_start_us)
        np.testing.assert_array_equal(one.exposure_end_us, two.exposure_end_us)
        assert one.available_us == two.available_us
    assert not log.problems


@pytest.mark.parametrize("seed", range(3))
def test_random_bytes_do_no_harm(seed):
    rng = np.random.default_rng(seed)
    decode, _ = decoder()
    last = -1
    for _ in range(30):
        data = rng.bytes(int(rng.integers(0, 5000)))
        host_s = rng.choice([np.nan, 1e300, rng.uniform(0, 1e3)])
        for packet in decode.feed(data, host_s, lost=rng.random() < 0.2):
            if packet.start_us is not None:
                assert packet.start_us >= last
                last = packet.stop_us - 1
                assert packet.events["x"].max(initial=0) < SIZE[1]
                assert packet.events["y"].max(initial=0) < SIZE[0]
