/* exp and log in float32, the same bits on every CPU: see _math.pxd. */
#ifndef PDAVIS_CV_MATH_H
#define PDAVIS_CV_MATH_H

#include <stdint.h>
#include <string.h>

static inline float pd_as_float(uint32_t bits) {
    float x;
    memcpy(&x, &bits, sizeof x);
    return x;
}

static inline uint32_t pd_as_bits(float x) {
    uint32_t bits;
    memcpy(&bits, &x, sizeof bits);
    return bits;
}

/* exp(x) = 2^n (1 + p): returns 2^n, sets p.  x is clamped to +-87. */
static inline float pd_exp_parts(float x, float *p) {
    const float magic = 12582912.0f;         /* 1.5 2^23: adding it rounds */
    float z, n, r, r2;
    x = x > -87.0f ? x : -87.0f;
    x = x < 87.0f ? x : 87.0f;
    z = x * 1.44269504f + magic;
    n = z - magic;
    r = (x - n * 0.693359375f) + n * 2.12194440e-4f;   /* ln 2 in two parts */
    r2 = r * r;
    *p = r + r2 * ((0.5f + r * 0.166665375f)
                   + r2 * ((0.0416662656f + r * 0.00836723391f)
                           + r2 * 0.00139475742f));
    return pd_as_float((pd_as_bits(z) + 127u) << 23);
}

static inline float pd_exp(float x) {
    float p, scale = pd_exp_parts(x, &p);
    return scale + scale * p;
}

/* exp(x) - 1, accurate near 0, as needed for the decay between close events. */
static inline float pd_expm1(float x) {
    float p, scale = pd_exp_parts(x, &p);
    return scale * p + (scale - 1.0f);
}

/* ln(x) for normal x > 0. */
static inline float pd_log(float x) {
    uint32_t bits = pd_as_bits(x);
    int32_t e = (int32_t)((bits - 0x3f3504f3u) >> 23);
    float n, f, f2, q;
    e = e >= 256 ? e - 512 : e;              /* exponent of x / sqrt(1/2) */
    f = pd_as_float(bits - ((uint32_t)e << 23)) - 1.0f;
    n = (float)e;
    f2 = f * f;
    q = ((0.333333164f + f * -0.250008076f)
         + f2 * (0.200022861f + f * -0.166245967f))
        + (f2 * f2) * ((0.141812131f + f * -0.131284043f)
                       + f2 * (0.128814116f + f * -0.0786021426f));
    return n * 0.693359375f
           + (f + (f2 * (f * q - 0.5f) + n * -2.12194440e-4f));
}

#endif
