/* `max_rate`: limits the number of messages per second. All times are in ns of the boot clock.
 *
 * Messages pass on a grid of one period. A message up to half a period early takes the next place on the grid: a limiter by
 * interval would wait for the next message and undershoot, to 25 instead of 30 Hz out of 100. After a pause the grid
 * restarts, so no burst accumulates. In any second, at most one message more than the rate passes. */
#ifndef LIMIT_H
#define LIMIT_H

#include <stdbool.h>
#include <stdint.h>

struct limit {
    int64_t period, late; /* `late` is period - period / 2 */
    int64_t next_pass;    /* the earliest time at which a message may pass; -period at first */
};

/* Open an unused limit that passes one message per `period`. Returns NULL if memory runs out. */
struct limit *limit_open(int64_t period);
void limit_close(struct limit *limit);

/* Return whether a message may pass now, and if so, count it against the limit. */
bool limit_passes(struct limit *limit, int64_t now);

#endif
