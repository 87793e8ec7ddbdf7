/* `max_rate`: passes at most so many messages per second, on a grid; as RateLimit in engine/pacing.py. */
#ifndef LIMIT_H
#define LIMIT_H

#include <stdbool.h>
#include <stdint.h>

struct limit {
    int64_t period, late, next_pass; /* ns; `late` is period - period / 2, `next_pass` starts as -period */
};

/* Whether a message may pass now; if so, it takes the place. */
static inline bool limit_passes(struct limit *limit, int64_t now) {
    int64_t waited = now - limit->next_pass;
    if (waited < 0) return false;
    limit->next_pass = waited < limit->period ? limit->next_pass + limit->period : now + limit->late;
    return true;
}

#endif
