"""The degree of polarization that lasts: docs/theory/kalman.md derives it."""
from libc.stdint cimport uint8_t
from libc.string cimport memchr

from _kernels._model cimport check_given

cdef extern from "_degree.h" nogil:
    enum:
        CELLS "PDAVIS_CELLS"
        ANALYSER "PDAVIS_ANALYSER"
    ctypedef struct cells_t:
        float light[4][CELLS]
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
    void weigh_degree(cells_t*, Py_ssize_t)

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
    float* light
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


cdef void weigh_group(const showing_t* of, group_t* group) noexcept nogil:
    """Weigh the degrees of a group and write its light back."""
    cdef cells_t* cells = &group.cells
    cdef const run_t* run
    cdef float* upper
    cdef Py_ssize_t i
    if group.n == 0:
        return
    weigh_degree(cells, group.n)
    for i in range(group.count):
        run = &group.runs[i]
        upper = of.light + run.corner
        from_places(&cells.light[0][run.at], &cells.light[1][run.at],
                    &cells.light[2][run.at], &cells.light[3][run.at], run.n, upper,
                    upper + of.w)
    group.count = group.n = 0


cdef void add_to_weigh(const showing_t* of, group_t* group, Py_ssize_t number,
                       Py_ssize_t corner, Py_ssize_t n) noexcept nogil:
    """Add n macropixels to a group with all that `weigh_degree` takes."""
    cdef Py_ssize_t i, size = of.rows * of.columns
    cdef cells_t* cells = &group.cells
    cdef const float* lasting = of.lasting + number
    cdef const float* light = of.light + corner
    cdef const float* variance = of.variance + corner
    cdef run_t* run = &group.runs[group.count]
    run.number, run.corner, run.at, run.n = number, corner, group.n, n
    group.count += 1
    group.n += n
    if not of.analyser.one:
        copy_analyser(&of.analyser, cells, run)
    elif not group.filled:
        fill_analyser(&of.analyser, group)
    to_places(light, light + of.w, n, &cells.light[0][run.at],
              &cells.light[1][run.at], &cells.light[2][run.at],
              &cells.light[3][run.at])
    to_places(variance, variance + of.w, n, &cells.variance[0][run.at],
              &cells.variance[1][run.at], &cells.variance[2][run.at],
              &cells.variance[3][run.at])
    for i in range(n):
        cells.degree[run.at + i] = lasting[i]
        cells.spread[run.at + i] = lasting[size + i]
        cells.share[run.at + i] = lasting[2 * size + i]


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
    cdef Py_ssize_t y, part, x, n, begin, end, some, number, corner
    group.count = group.n = 0
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
                while begin < end:
                    some = min(end - begin, CELLS - group.n)
                    add_to_weigh(of, &group, number + begin, corner + 2 * begin, some)
                    begin += some
                    if group.n == CELLS:
                        weigh_group(of, &group)
                begin = position(marks, 1, end, n)
    weigh_group(of, &group)


def lasting_degree(const float[:, :, ::1] lasting not None,
                   const float[:, :, ::1] analyser not None, shown not None,
                   rows not None):
    """Weigh the degree of polarization of an image against the one that lasts.

    lasting (3, h, w) is, by macropixel, that degree, its variance, and a factor on its
    weight (0: not used).  analyser, (24, h, w) or (24, 1, 1), has by place in the
    macropixel the solution for S0, S1 and S2, the responses to S1 and S2, and the null
    vector.  shown is (intensity, variance of its logarithm, valid), of at least (2 h,
    2 w).  The intensities of the rows (first, last) of macropixels change where all
    four places are valid.
    """
    cdef Py_ssize_t first, last
    cdef float[:, ::1] light
    cdef const float[:, ::1] variance
    cdef const uint8_t[:, ::1] valid
    cdef showing_t of
    check_given(shown)
    light, variance, valid = shown
    first, last = rows
    of.rows, of.columns, of.w = lasting.shape[1], lasting.shape[2], light.shape[1]
    set_analyser(&of.analyser, analyser, of.rows, of.columns)
    if lasting.shape[0] != 3:
        raise ValueError("lasting_degree: lasting must be (3, h, w)")
    if (light.shape[0] < 2 * of.rows or light.shape[1] < 2 * of.columns
            or variance.shape[0] != light.shape[0] or variance.shape[1] != of.w
            or valid.shape[0] != light.shape[0] or valid.shape[1] != of.w):
        raise ValueError("lasting_degree: shown must be images that hold (2 h, 2 w)")
    if first < 0 or last > of.rows:
        raise ValueError("lasting_degree: rows must lie in the image")
    if of.rows * of.columns == 0 or first >= last:
        return
    of.lasting = &lasting[0, 0, 0]
    of.light, of.variance, of.valid = &light[0, 0], &variance[0, 0], &valid[0, 0]
    with nogil:
        weigh_rows(&of, first, last)
