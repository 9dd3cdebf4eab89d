"""Plain NumPy twins of the kernels that decode and encode files."""
import re
import struct
from decimal import Decimal

import numpy as np

from pdavis_cv import EVENT_DTYPE

AEDAT4 = np.dtype([("t", "<i8"), ("x", "<i2"), ("y", "<i2"), ("p", "u1"), ("", "V3")])


def aedat4_events(data, at, n, height, width, *, flip=False, first=-1, last=1 << 61):
    """Decode n event structs, without those that lie outside, in space or time."""
    raw = np.frombuffer(bytes(data), AEDAT4, n, at)
    y = height - 1 - raw["y"].astype(int) if flip else raw["y"].astype(int)
    taken = _Taken(height, width)
    for i in range(n):
        t, x, p = (int(raw[name][i]) for name in "txp")
        if first <= t <= last:
            taken.add(t, x, int(y[i]), p)
    return np.array(taken.out, EVENT_DTYPE)


def pack_aedat4_events(events):
    """Return event structs as bytes."""
    raw = np.zeros(len(events), AEDAT4)
    for name in "txyp":
        raw[name] = events[name]
    return raw.tobytes()


def aedat4_flatbuffer(identifier, events):
    """Return events as a size-prefixed FlatBuffer: vtable at 14, table at 20."""
    return struct.pack(
        "<II4s2xHHHiII", 28 + 16 * len(events), 16, identifier, 6, 8, 4, 6, 4,
        len(events)) + pack_aedat4_events(events)


def aedat4_field(data, field, width):
    """Return where a field of the root table is, 0 by default, -1 outside."""
    def number(form, at):
        if at < 0:
            raise struct.error
        return struct.unpack_from(form, data, at)[0]

    try:
        table = 4 + number("<I", 4)
        vtable = table - number("<i", table)
        length, _ = number("<H", vtable), number("<H", vtable + 2)
        step = number("<H", vtable + 4 + 2 * field) if 6 + 2 * field <= length else 0
    except struct.error:
        return -1
    return 0 if not step else table + step if table + step + width <= len(data) else -1


def aedat4_vector(data, field, item):
    """Return where the items of a vector lie, -1 outside, and their number."""
    at = aedat4_field(data, field, 4)
    if at <= 0:
        return at, 0
    at += struct.unpack_from("<I", data, at)[0]
    if at + 4 > len(data):
        return -1, 0
    count = struct.unpack_from("<I", data, at)[0]
    return at + 4 if at + 4 + item * count <= len(data) else -1, count


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


class _Taken:
    """Events that lie on the sensor."""

    def __init__(self, height, width):
        self.out, self.size = [], (height, width)

    def add(self, t, x, y, p):
        """Take an event or drop it."""
        if 0 <= y < self.size[0] and 0 <= x < self.size[1] and 0 <= p <= 1:
            self.out.append((t, x, y, p))


