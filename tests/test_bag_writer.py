"""ROS 2 bags that convert and export write, read by rosbags, mcap and our reader."""
import json

import numpy as np
import pytest
from test_aedat4 import assert_same, joined
from test_aedat4_writer import small
from test_event_files import some_events

import pdavis_cv
from pdavis_cv import (
    EVENT_DTYPE,
    TRIGGER_DTYPE,
    ApsFrame,
    Layout,
    open_recording,
    recording_from_arrays,
)
from pdavis_cv.data import example_recording
from pdavis_cv.recording.registry import writer_for
from pdavis_cv.tools.convert import main as convert
from pdavis_cv.tools.export import main as export

pytest.importorskip("rosbags")
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

NAMES = ("x.mcap", "x.db3", "folder")
ENCODINGS = ("event_camera_msgs", "dvs_msgs")


def written(path, recording, **options):
    return dict(writer_for(path, "rosbag")[1](path, recording, **options))


def messages(path):
    """Yield (topic, log time, message) of all messages, as rosbags reads them."""
    with AnyReader([path]) as bag:
        for connection, t, data in bag.messages():
            yield connection.topic, t, bag.deserialize(data, connection.msgtype)


@pytest.mark.parametrize("encoding", ENCODINGS)
@pytest.mark.parametrize("name", NAMES)
def test_a_recording_is_the_same_when_read_again(tmp_path, name, encoding):
    source = small(layout=Layout.SONY)
    events, frames, imu, triggers = joined(source.packets())
    lost = written(tmp_path / name, source, encoding=encoding)
    kept = triggers[np.isin(triggers["type"], (1, 2))]
    assert lost == {"imu": len(imu), "triggers that are not external edges": len(
        triggers) - len(kept)}
    with open_recording(tmp_path / name) as again:
        assert again.info.layout == Layout.SONY
        assert_same(joined(again.packets()), (events, frames, imu[:0], kept))
        assert again.problems == ()


