/* Converts time stamps of the wall clock, which may have jumped since, to the monotonic clock.
 *
 * The rules and their reasons are in engine/freshness.py; both have to give the same answers. */
#ifndef FRESHNESS_H
#define FRESHNESS_H

#include <stdint.h>

enum { FRESHNESS_MOST_SETTINGS = 32 };

struct setting {
    int64_t offset, since, until;
};

struct freshness {
    int64_t is_known, offset, since, seen;
    uint32_t first, count; /* of the ring `past` */
    struct setting past[FRESHNESS_MOST_SETTINGS];
};

/* Return the monotonic time of an event that was stamped `stamp` by the wall clock; never after `now`. `now` and
 * `received_at` are the monotonic and the wall clock, read now in this order. For one thread, with every stamp. */
int64_t freshness_born(struct freshness *freshness, int64_t stamp, int64_t received_at, int64_t now);

#endif
