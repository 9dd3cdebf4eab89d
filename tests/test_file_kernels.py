"""Kernels that decode and encode files equal their twins."""
import struct
import threading

import lz4.frame
import numpy as np
import pytest
import reference_files
from event_bytes import evt2_file, evt3_file
from streams import random_events

from pdavis_cv import EVENT_DTYPE, _kernels, open_recording
from pdavis_cv.recording.base import TRIGGER_DTYPE

SIZE = (260, 346)


def state4():
    return np.array([0, -(1 << 61), 0, 0, 0, -1, -(1 << 61)], np.int64)


def decode4(data, at, n, *, flip=False):
    out, state = np.empty(n, EVENT_DTYPE), state4()
    state[5] = 0
    _kernels.aedat4_events(data, at, n, *SIZE, flip, -1, 1 << 61, state, out)
    return out[:state[0]], state


def packets4(payloads, counts, ends=(-1, 1 << 61), *, packed=True, room=1 << 17):
    """Return the events of packets, and how many packets were as usual."""
    block, rows = b"", []
    for payload, count in zip(payloads, counts, strict=True):
        block += struct.pack("<ii", 3, len(payload))
        rows.append((1000 + len(block), len(payload), count, ends[1], ends[0]))
        block += payload
    out, state = np.empty(sum(counts), EVENT_DTYPE), state4()
    done = _kernels.aedat4_packets(
        np.frombuffer(block, np.uint8), 1000, np.array(rows, np.int64), 0, len(rows), 3,
        packed, *SIZE, False, np.empty(room, np.uint8), state, out)
    return out[:state[0]], done


def rows2(words, size, state):
    """Return rows of words: events, and other words in their place."""
    rows = np.empty(len(words), EVENT_DTYPE)
    block = np.concatenate((words, np.zeros((1, 8), np.uint8)))
    return rows, _kernels.aedat2_rows(block, len(words), 0, *size, state, rows)


def samples2(rows, size):
    """Return the events of rows, and the reasons for which decoding stopped."""
    n, width = len(rows), size[1]
    state, frame = np.zeros(8, np.int64), np.array([0, 0, -1, 0, 0, 0, 0, 0, -1])
    seen, done, why, reasons = np.zeros(size, np.uint8), 0, 1, []
    while why:
        before = done
        done, why = _kernels.aedat2_samples(
            rows, done, state, frame, np.zeros(size, np.uint16),
            np.zeros(size, np.uint16), seen, np.zeros((2, width), np.int64),
            np.zeros(7, np.int16), np.empty(n, np.int64), np.empty((n, 7), np.int16),
            np.empty(n, np.int64), np.empty(n, np.uint8))
        if why:
            seen[:], frame[:] = 0, [0, 0, -1, 0, 0, 0, 0, 0, -1]
        assert done > before or why != 1
        reasons.append(why)
    assert done == n
    return rows[:state[3]], reasons


@pytest.mark.parametrize("n", [0, 1, 1000])
@pytest.mark.parametrize("flip", [False, True])
def test_aedat4_events_equal_their_twin(n, flip):
    events = random_events(n, (300, 400), seed=n, stop_us=500_000).copy()
    rng = np.random.default_rng(n)
    back = rng.random(n) < 0.1
    events["t"][back] -= np.minimum(events["t"][back], 2000)
    packed = np.frombuffer(
        bytes(5) + reference_files.pack_aedat4_events(events), np.uint8)
    got, state = decode4(packed, 5, n, flip=flip)
    wanted = reference_files.aedat4_events(packed, 5, n, *SIZE, flip=flip)
    np.testing.assert_array_equal(got, wanted)
    assert state[3] + state[4] == n - len(wanted)


@pytest.mark.parametrize("flip", [False, True])
@pytest.mark.parametrize(("field", "value"), [
    ("x", SIZE[1]), ("x", -1), ("x", -(1 << 15)), ("y", SIZE[0]), ("y", -1),
    ("y", -(1 << 15)), ("p", 2), ("p", 255), ("t", 0), ("t", -2), ("t", -(1 << 63)),
    ("t", (1 << 61) + 1), ("padding", 255)])