@pytest.mark.parametrize("encoding", ENCODINGS)
@pytest.mark.parametrize("beside", ["frames", "triggers"])
def test_events_rarer_than_the_clock_s_reach_are_delivered(tmp_path, encoding, beside):
    events, triggers = np.zeros(150, EVENT_DTYPE), np.zeros(1500, TRIGGER_DTYPE)
    events["t"], triggers["t"] = 200_000 * np.arange(150), 20_000 * np.arange(1500)
    triggers["type"] = 1
    frames = [ApsFrame(np.full((12, 16), 100.0), t, t + 900, available_us=t + 1000)
              for t in range(7, 30_000_000, 100_000)]
    source = recording_from_arrays(events, frames if beside == "frames" else (),
                                   sensor_size=(12, 16), triggers=(
                                       triggers if beside == "triggers" else None))
    written(tmp_path / "x.mcap", source, encoding=encoding)
    with open_recording(tmp_path / "x.mcap") as again:
        assert_same(joined(again.packets()), joined(source.packets()))
        np.testing.assert_array_equal(again.events(), events)
        assert again.problems == ()


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_rosbags_reads_the_same_events(tmp_path, encoding):
    events = some_events(2000)
    events["t"] += 1_700_000_000_000_000
    written(tmp_path / "x.mcap", recording_from_arrays(events, sensor_size=(480, 640)),
            encoding=encoding)
    found = []
    for topic, _, message in messages(tmp_path / "x.mcap"):
        if topic != "/pdavis/events":
            continue
        assert (message.height, message.width) == (480, 640)
        assert message.header.frame_id == "pdavis"
        if encoding == "dvs_msgs":
            found += [(e.ts.sec * 10**6 + e.ts.nanosec // 1000, e.x, e.y, e.polarity)
                      for e in message.events]
        else:
            assert message.encoding == "mono"
            words = message.events.view("<u8")
            found += zip((message.time_base + (words & 0xFFFFFFFF)) // 1000,
                         words >> 32 & 0xFFFF, words >> 48 & 0x7FFF, words >> 63,
                         strict=True)
    np.testing.assert_array_equal(np.array(found, np.int64), np.stack(
        [events[name].astype(np.int64) for name in "txyp"], 1))


def test_mcap_reads_the_same_messages(tmp_path):
    reader = pytest.importorskip("mcap.reader")
    source = small()
    written(tmp_path / "x.mcap", source)
    events, frames, _, _ = joined(source.packets())
    store = get_typestore(Stores.ROS2_HUMBLE)
    store.register(get_types_from_msg(
        "std_msgs/Header header\nuint32 height\nuint32 width\nuint64 seq\n"
        "uint64 time_base\nstring encoding\nbool is_bigendian\nuint8[] events\n",
        "event_camera_msgs/msg/EventPacket"))
    times, images = [], []
    with (tmp_path / "x.mcap").open("rb") as file:
        for schema, channel, message in reader.make_reader(file).iter_messages():
            if channel.topic == "/pdavis/events":
                packet = store.deserialize_cdr(message.data, schema.name)
                times.append((packet.time_base + (packet.events.view("<u8")
                                                  & 0xFFFFFFFF)) // 1000)
            elif channel.topic == "/pdavis/image_raw":
                image = store.deserialize_cdr(message.data, schema.name)
                images.append(image.data.view("<u2").reshape(image.height, -1))
                assert message.log_time == 1000 * frames[len(images) - 1].available_us
    np.testing.assert_array_equal(np.concatenate(times), events["t"])
    np.testing.assert_array_equal(images, [frame.dn for frame in frames])


@pytest.mark.parametrize("chain", [
    ["a.mcap", "b.aedat4", "c.db3", "d.h5", "e.mcap"], ["a.db3", "b.raw", "c.mcap"]])
def test_conversions_through_bags_keep_what_both_hold(tmp_path, chain, capsys):
    with open_recording(example_recording("fan")) as first:
        wanted = joined(first.packets())
    before = example_recording("fan")
    for name in chain:
        assert convert([str(before), str(tmp_path / name)]) == 0
        before = tmp_path / name
    with open_recording(before) as last:
        events, frames, _, _ = joined(last.packets())
    np.testing.assert_array_equal(events, wanted[0])
    if "b.raw" not in chain:
        for frame, other in zip(frames, wanted[1], strict=True):
            np.testing.assert_array_equal(frame.dn, other.dn)
            assert (frame.exposure_start_us, frame.exposure_end_us,
                    frame.available_us) == (other.exposure_start_us,
                                            other.exposure_end_us, other.available_us)


def test_images_of_a_copy_are_fused_as_those_of_its_source(tmp_path):
    assert convert([str(example_recording("fan")), str(tmp_path / "x.mcap")]) == 0
    images = []
    for path in (example_recording("fan"), tmp_path / "x.mcap"):
        with open_recording(path) as recording:
            images.append(list(pdavis_cv.fuse(recording, fps=20)))
    for one, other in zip(*images, strict=True):
        assert one.t_us == other.t_us
        np.testing.assert_array_equal(one.quad, other.quad)


@pytest.mark.parametrize("name", ["x.mcap", "x.db3"])
def test_export_writes_planes_a_picture_and_camera_info(tmp_path, name, capsys):
    path = tmp_path / name
    assert export([str(example_recording("fan")), "-o", str(path), "--fps", "20",
                   "--method", "cf", "--bare"]) == 0
    with open_recording(example_recording("fan")) as recording:
        images = list(pdavis_cv.fuse(recording, fps=20, method="cf"))
    found = {}
    for topic, t, message in messages(path):
        found.setdefault(topic, []).append((t, message))
    assert set(found) == {f"/pdavis/{one}" for one in (
        "s0", "aop", "dolp", "picture", "camera_info", "provenance")}
    for quantity in ("s0", "aop", "dolp"):
        for image, (t, message) in zip(images, found[f"/pdavis/{quantity}"],
                                       strict=True):
            stamp = message.header.stamp
            assert t == 1000 * image.t_us == stamp.sec * 10**9 + stamp.nanosec
            assert (message.encoding, message.header.frame_id) == ("32FC1", "pdavis")
            np.testing.assert_array_equal(
                message.data.view("<f4").reshape(message.height, message.width),
                np.where(image.valid, getattr(image, quantity), np.float32(np.nan)))
    height, width = images[0].shape
    [picture, *_] = [message for _, message in found["/pdavis/picture"]]
    assert (picture.encoding, picture.height, picture.width) == (
        "bgr8", height, 3 * width)
    info = found["/pdavis/camera_info"][0][1]
    assert (info.height, info.width, info.k[0]) == (height, width, 0)
    about = json.loads(found["/pdavis/provenance"][0][1].data)
    assert about["units"]["aop"] == "rad"


def test_what_cannot_be_written_is_one_line_and_leaves_nothing(tmp_path, capsys):
    source = str(example_recording("fan"))
    (tmp_path / "there").mkdir()
    for out, options, message in (
            ("x.bag", [], "the name must end in"),
            ("x.mcap", ["--encoding", "evt3"], "must be event_camera_msgs or dvs_msgs"),
            ("there", ["--format", "rosbag", "--force"], "Is a directory")):
        assert convert([source, str(tmp_path / out), *options]) == 2
        assert message in capsys.readouterr().err
    early = recording_from_arrays(some_events(200), sensor_size=(480, 640))
    events = early.events()
    events["t"] -= 10_000_000
    with pytest.raises(ValueError, match="a bag holds no time before 0"):
        written(tmp_path / "x.mcap", recording_from_arrays(
            events, sensor_size=(480, 640)))
    assert [path.name for path in tmp_path.iterdir()] == ["there"]
