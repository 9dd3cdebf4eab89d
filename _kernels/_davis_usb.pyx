"""Words that a DAVIS346 sends over USB: events, frames, IMU samples, triggers.

Facts: iniVation's libcaer (davis.c, timestamps.h) and neuromorphic-drivers
(adapters/davis346.rs), which agree but where a comment says so.  Bit 15 marks 15 bits
of time in us; else bits 14-12 are a code and bits 11-0 its data.
"""
from libc.stdint cimport int16_t, int64_t, uint16_t
from libc.string cimport memset

from _kernels._types cimport event_t

# Codes.
cdef enum:
    SPECIAL = 0
    ROW_ADDRESS = 1
    OFF_EVENT = 2       # its column; 3 is ON
    ON_EVENT = 3
    SAMPLE = 4          # of the converter
    BYTE = 5            # bits 11-8 say of what
    WRAP = 7            # of time: data times 2**15 us

# Specials.
cdef enum:
    RESERVED = 0
    TIME_RESET = 1
    FALLING = 2
    RISING = 3
    PULSE = 4
    IMU_START = 5
    IMU_END = 7
    GLOBAL_START = 8
    ROLLING_START = 9
    FRAME_END = 10
    RESET_COLUMN = 11
    SIGNAL_COLUMN = 12
    COLUMN_END = 13
    EXPOSURE_START = 14
    EXPOSURE_END = 15
    GENERATOR_FALLING = 16
    GENERATOR_RISING = 17

# Indices in the state of a stream; a negative value is none.
cdef enum:
    EVENTS = 0          # in the output, as are the next two
    IMU_SAMPLES = 1
    TRIGGERS = 2
    BASE = 3            # us, added to the 15 bits of time
    TIME = 4            # us
    ROW = 5
    SHUTTER = 6         # of the frame that is read: 0 global, 1 rolling
    EXPOSED_FROM = 7    # us, beginning of the exposure as the camera marks it
    EXPOSED_UNTIL = 8   # us, its end
    RESET_DONE = 9      # us, end of the last reset column
    RESETS = 10         # number of reset columns so far, complete or not
    SIGNALS = 11        # number of signal columns
    READ = 12           # kind of column being read: 0 reset, 1 signal
    PLACE = 13          # index of the next sample in its column
    IMU_BYTES = 14      # index of the next byte of a sample
    IMU_SCALE = 15      # byte of the ranges and of the sensors that are on
    IMU_VALUES = 16     # seven
    OUTSIDE = 23        # counts: events and rows outside the sensor
    BACKWARD = 24       # times that run backward
    UNKNOWN = 25        # words of an undefined kind
    CUT_COLUMNS = 26    # with too few or too many samples
    CUT_FRAMES = 27     # with too few columns, or without an end
    CUT_IMU = 28
    STREAM = 29

cdef enum:
    IMU_ROW = 9         # time, scale, seven values
    MISSING = 65535     # no sample

# Reason for which the kernel returns.
cdef enum:
    FULL = 0            # all words are decoded, or an output is full
    FRAME = 1           # a frame has ended
    RESET = 2           # the camera's clock was reset to 0


cdef inline void start_frame(int64_t* s, int64_t shutter) noexcept nogil:
    if s[SHUTTER] >= 0:
        s[CUT_FRAMES] += 1
    s[SHUTTER] = shutter
    s[EXPOSED_FROM] = s[EXPOSED_UNTIL] = s[RESET_DONE] = -1
    s[RESETS] = s[SIGNALS] = 0
    s[READ] = -1


cdef inline void end_column(int64_t* s, uint16_t* reads, Py_ssize_t columns,
                            Py_ssize_t rows) noexcept nogil:
    """Count a column; one with too few or too many samples is shifted: discard it."""
    if s[READ] < 0:
        return
    if s[PLACE] != rows:
        s[CUT_COLUMNS] += 1
        memset(reads + (s[READ] * columns + s[RESETS + s[READ]]) * rows, 0xFF,
               rows * sizeof(uint16_t))
    if s[READ] == 0:
        s[RESETS] += 1
        s[RESET_DONE] = s[TIME]
    else:
        s[SIGNALS] += 1
    s[READ] = -1


