"""ROS 1 and ROS 2 bags; messages are written by the library rosbags, not by us."""
import os
import pickle
import warnings

import numpy as np
import pytest
from event_bytes import ros1_file, ros1_message
from test_aedat4 import joined

import pdavis_cv
from pdavis_cv import EVENT_DTYPE, RecordingError, open_recording
from pdavis_cv.recording.bag_writer import write_rosbag

pytest.importorskip("rosbags")
from rosbags import rosbag1, rosbag2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

ARRAY, PACKET, IMAGE = ("dvs_msgs/msg/EventArray", "event_camera_msgs/msg/EventPacket",
                        "sensor_msgs/msg/Image")
PROPHESEE, OLDER = ("prophesee_event_msgs/msg/EventArray",
                    "event_array_msgs/msg/EventArray")
START_S = 1_500_000_000


def store(two):
    found = get_typestore(Stores.ROS2_HUMBLE if two else Stores.ROS1_NOETIC)
    time = "builtin_interfaces/Time" if two else "time"
    event = f"uint16 x\nuint16 y\n{time} ts\nbool polarity\n"
    array = "std_msgs/Header header\nuint32 height\nuint32 width\nEvent[] events\n"
    packet = ("std_msgs/Header header\nuint32 height\nuint32 width\nuint64 seq\n"
              "uint64 time_base\nstring encoding\nbool is_bigendian\nuint8[] events\n")
    for name, text in (
            ("dvs_msgs/msg/Event", event), (ARRAY, array), (PACKET, packet),
            ("prophesee_event_msgs/msg/Event", event), (PROPHESEE, array),
            (OLDER, packet)):
        found.register(get_types_from_msg(text, name))
    return found


