"""The degree of polarization that lasts: docs/theory/kalman.md derives it."""
from libc.stdint cimport uint8_t
from libc.string cimport memchr, memcpy

from _kernels._model cimport check_given

cdef extern from "_degree.h" nogil:
    enum:
        CELLS "PDAVIS_CELLS"
        ANALYSER "PDAVIS_ANALYSER"
    ctypedef struct cells_t:
        float log[4][CELLS]
        float variance[4][CELLS]
        float degree[CELLS]
        float spread[CELLS]
        float share[CELLS]
        float analyser[ANALYSER][CELLS]
    void mark_lasting(const float*, const unsigned char*, const unsigned char*,
                      Py_ssize_t, unsigned char*)
    void to_places(const float*, const float*, Py_ssize_t, float*, float*, float*,
                   float*)
    void from_places(const float*, const float*, const float*, const float*, Py_ssize_t,
                     float*, float*)
    void find_degree(cells_t*, Py_ssize_t)
    void weigh_degree(cells_t*, Py_ssize_t)

cdef enum:
    BRIDGED = 4     # most unused macropixels within a run: a run costs more than these
    # Planes of `degree_frame`: mean degree; frames in it; error of its last prediction;
    # sums over neighbours, with a long memory, of products of errors of consecutive
    # frames, of squared errors, and their number, and of these two with a short memory.
    MEAN = 0
    SEEN = 1
    LAST = 2
    PRODUCT = 3
    LONG = 4
    COUNT = 5
    LATE = 6
    LATE_COUNT = 7
    PLANES = 8

cdef struct analyser_t:
    # Of macropixels; one: the same for all.
    Py_ssize_t size
    const float* numbers
    bint one

cdef struct showing_t:
    # What `lasting_degree` is given.
    Py_ssize_t rows, columns, w
    const float* lasting
    analyser_t analyser
    float* log
    const float* variance
    const uint8_t* valid


cdef int set_analyser(analyser_t* of, const float[:, :, ::1] numbers, Py_ssize_t h,
                      Py_ssize_t w) except -1:
    of.one = numbers.shape[1] == 1 and numbers.shape[2] == 1
    of.size = 1 if of.one else h * w
    if numbers.shape[0] != ANALYSER or not of.one and (
            numbers.shape[1] != h or numbers.shape[2] != w):
        raise ValueError("analyser must be (24, h, w) or (24, 1, 1)")
    of.numbers = &numbers[0, 0, 0] if h * w > 0 else NULL
    return 0


cdef struct run_t:
    # Adjacent macropixels of a row: number of the first one and index of its first
    # pixel, and which of the cells they are.
    Py_ssize_t number, corner
    Py_ssize_t at, n

cdef struct group_t:
    # Runs of macropixels that are computed together.
    cells_t cells
    run_t[CELLS] runs
    Py_ssize_t count, n     # of runs, of cells
    bint filled             # whether all cells have the one analyser


cdef void copy_analyser(const analyser_t* of, cells_t* cells,
                        const run_t* run) noexcept nogil:
    """Copy the analysers of a run, each with its own."""
    cdef Py_ssize_t j, i
    for j in range(ANALYSER):
        for i in range(run.n):
            cells.analyser[j][run.at + i] = of.numbers[j * of.size + run.number + i]


cdef void fill_analyser(const analyser_t* of, group_t* group) noexcept nogil:
    """Copy the one analyser of all macropixels to all cells."""
    cdef Py_ssize_t j, i
    for j in range(ANALYSER):
        for i in range(CELLS):
            group.cells.analyser[j][i] = of.numbers[j]
    group.filled = True


cdef void empty(group_t* group) noexcept nogil:
    """Take the runs out of a group."""
    group.count = 0
    group.n = 0