def test_one_bad_event_of_aedat4_is_found_wherever_it_lies(field, value, flip):
    n = 2500
    events = random_events(n, SIZE, seed=n, start_us=10)
    good = reference_files.pack_aedat4_events(events)
    for i in (0, 1, 1022, 1023, 1024, 1025, 2047, 2048, n - 2, n - 1):
        packed = np.frombuffer(bytearray(good), reference_files.AEDAT4)
        if field == "padding":
            packed.view(np.uint8).reshape(n, 16)[i, 13:] = value
        else:
            packed[field][i] = value
        got, state = decode4(packed.tobytes(), 0, n, flip=flip)
        wanted = reference_files.aedat4_events(packed, 0, n, *SIZE, flip=flip)
        np.testing.assert_array_equal(got, wanted)
        impossible = field == "t" and value != 0
        assert state[3:5].tolist() == [n - len(got) - impossible, impossible]
        assert state[5] == (-1 if np.any(np.diff(got["t"]) < 0) else 0)
        assert state[1] == got["t"][-1]


@pytest.mark.parametrize("n", [0, 1, 1000])
def test_aedat2_words_equal_their_twin(n):
    events = random_events(n, SIZE, seed=n)
    words = reference_files.pack_aedat2_events(events, -77, *SIZE)
    state = state4()
    rows, others = rows2(words, (250, 340), state)
    got, reasons = samples2(rows, (250, 340))
    wanted = reference_files.aedat2_words(words.tobytes(), 250, 340)
    np.testing.assert_array_equal(got, wanted)
    assert state.tolist()[:6] == [n, -(1 << 61), 0, 0, 0, -1]
    assert (others, reasons) == (n - len(wanted), [0])
    again, others = rows2(words, SIZE, state4())
    again["t"] -= 77
    np.testing.assert_array_equal(again, events)
    assert not others


@pytest.mark.parametrize("dtype", [EVENT_DTYPE, TRIGGER_DTYPE])
@pytest.mark.parametrize("n", [0, 1, 2, 1000])
def test_cells_equal_their_twin(n, dtype):
    rng = np.random.default_rng(1001)
    samples = np.zeros(n, dtype)
    samples["t"] = np.sort(rng.integers(-70_000, 70_000, n))
    samples["t"][::3] = samples["t"][::3] // 10_000 * 10_000
    samples["t"].sort()
    cell = samples["t"] // 10_000
    starts = [i for i in range(n) if i == 0 or cell[i] != cell[i - 1]]
    assert _kernels.cells(samples.view(np.uint8), samples.itemsize, 10_000) == (
        starts, samples["t"][starts].tolist())


def test_cells_of_any_times_are_whole():
    samples = np.random.default_rng(1002).integers(0, 256, (500, 13), np.uint8)
    starts, times = _kernels.cells(samples.reshape(-1), 13, 10_000)
    assert starts[0] == 0
    assert np.all(np.diff([*starts, 500]) > 0)
    assert times == samples[starts, :8].copy().view("<i8")[:, 0].tolist()
    for size, width in ((7, 1), (12, 1), (13, 0)):
        with pytest.raises(ValueError, match="cells: "):
            _kernels.cells(samples.reshape(-1), size, width)


def test_places_outside_the_data_are_refused():
    data, out = np.zeros(40, np.uint8), np.empty(9, EVENT_DTYPE)
    for at, n in ((-1, 1), (41, 0), (9, 2), (0, 3), (0, -1)):
        with pytest.raises(ValueError, match="lie outside data"):
            _kernels.aedat4_events(data, at, n, *SIZE, False, 0, 9, state4(), out)
    with pytest.raises(ValueError, match="out is too small"):
        _kernels.aedat4_events(data, 0, 2, *SIZE, False, 0, 9, state4(), out[:1])
    with pytest.raises(ValueError, match="rows and columns"):
        _kernels.aedat4_events(data, 0, 2, 0, 4, False, 0, 9, state4(), out)
    with pytest.raises(ValueError, match="lie outside data"):
        _kernels.aedat4_table_fields(data, 0, 0, np.empty((11, 3, 4), np.uint8))


def test_tables_that_point_anywhere_are_refused():
    rng = np.random.default_rng(0)
    for _ in range(3000):
        data = rng.integers(0, 256, 64, np.uint8)
        data[rng.random(64) < 0.6] = 0
        for width, columns in ((1, 1), (4, 3), (8, 1)):
            out = np.empty((4, columns, width), np.uint8)
            assert _kernels.aedat4_table_fields(data, 0, 1, out) <= 4