cdef inline void begin_column(int64_t* s, int read, int64_t* times,
                              Py_ssize_t columns) noexcept nogil:
    """Prepare for the samples of a column, unless there are enough already."""
    cdef int64_t column = s[RESETS + read]
    s[READ] = -1
    if s[SHUTTER] < 0:
        return
    if column >= columns:
        s[RESETS + read] += 1
        return
    times[read * columns + column] = s[TIME]
    s[READ] = read
    s[PLACE] = 0


cdef inline int64_t after_byte(int64_t place, int64_t scale) noexcept nogil:
    """Return the index of the next byte, which skips sensors that are off."""
    if place == 0 and not scale & 0x80:     # accelerations
        place = 6
    if place == 6 and not scale & 0x20:     # temperature
        place = 8
    if place == 8 and not scale & 0x40:     # rates of turn
        place = 14
    return place


cdef inline int trigger_type(int special) noexcept nogil:
    """Return a special's type in AEDAT-4, or -1."""
    if special == RISING:
        return 1
    if special == FALLING:
        return 2
    if special == PULSE:
        return 3
    if special == GENERATOR_RISING:
        return 4
    if special == GENERATOR_FALLING:
        return 5
    if special == GLOBAL_START or special == ROLLING_START:
        return 6
    if special == FRAME_END:
        return 7
    if special == EXPOSURE_START:
        return 8
    if special == EXPOSURE_END:
        return 9
    return -1


