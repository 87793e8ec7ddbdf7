#include "freshness.h"

#include <stdbool.h>
#include <stdlib.h>

/* TOLERANCE and MEMORY of engine/freshness.py, in ns. */
static const int64_t TOLERANCE = 10000000, MEMORY = 10000000000;

/* Remember a past setting of the clock, in place of the oldest one if there are too many. */
static void remember(struct freshness *freshness, struct setting setting) {
    if (freshness->count == FRESHNESS_MOST_SETTINGS) {
        freshness->first = (freshness->first + 1) % FRESHNESS_MOST_SETTINGS;
        freshness->count--;
    }
    freshness->past[(freshness->first + freshness->count) % FRESHNESS_MOST_SETTINGS] = setting;
    freshness->count++;
}

static void forget_old(struct freshness *freshness, int64_t now) {
    while (freshness->count && now - freshness->past[freshness->first].until > MEMORY) {
        freshness->first = (freshness->first + 1) % FRESHNESS_MOST_SETTINGS;
        freshness->count--;
    }
}

static bool is_possible(int64_t time, int64_t since, int64_t until) {
    return since - TOLERANCE <= time && time <= until + TOLERANCE;
}

/* `event` is what the stamp means under the present setting. Of all times that are possible, return the latest. */
static int64_t latest_possible(const struct freshness *freshness, int64_t stamp, int64_t event, int64_t now) {
    bool is_found = is_possible(event, freshness->since, now);
    int64_t latest = event;
    for (uint32_t index = 0; index < freshness->count; index++) {
        const struct setting *past = &freshness->past[(freshness->first + index) % FRESHNESS_MOST_SETTINGS];
        int64_t time = stamp - past->offset;
        if (!is_possible(time, past->since, past->until)) continue;
        if (!is_found || time > latest) latest = time;
        is_found = true;
    }
    return latest;
}

int64_t freshness_born(struct freshness *freshness, int64_t stamp, int64_t received_at, int64_t now) {
    int64_t offset = received_at - now;
    if (!freshness->is_known) {
        freshness->is_known = 1;
        freshness->offset = offset;
    } else if (llabs(offset - freshness->offset) > TOLERANCE / 2) {
        remember(freshness, (struct setting){freshness->offset, freshness->since, now});
        freshness->offset = offset;
        freshness->since = freshness->seen;
    }
    freshness->seen = now;
    int64_t event = stamp - offset;
    if (freshness->count) {
        forget_old(freshness, now);
        event = latest_possible(freshness, stamp, event, now);
    }
    return event < now ? event : now;
}