cdef run_t* add_run(group_t* group, const analyser_t* of, const float* log,
                    Py_ssize_t w, Py_ssize_t number, Py_ssize_t corner,
                    Py_ssize_t n) noexcept nogil:
    """Add n macropixels, their log intensities and analysers, to a group."""
    cdef run_t* run = &group.runs[group.count]
    cdef cells_t* cells = &group.cells
    run.number, run.corner, run.at, run.n = number, corner, group.n, n
    group.count += 1
    group.n += n
    if not of.one:
        copy_analyser(of, cells, run)
    elif not group.filled:
        fill_analyser(of, group)
    to_places(log + corner, log + corner + w, n, &cells.log[0][run.at],
              &cells.log[1][run.at], &cells.log[2][run.at], &cells.log[3][run.at])
    return run


cdef void weigh_group(const showing_t* of, group_t* group) noexcept nogil:
    """Weigh the degrees of a group and write its log intensities back."""
    cdef cells_t* cells = &group.cells
    cdef const run_t* run
    cdef float* upper
    cdef Py_ssize_t i
    if group.n == 0:
        return
    weigh_degree(cells, group.n)
    for i in range(group.count):
        run = &group.runs[i]
        upper = of.log + run.corner
        from_places(&cells.log[0][run.at], &cells.log[1][run.at],
                    &cells.log[2][run.at], &cells.log[3][run.at], run.n, upper,
                    upper + of.w)
    empty(group)


cdef void add_to_weigh(const showing_t* of, group_t* group, Py_ssize_t number,
                       Py_ssize_t corner, const uint8_t* marks,
                       Py_ssize_t n) noexcept nogil:
    """Add n macropixels to a group with all that `weigh_degree` takes.

    Those whose mark is 0 have no share.
    """
    cdef Py_ssize_t i, size = of.rows * of.columns
    cdef cells_t* cells = &group.cells
    cdef const float* lasting = of.lasting + number
    cdef const float* variance = of.variance + corner
    cdef const run_t* run = add_run(
        group, &of.analyser, of.log, of.w, number, corner, n)
    to_places(variance, variance + of.w, n, &cells.variance[0][run.at],
              &cells.variance[1][run.at], &cells.variance[2][run.at],
              &cells.variance[3][run.at])
    for i in range(n):
        cells.degree[run.at + i] = lasting[i]
        cells.spread[run.at + i] = lasting[size + i]
        cells.share[run.at + i] = lasting[2 * size + i] * marks[i]


cdef inline Py_ssize_t position(const uint8_t* marks, int mark, Py_ssize_t first,
                                Py_ssize_t n) noexcept nogil:
    """Return where the next mark is from `first` on; n: nowhere."""
    cdef const uint8_t* found = NULL
    if first < n:
        found = <const uint8_t*>memchr(marks + first, mark, n - first)
    return n if found == NULL else found - marks


