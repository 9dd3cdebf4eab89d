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

#endif