class Bag:
    """Writes messages of each kind."""

    def __init__(self, path, two, **options):
        self.two, self.store = two, store(two)
        self.types = self.store.types
        self.bag = (rosbag2.Writer(path, version=8, **options) if two
                    else rosbag1.Writer(path))
        self.bag.open()
        self.connections = {}

    def header(self, t_us, frame="camera"):
        time = self.types["builtin_interfaces/msg/Time"](
            sec=START_S + t_us // 10**6, nanosec=t_us % 10**6 * 1000)
        values = {"stamp": time, "frame_id": frame}
        if not self.two:
            values["seq"] = 0
        return self.types["std_msgs/msg/Header"](**values)

    def write(self, topic, kind, t_us, message):
        if topic not in self.connections:
            self.connections[topic] = self.bag.add_connection(
                topic, kind, typestore=self.store)
        data = (self.store.serialize_cdr if self.two else self.store.serialize_ros1)(
            message, kind)
        self.bag.write(self.connections[topic],
                       (START_S * 10**6 + t_us) * 1000, bytes(data))

    def events(self, events, size, topic="/dvs/events", frame="camera", kind=ARRAY):
        time, one = (self.types[name] for name in (
            "builtin_interfaces/msg/Time", kind.replace("EventArray", "Event")))
        at = int(events["t"][-1]) if len(events) else 0
        self.write(topic, kind, at, self.types[kind](
            header=self.header(at, frame), height=size[0], width=size[1], events=[
                one(x=int(e["x"]), y=int(e["y"]), polarity=bool(e["p"]), ts=time(
                    sec=START_S + int(e["t"]) // 10**6,
                    nanosec=int(e["t"]) % 10**6 * 1000)) for e in events]))

    def packet(self, data, size, t_us, encoding, base=0, *, kind=PACKET,
               topic="/event_camera/events", big=False):
        self.write(topic, kind, t_us, self.types[kind](
            header=self.header(t_us), height=size[0], width=size[1], seq=0,
            time_base=base, encoding=encoding, is_bigendian=big,
            events=np.frombuffer(data, np.uint8)))

    def image(self, image, t_us, encoding="mono8", topic="/dvs/image_raw"):
        self.write(topic, IMAGE, t_us, self.types[IMAGE](
            header=self.header(t_us), height=image.shape[0], width=image.shape[1],
            encoding=encoding, is_bigendian=0, step=image.strides[0],
            data=np.ascontiguousarray(image).view(np.uint8).ravel()))


@pytest.fixture(params=[1, 2])
def bag(request, tmp_path):
    two = request.param == 2
    made = Bag(tmp_path / ("bag" if two else "x.bag"), two)
    made.path = tmp_path / ("bag" if two else "x.bag")
    return made


def some_events(n=500, size=(12, 16), step=20, start=0):
    rng = np.random.default_rng(0)
    events = np.zeros(n, EVENT_DTYPE)
    events["t"] = start + step * np.arange(n)
    events["y"], events["x"] = rng.integers(0, size[0], n), rng.integers(0, size[1], n)
    events["p"] = rng.integers(0, 2, n)
    return events


def absolute(events):
    out = events.copy()
    out["t"] += START_S * 10**6
    return out


@pytest.mark.parametrize("frame", ["", "a", "camera", "cam12"])
def test_event_arrays_are_read(bag, frame):
    events = some_events()
    for part in np.split(events, [0, 1, 2, 5, 100, 100]):
        bag.events(part, (12, 16), frame=frame)
    bag.bag.close()
    with open_recording(bag.path) as recording:
        assert recording.info.sensor_size == (12, 16)
        assert recording.info.frame_count == 0
        np.testing.assert_array_equal(recording.events(), absolute(events))
        inside = absolute(events)[100:200]
        lo, hi = int(inside["t"][0]), int(inside["t"][-1]) + 1
        np.testing.assert_array_equal(recording.events(lo, hi), inside)
        with pickle.loads(pickle.dumps(recording)) as again:
            assert len(again.events()) == 500
        assert not recording.problems
    with pytest.raises(ValueError, match="recording is closed"):
        recording.events()


def test_images_come_with_the_events(bag):
    events = some_events(start=1000)
    images = [np.full((12, 16), 10 * k + 5, np.uint8) for k in range(3)]
    for k, image in enumerate(images):
        bag.events(events[k * 150:(k + 1) * 150], (12, 16))
        bag.image(image, 4000 * k)
    bag.image(np.zeros((12, 16), np.uint16), 20_000, "mono16")
    bag.image(np.zeros((12, 48), np.uint8), 21_000, "rgb8")
    bag.bag.close()
    with open_recording(bag.path) as recording:
        assert recording.info.frame_count is None
        got, frames, _, _ = joined(recording.packets())
        [problem] = recording.problems
        assert problem.kind == "wrong image"
    np.testing.assert_array_equal(got, absolute(events[:450]))
    assert [f.mid_us - START_S * 10**6 for f in frames] == [0, 4000, 8000, 20_000]
    np.testing.assert_array_equal(frames[1].dn, images[1])
    assert [f.full_scale_dn for f in frames] == [255, 255, 255, 65535]


@pytest.mark.parametrize("kind", [PACKET, OLDER])
def test_mono_packets_are_read(bag, kind):
    events = some_events()
    base = (START_S * 10**6 + 7) * 1000
    words = ((events["t"] * 1000).astype(np.uint64)
             | events["x"].astype(np.uint64) << np.uint64(32)
             | events["y"].astype(np.uint64) << np.uint64(48)
             | events["p"].astype(np.uint64) << np.uint64(63))
    bag.packet(words.astype("<u8").tobytes(), (12, 16), 0, "mono", base, kind=kind)
    bag.bag.close()
    expected = absolute(events)
    expected["t"] += 7
    with open_recording(bag.path) as recording:
        assert recording.info.trigger_count == 0
        np.testing.assert_array_equal(recording.events(), expected)


def test_events_of_prophesees_messages_are_read(bag):
    for part in np.split(some_events(), 4):
        bag.events(part, (12, 16), kind=PROPHESEE)
    bag.bag.close()
    with open_recording(bag.path) as recording:
        np.testing.assert_array_equal(recording.events(), absolute(some_events()))


def libcaer_words(events, offset=0):
    """Return events as libcaer has them: a word of data, 31 bits of time."""
    words = np.empty((len(events), 2), "<u4")
    words[:, 0] = (events["x"].astype("u4") << 17 | events["y"].astype("u4") << 2
                   | events["p"].astype("u4") << 1 | 1)
    words[:, 1] = events["t"] + offset & 0x7FFFFFFF
    return words.tobytes()


def libcaer_cmp_words(events, *, high_bits=12):
    """Return events in the compressed words of libcaer_driver.

    A vector holds neighbours of a column whose y have the same upper bits.
    """
    words, state = [], {}

    def change(kind, value):
        if state.get(kind) != value:
            state[kind] = value
            words.append(kind << 12 | value)

    rows = events.tolist()
    while rows:
        t, x, y, p = rows[0]
        change(0, t >> 12 & (1 << high_bits) - 1)
        change(1, t & 0xFFF)
        change(2, x)
        group = [row for row in rows[:8] if (row[0], row[1], row[3]) == (t, x, p)
                 and row[2] & ~7 == y & ~7]
        if len(group) == 1 or group != rows[:len(group)]:
            group = rows[:1]
            words.append(3 << 12 | p << 11 | y)
        else:
            words += [4 << 12 | p << 11 | y & ~7,
                      5 << 12 | sum(1 << row[2] % 8 for row in group)]
        del rows[:len(group)]
    return np.array(words, "<u2").tobytes()


def columns_of_neighbours(n=600, size=(180, 240)):
    events = some_events(n, size, step=250)
    for k in range(0, n - 8, 40):
        events[k:k + 8] = [(int(events["t"][k]), 7, 16 + i, 1) for i in range(8)]
    return events


@pytest.mark.parametrize("encoding", ["libcaer", "libcaer_cmp"])
def test_packets_of_libcaer_are_read_with_frames_beside(bag, encoding):
    events = columns_of_neighbours()
    base = START_S * 10**9
    for k, part in enumerate(np.split(events, 6)):
        t = int(part["t"][0])
        if encoding == "libcaer":   # whose time overflows in the third packet
            offset = 2**31 - int(events["t"][250])
            low = t + offset >> 31 << 31
            bag.packet(libcaer_words(part, offset), (180, 240), t, encoding,
                       base + 1000 * (low - offset))
        else:
            relative = part.copy()
            relative["t"] -= t
            bag.packet(libcaer_cmp_words(relative), (180, 240), t, encoding,
                       base + 1000 * t)
        bag.image(np.full((180, 240), 64 * k, np.uint16), t, "mono16",
                  topic="/event_camera/image_raw")
    bag.bag.close()
    with open_recording(bag.path) as recording:
        assert recording.info.sensor_size == (180, 240)
        found, frames, _, _ = joined(recording.packets())
        assert not recording.problems
    np.testing.assert_array_equal(found, absolute(events))
    assert [int(f.dn[0, 0]) for f in frames] == [0, 64, 128, 192, 256, 320]


@pytest.mark.parametrize("high_bits", [12, 4])
def test_a_compressed_packet_may_be_long(bag, high_bits):
    events = some_events(3000, (180, 240), step=100)    # .3 s: the driver keeps 4 bits
    events["t"] -= events["t"][0]
    bag.packet(libcaer_cmp_words(events, high_bits=high_bits), (180, 240), 0,
               "libcaer_cmp", START_S * 10**9)
    bag.bag.close()
    with open_recording(bag.path) as recording:
        np.testing.assert_array_equal(recording.events(), absolute(events))


def test_words_of_a_compressed_packet_without_their_base_are_no_events(bag):
    words = [3 << 12 | 5, 2 << 12 | 4, 5 << 12 | 3, 4 << 12 | 9, 5 << 12 | 1,
             6 << 12 | 7, 5 << 12 | 2]      # no x; no base; two vectors; unknown word
    bag.packet(np.array(words, "<u2").tobytes(), (30, 30), 0, "libcaer_cmp",
               START_S * 10**9)
    bag.bag.close()
    with open_recording(bag.path) as recording:
        assert recording.events().tolist() == [
            (START_S * 10**6, 4, 9, 0), (START_S * 10**6, 4, 18, 0)]
        assert {p.kind: p.count for p in recording.problems} == {"outside sensor": 3}


def test_triggers_of_packets_are_read(bag):
    t = START_S * 10**6 + 10_000
    words = [0x8001, 0x6005, 3, 0x2004, 0xA001, 0x6009, 0xA000, 0x2005]
    bag.packet(np.array(words, "<u2").tobytes(), (12, 16), 10_000, "evt3")
    bag.bag.close()
    with open_recording(bag.path) as recording:
        assert recording.info.trigger_count is None
        events, _, _, triggers = joined(recording.packets())
    assert events["t"].tolist() == [t, t + 4]
    assert triggers.tolist() == [(t, 1), (t + 4, 2)]


def test_triggers_may_have_a_topic_of_their_own(bag):
    events, base = some_events(), START_S * 10**9
    bag.packet(libcaer_words(events), (12, 16), 0, "libcaer", base)
    edges = np.array([300_000 | 1 << 63, 500_000], np.uint64)
    bag.packet(edges.astype("<u8").tobytes(), (12, 16), 500, "trigger", base,
               topic="/event_camera/triggers")
    bag.bag.close()
    with open_recording(bag.path) as recording:
        found, _, _, triggers = joined(recording.packets())
    np.testing.assert_array_equal(found, absolute(events))
    assert triggers.tolist() == [(START_S * 10**6 + 300, 1), (START_S * 10**6 + 500, 2)]


@pytest.mark.parametrize("store", ["SQLITE3", "MCAP"])
def test_a_file_of_a_bag_is_a_recording_by_itself(tmp_path, store, capfd):
    from rosbags.rosbag2 import StoragePlugin
    bag = Bag(tmp_path / "bag", True, storage_plugin=StoragePlugin[store])
    for k, part in enumerate(np.split(some_events(), 5)):
        bag.packet(libcaer_words(part), (12, 16), 1000 * k, "libcaer", START_S * 10**9)
    bag.bag.close()
    [path] = [p for p in (tmp_path / "bag").iterdir() if p.suffix != ".yaml"]
    with open_recording(path, layout="sony") as recording:
        np.testing.assert_array_equal(recording.events(), absolute(some_events()))
        next(recording.packets())       # and left unread: the query must be closed
    assert capfd.readouterr().err == ""
    video = pdavis_cv.VideoCapture(str(path), layout="sony")
    assert video.isOpened()
    assert video.read()[0]
    video.release()
    path.rename(tmp_path / "x.bin")
    with pytest.raises(RecordingError, match=rf"must be named \*{path.suffix}"):
        open_recording(tmp_path / "x.bin")


def test_libcaer_of_the_public_case(data_dir):
    with open_recording(data_dir / "public" / "ros2_libcaer") as recording:
        assert recording.info.sensor_size == (480, 640)
        events = recording.events()
    assert len(events) == 334_331
    assert int(events["p"].sum()) == 181_908
    assert int(events["x"].sum(dtype=np.int64)) == 111_651_612
    assert int(events["y"].sum(dtype=np.int64)) == 82_801_007
    nanoseconds = events["t"].astype(np.uint64) * np.uint64(1000) + np.uint64(18)
    assert int(nanoseconds.sum()) == 15_762_826_572_202_229_126


def test_evt3_packets_go_on_from_one_to_the_next(bag):
    words = [0x8001, 0x6005, 3, 0x2000 | 1 << 11 | 4, 0x3000 | 5, 0x4005]
    bag.packet(np.array(words, "<u2").tobytes(), (12, 16), 10_000, "evt3")
    bag.packet(np.array([0x2009], "<u2").tobytes(), (12, 16), 11_000, "evt3")
    bag.bag.close()
    t = START_S * 10**6 + 10_000
    with open_recording(bag.path) as recording:
        assert recording.events().tolist() == [
            (t, 4, 3, 1), (t, 5, 3, 0), (t, 7, 3, 0), (t, 9, 3, 0)]


def test_words_without_a_time_are_said(bag):
    words = [3, 0x2004, 0x8001, 0x6005, 0x2004, 0x9000]
    bag.packet(np.array(words, "<u2").tobytes(), (12, 16), 10_000, "evt3")
    bag.bag.close()
    with open_recording(bag.path) as recording:
        assert len(recording.events()) == 1
        assert {p.kind: p.count for p in recording.problems} == {"untimed": 2}


def test_what_cannot_be_read_is_said(bag, tmp_path):
    bag.packet(b"12345678", (12, 16), 0, "evt4")
    bag.packet(b"12345678", (12, 16), 0, "mono", topic="/other/events", big=True)
    bag.image(np.zeros((12, 16), np.uint8), 5, topic="/left/image_raw")
    bag.image(np.zeros((12, 16), np.uint8), 5, topic="/right/image_raw")
    bag.bag.close()
    for camera, message in (
            ("image", "several topics of images, .*: /left/image_raw, /right"),
            ("event_camera", "of /event_camera/events in the encoding 'evt4' are not "
             "read, mono, libcaer, libcaer_cmp, evt3, trigger are"),
            ("other", "'mono', big-endian, are not read"),
            ("up", "of a camera named 'up'; it holds /")):
        with pytest.raises(RecordingError, match=message):
            open_recording(bag.path, camera=camera)
    with open_recording(bag.path, camera="left") as recording:
        assert recording.info.event_count == 0
        assert len(joined(recording.packets())[1]) == 1
    video = pdavis_cv.VideoCapture(str(bag.path), camera="event_camera")
    assert not video.isOpened()
    assert "evt4" in str(video.last_error)


def test_a_packet_in_another_encoding_than_the_first_is_damage(bag):
    events = some_events()
    bag.packet(libcaer_words(events[:250]), (12, 16), 0, "libcaer", START_S * 10**9)
    bag.packet(b"12345678", (12, 16), 5, "evt4")
    bag.packet(libcaer_words(events[250:]), (12, 16), 9, "libcaer", START_S * 10**9)
    bag.bag.close()
    with open_recording(bag.path) as recording:
        with pytest.warns(UserWarning, match="events in the encoding 'evt4'"):
            np.testing.assert_array_equal(recording.events(), absolute(events))


def test_a_bag_that_was_cut_is_no_bag(bag):
    bag.events(some_events(), (12, 16))
    bag.bag.close()
    if bag.two:
        for file in bag.path.glob("*.db3"):
            file.write_bytes(file.read_bytes()[:100])
    else:
        data = bag.path.read_bytes()
        bag.path.write_bytes(data[:5000])
    with pytest.raises(RecordingError, match="not a bag that can be read"):
        open_recording(bag.path)


def test_without_the_library_one_line_says_what_to_install(
        tmp_path, monkeypatch, capsys):
    import sys
    monkeypatch.setitem(sys.modules, "rosbags", None)
    (tmp_path / "x.bag").write_bytes(b"#ROSBAG V2.0\n" + bytes(100))
    assert "rosbag" in pdavis_cv.FORMATS
    from pdavis_cv.tools.main import main
    assert main(["info", str(tmp_path / "x.bag")]) == 2
    assert capsys.readouterr().err == (
        "pdavis: ROS bags need a package: pip install rosbags (extra [ros])\n")


@pytest.mark.parametrize("damage", ["size", "first count", "last time"])
def test_a_damaged_message_costs_itself_only(tmp_path, damage):
    events = np.zeros(40, EVENT_DTYPE)
    events["t"], events["x"] = 1000 * np.arange(40), np.arange(40)
    ros1_file(tmp_path / "x.bag", events, (260, 346))
    data = bytearray((tmp_path / "x.bag").read_bytes())
    at = data.index(ros1_message(events[:10], (260, 346)))
    if damage == "size":
        data[at + 16] ^= 1
        left = np.s_[:]
    elif damage == "first count":
        data[at + 24:at + 28] = b"\xff" * 4
        left = np.s_[10:]
    else:       # by .26 s
        data[at + 28 + 9 * 13 + 8 + 3] += 15
        left = np.delete(np.arange(40), 9)
    (tmp_path / "x.bag").write_bytes(data)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", pdavis_cv.DamagedFileWarning)
        with open_recording(tmp_path / "x.bag") as recording:
            assert recording.info.sensor_size == (260, 346)
            np.testing.assert_array_equal(recording.events(), events[left])
            assert damage == "size" or recording.problems


@pytest.mark.parametrize("what", ["merge keys", "a pipe"])
def test_a_folder_that_would_never_be_read_is_refused(tmp_path, what):
    recording = pdavis_cv.recording_from_arrays(some_events(), sensor_size=(12, 16))
    write_rosbag(tmp_path / "bag", recording)
    about, = (tmp_path / "bag").glob("*.yaml")
    if what == "a pipe":
        stored, = (tmp_path / "bag").glob("*.mcap")
        stored.unlink()
        os.mkfifo(stored)
    else:       # each line doubles what it holds
        about.write_text(about.read_text() + "a0: &a0 {x: 1}\n" + "".join(
            f"a{k + 1}: &a{k + 1}\n  <<: [*a{k}, *a{k}]\n" for k in range(60)))
    with pytest.raises(RecordingError, match=(
            "mcap: neither a file nor a folder" if what == "a pipe" else "merge")):
        open_recording(tmp_path / "bag")