cdef void weigh_rows(const showing_t* of, Py_ssize_t first,
                     Py_ssize_t last) noexcept nogil:
    """Weigh the macropixels of rows whose degree lasts and that are valid."""
    cdef const float* share = of.lasting + 2 * of.rows * of.columns
    cdef const uint8_t* valid
    cdef group_t group
    cdef uint8_t[CELLS] marks
    cdef Py_ssize_t y, part, x, n, begin, end, after, some, number, corner
    empty(&group)
    group.filled = False
    for y in range(first, last):
        for part in range((of.columns + CELLS - 1) // CELLS):
            x = part * CELLS
            n = min(<Py_ssize_t>CELLS, of.columns - x)
            number = y * of.columns + x
            corner = 2 * (y * of.w + x)
            valid = of.valid + corner
            mark_lasting(share + number, valid, valid + of.w, n, marks)
            begin = position(marks, 1, 0, n)
            while begin < n:
                end = position(marks, 0, begin, n)
                after = position(marks, 1, end, n)
                while after < n and after - end <= BRIDGED:
                    end = position(marks, 0, after, n)
                    after = position(marks, 1, end, n)
                while begin < end:
                    some = min(end - begin, CELLS - group.n)
                    add_to_weigh(of, &group, number + begin, corner + 2 * begin,
                                 marks + begin, some)
                    begin += some
                    if group.n == CELLS:
                        weigh_group(of, &group)
                begin = after
    weigh_group(of, &group)


cdef struct frame_t:
    # What `degree_frame` is given; h and w count macropixels.
    Py_ssize_t h, w, stride     # stride: of log
    const float* log
    analyser_t analyser
    float most, late, first, sure
    const float* before         # planes, before and after the frame
    float* planes
    float* scratch
    float* lasting


cdef void compare(const frame_t* of) noexcept nogil:
    """Find the degrees, and by how much they differ from the means before."""
    cdef Py_ssize_t size = of.h * of.w, padded = (of.h + 2) * of.w
    cdef Py_ssize_t y, part, x, n, i, at
    cdef group_t group
    cdef float* row
    cdef float degree, error, seen
    group.filled = False
    for y in range(of.h):
        for part in range((of.w + CELLS - 1) // CELLS):
            x = part * CELLS
            n = min(<Py_ssize_t>CELLS, of.w - x)
            empty(&group)
            add_run(&group, &of.analyser, of.log + 2 * (y * of.stride + x), of.stride,
                    y * of.w + x, 0, n)
            find_degree(&group.cells, n)
            for i in range(n):
                at = y * of.w + x + i
                row = of.scratch + of.w + at
                row[0] = 0.0
                row[padded] = 0.0
                row[2 * padded] = 0.0
                degree = group.cells.degree[i]
                seen = of.before[SEEN * size + at]
                error = degree - of.before[MEAN * size + at]
                of.planes[MEAN * size + at] = of.before[MEAN * size + at]
                of.planes[SEEN * size + at] = seen
                of.planes[LAST * size + at] = 0.0
                if degree != degree:
                    continue
                if seen > 0.0:
                    row[0] = error * error
                    row[padded] = 1.0
                    row[2 * padded] = error * of.before[LAST * size + at]
                    of.planes[LAST * size + at] = error
                if seen < of.most:
                    seen += 1.0
                of.planes[SEEN * size + at] = seen
                of.planes[MEAN * size + at] += error / seen


cdef void add_row(const frame_t* of, Py_ssize_t plane, Py_ssize_t row, Py_ssize_t y,
                  float kept) noexcept nogil:
    """Multiply a plane's row by `kept`; add the sums of 3 x 3 numbers of the scratch.
    """
    cdef Py_ssize_t w = of.w, x, at = (plane * of.h + y) * w
    cdef const float* above = of.scratch + (row * (of.h + 2) + y) * w
    cdef const float* own = above + w
    cdef const float* below = own + w
    cdef float before = 0.0, here = above[0] + own[0] + below[0], after
    for x in range(w):
        after = 0.0
        if x + 1 < w:
            after = above[x + 1] + own[x + 1] + below[x + 1]
        of.planes[at + x] = kept * of.before[at + x] + (before + here + after)
        before = here
        here = after


cdef void sum_around(const frame_t* of) noexcept nogil:
    """Sum the errors around each macropixel, and write what lasts."""
    cdef Py_ssize_t size = of.h * of.w, y, x, k
    cdef const float* p
    cdef float error, mean, own, latest, compared, share
    for y in range(of.h):
        for k in range(PRODUCT, PLANES):
            add_row(of, k, 2 if k == PRODUCT else (k - LONG) % 2, y, <float>1.0
                    - <float>1.0 / (of.most if k < LATE else of.late))
        for x in range(y * of.w, (y + 1) * of.w):
            p = of.planes + x
            mean = p[MEAN * size]
            compared = <float>1.0 / (p[COUNT * size] + <float>1.0)
            error = (p[LONG * size] + of.first) * compared
            latest = p[LATE * size] / max(p[LATE_COUNT * size], <float>1.0)
            # What errors of consecutive frames share is not noise of a frame.
            own = error / max(p[SEEN * size], <float>1.0) + max(
                p[PRODUCT * size] * compared, <float>0.0)
            own = min(own, error)
            # Not a quotient: the mean may be 0.
            share = mean * mean - of.sure * max(error, latest)
            of.lasting[x] = mean
            of.lasting[size + x] = max(own, latest - (error - own))
            of.lasting[2 * size + x] = share / (mean * mean) if share > 0.0 else 0.0


def degree_frame(const float[:, ::1] log not None,
                 const float[:, :, ::1] analyser not None, constants not None,
                 const float[:, :, ::1] before not None,
                 float[:, :, ::1] planes not None, float[:, :, ::1] scratch not None,
                 float[:, :, ::1] lasting not None):
    """Update the degree of polarization that lasts with a frame.

    log (>= 2 h, >= 2 w) holds log intensities at mid-exposure, NaN where unknown.
    analyser is as in `lasting_degree`.  constants are the long and the short memory in
    frames, the squared error that is assumed before the first comparison, and how many
    times its sigma the degree has to be, squared.  before (8, h, w) is the state, 0 at
    first, and planes receives the next one; scratch is (3, h + 2, w), 0 in its first
    and last rows; lasting (3, h, w) receives the degree, its variance and its share.
    """
    cdef Py_ssize_t h = planes.shape[1], w = planes.shape[2]
    cdef frame_t of
    of.most, of.late, of.first, of.sure = constants
    if (log.shape[0] < 2 * h or log.shape[1] < 2 * w or planes.shape[0] != PLANES
            or before.shape[0] != PLANES or before.shape[1] != h or before.shape[2] != w
            or scratch.shape[0] != 3 or scratch.shape[1] != h + 2
            or scratch.shape[2] != w or lasting.shape[0] != 3 or lasting.shape[1] != h
            or lasting.shape[2] != w):
        raise ValueError("degree_frame: planes, scratch, lasting and log must fit")
    set_analyser(&of.analyser, analyser, h, w)
    if h * w == 0:
        return
    of.h, of.w, of.stride, of.log = h, w, log.shape[1], &log[0, 0]
    of.before, of.planes = &before[0, 0, 0], &planes[0, 0, 0]
    of.scratch, of.lasting = &scratch[0, 0, 0], &lasting[0, 0, 0]
    with nogil:
        compare(&of)
        sum_around(&of)


def lasting_degree(const float[:, :, ::1] lasting not None,
                   const float[:, :, ::1] analyser not None, shown not None,
                   rows not None, float[:, ::1] out not None):
    """Weigh the degree of polarization of an image against the one that lasts.

    lasting (3, h, w) is, by macropixel, that degree, its variance, and a factor on its
    weight (0: not used).  analyser, (24, h, w) or (24, 1, 1), has by place in the
    macropixel the solution for S0, S1 and S2, the responses to S1 and S2, and the null
    vector.  shown is (log intensity, its variance, valid), of at least (2 h, 2 w).  out
    receives the log intensities of the rows (first, last) of macropixels, of which
    those that are valid at all four places change, and all rows below with the last of
    them; it may be the same image.
    """
    cdef Py_ssize_t first, last, top, bottom
    cdef const float[:, ::1] log, variance
    cdef const uint8_t[:, ::1] valid
    cdef showing_t of
    check_given(shown)
    log, variance, valid = shown
    first, last = rows
    of.rows, of.columns, of.w = lasting.shape[1], lasting.shape[2], log.shape[1]
    set_analyser(&of.analyser, analyser, of.rows, of.columns)
    if lasting.shape[0] != 3:
        raise ValueError("lasting_degree: lasting must be (3, h, w)")
    if (log.shape[0] < 2 * of.rows or log.shape[1] < 2 * of.columns
            or variance.shape[0] != log.shape[0] or variance.shape[1] != log.shape[1]
            or valid.shape[0] != log.shape[0] or valid.shape[1] != log.shape[1]
            or out.shape[0] != log.shape[0] or out.shape[1] != log.shape[1]):
        raise ValueError("lasting_degree: shown must be images that hold (2 h, 2 w)")
    if first < 0 or last > of.rows:
        raise ValueError("lasting_degree: rows must lie in the image")
    if of.rows * of.columns == 0 or first >= last:
        return
    of.lasting = &lasting[0, 0, 0]
    of.log, of.variance, of.valid = &out[0, 0], &variance[0, 0], &valid[0, 0]
    top, bottom = 2 * first, log.shape[0] if last == of.rows else 2 * last
    with nogil:
        if <const float*>&out[0, 0] != &log[0, 0]:
            memcpy(&out[top, 0], &log[top, 0], (bottom - top) * of.w * sizeof(float))
        weigh_rows(&of, first, last)
