/* Rows of an image shared with a thread that is already at work on something else.

   One thread runs team_share.  One other runs team_help now and then, and takes chunks of
   the rows that nobody has taken; or it sleeps in team_sleep, and is woken if the work is
   worth it.  The first one waits for a chunk at most. */
#ifndef PDAVIS_CV_TEAM_H
#define PDAVIS_CV_TEAM_H

#include "Python.h"
#include <stddef.h>
#if defined(__linux__)
#include <sched.h>
#include <sys/syscall.h>
#include <unistd.h>
#endif

#if defined(_MSC_VER)
#include <intrin.h>
#include <windows.h>
typedef __int64 pd_count;
#define PD_ADD(at, n) _InterlockedExchangeAdd64(at, n)
#define PD_LOAD(at) _InterlockedExchangeAdd64(at, 0)
#define PD_STORE(at, n) ((void)_InterlockedExchange64(at, n))
#define PD_SWAP(at, n) _InterlockedExchange64(at, n)
#define PD_PAUSE() YieldProcessor()
static inline pd_count pd_now(void)     /* ns */
{
    LARGE_INTEGER count, rate;
    QueryPerformanceCounter(&count);
    QueryPerformanceFrequency(&rate);
    return (pd_count)(1e9 * (double)count.QuadPart / (double)rate.QuadPart);
}
#else
#include <time.h>
typedef long long pd_count;
#define PD_ADD(at, n) __atomic_fetch_add(at, n, __ATOMIC_SEQ_CST)
#define PD_LOAD(at) __atomic_load_n(at, __ATOMIC_SEQ_CST)
#define PD_STORE(at, n) __atomic_store_n(at, n, __ATOMIC_SEQ_CST)
#define PD_SWAP(at, n) __atomic_exchange_n(at, n, __ATOMIC_SEQ_CST)
#if defined(__x86_64__) || defined(__i386__)
#define PD_PAUSE() __builtin_ia32_pause()
#elif defined(__aarch64__)
#define PD_PAUSE() __asm__ __volatile__("yield")
#else
#define PD_PAUSE() ((void)0)
#endif
static inline pd_count pd_now(void)     /* ns */
{
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return (pd_count)now.tv_sec * 1000000000 + now.tv_nsec;
}
#endif

/* For so long a thread that waits looks at a counter; then it sleeps.  It is about the
   time of a chunk.  sched_yield is of no use here: under Linux 6.18 a thread that called
   it repeatedly did not run again for 5 to 18 ms while another one wanted its core,
   even at a lower priority. */
#define PD_LOOK_NS 100000
/* If the first thread waits for so much longer than its own part took, the other one had
   no processor.  Such waits may take 1 / PD_SHARE of the time, and PD_PAST_NS / PD_SHARE
   (20 ms) at once, so that an interruption now and then changes nothing.  After longer
   waits the first thread works alone until they are that share of the time again.
   Engineering choices. */
#define PD_LATE_NS 100000
#define PD_SHARE 20
#define PD_PAST_NS 400000000
/* After a kernel that shares its rows, the next one of the same image follows within
   such a time: the other thread stays awake. */
#define PD_SOON_NS 100000

typedef void (*pd_rows)(void *args, ptrdiff_t first, ptrdiff_t last);

/* Rows 0 <= row < n in chunks.  The first thread takes them from the front, the other
   from the back, so that each finds what it used last time in its own cache. */
typedef struct {
    pd_rows work;
    void *args[2];          /* of the other thread, of the first one */
    ptrdiff_t n, chunk;
    ptrdiff_t front, back;  /* chunks taken by the first thread, by the other one */
    pd_count taken, done;   /* chunks: asked for, and finished */
} share_t;

