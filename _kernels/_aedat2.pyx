"""AEDAT-2.0: big-endian words of address and time.

Words become rows first, in place of events, which a clock puts in order: an event has
its pixel, any other word its address.  Then rows become samples.

Facts: the address layout of the DAVIS cameras as jAER and iniVation document it.
"""
from libc.stdint cimport (
    int16_t, int32_t, int64_t, uint8_t, uint16_t, uint32_t, uint64_t)

from _kernels._check cimport FILLED, ORDERED, STATE
from _kernels._types cimport event_t

cdef enum:
    OTHER = 2           # in place of a polarity: x and y are halves of an address

# Indices in the state of the sample streams.
cdef enum:
    TIME = 0            # of the last row taken
    OUTSIDE = 1         # words dropped because they lie outside the sensor
    UNKNOWN = 2         # words of an undefined kind
    EVENTS = 3          # taken into the outputs so far
    SAMPLES = 4
    TRIGGERS = 5
    LABELLED = 6        # events with the special bit, v2e's label of noise
    CODE = 7            # next IMU code expected, 0 = none begun
    SAMPLE_STATE = 8

# Indices in the state of the frame that is being assembled.
cdef enum:
    RESETS = 0          # number of pixels whose reset was read
    SIGNALS = 1         # likewise of signals
    COLUMN = 2          # column of the last reset, -1 before the first
    FIRST_RESET = 3     # times
    LAST_RESET = 4
    FIRST_SIGNAL = 5
    LAST_SIGNAL = 6
    INTERLEAVED = 7     # a reset came after a signal: rolling shutter
    SIGNAL_COLUMN = 8
    FRAME_STATE = 9

cdef enum:
    END = 0             # all rows were taken
    WHOLE = 1           # the last row taken completed a frame
    NEXT = 2            # this row begins a new frame, the last is not complete

cdef enum:
    RESET_SEEN = 1
    SIGNAL_SEEN = 2


cdef inline uint64_t word(const uint8_t* at) noexcept nogil:
    """Return address << 32 | time; compilers make one byte-swapped load of it."""
    return (<uint64_t>at[0] << 56 | <uint64_t>at[1] << 48 | <uint64_t>at[2] << 40
            | <uint64_t>at[3] << 32 | <uint64_t>at[4] << 24 | <uint64_t>at[5] << 16
            | <uint64_t>at[6] << 8 | <uint64_t>at[7])


cdef inline Py_ssize_t plain(const uint8_t* source, Py_ssize_t n, int64_t origin,
                             uint32_t height, uint32_t width, event_t* out,
                             bint* fallen) noexcept nogil:
    """Decode words while they are events inside; return how many.

    It reads one word beyond the last that it decodes: source holds n + 1.
    """
    cdef Py_ssize_t i
    cdef uint32_t address, x, y
    cdef int32_t t, following
    cdef uint64_t here = word(source)
    cdef uint32_t right = width - 1, bottom = height - 1
    for i in range(n):
        address = <uint32_t>(here >> 32)
        t = <int32_t>here
        here = word(source + 8 * (i + 1))
        following = <int32_t>here
        # Unsigned: coordinates off the sensor, and words of other kinds, become large.
        x = right - (address >> 12 & 0x3FF)
        y = bottom - (address >> 22)
        if (following < t) | (x > right) | (y > bottom) | (address >> 10 & 1):
            fallen[0] |= following < t
            if (x > right) | (y > bottom) | (address >> 10 & 1):
                return i
        out[i].t = t + origin
        out[i].x = <uint16_t>x
        out[i].y = <uint16_t>y
        out[i].p = address >> 11 & 1
    return n


def aedat2_rows(const uint8_t[:, ::1] words not None, Py_ssize_t n, int64_t origin,
                uint32_t height, uint32_t width, int64_t[::1] state not None,
                event_t[::1] out not None):
    """Append a row for each of n words to out; return how many are not plain events.

    The word after them is looked at as well.  origin is added to times.
    """
    cdef Py_ssize_t i = 0, others = 0
    cdef uint64_t here, following
    cdef bint fallen = False
    cdef const uint8_t* source
    cdef event_t* to
    if (words.shape[1] != 8 or state.shape[0] != STATE or height > 512 or width > 1024
            or height < 1 or width < 1):
        raise ValueError("aedat2_rows: an array has the wrong shape")
    if not 0 <= n < words.shape[0] or state[FILLED] < 0 or (
            out.shape[0] - state[FILLED] < n):
        raise ValueError("aedat2_rows: words or out is too small")
    if n == 0:
        return 0
    source, to = &words[0, 0], &out[0] + state[FILLED]
    with nogil:
        while True:
            i += plain(source + 8 * i, n - i, origin, height, width, to + i, &fallen)
            if i == n:
                break
            while True:     # words of other kinds come in runs
                here = word(source + 8 * i)
                to[i].t = <int32_t>here + origin
                to[i].x = <uint16_t>(here >> 32)
                to[i].y = <uint16_t>(here >> 48)
                to[i].p = OTHER
                others += 1
                i += 1
                following = word(source + 8 * i)
                fallen |= <int32_t>following < <int32_t>here
                if i == n or not following >> 63:
                    break
    state[FILLED] += n
    if fallen:
        state[ORDERED] = -1
    return others


