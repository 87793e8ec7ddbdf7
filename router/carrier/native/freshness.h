/* When a message was born by the boot clock: its time stamp is of the wall clock, which may have been set since.
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
    uint32_t first, count; /* of the ring `past`: settings under which what is still to come may have been stamped */
    struct setting past[FRESHNESS_MOST_SETTINGS];
};

/* The earliest and the latest time (boot clock, ns) that a stamp can mean. */
struct born {
    int64_t oldest, youngest;
};

/* Compare the clocks: `now` and `received_at` are the boot clock and the wall clock, read now in this order. Often, also
 * while nothing is stamped: that bounds when the clock can have been set. For one thread. */
void freshness_look(struct freshness *freshness, int64_t received_at, int64_t now);

/* Nothing that is still to come was stamped before the last look: the queue was found empty since. */
static inline void freshness_forget_past(struct freshness *freshness) { freshness->count = 0; }

/* Look, and return when an event was that the wall clock stamped `stamp`; never after `now`. It was not before
 * `not_before` (boot clock), if that is known; else INT64_MIN. */
struct born freshness_born(struct freshness *freshness, int64_t stamp, int64_t received_at, int64_t now,
                           int64_t not_before);

#endif
