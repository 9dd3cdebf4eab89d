"""AEDAT-2.0: big-endian words of address and time.

Facts: the address layout of the DAVIS cameras as jAER and iniVation document it.
"""
from libc.stdint cimport (
    int16_t, int32_t, int64_t, uint8_t, uint16_t, uint32_t, uint64_t)

from _kernels._check cimport SEGMENT_US
from _kernels._types cimport event_t

# Indices in the state of time and of the sample streams.
cdef enum:
    BASE = 0            # added to the 32-bit time of the file
    LAST = 1            # time of the last word taken
    BACKWARD = 2        # words dropped because their time runs backward
    OUTSIDE = 3         # words dropped because they lie outside the sensor
    UNKNOWN = 4         # words of an undefined kind
    EVENTS = 5          # taken into the outputs so far
    SAMPLES = 6
    TRIGGERS = 7
    LABELLED = 8        # events with the special bit, v2e's label of noise
    FIRST_BAD = 9       # index of the first word dropped in this call, or -1
    CODE = 10           # next IMU code expected, 0 = none begun
    STATE = 11

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
    END = 0             # all words were taken
    JUMP = 1            # time falls by more than a second before this word
    WHOLE = 2           # the last word taken completed a frame
    NEXT = 3            # this word begins a new frame, the last is not complete

cdef enum:
    RESET_SEEN = 1
    SIGNAL_SEEN = 2


cdef inline uint32_t big_endian(const uint8_t* at) noexcept nogil:
    return (<uint32_t>at[0] << 24 | <uint32_t>at[1] << 16
            | <uint32_t>at[2] << 8 | <uint32_t>at[3])


cdef inline uint64_t word(const uint8_t* at) noexcept nogil:
    """Return address << 32 | time; compilers make one byte-swapped load of it."""
    return (<uint64_t>at[0] << 56 | <uint64_t>at[1] << 48 | <uint64_t>at[2] << 40
            | <uint64_t>at[3] << 32 | <uint64_t>at[4] << 24 | <uint64_t>at[5] << 16
            | <uint64_t>at[6] << 8 | <uint64_t>at[7])


cdef inline Py_ssize_t plain(const uint8_t* source, Py_ssize_t n, int64_t base,
                             int64_t last, uint32_t height, uint32_t width,
                             event_t* out) noexcept nogil:
    """Decode words while they are events in order, inside; return how many.

    It reads one word beyond the last that it decodes: source holds n + 1.
    """
    cdef Py_ssize_t i
    cdef uint32_t address, x, y
    cdef int32_t t, following
    cdef uint64_t here = word(source)
    cdef uint32_t right = width - 1, bottom = height - 1
    if <int32_t>here + base < last:
        return 0
    for i in range(n):
        address = <uint32_t>(here >> 32)
        t = <int32_t>here
        here = word(source + 8 * (i + 1))
        following = <int32_t>here
        # Unsigned: coordinates off the sensor, and words of other kinds, become large.
        x = right - (address >> 12 & 0x3FF)
        y = bottom - (address >> 22)
        if (following < t) | (x > right) | (y > bottom) | (address >> 10 & 1):
            return i
        out[i].t = t + base
        out[i].x = <uint16_t>x
        out[i].y = <uint16_t>y
        out[i].p = address >> 11 & 1
    return n


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


