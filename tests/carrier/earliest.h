/* When the first of the timers of a group is due, by looking at each. For tests. */
#ifndef EARLIEST_H
#define EARLIEST_H

#include "timers.h"

static inline int64_t earliest(const struct timers *timers) {
    int64_t due = NEVER;
    for (const struct timer *each = timers->first; each; each = each->next)
        if (each->due < due) due = each->due;
    return due;
}

#endif
