"""Whole files, streams and requests of every parser: what mutants are made of.

A corpus takes what makes its recordings: `large` for tests of faults, which need some
time to pass while a file is read, or `small`, of which thousands are read in a second.
"""
import importlib.util
import io
import struct
import tempfile
from pathlib import Path

import numpy as np

import pdavis_cv
from pdavis_cv import recording_from_arrays, write_aedat2, write_aedat4


def _recording(size, frames, count, stop_us):
    """Return a recording of every kind of sample; no two events have the same time.

    As far as there are pixels, no two events have the same place either.
    """
    rng = np.random.default_rng(0)
    events = np.zeros(count, pdavis_cv.EVENT_DTYPE)
    events["t"] = np.sort(rng.choice(stop_us, count, replace=False))
    places = rng.permutation(np.arange(max(count, size[0] * size[1])))[:count]
    events["y"], events["x"] = places // size[1] % size[0], places % size[1]
    events["p"] = rng.integers(0, 2, count)
    images = [pdavis_cv.ApsFrame(
        rng.integers(0, 1000, size).astype(np.float32), 50_000 * k + 4_000,
        50_000 * k + 14_000, available_us=50_000 * k + 17_000) for k in range(frames)]
    imu = np.zeros(stop_us // 5_000, pdavis_cv.IMU_DTYPE)
    imu["t"] = 5_000 * np.arange(len(imu))
    triggers = np.zeros(4, pdavis_cv.TRIGGER_DTYPE)
    triggers["t"], triggers["type"] = np.array([1, 9, 90, 199]) * (
        stop_us // 200), [1, 2, 3, 1]
    return recording_from_arrays(events, images, sensor_size=size, imu=imu,
                                 triggers=triggers)


def large(size, frames):
    """Return 3000 events in 200 ms."""
    return _recording(size, frames, 3000, 200_000)


def small(size, frames):
    """Return 30 events in 20 ms, and one frame where there are any."""
    return _recording(size, min(frames, 1), 30, 20_000)


def written(write, *arguments, **options):
    """Return the bytes of what writes a file."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "x"
        write(path, *arguments, **options)
        return path.read_bytes()


def aedat4(make):
    return [written(write_aedat4, make((12, 16), 4), compression=name)
            for name in ("lz4", "none", "zstd")]


def aedat2(make):
    """Return a file with all reads of its frames, and one with those of a column."""
    whole = written(write_aedat2, make((128, 128), 2))
    if make is large:
        return [whole]
    begin = whole.rindex(b"#End Of ASCII Header\r\n") + 22
    words = np.frombuffer(whole, ">u4", offset=begin).reshape(-1, 2)
    column, frame = words[:, 0] >> 12 & 0x3FF, words[:, 0] >> 31 == 1
    return [whole[:begin] + words[~frame | (column == 0)].tobytes()]


def aedat31(make):
    from aedat31_bytes import aedat31_file
    return [aedat31_file(make((12, 16), 3))]


def hdf5(make):
    if importlib.util.find_spec("h5py") is None:
        return []
    from pdavis_cv.recording.hdf5.writer import write_hdf5
    return [written(write_hdf5, make((12, 16), 3), flavour=name)
            for name in ("e2p", "dsec")]


def prophesee(make):
    from event_bytes import dat_file, evt2_file, evt3_file
    source = make((12, 16), 0).events()
    return [write(source, (12, 16)) for write in (evt2_file, evt3_file, dat_file)]


def lists(make):
    from event_bytes import npy_file, npz_file, text_file
    source = make((12, 16), 0).events()
    return [npy_file(source), npz_file(source), text_file(source)]


def rpg(make):
    if importlib.util.find_spec("h5py") is None:
        return []
    from event_bytes import rpg_file
    return [written(rpg_file, make((12, 16), 3))]


def ros1(make):
    if importlib.util.find_spec("rosbags") is None:
        return []
    from event_bytes import ros1_file
    return [written(ros1_file, make((12, 16), 0).events(), (12, 16))]


def ros2(make):
    if importlib.util.find_spec("rosbags") is None:
        return []
    from event_bytes import ros2_bytes
    return [ros2_bytes(make((12, 16), 0).events(), (12, 16))]


def usb(make):
    from davis_words import write_trace
    return [written(write_trace, make((12, 16), 3))]


def weights(make):
    """Return archives of numbers: one as ours are, one as torch writes them."""
    from test_checkpoint import Writer
    archive = io.BytesIO()
    np.savez_compressed(
        archive, about=np.array('{"network": "joint", "unit": 0.2, "about": {}}'),
        **{"head.bias": np.zeros(16, np.float32),
           "head.weight": np.zeros((2, 3, 3, 3), np.float32)})
    checkpoint = Writer()
    checkpoint.body.append(b"}(")
    for name, values in (("a", np.zeros((2, 3), np.float32)), ("b", np.ones(4, "f4"))):
        checkpoint.text(name)
        checkpoint.tensor(values)
    checkpoint.body.append(b"u")
    return [archive.getvalue(), written(checkpoint.write)]


def calibration(make):
    plane = np.full((4, 6), 0.2, np.float32)
    known = pdavis_cv.Calibration(
        sensor_size=(4, 6), chip="Davis346", serial="7", layout=pdavis_cv.Layout.PDAVIS,
        theta_on=plane, theta_off=plane, dark=plane, usable=plane > 0, clip_dn=1000.0,
        bandwidth_hz_per_dn=3.0, bandwidth_sigma=0.1, notes={"wavelength_nm": 530})
    return [written(known.save)]


def load(make):
    rows = [(0.01 * i, 2.0 * i, 0.001 * i, i % 5 > 3) for i in range(40)]
    comma = "".join(f"{t:.3f},{f:.3f},{d:.4f},{v:d}\n" for t, f, d, v in rows)
    semicolon = "".join(f"{t:.3f};{f:.3f}\n" for t, f, *_ in rows).replace(".", ",")
    return [("Time (s),Force (mN),Position (um),TTL (V)\n" + comma).encode(),
            ("# rig 3\nElapsed;Load\n(ms);(N)\n" + semicolon).encode("latin-1")]


def roi(make):
    if importlib.util.find_spec("roifile") is None:
        return []
    import roifile
    polygon = roifile.ImagejRoi.frompoints([(1, 1), (9, 2), (8, 9.5)], name="a")
    oval = roifile.ImagejRoi.frompoints([(2, 2), (9, 8)], name="b")
    oval.roitype = roifile.ROI_TYPE.OVAL

    def zipped(path):
        path = path.with_suffix(".zip")
        roifile.roiwrite(path, [polygon, oval])
        path.rename(path.with_suffix(""))
    return [polygon.tobytes(), oval.tobytes(), written(zipped)]


def dv(make):
    """Return what a server of DV's protocol sends: a file without magic and index."""
    found = []
    for data in aedat4(make):
        parts = list(aedat4_packets(data))
        found.append(data[14:parts[-1][1]])
    return found


def http(make):
    host = b" HTTP/1.1\r\nHost: localhost:8346\r\n"
    json = (b"POST /command" + host + b"Content-Type: application/json\r\n"
            b"Content-Length: %d\r\n\r\n%s")
    bodies = (b'{"do": "seek", "value": 1}', b'{"do": "roi", "value": [2, 2, 8, 6]}',
              b'{"do": "method", "value": "cf"}', b'{"do": "speed", "value": 2.5}')
    return [b"GET /status?palettes" + host + b"\r\n", b"GET /" + host + b"\r\n",
            b"GET /snapshot.npz?token=abc" + host + b"Origin: http://localhost\r\n\r\n",
            *(json % (len(body), body) for body in bodies), *sockets(host)]


def sockets(host):
    """Return WebSockets of a page that asks for images."""
    head = (b"GET /images" + host + b"Upgrade: websocket\r\nConnection: Upgrade\r\n"
            b"Sec-WebSocket-Version: 13\r\n"
            b"Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n\r\n")
    mask = bytes((7, 11, 13, 17))
    asked = (b'{"after": 0, "panes": ["s0", "aop"], "id": 1}',
             b'{"panes": ["events"], "region": [1, 2, 3, 4]}')
    texts = [bytes((0x81, 0x80 | len(text))) + mask + bytes(
        byte ^ mask[i % 4] for i, byte in enumerate(text)) for text in asked]
    return [head + texts[0], head + texts[0] + b"\x89\x80" + mask + texts[1],
            head + texts[1] + b"\x88\x80" + mask]


def aedat4_packets(data):
    """Yield (first byte, byte after the last) of each packet before the index."""
    at = 18 + int.from_bytes(data[14:18], "little")
    while at + 8 <= len(data):
        stream, size = struct.unpack_from("<ii", data, at)
        if not 0 <= stream < 4 or not 0 < size <= len(data) - at - 8:
            return
        yield at, at + 8 + size
        at += 8 + size


def aedat31_packets(data):
    """Yield (first byte, byte after the last) of each packet."""
    at = data.index(b"#!END-HEADER\r\n") + 14
    while at < len(data):
        size, number = struct.unpack_from("<4xi12xi", data, at)
        yield at, at + 28 + size * number
        at += 28 + size * number
