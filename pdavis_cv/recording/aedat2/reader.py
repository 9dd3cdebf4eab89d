"""Recordings in AEDAT-2.0, the format of jAER before AEDAT-4, and of v2e."""
from __future__ import annotations

import re
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from pdavis_cv.errors import RecordingError
from pdavis_cv.recording.aedat2.addresses import camera_of
from pdavis_cv.recording.aedat2.decoder import CHUNK_WORDS, Decoder, ImuScale, Mark
from pdavis_cv.recording.aedat2.header import DVS128, SOURCE, bias_currents, read_header
from pdavis_cv.recording.base import RecordingInfo
from pdavis_cv.recording.facts import ASSUMED, CALLER, FILE, MEASURED, Fact, stated
from pdavis_cv.recording.options import SourceOptions
from pdavis_cv.recording.packetise import Batch, cell_start
from pdavis_cv.recording.scratch import Scratch
from pdavis_cv.recording.sequential import PiecewiseRecording
from pdavis_cv.recording.timeline import NEVER, Marks
from pdavis_cv.sensor import Sensor

WARM_UP_US = 2_000_000
"""Time by which reading begins before the interval; longer than any frame takes."""
PROBE_WORDS = 1 << 13
MOST_PROBES = 1 << 10
MAX_HEIGHT, MAX_WIDTH = 512, 1024
"""What the bits of an address can hold."""
_SERIAL = re.compile(r"[-_]([0-9A-F]{8}|\d{3,8})(?=[-_.]|$)")


