"""Plain NumPy twins of the kernels that decode and encode files."""
import numpy as np

from pdavis_cv import EVENT_DTYPE

AEDAT4 = np.dtype([("t", "<i8"), ("x", "<i2"), ("y", "<i2"), ("p", "u1"), ("", "V3")])


def aedat4_events(data, at, n, height, width, *, flip=False):
    """Decode n event structs.

    Drops what lies outside, before what was taken, or ahead of both neighbours.
    """
    raw = np.frombuffer(bytes(data), AEDAT4, n, at)
    y = height - 1 - raw["y"].astype(int) if flip else raw["y"].astype(int)
    out, last = [], -(1 << 61)
    for i in range(n):
        t, x, p = (int(raw[name][i]) for name in "txp")
        following = int(raw["t"][i + 1]) if i + 1 < n else t
        inside = 0 <= x < width and 0 <= y[i] < height and p <= 1
        if inside and t >= last and not last <= following < t:
            out.append((t, x, y[i], p))
            last = t
    return np.array(out, EVENT_DTYPE)


def pack_aedat4_events(events):
    """Return event structs as bytes."""
    raw = np.zeros(len(events), AEDAT4)
    for name in "txyp":
        raw[name] = events[name]
    return raw.tobytes()


def pack_aedat2_events(events, origin, height, width):
    """Return AEDAT-2.0 words as an array (N, 8) of bytes."""
    words = np.empty((len(events), 2), ">u4")
    y = height - 1 - events["y"].astype(np.int64)
    x = width - 1 - events["x"].astype(np.int64)
    words[:, 0] = y << 22 | x << 12 | (events["p"] != 0).astype(np.int64) << 11
    words[:, 1] = (events["t"] - origin) & 0xFFFFFFFF
    return words.view(np.uint8).reshape(-1, 8)


def aedat2_words(data, height, width):
    """Decode words whose times are in order and hold events only: the NumPy way."""
    words = np.frombuffer(data, ">u4").reshape(-1, 2)
    address, t = words[:, 0].astype(np.uint32), words[:, 1].astype(np.int32)
    x, y = width - 1 - (address >> 12 & 0x3FF).astype(int), (address >> 22 & 0x1FF)
    inside = (address < 1 << 31) & (x >= 0) & (y < height)
    out = np.empty(int(inside.sum()), EVENT_DTYPE)
    out["t"], out["x"] = t[inside], x[inside]
    out["y"], out["p"] = height - 1 - y[inside], address[inside] >> 11 & 1
    return out