cdef inline int aps(Py_ssize_t column, Py_ssize_t row, uint32_t address, int64_t t,
                    int64_t* frame, uint16_t[:, ::1] reset,
                    uint16_t[:, ::1] signal, uint8_t[:, ::1] seen,
                    int64_t[:, ::1] times) noexcept nogil:
    """Store one sample of a frame; return END, WHOLE or NEXT."""
    cdef Py_ssize_t width = seen.shape[1]
    if address & 0x400:
        # A signal for the second time: the next frame's resets were lost.
        if seen[row, column] & SIGNAL_SEEN:
            return NEXT
        if frame[SIGNALS] == 0:
            frame[FIRST_SIGNAL] = t
        if frame[SIGNAL_COLUMN] != column:
            times[1, column] = t
        frame[SIGNAL_COLUMN] = column
        frame[LAST_SIGNAL] = t
        frame[SIGNALS] += 1
        seen[row, column] |= SIGNAL_SEEN
        signal[row, column] = <uint16_t>(address & 0x3FF)
        if frame[SIGNALS] == seen.shape[0] * width:
            return WHOLE
        return END
    # Cameras send columns, converters of files rows, so that the order of samples does
    # not delimit frames.  A pixel's second reset belongs to the next frame, and so does
    # a reset after signals without one, where the file begins inside a frame.
    if seen[row, column] & RESET_SEEN or (
            frame[RESETS] == 0 and frame[SIGNALS] > 0):
        return NEXT
    if frame[RESETS] == 0:
        frame[FIRST_RESET] = t
    if frame[COLUMN] != column:
        times[0, column] = t
    if frame[SIGNALS] > 0:
        frame[INTERLEAVED] = 1
    frame[COLUMN] = column
    frame[LAST_RESET] = t
    frame[RESETS] += 1
    seen[row, column] |= RESET_SEEN
    reset[row, column] = <uint16_t>(address & 0x3FF)
    return END


def aedat2_samples(event_t[::1] rows not None, Py_ssize_t begin,
                   int64_t[::1] state not None,
                   int64_t[::1] frame not None, uint16_t[:, ::1] reset not None,
                   uint16_t[:, ::1] signal not None, uint8_t[:, ::1] seen not None,
                   int64_t[:, ::1] times not None, int16_t[::1] sample not None,
                   int64_t[::1] imu_t not None, int16_t[:, ::1] imu not None,
                   int64_t[::1] trigger_t not None, uint8_t[::1] trigger not None):
    """Decode rows from begin on; return (index, reason).

    Events move to the beginning of rows.  The reason to stop is 0 at the end, 1 after a
    whole frame, 2 before a row that belongs to the next frame.  reset, signal, seen and
    times hold the frame being assembled, rows from the top.
    """
    cdef Py_ssize_t height = seen.shape[0], width = seen.shape[1], n = rows.shape[0]
    cdef Py_ssize_t i, x, y, taken
    cdef int64_t t
    cdef uint32_t address
    cdef int code, why = END
    cdef event_t* r
    cdef int64_t* s
    if (state.shape[0] != SAMPLE_STATE or frame.shape[0] != FRAME_STATE
            or times.shape[0] != 2 or times.shape[1] != width or sample.shape[0] != 7
            or imu.shape[1] != 7 or reset.shape[0] != height
            or reset.shape[1] != width or signal.shape[0] != height
            or signal.shape[1] != width):
        raise ValueError("aedat2_samples: an array has the wrong shape")
    if (begin < 0 or begin > n or not 0 <= state[EVENTS] <= begin
            or state[SAMPLES] < 0 or state[TRIGGERS] < 0
            or trigger_t.shape[0] - state[TRIGGERS] < n - begin
            or trigger.shape[0] < trigger_t.shape[0]
            or imu_t.shape[0] - state[SAMPLES] < (n - begin + 6) // 7
            or imu.shape[0] < imu_t.shape[0]
            or state[CODE] < 0 or state[CODE] > 6):
        raise ValueError("aedat2_samples: an output is too small")
    if begin == n:
        return n, END
    s, r = &state[0], &rows[0]
    i, taken = begin, s[EVENTS]
    with nogil:
        while i < n:
            t = r[i].t
            if r[i].p != OTHER:
                if taken < i:
                    r[taken] = r[i]
                taken += 1
                i += 1
                continue
            address = <uint32_t>r[i].y << 16 | r[i].x
            x = address >> 12 & 0x3FF
            y = height - 1 - <Py_ssize_t>(address >> 22 & 0x1FF)
            if not address & 0x80000000u:
                if address & 0x400 and x == 0 and y == height - 1 and address & 0x3FF:
                    code = address & 0x3FF
                    if code < 2 or code > 4:
                        s[UNKNOWN] += 1
                    else:
                        trigger_t[s[TRIGGERS]] = t
                        trigger[s[TRIGGERS]] = <uint8_t>code
                        s[TRIGGERS] += 1
                elif y < 0 or x >= width:
                    s[OUTSIDE] += 1
                else:
                    s[LABELLED] += 1
                    r[taken].t = t
                    r[taken].x = <uint16_t>(width - 1 - x)
                    r[taken].y = <uint16_t>y
                    r[taken].p = address >> 11 & 1
                    taken += 1
            elif address & 0xC00 == 0xC00:
                code = address >> 28 & 7
                if code == 0 or code == s[CODE]:
                    if code < 7:
                        sample[code] = <int16_t>(address >> 12 & 0xFFFF)
                        s[CODE] = code + 1
                    if code == 6:
                        imu_t[s[SAMPLES]] = t
                        for x in range(7):
                            imu[s[SAMPLES], x] = sample[x]
                        s[SAMPLES] += 1
                        s[CODE] = 0
                else:
                    s[UNKNOWN] += 1
                    s[CODE] = 0
            elif address & 0x800:
                s[UNKNOWN] += 1     # the third read of old cameras
            elif y < 0 or x >= width:
                s[OUTSIDE] += 1
            else:
                why = aps(x, y, address, t, &frame[0], reset, signal, seen, times)
                if why == NEXT:
                    break
            i += 1
            if why == WHOLE:
                break
        if i:
            s[TIME] = r[i - 1].t
        s[EVENTS] = taken
    return i, why