class Aedat2Recording(PiecewiseRecording):
    """A recording in AEDAT-2.0; see `open_recording`.

    Rows and columns are those of the image: row 0 at the top, no mirror.  IMU signs are
    jAER's (``info.header["imu_axes"]``).  A stated ``camera`` must be part of the
    chip's name; ``sensor_size`` is needed if no chip is named and the addresses fit
    several.
    """

    def _open(self, options: SourceOptions) -> RecordingInfo:
        self._reader = self._bytes()
        self._header = read_header(self._reader)
        self._marks = Marks(2)
        self._size_fact, self._dvs128 = self._sensor(options)
        self._size: tuple[int, int] = self._size_fact.value
        return self._make_info(options)

    def _sensor(self, options: SourceOptions) -> tuple[Fact, bool]:
        """Return (height, width), and whether addresses are those of a DVS128."""
        chip = self._header.chip
        self._check_camera(options.camera, chip)
        size = self._header.size
        if size is not None:
            return Fact(size, FILE), str(chip).lower().startswith(DVS128)
        if options.size is None and chip is not None and (
                not chip.lower().startswith("davis")):
            raise RecordingError(
                f"{self.path}: chip {chip} is not known: if its addresses are those of "
                "a DAVIS, sensor_size=(height, width) states its size")
        found, dvs128, seen = camera_of(self._probed())
        if options.size is not None:
            height, width = options.size
            if height > MAX_HEIGHT or width > MAX_WIDTH:
                raise RecordingError(
                    f"{self.path}: a sensor of {width}x{height} pixels, but addresses "
                    f"hold {MAX_WIDTH}x{MAX_HEIGHT}")
            return Fact(options.size, CALLER), dvs128 and options.size == found
        names = f"the header names {'no chip' if chip is None else chip}"
        if found is None:
            raise RecordingError(
                f"{self.path}: {names} and {seen}: the sensor is stated by "
                "sensor_size=(height, width)")
        fact = Fact(found, MEASURED if dvs128 else ASSUMED)
        self._log.add(
            "unknown chip", None, f"{names}: {seen}; size {fact.origin}: {found[1]}x"
            f"{found[0]}; sensor_size=(height, width) sets another")
        return fact, dvs128

    def _make_info(self, options: SourceOptions) -> RecordingInfo:
        header = self._header
        first = self._reader.read(header.data_start, 8)
        start = None if len(first) < 8 else header.origin_us + int.from_bytes(
            first[4:], "big", signed=True)
        clock = header.start_ms
        if clock is None and SOURCE not in header.facts:    # a copy is made later
            clock = header.creation_ms
        serial = _SERIAL.search(self.path.stem)
        said = " ".join(f"{key} {value}" for key, value in header.facts.items()).lower()
        # Bit 31 set: not an event.  Bits 10 and 11 both set: IMU.  If a camera sent
        # frames, they are at least a fifth of its words.
        has_frames = any(np.any((address & 0x80000800) == 0x80000000)
                         for address in self._probed())
        return RecordingInfo(
            format="AEDAT-2.0", writer=next((name for name in (
                "pdavis_cv", "v2e", "jAER") if name.lower() in said), None),
            camera=header.chip, serial=serial[1] if serial else None, start_us=start,
            frame_count=None if has_frames else 0, **stated(
                options, header.facts.get(SOURCE), sensor_size=self._size_fact,
                sensor=Sensor.of_chip(header.chip), frame_times="time stamps",
                exposure_us=header.number("APS.Exposure") or None, full_scale_dn=1023,
                biases=bias_currents(header)),
            wall_clock_us=None if clock is None else clock * 1000 - (start or 0),
            header={"first_row": "bottom", "imu_axes": "jAER",
                    "shutter": {True: "global", False: "rolling",
                                None: "unknown"}[header.global_shutter],
                    "data_start": header.data_start,
                    "preferences": dict(header.preferences), **header.facts})

    def _probed(self) -> Iterator[NDArray[np.uint32]]:
        """Yield a file's addresses; of one over 64 MiB, at 1024 even places."""
        left = self.word_count
        step = max(PROBE_WORDS, left // MOST_PROBES)
        for at in range(0, left, step):
            data = self._reader.read(
                self._header.data_start + 8 * at, 8 * min(PROBE_WORDS, left - at))
            yield np.frombuffer(data, ">u4", len(data) // 8 * 2)[::2].astype(np.uint32)

    def _decoder(self, mark: Mark, quiet_us: int = NEVER) -> Decoder:
        accel = self._header.number("IMU.AccelFullScale")
        gyro = self._header.number("IMU.GyroFullScale")
        # jAER falls back on 8 g and 1000 degrees per second.
        g = accel if accel in (0, 1, 2, 3) else 2
        rate = gyro if gyro in (0, 1, 2, 3) else 2
        scale = ImuScale(1 / (16384 >> g), 1 / (131.0, 65.5, 32.8, 16.4)[rate])
        return Decoder(
            self._reader, self._log, self._count, self._header.data_start,
            self._header.origin_us, self._size, mark=mark, quiet_us=quiet_us,
            global_shutter=self._header.global_shutter, scale=scale,
            dvs128=self._dvs128)

    def _pieces(self, start_us: int | None, memory: Scratch, *, frames: bool = True
                ) -> Iterator[tuple[Batch, float]]:
        """Yield the samples of each chunk, and the share of the file read by then."""
        mark, quiet = Mark.first(), NEVER
        if start_us is not None and (found := self._marks.before(
                cell_start(start_us) - WARM_UP_US)) is not None:
            mark, quiet = found, cell_start(start_us)
        decoder = self._decoder(mark, quiet)
        ended = decoder.clock.last
        for batch in decoder.batches(memory, frames=frames):
            self._marks.note(decoder.chunk, decoder.clock.last, decoder.mark)
            for frame in batch.frames:
                before, ended = ended, frame.available_us
                if ended - np.min(frame.exposure_start_us) > WARM_UP_US:
                    self._marks.cover(before, ended)    # time jumped inside the frame
            yield batch, min(decoder.chunk * CHUNK_WORDS / max(self.word_count, 1), 1.0)
        decoder.check_end()

    @property
    def word_count(self) -> int:
        """Number of words in the file, of any kind."""
        return max(self._reader.size - self._header.data_start, 0) // 8
