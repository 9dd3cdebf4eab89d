"""Double-precision log, exp and counter-based random numbers, the same bits on every
CPU: libm's versions differ with the instruction set that it finds.  Algorithms of
fdlibm (e_log.c, e_exp.c; below 1 ulp) and of SplitMix64 (Steele et al., 2014)."""
from libc.stdint cimport int64_t, uint64_t
from libc.string cimport memcpy

cdef extern from *:
    """
    #define ROUND 6755399441055744.0
    """
    const double ROUND      # 1.5 * 2^52: adding it rounds to an integer


cdef inline double log64(double x) noexcept nogil:
    """Natural log of a positive, normal, finite x."""
    cdef int64_t bits, k
    cdef double f, s, z, r, half, m, dk
    memcpy(&bits, &x, 8)
    # the exponent for which the mantissa lies in [sqrt(1/2), sqrt(2))
    k = ((bits + <int64_t>0x00095f6400000000ULL) >> 52) - 1023
    bits -= k * (<int64_t>1 << 52)  # a shift of what is negative is not defined
    memcpy(&m, &bits, 8)
    f = m - 1.0
    s = f / (2.0 + f)
    z = s * s
    r = z * (6.666666666666735130e-01 + z * (3.999999999940941908e-01 + z * (
        2.857142874366239149e-01 + z * (2.222219843214978396e-01 + z * (
            1.818357216161805012e-01 + z * (1.531383769920937332e-01
                                            + z * 1.479819860511658591e-01))))))
    half = 0.5 * f * f
    dk = k
    return dk * 6.93147180369123816490e-01 - (
        (half - (s * (half + r) + dk * 1.90821492927058770002e-10)) - f)


cdef inline double exp64(double x) noexcept nogil:
    """e to the x, x limited to -700..700."""
    cdef double hi, lo, r, t, c, y, k, scale
    cdef int64_t bits
    if x > 700.0:
        x = 700.0
    elif x < -700.0:
        x = -700.0
    k = x * 1.44269504088896338700 + ROUND
    k -= ROUND
    hi = x - k * 6.93147180369123816490e-01
    lo = k * 1.90821492927058770002e-10
    r = hi - lo
    t = r * r
    c = r - t * (1.66666666666666019037e-01 + t * (-2.77777777770155933842e-03 + t * (
        6.61375632143793436117e-05 + t * (-1.65339022054652515390e-06
                                          + t * 4.13813679705723846039e-08))))
    y = 1.0 - ((lo - (r * c) / (2.0 - c)) - hi)
    bits = (<int64_t>k + 1023) << 52
    memcpy(&scale, &bits, 8)
    return y * scale


cdef inline uint64_t draw64(uint64_t key, uint64_t counter) noexcept nogil:
    """Return 64 random bits: SplitMix64's output number `counter` of stream `key`."""
    cdef uint64_t z = key + (counter + 1) * 0x9e3779b97f4a7c15ULL
    z = (z ^ (z >> 30)) * 0xbf58476d1ce4e5b9ULL
    z = (z ^ (z >> 27)) * 0x94d049bb133111ebULL
    return z ^ (z >> 31)


cdef inline double uniform64(uint64_t bits) noexcept nogil:
    """Uniform in (0, 1), both ends excluded."""
    return (<double>(bits >> 11) + 0.5) * 1.1102230246251565e-16