def davis_words(const uint16_t[::1] words not None, Py_ssize_t begin, bint turned,
                Py_ssize_t height, Py_ssize_t width, int64_t[::1] state not None,
                uint16_t[:, :, ::1] reads not None,
                int64_t[:, ::1] times not None, event_t[::1] out not None,
                int64_t[:, ::1] imu not None, int64_t[:, ::1] triggers not None):
    """Decode words from begin on while there is room; return (index, reason).

    height and width are those of the sensor; turned: addresses of rows are columns.
    reads (2, columns, rows) receives resets and signals as they are read out, column
    after column, times (2, columns) the times at which columns began.  The reason is 1
    after the end of a complete frame, 2 after a reset of the clock, to which the caller
    adapts BASE.  state is kept from call to call.
    """
    cdef Py_ssize_t i = begin, n = words.shape[0], room = out.shape[0]
    cdef Py_ssize_t columns = reads.shape[1], rows = reads.shape[2], at, place, k
    cdef Py_ssize_t imu_room = imu.shape[0], trigger_room = triggers.shape[0]
    cdef int64_t base, t, candidate, row, most_rows, most_columns
    cdef uint16_t word, data
    cdef int64_t backward = 0, outside = 0
    cdef int code, kind, why = FULL
    cdef event_t* event
    cdef event_t* last
    cdef int64_t* s
    cdef uint16_t* pixels
    if (state.shape[0] != STREAM or reads.shape[0] != 2 or times.shape[0] != 2
            or times.shape[1] != columns or imu.shape[1] != IMU_ROW
            or triggers.shape[1] != 2):
        raise ValueError("davis_words: an array has the wrong shape")
    if columns == 0 or rows == 0 or room == 0 or imu_room == 0 or trigger_room == 0:
        raise ValueError("davis_words: an array is empty")
    if begin < 0 or begin > n:
        raise ValueError("davis_words: begin lies outside words")
    if (min(state[EVENTS], state[IMU_SAMPLES], state[TRIGGERS]) < 0
            or state[EVENTS] > room or state[IMU_SAMPLES] > imu_room
            or state[TRIGGERS] > trigger_room or state[READ] > 1
            or state[RESETS] < 0 or state[SIGNALS] < 0 or state[PLACE] < 0
            or state[IMU_BYTES] > 14
            or (state[READ] >= 0 and state[RESETS + state[READ]] >= columns)):
        raise ValueError("davis_words: state lies outside an array")
    s, pixels = &state[0], &reads[0, 0, 0]
    base, t, row = s[BASE], s[TIME], s[ROW]
    event, last = &out[0] + s[EVENTS], &out[0] + room
    most_rows, most_columns = (width, height) if turned else (height, width)
    with nogil:
        while i < n and event < last:
            word = words[i]
            code = word >> 12
            data = word & 0xFFF
            i += 1
            # Nearly all words of a busy sensor are of these three kinds.
            if word & 0x8000:
                candidate = base + (word & 0x7FFF)
                if candidate >= t:
                    t = candidate
                else:
                    backward += 1
                continue
            if (code & 0xE) == OFF_EVENT:
                if data < most_columns and row >= 0:
                    event.t = t
                    event.x = <uint16_t>(row if turned else data)
                    event.y = <uint16_t>(data if turned else row)
                    event.p = code & 1
                    event += 1
                else:
                    outside += 1
                continue
            if code == ROW_ADDRESS:
                row = data
                if row >= most_rows:
                    row = -1
                    outside += 1
                continue
            s[TIME] = t
            if code == SAMPLE:
                if s[READ] < 0:
                    continue
                place = s[PLACE]
                at = (s[READ] * columns + s[RESETS + s[READ]]) * rows
                while True:
                    if place < rows:
                        # Ten bits; more are damage.
                        pixels[at + place] = data if data < 1024 else MISSING
                    place += 1
                    if i == n or words[i] >> 12 != SAMPLE:
                        break
                    data = words[i] & 0xFFF
                    i += 1
                s[PLACE] = place
            elif code == WRAP:
                base += <int64_t>data << 15
                t = max(t, base)
            elif code == BYTE:
                kind = data >> 8
                data &= 0xFF
                if kind == 3 and s[IMU_BYTES] >= 0:
                    s[IMU_SCALE] = data
                    memset(&s[IMU_VALUES], 0, 7 * sizeof(int64_t))
                    s[IMU_BYTES] = after_byte(0, data)
                elif kind == 0 and s[IMU_BYTES] >= 0 and s[IMU_SCALE] >= 0:
                    if s[IMU_BYTES] >= 14:
                        s[IMU_BYTES] = -1       # too many
                        s[CUT_IMU] += 1
                    else:
                        k = IMU_VALUES + s[IMU_BYTES] // 2
                        if s[IMU_BYTES] % 2 == 0:
                            s[k] = data
                        else:
                            s[k] = <int16_t>((s[k] & 0xFF) << 8 | data)
                        s[IMU_BYTES] = after_byte(s[IMU_BYTES] + 1, s[IMU_SCALE])
                elif kind > 3:
                    s[UNKNOWN] += 1
            elif code == SPECIAL:
                kind = trigger_type(data)
                if kind >= 0:
                    triggers[s[TRIGGERS], 0] = t
                    triggers[s[TRIGGERS], 1] = kind
                    s[TRIGGERS] += 1
                if data == TIME_RESET:
                    s[CUT_FRAMES] += s[SHUTTER] >= 0
                    s[SHUTTER] = s[READ] = s[IMU_BYTES] = -1
                    why = RESET
                elif data == IMU_START:
                    s[IMU_BYTES] = 0
                    s[IMU_SCALE] = -1
                elif data == IMU_END:
                    if s[IMU_BYTES] == 14:
                        # As libcaer, of the time of the end, so that order is kept.
                        imu[s[IMU_SAMPLES], 0] = t
                        for k in range(8):
                            imu[s[IMU_SAMPLES], 1 + k] = s[IMU_SCALE + k]
                        s[IMU_SAMPLES] += 1
                    elif s[IMU_BYTES] >= 0:
                        s[CUT_IMU] += 1
                    s[IMU_BYTES] = -1
                elif data == GLOBAL_START or data == ROLLING_START:
                    start_frame(s, data - GLOBAL_START)
                    memset(pixels, 0xFF, 2 * columns * rows * sizeof(uint16_t))
                elif data == FRAME_END:
                    if s[SHUTTER] >= 0:
                        if s[RESETS] == columns and s[SIGNALS] == columns:
                            why = FRAME
                        else:
                            s[CUT_FRAMES] += 1
                    if why != FRAME:
                        s[SHUTTER] = -1
                    s[READ] = -1
                elif data == RESET_COLUMN or data == SIGNAL_COLUMN:
                    begin_column(s, data - RESET_COLUMN, &times[0, 0], columns)
                elif data == COLUMN_END:
                    end_column(s, pixels, columns, rows)
                elif data == EXPOSURE_START:
                    s[EXPOSED_FROM] = t
                elif data == EXPOSURE_END:
                    s[EXPOSED_UNTIL] = t
                elif data > GENERATOR_RISING or data == RESERVED:
                    s[UNKNOWN] += 1
                if (why != FULL or s[TRIGGERS] == trigger_room
                        or s[IMU_SAMPLES] == imu_room):
                    break
            # Code 6 holds what the camera's own automatic exposure measured.
        s[EVENTS], s[BASE], s[TIME], s[ROW] = event - &out[0], base, t, row
        s[BACKWARD] += backward
        s[OUTSIDE] += outside
    return i, why
