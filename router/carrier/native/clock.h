/* Clocks in ns: boot clock for ages, deadlines and rates; monotonic clock for waits; wall clock for time stamps. While the
 * computer is suspended, the monotonic clock stops and the boot clock continues. */
#ifndef CLOCK_H
#define CLOCK_H

#include <stdint.h>
#include <time.h>

static inline int64_t clock_read(clockid_t clock) {
    struct timespec now;
    clock_gettime(clock, &now);
    return (int64_t)now.tv_sec * 1000000000 + now.tv_nsec;
}

static inline int64_t boottime_ns(void) { return clock_read(CLOCK_BOOTTIME); }

static inline int64_t monotonic_ns(void) { return clock_read(CLOCK_MONOTONIC); }

static inline int64_t wall_ns(void) { return clock_read(CLOCK_REALTIME); }

#endif
