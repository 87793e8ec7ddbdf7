#include "limit.h"

bool limit_passes(struct limit *limit, int64_t now) {
    int64_t waited = now - limit->next_pass;
    if (waited < 0) return false;
    limit->next_pass = waited < limit->period ? limit->next_pass + limit->period : now + limit->late;
    return true;
}
