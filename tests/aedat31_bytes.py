"""AEDAT-3.1 files byte by byte, from the format's description."""
import struct

import numpy as np
from test_aedat4 import joined


def packet(kind, size, ts_offset, overflow, events):
    """Return a packet: 28 bytes of header, then events of one size."""
    data = b"".join(events)
    n = len(events)
    return struct.pack("<hhiiiiii", kind, 1, size, ts_offset, overflow, n, n, n) + data


def stamped(t):
    """Return (overflow, 31-bit time)."""
    return t >> 31, t & 0x7FFFFFFF


def aedat31_file(recording):
    """Return a recording as AEDAT-3.1, in time order."""
    events, frames, imu, triggers = joined(recording.packets())
    height, width = recording.info.sensor_size
    parts = []
    for t, x, y, p in events.tolist():
        over, low = stamped(t)
        parts.append((t, over, 1, 8, 4, struct.pack(
            "<Ii", 1 | p << 1 | y << 2 | x << 17, low)))
    for frame in frames:
        over, _ = stamped(frame.available_us)
        times = [stamped(t)[1] for t in (
            frame.exposure_start_us, frame.available_us, frame.exposure_start_us,
            frame.exposure_end_us)]
        pixels = (np.clip(frame.dn, 0, 1023).astype("<u2") << 6).tobytes()
        data = struct.pack("<i4i4i", 1, *times, width, height, 0, 0) + pixels
        parts.append((frame.available_us, over, 2, len(data), 8, data))
    for s in imu:
        over, low = stamped(int(s["t"]))
        data = struct.pack("<ii7f", 1, low, *s["accel"], *s["gyro"], s["temperature"])
        parts.append((int(s["t"]), over, 3, 36, 4, data))
    codes = {1: 2, 2: 3, 3: 4}
    for t, kind in triggers[np.isin(triggers["type"], list(codes))].tolist():
        over, low = stamped(t)
        parts.append((t, over, 0, 8, 4, struct.pack("<Ii", 1 | codes[kind] << 1, low)))
    parts.sort(key=lambda part: part[0])
    head = (b"#!AER-DAT3.1\r\n#Format: RAW\r\n#Source 1: test\r\n"
            b"#Start-Time: 2017-05-05 12:00:00 (TZ+0200)\r\n#!END-HEADER\r\n")
    out, i = [head], 0
    while i < len(parts):
        _, over, kind, size, at, _ = parts[i]
        j = i
        while j < len(parts) and parts[j][1:4] == (over, kind, size) and j - i < 200:
            j += 1
        out.append(packet(kind, size, at, over, [part[5] for part in parts[i:j]]))
        i = j
    return b"".join(out)
