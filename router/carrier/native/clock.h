/* The monotonic clock, for durations, and the wall clock, for time stamps. Both in ns. */
#ifndef CLOCK_H
#define CLOCK_H

#include <stdint.h>
#include <time.h>

static inline int64_t clock_read(clockid_t clock) {
    struct timespec now;
    clock_gettime(clock, &now);
    return (int64_t)now.tv_sec * 1000000000 + now.tv_nsec;
}

static inline int64_t monotonic_ns(void) { return clock_read(CLOCK_MONOTONIC); }

static inline int64_t wall_ns(void) { return clock_read(CLOCK_REALTIME); }

#endif
