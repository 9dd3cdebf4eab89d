"""exp and log in float32, the same bits on every CPU.  Inline only.

libm picks its code by CPU at run time, so its last bits differ between machines.
These are polynomials (Lawson fits, relative error below 1.2e-7 in float32) after the
usual range reductions; without -ffast-math and with -ffp-contract=off the compiler
may vectorize them but not change a bit.
"""
cdef extern from "_math.h" nogil:
    float exp_f "pd_exp"(float x)
    float expm1_f "pd_expm1"(float x)
    float log_f "pd_log"(float x)