@pytest.mark.parametrize("n", [0, 1, 700])
def test_events_of_a_flatbuffer_are_found(n):
    events = random_events(n, SIZE, seed=n)
    data = reference_files.aedat4_flatbuffer(b"EVTS", events)
    at, count = _kernels.aedat4_vector(data, 0, 16)
    assert (count, data[at:]) == (n, reference_files.pack_aedat4_events(events))
    assert _kernels.aedat4_vector(data, 1, 16) == (0, 0)      # it has its default


def test_vectors_of_any_flatbuffer_equal_their_twin():
    rng = np.random.default_rng(1003)
    data = reference_files.aedat4_flatbuffer(b"EVTS", random_events(3, SIZE, seed=1))
    others = [data[:cut] for cut in range(len(data))]
    for _ in range(5000):
        other = bytearray(data)
        for place in rng.integers(4, 32, 3):
            other[place] = rng.choice((0, 1, 2, 4, 6, 64, 127, 128, 255))
        others.append(bytes(other))
    for other in (data, *others):
        for field, size in ((0, 16), (0, 1), (1, 4)):
            assert _kernels.aedat4_vector(other, field, size) == (
                reference_files.aedat4_vector(other, field, size))
    assert _kernels.aedat4_vector(data, -1, 1) == (-1, 0)
    assert _kernels.aedat4_vector(data, 0, 0) == (-1, 0)


@pytest.mark.parametrize("options", [
    {}, {"block_linked": False}, {"store_size": False, "block_size": 7},
    {"compression_level": 9}, {"compression_level": -9}, {"content_checksum": True},
    {"content_checksum": True, "block_checksum": True, "block_size": 4}])
def test_packets_of_aedat4_equal_their_twins(options):
    counts = [0, 1, 2, 50, 7000]
    parts = [random_events(n, SIZE, seed=n, stop_us=10 * n + 1, read_only=False)
             for n in counts]
    parts[3]["t"][7:] = parts[3]["t"][7]            # long matches
    parts[4]["t"] = np.sort(np.random.default_rng(1001).integers(0, 1 << 60, 7000))
    data = [reference_files.aedat4_flatbuffer(b"EVTS", part) for part in parts]
    data.insert(2, data[2] + bytes(70_000))         # runs over a block
    counts.insert(2, 2)
    packed = [lz4.frame.compress(one, **options) for one in data]
    wanted = np.concatenate([reference_files.aedat4_events(
        one, 32, n, *SIZE) for one, n in zip(data, counts, strict=True)])
    for payloads in (packed, data):
        got, done = packets4(payloads, counts, packed=payloads is packed)
        assert done == len(counts)
        np.testing.assert_array_equal(got, wanted)
    got, done = packets4(packed[4:5] * 3, counts[4:5] * 3, (9, 30))
    late, early = parts[3]["t"] >= 9, parts[3]["t"] <= 30
    np.testing.assert_array_equal(got, np.concatenate([
        parts[3][keep] for keep in (early, late & early, late)]))
    assert done == 3
    assert late.sum() < 50 > early.sum()


def test_packets_of_aedat4_that_are_not_as_usual_are_left():
    data = reference_files.aedat4_flatbuffer(b"EVTS", random_events(30, SIZE, seed=1))
    good = lz4.frame.compress(data)
    rng = np.random.default_rng(1002)
    noise = rng.integers(0, 256, 40, np.uint8).tobytes()
    summed = lz4.frame.compress(data, content_checksum=True)
    assert packets4([summed], [30])[1] == 1
    for bad in (b"", b"x", good[:-4], good[:9], good[:40] + good[50:], noise,
                summed[:-1], summed[:-4], summed[:-1] + bytes([summed[-1] ^ 1]),
                summed[:200] + bytes([summed[200] ^ 1]) + summed[201:],
                lz4.frame.compress(data, block_checksum=True),
                lz4.frame.compress(b""), lz4.frame.compress(data[:-1]),
                lz4.frame.compress(data.replace(b"EVTS", b"IMUS"))):
        got, done = packets4([good, bad, good], [30, 30, 30])
        assert (len(got), done) == (30, 1)
    assert packets4([good, good], [30, 29])[1] == 1
    assert packets4([good], [30], room=len(data) - 1)[1] == 0
    assert packets4([good], [30], room=len(data))[1] == 1
    with pytest.raises(ValueError, match="index or state"):
        _kernels.aedat4_packets(
            np.zeros(9, np.uint8), 0, np.zeros((2, 5), np.int64), 0, 3, 0, True, *SIZE,
            False, np.zeros(9, np.uint8), state4(), np.empty(0, EVENT_DTYPE))


