"""AEDAT-2.0 files byte by byte, from the format's description, not from our writer."""
import struct

import numpy as np

HEIGHT, WIDTH = 260, 346
START = b"#!AER-DAT2.0\r\n# This is a raw AE data file - do not edit\r\n"
CHIP = b"# AEChip: eu.seebetter.ini.chips.davis.Davis346red\r\n"
END = b"#End Of ASCII Header\r\n"
HEADER = START + CHIP + END


def word(address, t):
    """Return one record: big-endian address and time, both 32 bits."""
    return struct.pack(">II", address & 0xFFFFFFFF, t & 0xFFFFFFFF)


def dvs(row, column, on, t, flag=0):
    """Return an event at an image position: y from the bottom, x mirrored."""
    y, x = HEIGHT - 1 - row, WIDTH - 1 - column
    return word(y << 22 | x << 12 | on << 11 | flag << 10, t)


def aps(row, column, kind, sample, t):
    """Return a sample of a frame: kind 0 is a reset read, 1 a signal read."""
    return word(1 << 31 | (HEIGHT - 1 - row) << 22 | column << 12 | kind << 10
                | int(sample), t)


def imu(code, value, t):
    """Return one word of an IMU sample."""
    return word(1 << 31 | code << 28 | (value & 0xFFFF) << 12 | 0xC00, t)


def column_reads(kind, image, column, t):
    """Return the samples of one column, which share one time."""
    words = np.empty((HEIGHT, 2), ">u4")
    y = np.arange(HEIGHT - 1, -1, -1)
    words[:, 0] = 1 << 31 | y << 22 | column << 12 | kind << 10 | image[:, column]
    words[:, 1] = t
    return words.tobytes()


def global_frame(reset, signal, start, exposure, *, columns=range(WIDTH), step=10):
    """Return a frame whose resets all come before its signals."""
    columns = list(columns)
    last = start + step * (len(columns) - 1)
    data = [column_reads(0, reset, c, start + step * i)
            for i, c in enumerate(columns)]
    data += [column_reads(1, signal, c, last + exposure + step * i)
             for i, c in enumerate(columns)]
    return b"".join(data)


def rolling_frame(reset, signal, start, lag, *, columns=range(WIDTH), step=10):
    """Return a frame whose signal reads follow each column's reset by lag columns."""
    columns = list(columns)
    data = []
    for i in range(len(columns) + lag):
        t = start + step * i
        if i < len(columns):
            data.append(column_reads(0, reset, columns[i], t))
        if i >= lag:
            data.append(column_reads(1, signal, columns[i - lag], t + 1))
    return b"".join(data)


def reads(seed):
    """Return reset and signal images without saturated pixels."""
    rng = np.random.default_rng(seed)
    return (rng.integers(700, 1000, (HEIGHT, WIDTH)),
            rng.integers(10, 700, (HEIGHT, WIDTH)))
