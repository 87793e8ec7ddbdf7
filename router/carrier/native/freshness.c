#include "freshness.h"

#include <stdbool.h>
#include <stdlib.h>

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
    while (freshness->count && now - freshness->past[freshness->first].until > FRESHNESS_MEMORY) {
        freshness->first = (freshness->first + 1) % FRESHNESS_MOST_SETTINGS;
        freshness->count--;
    }
}

static bool is_possible(int64_t time, int64_t since, int64_t until) {
    return since - FRESHNESS_TOLERANCE <= time && time <= until + FRESHNESS_TOLERANCE;
}

static int64_t earlier(int64_t one, int64_t other) { return one < other ? one : other; }

/* The possible times found so far. */
struct found {
    struct time_range times;
    int64_t oldest_in_order; /* not before `not_before` */
    bool is_any, is_in_order;
};

static void find(struct found *found, int64_t time, int64_t not_before) {
    if (!found->is_any || time < found->times.oldest) found->times.oldest = time;
    if (!found->is_any || time > found->times.youngest) found->times.youngest = time;
    found->is_any = true;
    if (not_before == INT64_MIN || time < not_before - FRESHNESS_TOLERANCE) return;
    if (!found->is_in_order || time < found->oldest_in_order) found->oldest_in_order = time;
    found->is_in_order = true;
}

/* `event` is the time of the stamp under the present setting. */
static struct time_range possible(const struct freshness *freshness, int64_t stamp, int64_t event, int64_t now,
                                  int64_t not_before) {
    struct found found = {0};
    if (is_possible(event, freshness->since, now)) find(&found, event, not_before);
    for (uint32_t index = 0; index < freshness->count; index++) {
        const struct setting *past = &freshness->past[(freshness->first + index) % FRESHNESS_MOST_SETTINGS];
        int64_t time = stamp - past->offset;
        if (is_possible(time, past->since, past->until)) find(&found, time, not_before);
    }
    if (!found.is_any) return (struct time_range){event, event};
    return (struct time_range){found.is_in_order ? found.oldest_in_order : found.times.oldest, found.times.youngest};
}

void freshness_look(struct freshness *freshness, int64_t received_at, int64_t now) {
    int64_t offset = received_at - now;
    if (!freshness->is_known) {
        freshness->is_known = 1;
        freshness->offset = offset;
    } else if (llabs(offset - freshness->offset) > FRESHNESS_TOLERANCE / 2) {
        remember(freshness, (struct setting){freshness->offset, freshness->since, now});
        freshness->offset = offset;
        freshness->since = freshness->seen;
    }
    freshness->seen = now;
}

struct time_range freshness_times(struct freshness *freshness, int64_t stamp, int64_t received_at, int64_t now,
                                  int64_t not_before) {
    freshness_look(freshness, received_at, now);
    int64_t event = stamp - (received_at - now);
    struct time_range times = {event, event};
    if (freshness->count) {
        forget_old(freshness, now);
        times = possible(freshness, stamp, event, now, not_before);
    }
    return (struct time_range){earlier(times.oldest, now), earlier(times.youngest, now)};
}