@pytest.mark.parametrize("summed", [False, True])
def test_damaged_lz4_gives_what_its_library_gives_or_nothing(summed):
    rng = np.random.default_rng(1003)
    events = random_events(600, SIZE, seed=2, read_only=False)
    events["t"][100:200] = 7 << 40
    data = reference_files.aedat4_flatbuffer(b"EVTS", events)
    good, taken = lz4.frame.compress(data, block_size=4, content_checksum=summed), 0
    for _ in range(3000):
        bad = bytearray(good)
        for place in rng.integers(7, len(bad), rng.integers(1, 4)):
            bad[place] = rng.choice((0, 1, 15, 16, 240, 255, rng.integers(256)))
        got, done = packets4([bytes(bad)], [600], (-(1 << 61), 1 << 61))
        try:
            wanted = lz4.frame.decompress(bytes(bad))
        except RuntimeError:
            if not summed:
                continue
            wanted = data       # what is damaged is beside the data
        taken += done
        if done:
            np.testing.assert_array_equal(got, reference_files.aedat4_events(
                wanted, 32, 600, *SIZE, first=-(1 << 61)))
    assert taken > (50 if summed else 300)


def test_any_words_decode_without_harm():
    rng = np.random.default_rng(1)
    for _ in range(30):
        words = rng.integers(0, 256, (4000, 8), np.uint8)
        words[:, 4] = 0
        words[:, 5] &= 7
        words[:, 4:] = words[np.lexsort(words[:, 7:3:-1].T)][:, 4:]
        rows, _ = rows2(words, SIZE, state4())
        events, _ = samples2(rows, SIZE)
        assert not len(events) or events["x"].max() < 346
    rows = np.empty(9, EVENT_DTYPE)
    for n in (-1, 4000):
        with pytest.raises(ValueError, match="is too small"):
            _kernels.aedat2_rows(words, n, 0, *SIZE, state4(), rows)


def test_eight_threads_decode_the_same():
    events = random_events(20_000, SIZE, seed=3)
    packed = np.frombuffer(reference_files.pack_aedat4_events(events), np.uint8)
    results = [None] * 8

    def work(i):
        results[i] = decode4(packed, 0, len(events))[0]

    threads = [threading.Thread(target=work, args=(i,)) for i in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    for result in results:
        np.testing.assert_array_equal(result, events)


@pytest.mark.parametrize(("make", "dtype", "kinds"), [
    # An event that becomes a time; an event that becomes the base of a vector, and a
    # time or base that becomes what continues others.
    (evt2_file, "<u4", [(0, 8)]), (evt3_file, "<u2", [(2, 3), (6, 7), (3, 7)])])
def test_words_that_become_of_a_kind_that_cannot_be_there_are_said(
        tmp_path, make, dtype, kinds):
    rng = np.random.default_rng(0)
    events = np.zeros(200, EVENT_DTYPE)
    events["t"], events["p"] = 5000 + 100 * np.arange(200), rng.integers(0, 2, 200)
    events["x"], events["y"] = rng.integers(0, 30, 200), rng.integers(0, 20, 200)
    events["t"][100:130] = events["t"][100]     # neighbours, as EVT3 packs them
    events["x"][100:130], events["y"][100:130] = np.arange(30), 7
    head, end, data = make(events, (20, 30)).partition(b"% end\n")
    words = np.frombuffer(data, dtype)
    shift = 8 * words.itemsize - 4
    for old, new in kinds:
        damaged = [k for k in np.flatnonzero(words >> shift == old)
                   if 0 < k < len(words) - 9 and words[k - 1] >> shift != 8
                   and words[k + 1] >> shift != 8]
        assert damaged
        for k in damaged[::9]:
            one = words.copy()
            one[k] ^= (old ^ new) << shift
            (tmp_path / "x").write_bytes(head + end + one.tobytes())
            with open_recording(tmp_path / "x") as recording:
                recording.events()
                assert "untimed" in [p.kind for p in recording.problems], (old, new, k)
