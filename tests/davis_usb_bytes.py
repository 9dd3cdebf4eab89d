"""Words as a DAVIS346 sends them, written one by one; knows nothing of the library."""
import struct


class Words:
    """Collects words; times must not fall."""

    def __init__(self):
        self.words, self.time, self.row = [], 0, None

    def bytes(self):
        return struct.pack(f"<{len(self.words)}H", *self.words)

    def at(self, time):
        while self.time // 32768 < time // 32768:
            self.words.append(0x7001)
            self.time = (self.time // 32768 + 1) * 32768
        if time != self.time:
            self.words.append(0x8000 + time % 32768)
            self.time = time

    def special(self, code, time=None):
        if time is not None:
            self.at(time)
        self.words.append(code)

    def event(self, t, x, y, p):
        self.at(t)
        if y != self.row:
            self.words.append(0x1000 + y)
            self.row = y
        self.words.append((0x3000 if p else 0x2000) + x)

    def column(self, code, samples):
        self.special(code)
        self.words += [0x4000 + int(value) for value in samples]
        self.special(13)

    def global_frame(self, reset, signal, start, end, available):
        """Columns from the left, each from the top: reset, exposure, signal."""
        self.special(8, start - 100)
        for x in range(reset.shape[1]):
            self.column(11, reset[:, x])
        self.special(14, start)
        self.special(15, end)
        for x in range(reset.shape[1]):
            self.column(12, signal[:, x])
        self.special(10, available)

    def rolling_frame(self, reset, signal, starts, ends, available):
        """Columns by their times; a reset of one stands between signals of others."""
        self.special(9, min(starts))
        blocks = sorted([(t, 11, x) for x, t in enumerate(starts)]
                        + [(t, 12, x) for x, t in enumerate(ends)])
        for t, code, x in blocks:
            self.at(t)
            self.column(code, (reset if code == 11 else signal)[:, x])
        self.special(10, available)

    def imu(self, t, scale, values):
        """Write seven 16-bit numbers; scale says what is measured, and the ranges."""
        self.at(t)
        self.special(5)
        self.words.append(0x5300 + scale)
        for place, value in enumerate(values):
            if scale & (0x80 if place < 3 else 0x20 if place == 3 else 0x40):
                high, low = struct.pack(">h", value)
                self.words += [0x5000 + high, 0x5000 + low]
        self.special(7)
