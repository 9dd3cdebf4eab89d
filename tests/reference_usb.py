"""A twin of the kernel that decodes a DAVIS346's words, one word at a time."""
import numpy as np

TRIGGERS = {3: 1, 2: 2, 4: 3, 17: 4, 16: 5, 8: 6, 9: 6, 10: 7, 14: 8, 15: 9}


class Stream:
    """What a stream of words holds, for pictures of columns from the left and top."""

    def __init__(self, size, turned=False):
        self.size, self.turned = size, turned
        self.base = self.time = 0
        self.row = self.shutter = self.reading = self.imu_bytes = None
        self.samples, self.events, self.imu, self.triggers = [], [], [], []
        self.frames, self.resets = [], 0
        self.counts = dict.fromkeys(
            ("outside", "backward", "unknown", "columns", "frames", "imu"), 0)

    def decode(self, words):
        for word in map(int, words):
            if word & 0x8000:
                time = self.base + word % 0x8000
                self.counts["backward"] += time < self.time
                self.time = max(self.time, time)
            else:
                name = ("special", "address", "event", "event", "sample", "byte",
                        "exposure", "wrap")[word >> 12]
                getattr(self, name)(word & 0xFFF, word >> 12)

    def address(self, data, code):
        self.row = data if data < self.size[self.turned] else None
        self.counts["outside"] += self.row is None

    def event(self, data, code):
        if self.row is None or data >= self.size[1 - self.turned]:
            self.counts["outside"] += 1
            return
        y, x = (data, self.row) if self.turned else (self.row, data)
        self.events.append((self.time, x, y, code - 2))

    def sample(self, data, code):
        if self.reading is not None:
            self.samples.append(data if data < 1024 else 65535)

    def exposure(self, data, code):
        pass

    def wrap(self, data, code):
        self.base += 32768 * data
        self.time = max(self.time, self.base)

    def byte(self, data, code):
        kind, data = divmod(data, 256)
        self.counts["unknown"] += kind > 3
        if self.imu_bytes is None:
            return
        if kind == 3:
            self.scale = data
            self.wanted = [p for p, mark in enumerate((128,) * 3 + (32,) + (64,) * 3)
                           if data & mark]
            self.imu_bytes = []
        elif kind == 0 and self.scale is not None:
            self.imu_bytes.append(data)
            if len(self.imu_bytes) > 2 * len(self.wanted):
                self.imu_bytes = None
                self.counts["imu"] += 1

    def special(self, code, _):
        if code in TRIGGERS:
            self.triggers.append((self.time, TRIGGERS[code]))
        if code == 1:
            self.counts["frames"] += self.shutter is not None
            self.shutter = self.reading = self.imu_bytes = None
            self.resets += 1
        elif code == 5:
            self.imu_bytes, self.scale = [], None
        elif code == 7:
            self.end_imu()
        elif code in (8, 9):
            self.counts["frames"] += self.shutter is not None
            self.shutter = code - 8
            self.reads, self.times = ([[], []] for _ in range(2))
            self.marked, self.reading = [None, None], None
        elif code == 10:
            self.end_frame()
        elif code in (11, 12):
            self.reading, self.samples = None, []
            if self.shutter is not None:
                if len(self.reads[code - 11]) < self.size[1]:
                    self.reading = code - 11
                    self.times[code - 11].append(self.time)
                else:
                    self.reads[code - 11].append(None)      # one too many
        elif code == 13 and self.reading is not None:
            whole = len(self.samples) == self.size[0]
            self.counts["columns"] += not whole
            self.reads[self.reading].append(
                self.samples if whole else [65535] * self.size[0])
            self.reading = None
        elif code in (14, 15) and self.shutter is not None:
            self.marked[code - 14] = self.time
        self.counts["unknown"] += code == 0 or code > 17

    def end_imu(self):
        if self.imu_bytes is not None:
            whole = self.scale is not None and (
                len(self.imu_bytes) == 2 * len(self.wanted))
            self.counts["imu"] += not whole
            if whole:
                values = np.zeros(7, int)
                values[self.wanted] = np.frombuffer(bytes(self.imu_bytes), ">i2")
                self.imu.append((self.time, self.scale, *values.tolist()))
        self.imu_bytes = None

    def end_frame(self):
        if self.shutter is not None:
            if all(len(read) == self.size[1] for read in self.reads):
                self.frames.append((
                    self.shutter, np.array(self.reads).swapaxes(1, 2).tolist(),
                    self.times, self.time))
            else:
                self.counts["frames"] += 1
        self.shutter = self.reading = None
