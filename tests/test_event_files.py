"""Prophesee RAW and DAT, lists of events as text and arrays, HDF5 of rpg."""
import pickle
import zipfile

import numpy as np
import pytest
import reference_files as reference
from event_bytes import (
    dat_file,
    es_file,
    evt2_file,
    evt3_file,
    evt21_file,
    npy_file,
    npz_file,
    rpg_file,
    text_file,
)
from test_aedat4 import joined
from test_aedat4_writer import small

from pdavis_cv import (
    EVENT_DTYPE,
    Layout,
    RecordingError,
    _kernels,
    fuse,
    open_recording,
)
from pdavis_cv.recording.prophesee import WordStream

SIZE = (480, 640)


def some_events(n=3000, size=SIZE, seed=0, step=40):
    rng = np.random.default_rng(seed)
    events = np.zeros(n, EVENT_DTYPE)
    events["t"] = np.sort(rng.integers(0, step * n, n)) + 5000
    events["y"], events["x"] = rng.integers(0, size[0], n), rng.integers(0, size[1], n)
    events["p"] = rng.integers(0, 2, n)
    events[100:130]["t"] = events["t"][100]  # a row of neighbours, as EVT3 packs them
    events["y"][100:130], events["x"][100:130] = 7, 50 + 2 * np.arange(30)
    return events


MAKERS = {"evt2.raw": evt2_file, "evt3.raw": evt3_file, "evt21.raw": evt21_file,
          "x.dat": dat_file, "x.es": es_file,
          "x.npy": lambda e, size: npy_file(e), "x.npz": lambda e, size: npz_file(e),
          "x.csv": lambda e, size: b"t,x,y,p\r\n" + text_file(
              e, line="{t},{x},{y},{p}\r\n"),
          "x.txt": lambda e, size: text_file(e, line="{s} {x} {y} {p}\n")[:-1]}


