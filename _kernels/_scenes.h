/* Light of scenes that are not uniform, by rows of doubles.

   The same bits on every CPU, on which those of NumPy's sine and exponential depend. */
#ifndef PDAVIS_CV_SCENES_H
#define PDAVIS_CV_SCENES_H

#include "_clones.h"

#define SCENE_ROUND 6755399441055744.0      /* 1.5 * 2^52: adding it rounds */

PDAVIS_INLINE int64_t bits64_of(double value)
{
    int64_t bits;
    memcpy(&bits, &value, sizeof bits);
    return bits;
}

PDAVIS_INLINE double double_of(int64_t bits)
{
    double value;
    memcpy(&value, &bits, sizeof value);
    return value;
}

/* e to the x, |x| up to 700: fdlibm's e_exp.c, as exp64 in _double.pxd. */
PDAVIS_INLINE double scene_exp(double x)
{
    double k, hi, lo, r, t, c, y;
    int64_t bits;
    x = x > 700.0 ? 700.0 : x;
    x = x < -700.0 ? -700.0 : x;
    k = x * 1.44269504088896338700 + SCENE_ROUND;
    bits = bits64_of(k);                    /* the lowest bits are those of k */
    k -= SCENE_ROUND;
    hi = x - k * 6.93147180369123816490e-01;
    lo = k * 1.90821492927058770002e-10;
    r = hi - lo;
    t = r * r;
    c = r - t * (1.66666666666666019037e-01 + t * (-2.77777777770155933842e-03 + t * (
        6.61375632143793436117e-05 + t * (-1.65339022054652515390e-06
                                          + t * 4.13813679705723846039e-08))));
    y = 1.0 - ((lo - (r * c) / (2.0 - c)) - hi);
    return y * double_of((int64_t)((uint64_t)(bits + 1023) << 52));
}

/* Sine and cosine of |x| up to 1e5, below 1e-15 off: fdlibm's k_sin.c and k_cos.c. */
PDAVIS_INLINE void scene_sincos(double x, double *sine, double *cosine)
{
    double q = x * 6.36619772367581382433e-01 + SCENE_ROUND, r, low, z, s, c, half, w;
    int64_t turn = bits64_of(q), odd = -(turn & 1);
    int64_t sign_s = (int64_t)((uint64_t)(turn & 2) << 62);
    int64_t sign_c = (int64_t)((uint64_t)((turn + 1) & 2) << 62);
    q -= SCENE_ROUND;
    w = x - q * 1.57079632673412561417e+00;
    low = q * 6.07710050650619224932e-11;
    r = w - low;
    low = (w - r) - low;
    z = r * r;
    s = 8.33333333332248946124e-03 + z * (-1.98412698298579493134e-04 + z * (
        2.75573137070700676789e-06 + z * (-2.50507602534068634195e-08
                                          + z * 1.58969099521155010221e-10)));
    w = z * r;
    s = r - ((z * (0.5 * low - w * s) - low) - w * -1.66666666666666324348e-01);
    c = z * (4.16666666666666019037e-02 + z * (-1.38888888888741095749e-03 + z * (
        2.48015872894767294178e-05 + z * (-2.75573143513906633035e-07 + z * (
            2.08757232129817482790e-09 + z * -1.13596475577881948265e-11)))));
    half = 0.5 * z;
    w = 1.0 - half;
    c = w + (((1.0 - w) - half) + (z * c - r * low));
    *sine = double_of(((odd & bits64_of(c)) | (~odd & bits64_of(s))) ^ sign_s);
    *cosine = double_of(((odd & bits64_of(s)) | (~odd & bits64_of(c))) ^ sign_c);
}

/* Write to out, n columns, the sum over waves of down_c cos - down_s sin, in the order
   of the waves; their stride is `apart` in down_c and down_s, n in cos and sin. */
PDAVIS_CLONES PDAVIS_UNUSED static void waves_row(
    ptrdiff_t waves, ptrdiff_t n, ptrdiff_t apart, const double *restrict down_c,
    const double *restrict down_s, const double *restrict cos,
    const double *restrict sin, double *restrict out)
{
    ptrdiff_t i, k;
    for (k = 0; k < n; k++)
        out[k] = 0.0;
    for (i = 0; i < waves; i++) {
        const double c = down_c[i * apart], s = down_s[i * apart];
        const double *restrict along_c = cos + i * n, *restrict along_s = sin + i * n;
        for (k = 0; k < n; k++) {
            double sum = out[k] + c * along_c[k];
            out[k] = sum - s * along_s[k];
        }
    }
}

/* Replace three fields of a texture by its Stokes components. */
PDAVIS_CLONES PDAVIS_UNUSED static void texture_row(
    ptrdiff_t n, double s0, double contrast, double dolp, double dolp_spread,
    double aop, double aop_spread, double *restrict first, double *restrict second,
    double *restrict third)
{
    ptrdiff_t k;
    for (k = 0; k < n; k++) {
        double light = s0 * scene_exp(contrast * first[k]), s, c, linear;
        scene_sincos(second[k], &s, &c);
        linear = light * (dolp + dolp_spread * s);
        scene_sincos(2.0 * (aop + aop_spread * third[k]), &s, &c);
        first[k] = light;
        second[k] = linear * c;
        third[k] = linear * s;
    }
}

/* S1 and S2 of a wheel of sectors.  rest: azimuth in sectors; minus turn it is that on
   the wheel, -9..3; steep: width of a sector over that of an edge there; cosines and
   sines: of twice the polarizers' angles, from sector -12 on. */
PDAVIS_CLONES PDAVIS_UNUSED static void fan_row(
    ptrdiff_t n, double turn, const double *restrict cosines,
    const double *restrict sines, const double *restrict rest,
    const double *restrict steep, const double *restrict light, double *restrict s1,
    double *restrict s2)
{
    ptrdiff_t i;
    for (i = 0; i < n; i++) {
        double place = rest[i] - turn, first = floor(place), part = place - first;
        double other = 1 - part, edge = (part < other ? part : other) * steep[i], c, s;
        int k = (int)first + 12;
        c = cosines[k];
        s = sines[k];
        if (edge < 0.5) {
            double nearest = rint(place), u = (place - nearest) * steep[i] + 0.5;
            k = (int)nearest + 12;
            u = u < 0 ? 0 : u > 1 ? 1 : u;
            u = u * u * u * (10 - u * (15 - 6 * u));
            c = cosines[k - 1] + u * (cosines[k] - cosines[k - 1]);
            s = sines[k - 1] + u * (sines[k] - sines[k - 1]);
        }
        s1[i] = light[i] * c;
        s2[i] = light[i] * s;
    }
}

/* Light on pixels of responses a0, a1, a2 to Stokes components. */
PDAVIS_CLONES PDAVIS_UNUSED static void analysed_row(
    ptrdiff_t n, const double *restrict a0, const double *restrict a1,
    const double *restrict a2, const double *restrict s0, const double *restrict s1,
    const double *restrict s2, double *restrict out)
{
    ptrdiff_t i;
    for (i = 0; i < n; i++)
        out[i] = a0[i] * s0[i] + a1[i] * s1[i] + a2[i] * s2[i];
}

#endif