def settle(times, *, reach=8, equal=64, last=-(1 << 61), segments=True):
    """Return (index, time) of the times that are in order, and how many segments began.

    Where one is before the last, the fewest values are dropped: the last of those that
    were accepted, or those of the next `reach` that are behind.
    """
    kept, i, offset, jumps, floor = [], 0, 0, 0, last
    far = 1 << 61
    while i < len(times):
        t, before = times[i] + offset, kept[-1][1] if kept else floor
        if not (-(1 << 55) <= times[i] <= far and -(1 << 55) <= t <= far):
            i += 1
            continue
        if t >= before:
            kept.append((i, t))
            i += 1
            continue
        following = [min(max(t, -far), far) + offset for t in times[i:i + reach]]
        behind = [t for t in following if t < before]
        best, cut, at, values = len(behind), 0, len(kept), 0
        while at > 0 and values < reach and len(kept) - at < equal:
            value = kept[at - 1][1]
            while at > 0 and len(kept) - at < equal and kept[at - 1][1] == value:
                at -= 1
            values += 1
            rest = kept[at - 1][1] if at else floor
            cost = values + sum(t < rest for t in following)
            if cost < best or cost == best == 1:
                best, cut = cost, len(kept) - at
        if cut:
            del kept[-cut:]
            continue
        near = sorted(behind)
        n = len(near)
        spread = 10**6 + 4 * (near[3 * n // 4] - near[n // 4])
        if segments and n > 1 and 2 * n > len(following) and before - t > 10**6 and (
                abs(t - near[n // 2]) <= spread):
            lone = [k for k in range(1, min(4, len(kept)))
                    if kept[-k][1] - kept[-k - 1][1] > 3_600_000_000]
            if lone:
                del kept[-lone[-1]:]
            fall = (kept[-1][1] if kept else floor) - t
            offset += 1 << 32 if abs(fall - (1 << 32)) < 10**6 else fall + 1
            jumps += 1
        else:
            i += 1
    if len(kept) > 3 and kept[-1][1] - kept[-2][1] > 3_600_000_000:
        kept.pop()
    if len(kept) > 3 and floor == -far and kept[1][1] - kept[0][1] > 3_600_000_000:
        del kept[0]
    return kept, jumps


def right_times(words, version, before):
    """Return words without those from damaged upper bits of time to the next ones."""
    shift, kept, i = (28 if version == 2 else 12), [], 0
    values = words.tolist()
    while i < len(values):
        high = values[i] & (1 << shift) - 1
        if values[i] >> shift == 8:
            if before is not None and not before <= high <= before + 1:
                later = [k for k in range(i + 1, min(i + 4096, len(values)))
                         if values[k] >> shift == 8][:3]
                highs = [values[k] & (1 << shift) - 1 for k in later]
                going_on = [k for k, following in zip(later, highs, strict=True)
                            if before <= following < high
                            or high < before <= following]
                if 2 * len(going_on) > len(later):
                    i = going_on[0]
                    continue
            before = high
        kept.append(values[i])
        i += 1
    return kept, before


def words(pieces, version, height, width):
    """Decode pieces of words of EVT2 or EVT3.

    Returns the events, and the triggers as (time, whether rising, channel).
    """
    triggers = []
    loops, high, low, before = 0, None, 0, None
    row = column = polarity = 0
    taken = _Taken(height, width)
    for piece in pieces:
        kept, before = right_times(piece, version, before)
        for word in kept:
            kind = word >> (28 if version == 2 else 12)
            value = word & (0xFFFFFFF if version == 2 else 0xFFF)
            if kind == 8:
                span = 28 if version == 2 else 12
                if high is not None and high - value > 1 << (span - 1):
                    loops += 1
                low = 0 if value != high else low
                high = value
                base = (loops << span) + value << (6 if version == 2 else 12)
            elif kind == 10:
                if high is not None:
                    triggers.append((
                        base + (word >> 22 & 63 if version == 2 else low), word & 1,
                        word >> 8 & (31 if version == 2 else 15)))
            elif version == 2 and kind in (0, 1) and high is not None:
                taken.add(base + (word >> 22 & 63), word >> 11 & 2047, word & 2047,
                          kind)
            elif version == 3 and kind == 0:
                row = value & 2047
            elif version == 3 and kind == 6:
                low = value
            elif version == 3 and kind == 2 and high is not None:
                taken.add(base + low, value & 2047, row, value >> 11)
            elif version == 3 and kind == 3:
                column, polarity = value & 2047, value >> 11
            elif version == 3 and kind in (4, 5):
                bits = 12 if kind == 4 else 8
                for i in range(bits):
                    if word >> i & 1 and high is not None:
                        taken.add(base + low, column + i, row, polarity)
                column += bits
    return taken.out, triggers


def stream_events(data, atis, height, width):
    """Return the events of an Event Stream after its header, and what is left."""
    taken, t, i = _Taken(height, width), 0, 0
    while i < len(data):
        head = data[i]
        if head >= (252 if atis else 254):
            t += 63 * (head & 3) if atis else 127 * (head & 1)
            i += 1
            continue
        if i + 5 > len(data):
            break
        t += head >> 2 if atis else head >> 1
        x, y = struct.unpack_from("<HH", data, i + 1)
        if not (atis and head & 1):
            taken.add(t, x, height - 1 - y, head >> atis & 1)
        i += 5
    return taken.out, data[i:]


def text_rows(lines, order, more=False):
    """Return rows of t, x, y, p, nanounits of t, and how many lines are bad."""
    rows, bad = [], 0
    for line in lines:
        parts = re.sub('[,;"]', " ", line).split()
        if not parts or parts[0][0] in "#%":
            continue
        values = {}
        for name, part in zip(order, parts, strict=False):
            if re.fullmatch("true|false", part, re.IGNORECASE):
                part = str(int(part.lower() == "true"))
            if name != "_" and re.fullmatch(
                    r"[-+]?([0-8]?\d{1,18}(\.\d*)?|\.\d+)([eE][-+]?\d{1,3})?", part):
                value = Decimal(part)
                if "e" in part.lower():     # rounded
                    value = Decimal(round(value * 10**9)) / 10**9
                    if abs(value) > 2**62:
                        continue
                values[name] = value
        if sorted(values) != sorted(order.replace("_", "")) or (
                len(parts) > len(order) and not more) or any(
                values[name] % 1 for name in "xyp"):
            bad += 1
            continue
        nano = int(values["t"] % 1 * 10**9)
        rows.append([*(int(values[name]) for name in "txyp"), nano])
    return rows, bad


def text_events(lines, order, unit, height, width, more=False):
    """Return events of lines of text, and how many lines are bad."""
    taken, bad = _Taken(height, width), 0

    def read(line):
        rows, wrong = text_rows([line], order, more)
        for whole, x, y, p, nano in rows:
            return ({"us": whole, "ns": whole // 1000,
                     "s": whole * 10**6 + (nano + 500) // 1000,
                     "ms": whole * 1000 + (nano + 500_000) // 10**6}[unit],
                    x, y, p), wrong
        return None, wrong

    for row, wrong in map(read, lines):
        bad += wrong
        if row is not None:
            t, x, y, p = row
            taken.add(t, x, y, max(p, 0))
    return [row for row in taken.out if abs(row[0]) <= 2**61], bad


def event_rows(rows, height, width):
    """Return those of rows of t, x, y, p that lie on the sensor."""
    taken = _Taken(height, width)
    for t, x, y, p in rows:
        taken.add(t, x, y, max(p, 0))
    return taken.out
