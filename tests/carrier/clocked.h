/* In place of clock.h, for tests of what the receive thread does with a datagram: clocks that are set. */
#ifndef CLOCK_H
#define CLOCK_H

#include <stdint.h>

extern int64_t seam_monotonic, seam_wall;

static inline int64_t monotonic_ns(void) { return seam_monotonic; }

static inline int64_t wall_ns(void) { return seam_wall; }

#endif
