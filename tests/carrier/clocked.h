/* In place of clock.h, for tests: clocks that are set. */
#ifndef CLOCK_H
#define CLOCK_H

#include <stdint.h>
#include <time.h>

extern int64_t seam_boottime, seam_wall;

static inline int64_t clock_read(clockid_t clock) { return clock == CLOCK_REALTIME ? seam_wall : seam_boottime; }

static inline int64_t boottime_ns(void) { return clock_read(CLOCK_BOOTTIME); }

static inline int64_t monotonic_ns(void) { return clock_read(CLOCK_MONOTONIC); }

static inline int64_t wall_ns(void) { return clock_read(CLOCK_REALTIME); }

#endif
