"""Plain NumPy twins of the kernels that decode and encode files."""
import re
from decimal import Decimal

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


def words(data, version, height, width):
    """Decode words of EVT2 or EVT3, one by one; times never jump by a second."""
    out, last, loops, high, low = [], -(1 << 61), 0, None, 0
    row = column = polarity = 0

    def put(t, x, y, p):
        nonlocal last
        if x < width and y < height and t >= last:
            out.append((t, x, y, p))
            last = t

    for word in data.tolist():
        kind = word >> (28 if version == 2 else 12)
        value = word & (0xFFFFFFF if version == 2 else 0xFFF)
        if kind == 8:
            span = 28 if version == 2 else 12
            if high is not None and high - value > 1 << (span - 1):
                loops += 1
            low = 0 if value != high else low
            high = value
            base = (loops << span) + value << (6 if version == 2 else 12)
        elif version == 2 and kind in (0, 1) and high is not None:
            put(base + (word >> 22 & 63), word >> 11 & 2047, word & 2047, kind)
        elif version == 3 and kind == 0:
            row = value & 2047
        elif version == 3 and kind == 6:
            low = value
        elif version == 3 and kind == 2 and high is not None:
            put(base + low, value & 2047, row, value >> 11)
        elif version == 3 and kind == 3:
            column, polarity = value & 2047, value >> 11
        elif version == 3 and kind in (4, 5):
            bits = 12 if kind == 4 else 8
            for i in range(bits):
                if word >> i & 1 and high is not None:
                    put(base + low, column + i, row, polarity)
            column += bits
    return out


def text_rows(lines, order):
    """Return rows of t, x, y, p, nanounits of t, and how many lines are bad."""
    rows, bad = [], 0
    for line in lines:
        parts = line.replace(",", " ").replace(";", " ").split()
        if not parts or parts[0][0] == "#" or parts[0][0].isalpha():
            continue
        if len(parts) != 4 or any(
                re.fullmatch(r"[-+]?([0-8]?\d{1,18}(\.\d*)?|\.\d+)", part) is None
                for part in parts):
            bad += 1
            continue
        values = dict(zip(order, map(Decimal, parts), strict=True))
        if any(values[name] % 1 for name in "xyp"):
            bad += 1
            continue
        nano = int(values["t"] % 1 * 10**9)
        rows.append([*(int(values[name]) for name in "txyp"), nano])
    return rows, bad


def text_events(lines, order, unit, height, width):
    """Return events of lines of text, and how many lines are bad.

    Where time falls by more than a second it is forgotten.
    """
    rows, bad = text_rows(lines, order)
    out, last = [], -2**61
    for whole, x, y, p, nano in rows:
        t = {"us": whole, "ns": whole // 1000,
             "s": whole * 10**6 + (nano + 500) // 1000}[unit]
        p = max(p, 0)
        if not (0 <= x < width and 0 <= y < height and p <= 1 and abs(t) <= 2**61):
            continue
        if t < last - 10**6 or t >= last:
            out.append((t, x, y, p))
            last = t
    return out, bad


def event_rows(rows, height, width):
    """Return those of rows of t, x, y, p that lie on the sensor and in order.

    Where time falls by more than a second it is forgotten.
    """
    out, last = [], -2**61
    for t, x, y, p in rows:
        p = max(p, 0)
        if (0 <= x < width and 0 <= y < height and p <= 1 and abs(t) <= 2**61
                and (t < last - 10**6 or t >= last)):
            out.append((t, x, y, p))
            last = t
    return out
