/* Converts time stamps of the wall clock to the boot clock, although the wall clock may have been set since.
 *
 * Each look compares the wall clock with the boot clock. If the offset has changed, the clock was set since the last look.
 * A stamp means a different time under each setting, but only times at which that setting may have been in force are
 * possible. If there are several, the stamp is ambiguous: a clock that is set back shows the same time twice.
 *
 * Provided that the clock was set at most once between two looks, and that stamps come from clocks that are set together
 * with ours, the following holds for an event of the last FRESHNESS_MEMORY, within FRESHNESS_TOLERANCE:
 *
 * - The oldest reading is never younger than the event: a message that is stale by it remains stale however the clock is
 *   set. For a while after the clock was set back by `d`, it makes fresh messages appear older by `d`, unless
 *   `not_before` excludes that, or the past was forgotten.
 * - The youngest reading is never older than the event: no jump makes a fresh message stale by it. It is younger only if
 *   the clock was set since, or since the last look before the event, by some `d` no greater than its age.
 *
 * An older event may have any age if the clock was set since.
 *
 * A stamp in the future under all settings comes from a computer whose clock is ahead; it counts as now. For
 * FRESHNESS_MEMORY after our clock was set back by more than theirs is ahead, it instead counts as a stamp from before the
 * change. */
#ifndef FRESHNESS_H
#define FRESHNESS_H

#include <stdint.h>

enum { FRESHNESS_MOST_SETTINGS = 32 };

/* In ns: the error of a reading while the wall clock is slewed, at up to 1 ms/s, and how long a past setting of the clock
 * is remembered after the next one was detected. */
static const int64_t FRESHNESS_TOLERANCE = 10000000, FRESHNESS_MEMORY = 10000000000;

/* The wall clock was `offset` ahead of the boot clock, at most from `since` until `until`. */
struct setting {
    int64_t offset, since, until;
};

struct freshness {
    int64_t is_known, offset, since, seen;
    uint32_t first, count; /* of the ring `past`: settings under which later messages may have been stamped */
    struct setting past[FRESHNESS_MOST_SETTINGS];
};

/* The earliest and the latest possible time of a stamp (boot clock, ns). */
struct time_range {
    int64_t oldest, youngest;
};

/* Compare the clocks: `now` and `received_at` are the boot clock and the wall clock, read now in this order. Call it often,
 * also without stamps, to bound the time at which the clock was set. For one thread. */
void freshness_look(struct freshness *freshness, int64_t received_at, int64_t now);

/* Record that all later messages are stamped after the last look, because the queue has been empty since. */
static inline void freshness_forget_past(struct freshness *freshness) { freshness->count = 0; }

/* Look, and return the possible times of an event with the wall-clock stamp `stamp`, never after `now`. The event did not
 * happen before `not_before` (boot clock), if that is known; else INT64_MIN. */
struct time_range freshness_times(struct freshness *freshness, int64_t stamp, int64_t received_at, int64_t now,
                                  int64_t not_before);

#endif
