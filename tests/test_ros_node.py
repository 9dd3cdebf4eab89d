"""The ROS 2 node: its logic on messages of a bag, and the node without ROS."""
import sys
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest

import pdavis_cv
from pdavis_cv.data import example_recording
from pdavis_cv.recording.registry import writer_for

pytest.importorskip("rosbags")
pytest.importorskip("cv2")
from rosbags.highlevel import AnyReader

EXPOSURE_US = 10_000


@pytest.fixture(scope="module")
def messages(tmp_path_factory):
    """Return (topic, message) of a bag of the example, in the order of arrival."""
    path = tmp_path_factory.mktemp("bag") / "fan.mcap"
    with pdavis_cv.open_recording(example_recording("fan")) as recording:
        writer_for(path)[1](path, recording)
    with AnyReader([path]) as bag:
        return [(connection.topic, bag.deserialize(data, connection.msgtype))
                for connection, _, data in bag.messages()]


@pytest.fixture
def package(root, monkeypatch):
    monkeypatch.syspath_prepend(str(root / "ros" / "pdavis_ros"))
    yield
    for name in [one for one in sys.modules if one.startswith("pdavis_ros")]:
        del sys.modules[name]


def fed(fuser, messages):
    images = []
    for topic, message in messages:
        if topic.endswith("/events"):
            images += fuser.events(message)
        elif topic.endswith("/image_raw"):
            images += fuser.image(message)
    return images


def of_recording():
    with pdavis_cv.open_recording(example_recording("fan")) as recording:
        packets = list(recording.packets())
    return recording.info, packets


def test_messages_are_fused_as_the_recording_is(package, messages):
    from pdavis_ros.fuser import Fuser
    info, packets = of_recording()
    frames = [frame for packet in packets for frame in packet.frames]
    fuser = Fuser(exposure_us=round(1000 * frames[0].exposure_ms), fps=50,
                  method="cf")
    found = {image.t_us: image for image in fed(fuser, messages)}
    fuser.close()
    assert fuser.dropped == 0
    with pdavis_cv.live.Session(info, fps=50, method="cf") as session:
        wanted = {image.t_us: image for packet in packets
                  for image in session.push(packet)}
    both = sorted(found.keys() & wanted.keys())
    assert len(both) > 40
    for t in both[5:]:      # the frames arrive with the next events, a little later
        one, other = found[t], wanted[t]
        good = one.valid & other.valid & (other.dolp > 0.1)
        turned = np.abs((one.aop - other.aop + np.pi / 2) % np.pi - np.pi / 2)[good]
        assert np.median(turned) < np.deg2rad(2)
        assert np.median(np.abs(one.dolp - other.dolp)[good]) < 0.03


def test_every_event_and_frame_is_pushed_in_order(package, messages, monkeypatch):
    from pdavis_ros import fuser as module
    pushed = []
    monkeypatch.setattr(module, "Session", lambda info, **options: SimpleNamespace(
        push=lambda packet: pushed.append(packet) or [], close=lambda: None))
    fed(module.Fuser(exposure_us=EXPOSURE_US), messages)
    _, packets = of_recording()
    np.testing.assert_array_equal(
        np.concatenate([packet.events for packet in pushed]),
        np.concatenate([packet.events for packet in packets]))
    frames = [frame for packet in packets for frame in packet.frames]
    got = [frame for packet in pushed for frame in packet.frames]
    assert len(got) >= len(frames) - 1      # the last may wait for events
    for one, other in zip(got, frames, strict=False):
        np.testing.assert_array_equal(one.dn, other.dn)
        assert one.mid_us == other.mid_us
        assert one.exposure_ms == EXPOSURE_US / 1000
    ends = [packet.start_us for packet in pushed]
    assert ends == sorted(ends)


def test_images_alone_and_late_events(package, messages):
    from pdavis_ros.fuser import Fuser
    images = [(topic, one) for topic, one in messages if topic.endswith("image_raw")]
    fuser = Fuser(fps=None, method="frames")
    assert len(fed(fuser, images)) >= len(images) - 1
    events = [one for topic, one in messages if topic.endswith("/events")]
    fuser.events(events[0])
    assert fuser.dropped > 0
    fuser.close()


def test_what_is_not_read_is_an_error(package, messages):
    from pdavis_ros.fuser import Fuser
    [image, *_] = [one for topic, one in messages if topic.endswith("image_raw")]
    with pytest.raises(ValueError, match="the encoding 'evt9' are not read"):
        Fuser().events(SimpleNamespace(encoding="evt9", is_bigendian=False))
    with pytest.raises(ValueError, match="images of 'rgb8' are not read"):
        Fuser().image(SimpleNamespace(encoding="rgb8", is_bigendian=0))
    fuser = Fuser()
    fuser.image(image)
    with pytest.raises(ValueError, match="do not fit the sensor"):
        fuser.image(SimpleNamespace(
            encoding="mono8", is_bigendian=0, height=3, width=4))
    fuser.close()


