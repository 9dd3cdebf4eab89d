"""Files of events byte by byte, from the formats' descriptions, not our readers."""
import io
import struct

import numpy as np


def evt2_file(events, size=(480, 640), *, header=None):
    """Return a RAW file of EVT2: 32-bit words, times in two parts."""
    words, high = [], None
    for t, x, y, p in events.tolist():
        if t >> 6 != high:
            high = t >> 6
            words.append(8 << 28 | high & 0xFFFFFFF)
        words.append(p << 28 | (t & 63) << 22 | x << 11 | y)
    head = header or f"% evt 2.0\n% geometry {size[1]}x{size[0]}\n% end\n".encode()
    return head + np.array(words, "<u4").tobytes()


def evt21_file(events, size=(480, 640), *, legacy=True, header=None):
    """Return a RAW file of EVT2.1: 64-bit words, each with 32 neighbours of a row.

    The upper half of a word comes first in the order that is called legacy.
    """
    words, high, i = [], None, 0
    rows = events.tolist()
    while i < len(rows):
        t, x, y, p = rows[i]
        if t >> 6 != high:
            high = t >> 6
            words.append((8 << 28 | high & 0xFFFFFFF) << 32)
        base, pixels = x & ~31, 0
        while i < len(rows) and (t, y, p) == (rows[i][0], *rows[i][2:]) and (
                base <= rows[i][1] < base + 32 and not pixels >> rows[i][1] - base):
            pixels |= 1 << rows[i][1] - base
            i += 1
        words.append((p << 28 | (t & 63) << 22 | base << 11 | y) << 32 | pixels)
    data = np.array(words, ">u8" if legacy else "<u8")
    if legacy:
        data = data.view(">u4").astype("<u4")
    order = "legacy" if legacy else "little"
    head = header or (f"% endianness {order}\n% format EVT21;height={size[0]};"
                      f"width={size[1]}\n% end\n".encode())
    return head + data.tobytes()


def evt3_file(events, size=(480, 640), *, header=None):
    """Return a RAW file of EVT3: 16-bit words; neighbours go into vectors."""
    words, before, i = [], (None, None, None), 0
    rows = events.tolist()
    while i < len(rows):
        t, x, y, p = rows[i]
        high, low, row = before
        if t >> 12 != high:
            words.append(8 << 12 | t >> 12 & 0xFFF)
            low = None
        if t & 0xFFF != low:
            words.append(6 << 12 | t & 0xFFF)
        if y != row:
            words.append(y)
        before = t >> 12, t & 0xFFF, y
        group = [x]
        while i + len(group) < len(rows):
            nt, nx, ny, np_ = rows[i + len(group)]
            if (nt, ny, np_) != (t, y, p) or not group[-1] < nx < x + 20:
                break
            group.append(nx)
        if len(group) > 1:
            words.append(3 << 12 | p << 11 | x)
            bits = sum(1 << (column - x) for column in group)
            words += [4 << 12 | bits & 0xFFF, 5 << 12 | bits >> 12 & 0xFF]
        else:
            words.append(2 << 12 | p << 11 | x)
        i += len(group)
    head = header or (
        f"% format EVT3;height={size[0]};width={size[1]}\n% end\n".encode())
    return head + np.array(words, "<u2").tobytes()


def dat_file(events, size=(480, 640)):
    """Return a DAT file of CD events: 32-bit time and place."""
    words = np.empty((len(events), 2), "<u4")
    words[:, 0] = events["t"]
    words[:, 1] = (events["x"].astype("u4") | events["y"].astype("u4") << 14
                   | events["p"].astype("u4") << 28)
    head = ("% Data file containing CD events.\n% Version 2\n"
            "% Date 2020-01-01 00:00:00\n"
            f"% Height {size[0]}\n% Width {size[1]}\n")
    return head.encode() + bytes([12, 8]) + words.tobytes()


