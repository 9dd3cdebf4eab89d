/* Ask for memory that is needed soon: a pixel's record, some events ahead. */
#ifndef PDAVIS_CV_PREFETCH_H
#define PDAVIS_CV_PREFETCH_H

/* Events, or pixels, ahead: where others use the third-level cache as well, a miss takes
   as long as so many events. */
#define PDAVIS_AHEAD 32

#if defined(__GNUC__)
#define PDAVIS_PREFETCH(at) __builtin_prefetch((at), 1)
#else
#define PDAVIS_PREFETCH(at) ((void)(at))
#endif

/* All cache lines of some bytes.  A macro: gcc drops calls of a function that does
   nothing else. */
#define PDAVIS_PREFETCH_ALL(at, size) \
    do { \
        const char *pd_at = (const char *)(at), *pd_end = pd_at + (size) - 1; \
        for (; pd_at < pd_end; pd_at += 64) \
            PDAVIS_PREFETCH(pd_at); \
        PDAVIS_PREFETCH(pd_end); \
    } while (0)

#endif