def aedat2_words(const uint8_t[:, ::1] words not None, Py_ssize_t begin,
                 Py_ssize_t n, int64_t[::1] state not None,
                 int64_t[::1] frame not None, uint16_t[:, ::1] reset not None,
                 uint16_t[:, ::1] signal not None, uint8_t[:, ::1] seen not None,
                 int64_t[:, ::1] times not None, int16_t[::1] sample not None,
                 event_t[::1] events not None, int64_t[::1] imu_t not None,
                 int16_t[:, ::1] imu not None, int64_t[::1] trigger_t not None,
                 uint8_t[::1] trigger not None):
    """Decode words begin .. n, reading one word further; return (index, reason).

    The reason to stop is 0 at the end, 1 before a jump back in time by more than a
    second, 2 after a whole frame, 3 before a word that belongs to the next frame.
    reset, signal, seen and times hold the frame being assembled, rows from the top.
    """
    cdef Py_ssize_t height = seen.shape[0], width = seen.shape[1]
    cdef Py_ssize_t i, x, y
    cdef int64_t t, following
    cdef int64_t last, taken
    cdef Py_ssize_t run, whole = words.shape[0] - 1
    cdef uint32_t address
    cdef int code, why = END
    cdef const uint8_t* source
    cdef event_t* out
    cdef int64_t* s
    if (words.shape[1] != 8 or state.shape[0] != STATE or frame.shape[0] != FRAME_STATE
            or times.shape[0] != 2 or times.shape[1] != width or sample.shape[0] != 7
            or imu.shape[1] != 7 or reset.shape[0] != height
            or reset.shape[1] != width or signal.shape[0] != height
            or signal.shape[1] != width or height > 512 or width > 1024
            or height < 1 or width < 1):
        raise ValueError("aedat2_words: an array has the wrong shape")
    if (begin < 0 or begin > n or n > words.shape[0]
            or state[EVENTS] < 0 or state[SAMPLES] < 0
            or state[TRIGGERS] < 0 or events.shape[0] - state[EVENTS] < n - begin
            or trigger_t.shape[0] - state[TRIGGERS] < n - begin
            or trigger.shape[0] < trigger_t.shape[0]
            or imu_t.shape[0] - state[SAMPLES] < (n - begin + 6) // 7
            or imu.shape[0] < imu_t.shape[0]
            or state[CODE] < 0 or state[CODE] > 6):
        raise ValueError("aedat2_words: an output is too small")
    if begin == n:
        return n, END
    s = &state[0]
    s[FIRST_BAD] = -1
    i = begin
    source = &words[0, 0]
    out = &events[0]
    # What each event changes stays in registers; the compiler cannot see that the
    # outputs do not overlap the state.
    last, taken = s[LAST], s[EVENTS]
    with nogil:
        while i < n:
            run = plain(source + 8 * i, (n if n < whole else whole) - i, s[BASE], last,
                        <uint32_t>height, <uint32_t>width, out + taken)
            if run > 0:
                i += run
                taken += run
                last = out[taken - 1].t
                if i == n:
                    break
            address = big_endian(source + 8 * i)
            t = <int32_t>big_endian(source + 8 * i + 4) + s[BASE]
            following = t
            if i + 1 < words.shape[0]:
                following = <int32_t>big_endian(source + 8 * i + 12) + s[BASE]
            if t < last or following < t:
                # Rare: one of the two is damaged, or the counter was reset.
                if t < last:
                    if last - t > (<int64_t>1 << 31) and following < last:
                        # The 32-bit counter overflowed.
                        s[BASE] += <int64_t>1 << 32
                        continue
                    if last - t > SEGMENT_US and (
                            i + 1 == words.shape[0] or following < last):
                        why = JUMP
                        break
                if t < last or (following < t and following >= last):
                    # A word later than both its neighbours is damaged: as in
                    # _check.pxd, `take`.
                    s[BACKWARD] += 1
                    if s[FIRST_BAD] < 0:
                        s[FIRST_BAD] = i
                    i += 1
                    continue
            x = address >> 12 & 0x3FF
            y = height - 1 - <Py_ssize_t>(address >> 22 & 0x1FF)
            if not address & 0x80000000u:
                if (not address & 0x400) and y >= 0 and x < width:
                    out[taken].t = t
                    out[taken].x = <uint16_t>(width - 1 - x)
                    out[taken].y = <uint16_t>y
                    out[taken].p = address >> 11 & 1
                    taken += 1
                elif address & 0x400 and x == 0 and y == height - 1 and address & 0x3FF:
                    code = address & 0x3FF
                    if code < 2 or code > 4:
                        s[UNKNOWN] += 1
                    else:
                        trigger_t[s[TRIGGERS]] = t
                        trigger[s[TRIGGERS]] = <uint8_t>code
                        s[TRIGGERS] += 1
                elif y < 0 or x >= width:
                    s[OUTSIDE] += 1
                    if s[FIRST_BAD] < 0:
                        s[FIRST_BAD] = i
                else:
                    s[LABELLED] += 1
                    out[taken].t = t
                    out[taken].x = <uint16_t>(width - 1 - x)
                    out[taken].y = <uint16_t>y
                    out[taken].p = address >> 11 & 1
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
                if s[FIRST_BAD] < 0:
                    s[FIRST_BAD] = i
            else:
                why = aps(x, y, address, t, &frame[0], reset, signal, seen, times)
                if why == NEXT:
                    break
            last = t
            i += 1
            if why == WHOLE:
                break
        s[LAST], s[EVENTS] = last, taken
    return i, why