class FakeNode:
    """Stands in for rclpy.node.Node: keeps what is published."""

    def __init__(self, name):
        self.name, self.published, self.callbacks, self.errors = name, [], {}, []

    def declare_parameter(self, name, default):
        return SimpleNamespace(value={"exposure_us": EXPOSURE_US}.get(name, default))

    def create_publisher(self, kind, topic, qos):
        return SimpleNamespace(
            publish=lambda message: self.published.append((topic, message)))

    def create_subscription(self, kind, topic, callback, qos):
        self.callbacks[topic] = callback

    def get_logger(self):
        return SimpleNamespace(error=lambda text, **how: self.errors.append(text))

    def destroy_node(self):
        self.callbacks.clear()


class FakeMessage:
    def __init__(self):
        self.header = SimpleNamespace(stamp=SimpleNamespace(), frame_id="")


@pytest.fixture
def node(package, monkeypatch):
    for name, values in {
            "rclpy": {}, "rclpy.node": {"Node": FakeNode},
            "rclpy.qos": {"qos_profile_sensor_data": None},
            "sensor_msgs": {}, "sensor_msgs.msg": {
                "Image": FakeMessage, "CameraInfo": FakeMessage},
            "event_camera_msgs": {}, "event_camera_msgs.msg": {
                "EventPacket": FakeMessage}}.items():
        module = ModuleType(name)
        vars(module).update(values)
        monkeypatch.setitem(sys.modules, name, module)
    from pdavis_ros.node import PdavisNode
    return PdavisNode()


def test_the_node_publishes_planes_a_picture_and_camera_info(node, messages):
    for topic, message in messages:
        name = topic.rpartition("/")[2]
        if name in node.callbacks:
            node.callbacks[name](message)
    assert node.errors == []
    count = len(node.published) // 5
    assert count > 40
    assert [topic for topic, _ in node.published] == count * [
        "~/camera_info", "~/s0", "~/aop", "~/dolp", "~/picture"]
    last = {topic: message for topic, message in node.published[-5:]}
    height, width = last["~/camera_info"].height, last["~/camera_info"].width
    dolp = np.frombuffer(last["~/dolp"].data, "<f4").reshape(height, width)
    assert 0 < np.nanmedian(dolp) < 1
    assert (last["~/picture"].encoding, last["~/picture"].step) == ("bgr8", 3 * width)
    assert len(last["~/picture"].data) == 3 * height * width
    assert {message.header.frame_id for message in last.values()} == {"pdavis"}
    stamps = [(one.header.stamp.sec, one.header.stamp.nanosec)
              for _, one in node.published[::5]]
    assert stamps == sorted(stamps)
    node.callbacks["events"](SimpleNamespace(encoding="x", is_bigendian=False))
    assert len(node.errors) == 1
    node.destroy_node()


def test_the_launch_file_names_the_parameters_of_the_node(root, monkeypatch):
    import ast
    folder = root / "ros" / "pdavis_ros"
    tree = ast.parse((folder / "launch" / "pdavis.launch.py").read_text())
    [types] = [[key.value for key in one.value.keys] for one in tree.body
               if isinstance(one, ast.Assign) and one.targets[0].id == "TYPES"]
    source = (folder / "pdavis_ros" / "node.py").read_text()
    assert all(f'("{name}", ' in source for name in types)
    package = (folder / "package.xml").read_text()
    assert "<name>pdavis_ros</name>" in package


def test_images_far_ahead_hold_up_no_others_and_short_ones_are_refused(
        package, messages):
    from pdavis_ros.fuser import Fuser

    def ahead(message, **changes):
        stamp = SimpleNamespace(sec=4_000_000_000, nanosec=0)
        return SimpleNamespace(**{
            **{name: getattr(message, name) for name in (
                "encoding", "is_bigendian", "height", "width", "data")},
            "header": SimpleNamespace(stamp=stamp), **changes})

    fuser, other = (Fuser(fps=50, method="frames") for _ in range(2))
    first = next(one for topic, one in messages if topic.endswith("/image_raw"))
    begin = 1 + next(
        k for k, (topic, _) in enumerate(messages) if topic.endswith("/events"))
    found, wanted = fed(fuser, messages[:begin]), fed(other, messages[:begin])
    for _ in range(150):
        assert not fuser.image(ahead(first))
    assert fuser.dropped == 50
    found += fed(fuser, messages[begin:])
    wanted += fed(other, messages[begin:])
    assert [one.t_us for one in found] == [one.t_us for one in wanted]
    np.testing.assert_array_equal(found[-1].s0, wanted[-1].s0)
    for data in (b"", bytes(first.data)[:-1], bytes(first.data)[:-first.height]):
        with pytest.raises(ValueError, match="bytes are no image of"):
            fuser.image(ahead(first, data=data))
    fuser.close()
    other.close()