def es_file(events, size=(480, 640), *, atis=False):
    """Return an Event Stream: times since the last event, rows from the bottom."""
    out = bytearray(b"Event Stream\2\0\0" + bytes([2 if atis else 1])
                    + struct.pack("<HH", size[1], size[0]))
    most, last = (63, 0) if atis else (127, 0)
    for t, x, y, p in events.tolist():
        step, last = t - last, t
        while step >= most:
            many = min(step // most, 3 if atis else 1)
            out.append(0xFC | many if atis else 0xFF)
            step -= many * most
        out.append(step << 2 | p << 1 if atis else step << 1 | p)
        out += struct.pack("<HH", x, size[0] - 1 - y)
    return bytes(out)


def text_file(events, *, line="{t} {x} {y} {p}\n"):
    """Return lines of text."""
    return "".join(line.format(t=t, x=x, y=y, p=p, s=f"{t // 10**6}.{t % 10**6:06d}")
                   for t, x, y, p in events.tolist()).encode()


def npy_file(events):
    """Return an ``.npy`` file with the fields of the events."""
    file = io.BytesIO()
    np.save(file, events)
    return file.getvalue()


def npz_file(events):
    """Return an ``.npz`` file with an array for each field."""
    file = io.BytesIO()
    np.savez(file, **{name: events[name] for name in "txyp"})
    return file.getvalue()


def rpg_file(path, recording, *, offset=1_500_000_000):
    """Write HDF5 as rpg's and Monash's tools do: seconds, a dataset per image."""
    import h5py
    with h5py.File(path, "w") as file:
        events = recording.events()
        group = file.create_group("events")
        group["ts"] = events["t"] / 1e6 + offset
        group["xs"] = events["x"].astype(np.int16)
        group["ys"] = events["y"].astype(np.int16)
        group["ps"] = events["p"].astype(bool)
        file.attrs["sensor_resolution"] = recording.info.sensor_size
        images = file.create_group("images")
        for packet in recording.packets():
            for frame in packet.frames:
                image = images.create_dataset(
                    f"image{len(images):09d}", data=(frame.dn / 4).astype(np.uint8))
                image.attrs["timestamp"] = frame.mid_us / 1e6 + offset
                image.attrs["size"] = frame.shape


ROS2_DATABASE = "bag.db3"
"""Name of a ROS 2 bag's database within its folder."""


def ros2_bytes(events, size):
    """Return metadata.yaml and database of a ROS 2 bag, one after the other."""
    import tempfile
    from pathlib import Path

    from rosbags import rosbag2
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, ROS2_DATABASE.removesuffix(".db3"))
        with rosbag2.Writer(path, version=8) as bag:
            topic = bag.add_connection(
                "/dvs/events", "dvs_msgs/msg/EventArray",
                msgdef="std_msgs/Header header\nuint32 height\nuint32 width\n"
                       "dvs_msgs/Event[] events\n",
                rihs01="RIHS01_" + "0" * 64)
            for part in ros_parts(events):
                bag.write(topic, int(part["t"][-1]) * 1000, ros2_message(part, size))
        return ((path / "metadata.yaml").read_bytes()
                + (path / ROS2_DATABASE).read_bytes())


def ros1_file(path, events, size):
    """Write a ROS 1 bag of dvs_msgs/EventArray, its messages packed by hand."""
    from rosbags import rosbag1
    definition = ("std_msgs/Header header\nuint32 height\nuint32 width\n"
                  "dvs_msgs/Event[] events\n")
    path.unlink(missing_ok=True)
    with rosbag1.Writer(path) as bag:
        topic = bag.add_connection("/dvs/events", "dvs_msgs/msg/EventArray",
                                   msgdef=definition, md5sum="0" * 32)
        for part in ros_parts(events):
            bag.write(topic, int(part["t"][-1]) * 1000, ros1_message(part, size))


def ros_parts(events):
    """Return the events of each message of a bag."""
    return np.array_split(events, max(len(events) // 20_000, 4))


def ros1_message(events, size):
    """Return a dvs_msgs/EventArray of ROS 1."""
    rows = np.zeros(len(events), [("x", "<u2"), ("y", "<u2"), ("s", "<u4"),
                                  ("n", "<u4"), ("p", "u1")])
    rows["x"], rows["y"], rows["p"] = events["x"], events["y"], events["p"]
    rows["s"], rows["n"] = events["t"] // 10**6, events["t"] % 10**6 * 1000
    head = struct.pack("<IIII", 0, 0, 0, 0) + struct.pack("<III", *size, len(events))
    return head + rows.tobytes()


def ros2_message(events, size):
    """Return a dvs_msgs/EventArray of ROS 2.

    CDR, little endian: after four bytes of its own every number is aligned to its
    size; an empty frame name is a length of 1 and a 0.
    """
    data = bytearray(struct.pack("<iII4xIII", 0, 0, 1, *size, len(events)))
    for t, x, y, on in events[["t", "x", "y", "p"]].tolist():
        data += bytes(-len(data) % 2) + struct.pack("<HH", x, y)
        data += bytes(-len(data) % 4) + struct.pack(
            "<iIB", t // 10**6, t % 10**6 * 1000, on)
    return b"\0\1\0\0" + data