@pytest.mark.parametrize("name", MAKERS)
def test_events_are_read_whole_and_by_interval(tmp_path, name):
    events = some_events(200_000 if name != "x.txt" else 40_000)
    path = tmp_path / name
    path.write_bytes(MAKERS[name](events, SIZE))
    with open_recording(path) as recording:
        assert recording.info.sensor_size == SIZE
        assert recording.info.frame_count == 0
        inside = events[len(events) // 2:][:500]
        lo, hi = int(inside["t"][0]), int(inside["t"][-1]) + 1
        expected = events[(events["t"] >= lo) & (events["t"] < hi)]
        # Before and after the index is made by the first whole reading.
        np.testing.assert_array_equal(recording.events(lo, hi), expected)
        np.testing.assert_array_equal(recording.events(), events)
        np.testing.assert_array_equal(joined(recording.packets())[0], events)
        np.testing.assert_array_equal(recording.events(lo, hi), expected)
        np.testing.assert_array_equal(joined(recording.packets(lo, hi))[0], expected)
        assert {p.kind for p in recording.problems} <= {"unknown size"}
        with pickle.loads(pickle.dumps(recording)) as again:
            np.testing.assert_array_equal(again.events(lo, hi), expected)
    with pytest.raises(ValueError, match="recording is closed"):
        recording.events()


@pytest.mark.parametrize(
    "name", [name for name in MAKERS if name != "x.es"])    # its time cannot fall
def test_what_lies_outside_or_runs_backward_is_counted(tmp_path, name):
    events = some_events(300)
    events["x"][10] = 700
    events["t"][20] = events["t"][19] - 1
    path = tmp_path / name
    path.write_bytes(MAKERS[name](events, SIZE))
    options = {} if name.endswith(("raw", "dat")) else {"sensor_size": SIZE}
    with open_recording(path, **options) as recording:
        found = recording.events()
        kinds = {p.kind: p.count for p in recording.problems}
    assert kinds["outside sensor"] == 1
    assert kinds["backward time"] >= 1
    assert len(found) == 299 - kinds["backward time"]
    with open_recording(path, bad_events="raise", **options) as recording:
        with pytest.raises(RecordingError, match="1 events outside the sensor"):
            recording.events()


def test_words_of_evt3_are_decoded_alike_one_by_one_and_in_runs():
    # A call with three words never takes the shorter ways of usual runs.
    rng = np.random.default_rng(3)
    kinds = rng.choice([0, 2, 3, 4, 5, 6], 6_000, p=[.3, .3, .05, .03, .02, .3])
    sparse = np.tile([6, 0, 2], 1_000)      # in the second half, but for a few
    kinds[3_000:] = np.where(rng.random(3_000) < .02, kinds[3_000:], sparse)
    times = np.arange(6_000) % 600 * 6 + rng.integers(0, 12, 6_000)
    value = np.where(kinds == 6, times, rng.integers(0, 4096, 6_000))
    words = (kinds << 12 | value & 0xFFF).astype(np.uint16)
    words[::600] = 8 << 12 | np.arange(10)
    got = []
    for step in (len(words), 3):
        stream, state = np.zeros(8, np.int64), np.zeros(7, np.int64)
        stream[0] = -1
        out, room = np.zeros(80_000, EVENT_DTYPE), np.empty((4, 2), np.int64)
        for begin in range(0, len(words), step):
            part, done = words[begin:begin + step], 0
            while done < len(part):
                done = _kernels.evt3_words(
                    part, done, 900, 1500, stream, state, room, out)
        # Without words that are skipped, which depends on those beside them.
        got.append((out[:state[0]].tolist(), stream[:6].tolist(), state[:5].tolist()))
    assert got[0] == got[1]
    assert got[0][2][0] > 500


@pytest.mark.parametrize(("rows", "said"), [
    ([25], {"untimed": 1}), ([0x7FF], {"untimed": 1}), ([7, 25, 30, 7], {"untimed": 2}),
    ([7, 0x807], {}), ([], {})])
@pytest.mark.parametrize("before", [[], [2 << 12 | 9], [3 << 12 | 9, 5 << 12 | 1]])
@pytest.mark.parametrize("after", [6 << 12 | 60, 8 << 12 | 1, 10 << 12])
def test_a_row_of_evt3_outside_the_sensor_without_an_event_is_said(
        tmp_path, rows, said, before, after):
    words = np.array([8 << 12, 6 << 12 | 50, 5, *before, *rows, after, 6 << 12 | 70,
                      25, 2 << 12 | 3, 5, *[2 << 12 | 3] * 9], "<u2")
    (tmp_path / "x.raw").write_bytes(
        b"% evt 3.0\n% geometry 30x20\n% end\n" + words.tobytes())
    with open_recording(tmp_path / "x.raw") as recording:
        assert len(recording.events()) == 9 + bool(before)
        assert {p.kind: p.count for p in recording.problems} == {
            "outside sensor": 1, **said}


@pytest.mark.parametrize(("make", "loop"), [(evt2_file, 1 << 34), (evt3_file, 1 << 24)])
def test_time_goes_on_where_its_counter_begins_anew(tmp_path, make, loop):
    events = some_events(1000, step=4)
    events["t"] += loop - 7000
    (tmp_path / "x.raw").write_bytes(make(events, SIZE))
    expected = events.copy()
    expected["t"] -= loop - 7000
    with open_recording(tmp_path / "x.raw") as recording:
        found = recording.events()
    found["t"] -= found["t"][0] - expected["t"][0]
    np.testing.assert_array_equal(found, expected)


@pytest.mark.parametrize("make", [evt2_file, evt3_file])
def test_a_jump_back_begins_a_new_segment(tmp_path, make):
    one, two = some_events(500), some_events(500, seed=1)
    one["t"] += 3_000_000
    (tmp_path / "x.raw").write_bytes(make(one, SIZE) + make(
        two, SIZE).partition(b"% end\n")[2])
    with open_recording(tmp_path / "x.raw") as recording:
        found = recording.events()
        assert [p.kind for p in recording.problems] == ["segment"]
    assert len(found) == 1000
    assert found["t"][500] == one["t"][-1] + 1
    np.testing.assert_array_equal(np.diff(found["t"][500:]), np.diff(two["t"]))


@pytest.mark.parametrize("version", [2, 3])
def test_words_equal_their_twin(version):
    rng = np.random.default_rng(0)
    bits = 28 if version == 2 else 12
    kinds = (0, 1, 10, 14) if version == 2 else (0, 2, 3, 4, 5, 6, 7, 10, 14)
    words = (rng.choice(kinds, 20_000) << bits | rng.integers(0, 1 << bits, 20_000)
             ).astype(np.uint32 if version == 2 else np.uint16)
    times = np.arange(400)
    times[9::20] += 100     # damaged: ahead, and behind
    times[19::20] -= 9
    words[7::50] = (8 << bits | times).astype(words.dtype)
    pieces = np.array_split(words, 7)
    for size in (SIZE, (12, 16), (65_536, 65_536)):
        stream, state = WordStream(version, size, channel=6), np.zeros(7, np.int64)
        got, triggers = [], []
        for piece in pieces:
            out, state[0] = np.empty(stream.room(piece), EVENT_DTYPE), 0
            stream.decode(piece, state, out)
            got += out[:state[0]].tolist()
            triggers += map(tuple, stream.triggers.tolist())
        expected, found = reference.words(pieces, version, *size)
        assert got == expected
        assert triggers == [(t, rising) for t, rising, on in found if on == 6]
        assert 20 < len(triggers) == len(found) - stream.other_triggers
        assert len(found) > 256     # more than fit into the memory of one call
        assert len(expected) > (10 if size == SIZE else -1)


@pytest.mark.parametrize("atis", [False, True])
def test_an_event_stream_equals_its_twin(atis):
    rng = np.random.default_rng(0)
    data = rng.integers(0, 256, 5000, np.uint8)
    data[rng.integers(0, 5000, 2000)] = 0   # else most events lie outside
    time, out = np.zeros(1, np.int64), np.zeros(1001, EVENT_DTYPE)
    state = np.array([0, -2**61, 0, 0, 0, -1, -2**61], np.int64)
    done = _kernels.stream_events(data, atis, 300, 400, time, state, out)
    expected, left = reference.stream_events(data.tobytes(), atis, 300, 400)
    assert out[:state[0]].tolist() == expected
    assert data[done:].tobytes() == left
    assert len(expected) > 50


def test_kernels_refuse_arrays_of_the_wrong_shape():
    out, state = np.empty(50, EVENT_DTYPE), np.zeros(7, np.int64)
    stream, room = np.zeros(8, np.int64), np.zeros((4, 2), np.int64)
    for kernel, dtype in ((_kernels.evt2_words, np.uint32),
                          (_kernels.evt3_words, np.uint16)):
        words = np.zeros(4, dtype)
        for wrong in ((words, 5, 4, 4, stream, state, room, out),
                      (words, 0, 4, 4, stream[:3], state, room, out),
                      (words, 0, 4, 4, stream, state[:3], room, out),
                      (words, 0, 4, 4, stream, state, room[:, :1].copy(), out),
                      (words, 0, 4, 4, stream, state, room[:0], out),
                      (words, 0, 4, 4, stream, state - 1, room, out)):
            with pytest.raises(ValueError, match=kernel.__name__):
                kernel(*wrong)
        assert kernel(words[:0], 0, 4, 4, stream, state, room, out) == 0
    data = np.zeros(5, np.uint8)
    for wrong in ((data, False, 4, 4, stream, state, out),
                  (data, False, 4, 4, stream[:1], state[:3], out),
                  (data, False, 4, 4, stream[:1], state + 51, out)):
        with pytest.raises(ValueError, match="stream_events"):
            _kernels.stream_events(*wrong)


def rows_taken(kernel, room=500):
    """Return the events that a kernel appends, (state, out)."""
    state, out = np.zeros(7, np.int64), np.zeros(room, EVENT_DTYPE)
    kernel(state, out)
    return out[:state[0]].tolist()


def some_rows(rng, times):
    return np.stack([times, *(rng.integers(-1, top, len(times)) for top in (9, 7, 3))],
                    1)


def test_columns_equal_their_twin():
    rng = np.random.default_rng(0)
    times = np.cumsum(rng.integers(-1, 3, 400))
    times[200:] -= 5 * 10**6
    times[[50, 60]] = 2**61 + 1, -2**61 - 1
    rows = some_rows(rng, times)
    t, *rest = rows.T.copy()
    x, y, p = (column.astype(np.int32) for column in rest)
    got = rows_taken(lambda state, out: _kernels.event_columns(
        t, x, y, p, 6, 8, state, out))
    assert got == reference.event_rows(rows.tolist(), 6, 8)
    assert len(got) > 50
    with pytest.raises(ValueError, match="event_columns: an array"):
        _kernels.event_columns(t, x[1:], y, p, 6, 8, np.zeros(7, np.int64),
                               np.zeros(400, EVENT_DTYPE))
    with pytest.raises(ValueError, match="event_columns: out"):
        _kernels.event_columns(t, x, y, p, 6, 8, np.zeros(7, np.int64),
                               np.zeros(399, EVENT_DTYPE))


@pytest.mark.parametrize(("size", "places"), [
    (13, (0, 2, 4, 8, 12)), (16, (0, 2, 6, 10, 14)), (20, (18, 0, 4, 12, 9))])
def test_messages_of_ros_equal_their_twin(size, places):
    rng = np.random.default_rng(1)
    times = np.abs(10**6 + np.cumsum(rng.integers(-1, 9000, 400)))
    times[200:] -= 1_300_000
    rows = np.abs(some_rows(rng, times))
    names = dict(zip(("x", "y", "s", "ns", "p"), places, strict=True))
    message = np.zeros(400, {"names": list(names), "offsets": list(names.values()),
                             "formats": ["<u2", "<u2", "<i4", "<u4", "u1"],
                             "itemsize": size})
    message["s"], message["ns"] = rows[:, 0] // 10**6, rows[:, 0] % 10**6 * 1000 + 999
    for name, column in zip("xyp", rows[:, 1:].T, strict=True):
        message[name] = column
    data = np.frombuffer(b"head!" + message.tobytes(), np.uint8)

    def taken(count, state, out, at=5, where=places, shift=0):
        _kernels.ros_events(
            data, at, size, count, np.array(where), shift, 6, 8, state, out)

    got = rows_taken(lambda *rest: taken(400, *rest))
    assert got == reference.event_rows(rows.tolist(), 6, 8)
    assert len(got) > 50
    state, out = np.zeros(7, np.int64), np.zeros(500, EVENT_DTYPE)
    for wrong in ({"count": 401}, {"count": 2**62}, {"at": -1}, {"at": 5 + size},
                  {"where": (0, 2, 4, 8, size + 1)}, {"where": (0, 2, 4, 8)},
                  {"shift": -1}, {"shift": size + 1},
                  {"state": state[:3]}, {"state": state - 1}):
        given = {"count": 400, "state": state, "out": out} | wrong
        with pytest.raises(ValueError, match="ros_events"):
            taken(**given)


@pytest.mark.parametrize(("header", "size"), [
    (b"% evt 2.0\n% geometry 320x240\n", (240, 320)),
    (b"% Date 2020\n% evt 2.0\n% plugin_name hal_plugin_gen31_fx3\n", (480, 640)),
    (b"% system_ID 49\n% evt 2.0\n% sensor_generation 4.2\n% plugin_name hal_imx636\n",
     (720, 1280)),
    (b"% evt 2.0\n", (480, 640))])
def test_the_size_comes_from_the_header_or_the_events(tmp_path, header, size):
    events = some_events(200, (200, 400))
    events["y"][0] = 200
    events["x"] %= 320
    (tmp_path / "x").write_bytes(evt2_file(events, header=header))
    with open_recording(tmp_path / "x") as recording:
        expected = size if size != (480, 640) or b"plugin" in header else (260, 346)
        assert recording.info.sensor_size == expected
        np.testing.assert_array_equal(recording.events(), events)


@pytest.mark.parametrize(("data", "message"), [
    (b"% evt 4.0\n% end\n", "EVT4.0 is not read, EVT2, EVT2.1 and EVT3 are"),
    (b"% evt 3.0\n% endianness big\n% end\n", "endianness big are not read"),
    (b"Event Stream\2\0\0\4", "2.0.0 with colour events is not read"),
    (b"Event Stream\1\0\0\1", "1.0.0 with DVS events is not read: version 2"),
    (b"Event Stream\2\0\0\1\0\0\0\0", "sensor sides must lie in 1..8192, got 0x0"),
    (b"% evt 3.0\n% geometry 0x9\n% end\n", r"must lie in 1\.\.8192.* 0x9"),
    (b"% evt 2.0\n% geometry -640x480\n", r"must lie in 1\.\.8192, got -640x480"),
    (b"0 9\n1 2 3 1\n", r"must lie in 1\.\.8192, got 0x9"),
    (b"9000 9\n1 2 3 1\n", r"must lie in 1\.\.8192, got 9000x9"),
    (b"% Data file containing CD events\n\x0e\x08", "DAT 2 with events of type 14"),
    (b"% Data file containing CD events\n", "of type 0 and 0 bytes is not read"),
    (b"% Version 3\n\x0c\x08", "DAT 3 with events of type 12"),
    (b"% a TeX file\n", "not a recording, first bytes b'% a TeX"),
    (b"\x93NUMPY\x01\x00", "not arrays that can be read"),
    (b"PK\x03\x04", "not a zip archive that can be read"),
    (b"1 2 3\n", "not a recording"),
    (b"a,b,c\n1,2,3\n", "not a recording")])
def test_what_is_no_recording_is_refused_by_name(tmp_path, data, message):
    (tmp_path / "x.raw").write_bytes(data)
    with pytest.raises(RecordingError, match=rf"x\.raw: .*{message}"):
        open_recording(tmp_path / "x.raw")


@pytest.mark.parametrize("channel", [0, 6])
@pytest.mark.parametrize("make", [evt2_file, evt21_file, evt3_file])
def test_triggers_come_with_the_events(tmp_path, make, channel):
    events = some_events(1000)
    data = make(events, SIZE)
    head, t = data.index(b"% end\n") + 6, int(events["t"][0])
    on, other = channel << 8, 3 << 8
    # After the upper bits of the first event's time, before anything else.
    rising, falling = {
        evt2_file: ([10 << 28 | 5 << 22 | on | 1, 10 << 28 | 5 << 22 | other,
                     10 << 28 | 6 << 22 | on], "<u4"),
        evt21_file: ([10 << 28 | 5 << 22 | on | 1, 0, 10 << 28 | 5 << 22 | other, 0,
                      10 << 28 | 6 << 22 | on, 0], "<u4"),
        evt3_file: ([6 << 12 | t & 0xFC0 | 5, 10 << 12 | on | 1, 10 << 12 | other,
                     6 << 12 | t & 0xFC0 | 6, 10 << 12 | on], "<u2")}[make]
    at = head + {evt2_file: 4, evt21_file: 8, evt3_file: 2}[make]
    words = np.array(rising, falling).tobytes()
    (tmp_path / "x.raw").write_bytes(data[:at] + words + data[at:])
    with open_recording(tmp_path / "x.raw", trigger_channel=channel) as recording:
        assert recording.info.trigger_count is None
        found, _, _, triggers = joined(recording.packets())
        assert recording.scan().trigger_count == 2
        problem, = recording.problems
        assert (problem.kind, problem.count) == ("other triggers", 1)
    assert triggers.tolist() == [(t & ~63 | 5, 1), (t & ~63 | 6, 2)]
    np.testing.assert_array_equal(found, events[events["t"] >= t & ~63 | 6])


def test_halves_of_words_are_in_either_order(tmp_path):
    events = some_events(5000)
    stated = b"% evt 2.1\n% geometry 640x480\n"
    for legacy in (False, True):
        for header in (None, stated):
            (tmp_path / "x.raw").write_bytes(
                evt21_file(events, legacy=legacy, header=header))
            with open_recording(tmp_path / "x.raw") as recording:
                assert recording.info.format == "RAW (EVT2.1)"
                np.testing.assert_array_equal(recording.events(), events)


def test_events_of_atis_are_read(tmp_path):
    events = some_events(2000)
    (tmp_path / "x.es").write_bytes(es_file(events, SIZE, atis=True) + b"\1")
    with open_recording(tmp_path / "x.es") as recording:
        assert recording.info.format == "Event Stream (ATIS)"
        with pytest.warns(UserWarning, match="ends inside an event"):
            np.testing.assert_array_equal(recording.events(), events)


def test_a_file_that_ends_inside_a_word_is_damaged(tmp_path):
    events = some_events(150)
    (tmp_path / "x.dat").write_bytes(dat_file(events) + b"abc")
    with open_recording(tmp_path / "x.dat") as recording:
        with pytest.warns(UserWarning, match="ends inside a word"):
            assert len(recording.events()) == 150


# Lists ---------------------------------------------------------------------------


def read(path, **options):
    with open_recording(path, **options) as recording:
        return recording.events(), recording


def test_arrays_of_several_forms_are_read(tmp_path):
    events = some_events(300)
    plain = np.stack([events[k].astype(float) for k in "txyp"], 1)
    seconds = plain.copy()
    seconds[:, 0] /= 1e6
    signed = plain.astype(np.int64)
    signed[:, 3] = 2 * signed[:, 3] - 1
    other = np.zeros(300, [("timestamp", "u8"), ("x", "i2"), ("y", "i2"), ("on", "?")])
    for name, field in zip(other.dtype.names, "txyp", strict=True):
        other[name] = events[field]
    for k, array in enumerate((plain, seconds, signed, other)):
        np.save(tmp_path / f"{k}.npy", array)
        found, _ = read(tmp_path / f"{k}.npy")
        np.testing.assert_array_equal(found, events)
    np.savez_compressed(tmp_path / "x.npz", events=other)
    np.testing.assert_array_equal(read(tmp_path / "x.npz")[0], events)
    np.savez(tmp_path / "y.npz", a=np.zeros(3))
    with pytest.raises(RecordingError, match=r"no events: .* holds a \(3,\) float64"):
        open_recording(tmp_path / "y.npz")
    np.save(tmp_path / "z.npy", np.array([{}], object), allow_pickle=True)
    with pytest.raises(RecordingError, match="not arrays that can be read"):
        open_recording(tmp_path / "z.npy")


@pytest.mark.gate
@pytest.mark.parametrize("compressed", [False, True])
@pytest.mark.parametrize("form", ["fields", "rows", "columns", "apart"])
def test_arrays_in_npz_are_not_read_whole(tmp_path, compressed, form):
    import tracemalloc
    events = some_events(300_000)
    rows = np.stack([events[name].astype(float) for name in "txyp"], 1)
    arrays = {"fields": {"e": events}, "rows": {"e": rows},
              "columns": {"e": np.asfortranarray(rows)},
              "apart": {name: events[name] for name in "txyp"}}[form]
    (np.savez_compressed if compressed else np.savez)(
        tmp_path / "x.npz", notes=np.array(["none"]), **arrays)
    tracemalloc.start()
    try:
        with open_recording(tmp_path / "x.npz", sensor_size=SIZE) as recording:
            tracemalloc.reset_peak()
            count = sum(len(packet.events) for packet in recording.packets())
            peak = tracemalloc.get_traced_memory()[1]
            found = recording.events()
    finally:
        tracemalloc.stop()
    np.testing.assert_array_equal(found, events)
    assert count == len(events)
    # A piece is 65,536 rows of 32 bytes; the columns alone are 9.6 MB.
    assert peak < 8e6


@pytest.mark.parametrize("form", ["fields", "rows", "columns"])
def test_a_file_of_arrays_that_is_cut_while_it_is_read(tmp_path, form):
    events = some_events(200_000)
    rows = np.stack([events[name].astype(float) for name in "txyp"], 1)
    np.save(tmp_path / "x.npy", {"fields": events, "rows": rows,
                                 "columns": np.asfortranarray(rows)}[form])
    with open_recording(tmp_path / "x.npy", sensor_size=SIZE) as recording:
        size = (tmp_path / "x.npy").stat().st_size
        with open(tmp_path / "x.npy", "r+b") as file:
            file.truncate(size * 2 // 3)
        with pytest.warns(UserWarning, match="the file ends before its last row"):
            found = recording.events()
    np.testing.assert_array_equal(found, events[:len(found)])
    assert len(found) > (130_000 if form != "columns" else -1)


# HDF5 of rpg ---------------------------------------------------------------------


def test_rpg_files_are_read(tmp_path):
    pytest.importorskip("h5py")
    source = small()
    rpg_file(tmp_path / "x.h5", source, offset=100)
    with open_recording(tmp_path / "x.h5") as recording:
        assert recording.info.format == "HDF5 (rpg)"
        assert recording.info.sensor_size == (12, 16)
        assert recording.info.frame_count == 3
        events, frames, _, _ = joined(recording.packets())
        image = next(fuse(recording, method="frames", layout=Layout.PDAVIS))
    expected, images, _, _ = joined(source.packets())
    expected["t"] += 100_000_000
    np.testing.assert_array_equal(events, expected)
    assert [f.mid_us for f in frames] == [f.mid_us + 100_000_000 for f in images]
    np.testing.assert_array_equal(frames[0].dn, 4 * np.floor(images[0].dn / 4))
    assert image.t_us == frames[0].mid_us


FORMATS = {
    "text": text_file, "npy": npy_file, "dat": lambda e: dat_file(e, SIZE),
    "evt2": lambda e: evt2_file(e, SIZE), "evt3": lambda e: evt3_file(e, SIZE),
    "aedat2": lambda e: (
        b"#!AER-DAT2.0\r\n# AEChip: Davis640\r\n#End Of ASCII Header\r\n"
        + reference.pack_aedat2_events(e, 0, *SIZE).tobytes())}


@pytest.mark.parametrize("name", FORMATS)
@pytest.mark.parametrize("by_us", [
    [400_000], [5_000_000], [-5_000_000], [5_000_000] * 2, [-5_000_000, 4_000_000],
    [2**22, 2**23], [2**23, 2**22]])
def test_damaged_times_cost_their_events_only(tmp_path, name, by_us):
    events = some_events(1000)
    events["t"] = 6_000_000 + 5000 * (np.arange(1000) // 5)  # a time word for each 5
    damaged = events.copy()
    each = 5 if name[:3] == "evt" else 1
    hit = np.s_[500:500 + each * len(by_us)]
    damaged["t"][hit] += np.repeat(by_us, each)
    (tmp_path / "x").write_bytes(FORMATS[name](damaged))
    with open_recording(tmp_path / "x") as recording:
        found = recording.events()
        assert {p.kind for p in recording.problems} <= {
            "backward time", "untimed", "unknown size"}
    np.testing.assert_array_equal(
        found[["t", "x", "y", "p"]], np.delete(events, hit)[["t", "x", "y", "p"]])


def test_one_time_of_an_array_does_not_decide_its_unit(tmp_path):
    events = some_events(300)
    events["t"][0] = 10**18
    (tmp_path / "x.npy").write_bytes(npy_file(events))
    with open_recording(tmp_path / "x.npy") as recording:
        np.testing.assert_array_equal(recording.events(), events[1:])


def test_a_time_that_is_not_in_the_unit_of_the_others_is_said(tmp_path):
    rows = np.array([(*range(1, 30), 30.5), 30 * [1], 30 * [2], 30 * [1]]).T
    np.save(tmp_path / "x.npy", rows)
    np.savetxt(tmp_path / "x.txt", rows, "%g")
    for name in ("x.npy", "x.txt"):
        with open_recording(tmp_path / name, sensor_size=(4, 4)) as recording:
            assert recording.info.header["time_unit"] == "us"
            said = {p.kind: p.message for p in recording.problems}
        assert said == {"time unit": "1 of the times looked at have fractions, most "
                        "have none: all are read as us"}


@pytest.mark.parametrize(("version", "kinds", "known"), [
    (2, (3, 9, 12), (14, 15)), (3, (1, 9, 13), (7, 14, 15))])
def test_a_size_that_is_no_number_and_words_of_no_kind_are_said(
        tmp_path, version, kinds, known):
    events = some_events(200, (240, 320))
    write, dtype = ((evt2_file, "<u4"), (evt3_file, "<u2"))[version - 2]
    data = write(events, header=(
        b"%% evt %d.0\n%% geometry 3z0x240\n%% end\n" % version))
    shift = 8 * np.dtype(dtype).itemsize - 4
    for kind in kinds:
        words = np.array([one << shift for one in (kind, *known)], dtype)
        (tmp_path / "x").write_bytes(data + words.tobytes())
        with open_recording(tmp_path / "x") as recording:
            np.testing.assert_array_equal(recording.events(), events)
            said = {p.kind: p.count for p in recording.problems}
        assert said == {"sensor size": 1, "unknown size": 1, "untimed": 1}


def test_an_array_with_a_pixel_on_no_sensor_is_read(tmp_path):
    events = some_events(200, (200, 300))
    events["x"][40] = 65535
    (tmp_path / "x.npy").write_bytes(npy_file(events))
    with open_recording(tmp_path / "x.npy") as recording:
        assert recording.info.sensor_size == (260, 346)
        assert len(recording.events()) == 199


def test_times_in_nanoseconds_may_be_numbers_with_a_point(tmp_path):
    us = 1_700_000_000_000_000 + 1000 * np.arange(50)
    rows = np.zeros((50, 4))
    rows[:, 0] = 1000.0 * us
    np.save(tmp_path / "x.npy", rows)
    with open_recording(tmp_path / "x.npy", sensor_size=(4, 4)) as recording:
        assert recording.info.header["time_unit"] == "ns"
        assert np.abs(recording.events()["t"] - us).max() <= 1


def test_an_archive_with_a_file_without_a_name_is_read(tmp_path):
    with zipfile.ZipFile(tmp_path / "x.zip", "w") as archive:
        archive.writestr("a.txt", "1 2 3 0\n")
        archive.writestr("b", "")
    data = (tmp_path / "x.zip").read_bytes()
    at = data.rindex(b"PK\x01\x02")       # of the second file, in the directory
    end = data.rindex(b"PK\x05\x06")
    entry = bytearray(data[at:end])
    entry[28:30] = bytes(2)         # no name; its byte is that of a comment
    entry[32:34] = b"\1\0"
    (tmp_path / "x.zip").write_bytes(data[:at] + entry + data[end:])
    with open_recording(tmp_path / "x.zip", sensor_size=(4, 4)) as recording:
        assert recording.events().tolist() == [(1, 2, 3, 0)]
