#include "limit.h"

#include <stdlib.h>

struct limit *limit_open(int64_t period) {
    struct limit *limit = malloc(sizeof *limit);
    if (limit) *limit = (struct limit){period, period - period / 2, -period};
    return limit;
}

void limit_close(struct limit *limit) { free(limit); }

bool limit_passes(struct limit *limit, int64_t now) {
    int64_t waited = now - limit->next_pass;
    if (waited < 0) return false;
    limit->next_pass = waited < limit->period ? limit->next_pass + limit->period : now + limit->late;
    return true;
}
