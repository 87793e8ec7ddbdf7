/* `max_rate`: passes at most so many messages per second; all times are of the boot clock, in ns.
 *
 * Passes keep to a grid of one period. A message up to half a period early takes its place on the grid (a limiter by
 * interval would wait for the next and undershoot: 25 instead of 30 Hz out of 100); after a pause the grid starts anew, so
 * nothing is saved up for a burst. At most one message more than the rate passes in any second. */
#ifndef LIMIT_H
#define LIMIT_H

#include <stdbool.h>
#include <stdint.h>

struct limit {
    int64_t period, late; /* `late` is period - period / 2 */
    int64_t next_pass;    /* from when on a message may pass; -period at first */
};

/* A limit that passes a message each `period`, of which nothing was used. NULL for lack of memory. */
struct limit *limit_open(int64_t period);
void limit_close(struct limit *limit);

/* Whether a message may pass now; if so, it takes the place. */
bool limit_passes(struct limit *limit, int64_t now);

#endif
