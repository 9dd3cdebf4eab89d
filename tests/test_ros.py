"""ROS 1 and ROS 2 bags; messages are written by the library rosbags, not by us."""
import pickle
import warnings

import numpy as np
import pytest
from event_bytes import ros1_file, ros1_message
from test_aedat4 import joined

import pdavis_cv
from pdavis_cv import EVENT_DTYPE, RecordingError, open_recording

pytest.importorskip("rosbags")
from rosbags import rosbag1, rosbag2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

ARRAY, PACKET, IMAGE = ("dvs_msgs/msg/EventArray", "event_camera_msgs/msg/EventPacket",
                        "sensor_msgs/msg/Image")
START_S = 1_500_000_000


def store(two):
    found = get_typestore(Stores.ROS2_HUMBLE if two else Stores.ROS1_NOETIC)
    for name, text in (
            ("dvs_msgs/msg/Event", "uint16 x\nuint16 y\n"
             + ("builtin_interfaces/Time ts" if two else "time ts")
             + "\nbool polarity\n"),
            (ARRAY, "std_msgs/Header header\nuint32 height\nuint32 width\n"
             "dvs_msgs/Event[] events\n"),
            (PACKET, "std_msgs/Header header\nuint32 height\nuint32 width\nuint64 seq\n"
             "uint64 time_base\nstring encoding\nbool is_bigendian\nuint8[] events\n")):
        found.register(get_types_from_msg(text, name))
    return found


class Bag:
    """Writes messages of each kind."""

    def __init__(self, path, two):
        self.two, self.store = two, store(two)
        self.types = self.store.types
        self.bag = rosbag2.Writer(path, version=8) if two else rosbag1.Writer(path)
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

    def events(self, events, size, topic="/dvs/events", frame="camera"):
        time, one = (self.types[name] for name in (
            "builtin_interfaces/msg/Time", "dvs_msgs/msg/Event"))
        at = int(events["t"][-1]) if len(events) else 0
        self.write(topic, ARRAY, at, self.types[ARRAY](
            header=self.header(at, frame), height=size[0], width=size[1], events=[
                one(x=int(e["x"]), y=int(e["y"]), polarity=bool(e["p"]), ts=time(
                    sec=START_S + int(e["t"]) // 10**6,
                    nanosec=int(e["t"]) % 10**6 * 1000)) for e in events]))

    def packet(self, data, size, t_us, encoding, base=0):
        self.write("/event_camera/events", PACKET, t_us, self.types[PACKET](
            header=self.header(t_us), height=size[0], width=size[1], seq=0,
            time_base=base, encoding=encoding, is_bigendian=False,
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


def test_mono_packets_are_read(bag):
    events = some_events()
    base = (START_S * 10**6 + 7) * 1000
    words = ((events["t"] * 1000).astype(np.uint64)
             | events["x"].astype(np.uint64) << np.uint64(32)
             | events["y"].astype(np.uint64) << np.uint64(48)
             | events["p"].astype(np.uint64) << np.uint64(63))
    bag.packet(words.astype("<u8").tobytes(), (12, 16), 0, "mono", base)
    bag.bag.close()
    expected = absolute(events)
    expected["t"] += 7
    with open_recording(bag.path) as recording:
        np.testing.assert_array_equal(recording.events(), expected)


def test_evt3_packets_go_on_from_one_to_the_next(bag):
    words = [0x8001, 0x6005, 3, 0x2000 | 1 << 11 | 4, 0x3000 | 5, 0x4005]
    bag.packet(np.array(words, "<u2").tobytes(), (12, 16), 10_000, "evt3")
    bag.packet(np.array([0x2009], "<u2").tobytes(), (12, 16), 11_000, "evt3")
    bag.bag.close()
    t = START_S * 10**6 + 10_000
    with open_recording(bag.path) as recording:
        assert recording.events().tolist() == [
            (t, 4, 3, 1), (t, 5, 3, 0), (t, 7, 3, 0), (t, 9, 3, 0)]


def test_what_cannot_be_read_is_said(bag, tmp_path):
    bag.packet(b"12345678", (12, 16), 0, "libcaer_cmp")
    bag.image(np.zeros((12, 16), np.uint8), 5, topic="/left/image_raw")
    bag.image(np.zeros((12, 16), np.uint8), 5, topic="/right/image_raw")
    bag.bag.close()
    with pytest.raises(RecordingError, match=r"several topics of images, pass camera=: "
                       "/left/image_raw, /right/image_raw"):
        open_recording(bag.path)
    with open_recording(bag.path, camera="left") as recording:
        assert recording.info.event_count == 0
        assert len(joined(recording.packets())[1]) == 1
    with open_recording(bag.path, camera="event_camera") as recording, pytest.raises(
            RecordingError, match="encoding 'libcaer_cmp' are not read, mono and evt3"):
        recording.events()
    with pytest.raises(RecordingError, match="of a camera named 'up'; it holds /"):
        open_recording(bag.path, camera="up")


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
        "pdavis: ROS bags need a package: pip install rosbags\n")


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