typedef struct {
    share_t share;
    pd_count open;          /* whether there is work to share */
    pd_count opened;        /* how often there has been */
    pd_count seen;          /* the last such work of which nothing was left */
    pd_count inside;        /* whether the other thread may be at it */
    pd_count posted;        /* images posted for the other thread, */
    pd_count served;        /* and left by it: it uses them no more */
    pd_count asleep;        /* whether `wake` must be released for it to go on */
    pd_count waiting;       /* whether `left` must be for the first thread to go on */
    pd_count soon_until;    /* ns; until then more to share is expected */
    pd_count alone_until;   /* ns; until then nothing is shared, if it lies ahead */
    pd_count second;        /* Linux: number of the other thread; */
    pd_count core;          /* one more than the core on which it may not run, */
    pd_count part_again;    /* ns; until when this holds if the first one stays there */
    PyThread_type_lock wake, left;
} team_t;

static inline void share_begin(share_t *share, pd_rows work, void *args, void *others,
                               ptrdiff_t n, ptrdiff_t chunk)
{
    share->work = work;
    share->args[0] = others;
    share->args[1] = args;
    share->n = n;
    share->chunk = chunk;
    share->front = share->back = 0;
    PD_STORE(&share->done, (pd_count)0);
    PD_STORE(&share->taken, (pd_count)0);
}

static inline ptrdiff_t share_chunks(const share_t *share)
{
    return (share->n + share->chunk - 1) / share->chunk;
}

/* Process a chunk; return whether there was one, and in `last` whether it was the last
   one to be finished. */
static inline int share_step(share_t *share, int first_thread, int *last)
{
    ptrdiff_t count = share_chunks(share), k, begin, end;
    *last = 0;
    if (PD_LOAD(&share->taken) >= count || PD_ADD(&share->taken, (pd_count)1) >= count)
        return 0;
    k = first_thread ? share->front++ : count - 1 - share->back++;
    begin = k * share->chunk;
    end = begin + share->chunk;
    share->work(share->args[first_thread], begin, end < share->n ? end : share->n);
    *last = PD_ADD(&share->done, (pd_count)1) == count - 1;
    return 1;
}

static inline void team_wake(team_t *team)
{
    if (PD_SWAP(&team->asleep, (pd_count)0))
        PyThread_release_lock(team->wake);
}

/* Note that the calling thread is the other one. */
static inline void team_join(team_t *team)
{
#if defined(__linux__)
    PD_STORE(&team->second, (pd_count)syscall(SYS_gettid));
#else
    (void)team;
#endif
}

/* Note that it ends: its number may soon be that of a thread of someone else. */
static inline void team_leave(team_t *team)
{
    PD_STORE(&team->second, (pd_count)0);
}

/* Keep the other thread off the core of the first one, where it is of no use; if there
   is no other core, share nothing for a while.  Linux puts it there now and then, and
   for 4 ms and more lets the two take turns although the next core is idle. */
static inline void team_part(team_t *team, pd_count now)
{
#if defined(__linux__)
    int core = sched_getcpu();
    cpu_set_t cores;
    pd_count second = PD_LOAD(&team->second);
    if (core < 0 || !second || (core + 1 == team->core && now < team->part_again)
            || sched_getaffinity(0, sizeof cores, &cores))
        return;
    team->core = core + 1;
    team->part_again = now + PD_PAST_NS;
    CPU_CLR(core, &cores);
    if (CPU_COUNT(&cores))
        sched_setaffinity((pid_t)second, sizeof cores, &cores);
    else
        team->alone_until = team->part_again;
#else
    (void)team;
    (void)now;
#endif
}

/* Tell whether the first thread is to work alone. */
static inline int team_alone(team_t *team, pd_count now)
{
    if (now >= team->alone_until)
        team_part(team, now);
    return now < team->alone_until;
}

static inline int team_needed(team_t *team, ptrdiff_t finished)
{
    return PD_LOAD(&team->posted) > finished
        || (PD_LOAD(&team->open) && PD_LOAD(&team->opened) != team->seen);
}

/* Wait until there is work to share, or more images than the given number.  While the
   first thread is at its last chunk, more is likely to follow, so that this one stays
   awake; but not for long, as the first thread may be waiting for this processor. */
static inline void team_sleep(team_t *team, ptrdiff_t finished)
{
    pd_count now = pd_now(), last = now + PD_LOOK_NS;
    while (now < PD_LOAD(&team->soon_until) || (PD_LOAD(&team->open) && now < last)) {
        if (team_needed(team, finished))
            return;
        PD_PAUSE();
        now = pd_now();
    }
    PD_STORE(&team->asleep, (pd_count)1);
    if (team_needed(team, finished) && PD_SWAP(&team->asleep, (pd_count)0))
        return;
    PyThread_acquire_lock(team->wake, WAIT_LOCK);
}

static inline void team_post(team_t *team)
{
    PD_ADD(&team->posted, (pd_count)1);
    team_wake(team);
}

static inline ptrdiff_t team_posted(team_t *team)
{
    return (ptrdiff_t)PD_LOAD(&team->posted);
}

static inline ptrdiff_t team_served(team_t *team)
{
    return (ptrdiff_t)PD_LOAD(&team->served);
}

static inline void team_left(team_t *team)
{
    PD_ADD(&team->served, (pd_count)1);
}

/* Acquire a lock that is likely to be released soon. */
static inline void team_acquire(PyThread_type_lock lock)
{
    pd_count last = pd_now() + PD_LOOK_NS;
    while (!PyThread_acquire_lock(lock, NOWAIT_LOCK))
        if (pd_now() < last)
            PD_PAUSE();
        else {
            PyThread_acquire_lock(lock, WAIT_LOCK);
            return;
        }
}

/* Note that the first thread, which began and ended its own part, has waited until now. */
static inline void team_waited(team_t *team, pd_count began, pd_count ended)
{
    pd_count now = pd_now();
    pd_count past = now - PD_PAST_NS;
    if (now - ended > ended - began + PD_LATE_NS)
        team->alone_until = PD_SHARE * (now - ended)
            + (team->alone_until > past ? team->alone_until : past);
}

/* Sleep until the other thread has left what is shared, or for less. */
static inline void team_await(team_t *team)
{
    PD_STORE(&team->waiting, (pd_count)1);
    if (!PD_LOAD(&team->inside) && PD_SWAP(&team->waiting, (pd_count)0))
        return;
    PyThread_acquire_lock(team->left, WAIT_LOCK);
}

/* Process n rows in chunks; return when all are done.  wake: whether it is worth to wake
   the other thread. */
static inline void team_share(team_t *team, int wake, pd_rows work, void *args,
                              ptrdiff_t n, ptrdiff_t chunk)
{
    int last;
    pd_count ended, began = pd_now();
    if (team_alone(team, began)) {
        work(args, 0, n);
        return;
    }
    share_begin(&team->share, work, args, args, n, chunk);
    PD_ADD(&team->opened, (pd_count)1);
    PD_STORE(&team->open, (pd_count)1);
    if (wake)
        team_wake(team);
    while (share_step(&team->share, 1, &last))
        ;
    ended = pd_now();
    PD_STORE(&team->soon_until, ended + PD_SOON_NS);
    PD_STORE(&team->open, (pd_count)0);
    if (!PD_LOAD(&team->inside))
        return;
    while (PD_LOAD(&team->inside))
        if (pd_now() < ended + PD_LOOK_NS)
            PD_PAUSE();
        else
            team_await(team);
    team_waited(team, began, ended);
}

/* Take part in what is shared at the moment, if anything is. */
static inline void team_help(team_t *team)
{
    int last;
    if (!PD_LOAD(&team->open))
        return;
    PD_STORE(&team->inside, (pd_count)1);
    if (PD_LOAD(&team->open)) {     /* it is not closed while this is inside */
        while (share_step(&team->share, 0, &last))
            ;
        team->seen = PD_LOAD(&team->opened);
        /* Its last chunk may have taken longer than that of the first thread. */
        PD_STORE(&team->soon_until, pd_now() + PD_SOON_NS);
    }
    PD_STORE(&team->inside, (pd_count)0);
    if (PD_SWAP(&team->waiting, (pd_count)0))
        PyThread_release_lock(team->left);
}

#endif
