#include "pace.h"

#include <stdlib.h>
#include <string.h>

static const int64_t SECOND = 1000000000;      /* ns, as are the next two: */
static const int64_t BURST = 20000000;         /* the budget that a pause accumulates */
static const int64_t OVERDRAFT = 100000000;    /* how far commands may overdraw the budget */
enum { LEAST_OVERDRAFT = 2048 };               /* bytes, if that is more than OVERDRAFT */

/* The header of a waiting datagram, which follows, padded to a multiple of 8 bytes. */
struct waiting_datagram {
    struct route_target *of;
    int64_t expires, arrived;
    int64_t cost; /* ns of budget */
    size_t size;
};
static const int64_t SUPERSEDED = INT64_MIN; /* expires: it is lost already, and only takes room until it is the first */
enum { LONGEST_WAITING = sizeof(struct waiting_datagram) + LONGEST_SENT + 8 };

/* Datagrams of one priority, the oldest first: between `first` and `end`, or if they wrap around, between `first` and `limit`
 * and between 0 and `end`. */
struct lane {
    uint8_t *bytes;
    size_t capacity, first, end, limit;
    uint32_t count;
    bool goes_round;
};

struct pacer {
    struct timer timer;
    struct lane lanes[PRIORITIES];
    int64_t bandwidth; /* bytes per second */
    int64_t overdraft;
    int64_t bytes_left, datagrams_left; /* that may still wait; below 0 until the oldest is dropped */
    int64_t paid_at; /* when the budget has paid for everything sent; the time from then to now is accumulated */
    bool has_ended;  /* datagrams no longer wait */
};

/* ---- lanes ---- */

static size_t whole_size(size_t size) { return (sizeof(struct waiting_datagram) + size + 7) & ~(size_t)7; }

static struct waiting_datagram *first_of(const struct lane *lane) {
    return (struct waiting_datagram *)(lane->bytes + lane->first);
}

/* Add a datagram. There is always room, even while the first one stays: see lane_open. */
static void put(struct lane *lane, const struct waiting_datagram *waiting, const uint8_t *data) {
    size_t size = whole_size(waiting->size);
    if (!lane->count) {
        lane->first = lane->end = 0;
        lane->goes_round = false;
    }
    if (!lane->goes_round && size > lane->capacity - lane->end) {
        lane->limit = lane->end;
        lane->end = 0;
        lane->goes_round = true;
    }
    memcpy(lane->bytes + lane->end, waiting, sizeof *waiting);
    if (waiting->size) memcpy(lane->bytes + lane->end + sizeof *waiting, data, waiting->size);
    lane->end += size;
    lane->count++;
}

/* Remove the first datagram. It stays valid until another one is added. */
static const struct waiting_datagram *take(struct lane *lane) {
    const struct waiting_datagram *taken = first_of(lane);
    lane->first += whole_size(taken->size);
    if (lane->goes_round && lane->first == lane->limit) {
        lane->first = 0;
        lane->goes_round = false;
    }
    lane->count--;
    return taken;
}

/* Allocate enough that a datagram fits into one of the free pieces even while all that may wait, and one more, are in the
 * lane. */
static bool lane_open(struct lane *lane, int64_t bytes, int64_t datagrams) {
    lane->capacity = (size_t)bytes + (size_t)datagrams * (sizeof(struct waiting_datagram) + 8) + 4 * LONGEST_WAITING;
    lane->bytes = malloc(lane->capacity);
    return lane->bytes;
}

/* ---- the budget ---- */

static int64_t cost_of(const struct pacer *pacer, size_t size) {
    return ((int64_t)size * SECOND + pacer->bandwidth - 1) / pacer->bandwidth;
}

/* Limit the accumulated budget. Call it before the first datagram of a lane changes. */
static void limit_savings(struct pacer *pacer, int64_t now) {
    int64_t first = 0;
    for (int index = PRIORITY_COMMAND + 1; index < PRIORITIES; index++) {
        const struct lane *lane = &pacer->lanes[index];
        if (lane->count && first_of(lane)->cost > first) first = first_of(lane)->cost;
    }
    int64_t earliest = now - BURST - first;
    if (pacer->paid_at < earliest) pacer->paid_at = earliest;
}

static const struct waiting_datagram *take_off(struct pacer *pacer, struct lane *lane) {
    const struct waiting_datagram *taken = take(lane);
    pacer->bytes_left += (int64_t)taken->size;
    pacer->datagrams_left++;
    taken->of->queued--;
    return taken;
}

/* Send the first datagram, or drop it if it has expired or a state no longer lets it pass. Return whether it was sent. */
static bool send_first(struct timers *timers, struct pacer *pacer, struct lane *lane, int64_t now) {
    const struct waiting_datagram *first = take_off(pacer, lane);
    const struct route_target *of = first->of;
    if (first->expires == SUPERSEDED) return false;
    if (now > first->expires) {
        lose_stale(timers->env, of->to, of->target, now, first->expires, REFUSED_WAITING);
        return false;
    }
    if (!may_leave(timers->env, of->to, of->target)) return false;
    pacer->paid_at += first->cost;
    timers->arrived = first->arrived;
    deliver_now(timers->env, of->to, of->target, (const uint8_t *)(first + 1), first->size, first->expires, now);
    timers->arrived = NEVER;
    return true;
}

/* Send what the budget allows. Return when to continue, or NEVER if nothing waits. */
static int64_t send_affordable(struct timers *timers, struct pacer *pacer, int64_t now) {
    for (int index = 0; index < PRIORITIES; index++) {
        struct lane *lane = &pacer->lanes[index];
        while (lane->count) {
            const struct waiting_datagram *first = first_of(lane);
            int64_t may_go_at = pacer->paid_at + (index == PRIORITY_COMMAND ? -pacer->overdraft : first->cost);
            if (now < may_go_at && now <= first->expires) {
                /* An expired one no longer raises the limit of the accumulated budget. */
                return may_go_at > first->expires ? first->expires + 1 : may_go_at;
            }
            if (!send_first(timers, pacer, lane, now)) limit_savings(pacer, now);
        }
    }
    return NEVER;
}

static void drop_one(struct timers *timers, struct pacer *pacer, int64_t now) {
    int lowest = PRIORITIES - 1;
    while (!pacer->lanes[lowest].count) lowest--;
    const struct waiting_datagram *oldest = take_off(pacer, &pacer->lanes[lowest]);
    const struct route_target *of = oldest->of;
    if (oldest->expires == SUPERSEDED) return;
    lose_message(timers->env, of->to, of->target, now, (struct lost_event){.reason = DROP_QUEUE_FULL}, "");
}

/* ---- the timer ---- */

static void serve(struct timers *timers, struct timer *timer, int64_t now) {
    struct pacer *pacer = (struct pacer *)timer;
    limit_savings(pacer, now);
    timer_set_due(timers, timer, send_affordable(timers, pacer, now));
}

static void adopt(struct timers *timers, struct timer *timer, const struct targets *to, const struct target *target) {
    (void)to, (void)target; /* each waiting datagram has its target */
    timers_add(timers, timer);
}

/* Send all waiting datagrams, whatever the budget. */
static void end(struct timers *timers, struct timer *timer, int64_t now) {
    struct pacer *pacer = (struct pacer *)timer;
    pacer->has_ended = true;
    timer_set_due(timers, timer, NEVER);
    for (int index = 0; index < PRIORITIES; index++)
        while (pacer->lanes[index].count) send_first(timers, pacer, &pacer->lanes[index], now);
    timers_remove(timers, timer);
}

static const struct timer_kind PACER = {.serve = serve, .adopt = adopt, .end = end};

/* ---- public ---- */

void pacer_queue(struct timers *timers, struct pacer *pacer, struct route_target *of, const uint8_t *data, size_t size,
                 int64_t expires, int64_t now) {
    int64_t arrived = timers->arrived == NEVER ? now : timers->arrived;
    struct waiting_datagram waiting = {of, expires, arrived, cost_of(pacer, size), size};
    if (pacer->has_ended) {
        deliver_now(timers->env, of->to, of->target, data, size, expires, now);
        return;
    }
    limit_savings(pacer, now);
    put(&pacer->lanes[of->target->priority], &waiting, data);
    pacer->bytes_left -= (int64_t)size;
    pacer->datagrams_left--;
    of->queued++;
    timer_set_due(timers, &pacer->timer, send_affordable(timers, pacer, now));
    while (pacer->bytes_left < 0 || pacer->datagrams_left < 0) drop_one(timers, pacer, now);
}

void pacer_release(struct timers *timers, struct pacer *pacer, const struct route_target *of, int64_t now) {
    limit_savings(pacer, now);
    for (int index = 0; index < PRIORITIES; index++) {
        struct lane *lane = &pacer->lanes[index];
        for (uint32_t left = lane->count; left; left--) {
            if (first_of(lane)->of == of) {
                send_first(timers, pacer, lane, now);
            } else {
                const struct waiting_datagram *kept = first_of(lane);
                put(lane, kept, (const uint8_t *)(kept + 1));
                take(lane);
            }
        }
    }
    limit_savings(pacer, now);
}

void pacer_supersede(struct timers *timers, struct pacer *pacer, const struct route_target *of, int64_t now) {
    for (int index = 0; index < PRIORITIES; index++) {
        struct lane *lane = &pacer->lanes[index];
        size_t at = lane->first;
        for (uint32_t left = lane->count; left; left--) {
            if (lane->goes_round && at == lane->limit) at = 0;
            struct waiting_datagram *waiting = (struct waiting_datagram *)(lane->bytes + at);
            at += whole_size(waiting->size);
            if (waiting->of != of || waiting->expires == SUPERSEDED || waiting->arrived > timers->arrived) continue;
            waiting->expires = SUPERSEDED;
            lose_superseded(timers->env, of, now);
        }
    }
    timer_set_due(timers, &pacer->timer, now);
}

void lose_superseded(struct thread_env *env, const struct route_target *of, int64_t now) {
    lose_message(env, of->to, of->target, now, (struct lost_event){.reason = DROP_SUPERSEDED}, "");
}

struct pacer *pacer_open(int64_t bandwidth) {
    struct pacer *pacer = calloc(1, sizeof *pacer);
    if (!pacer) return NULL;
    int64_t room = bandwidth < LEAST_ROOM ? LEAST_ROOM : bandwidth > MOST_ROOM ? MOST_ROOM : bandwidth;
    pacer->timer = (struct timer){.kind = &PACER, .due = NEVER};
    pacer->bandwidth = bandwidth;
    pacer->overdraft = cost_of(pacer, LEAST_OVERDRAFT);
    if (pacer->overdraft < OVERDRAFT) pacer->overdraft = OVERDRAFT;
    pacer->bytes_left = room;
    pacer->datagrams_left = room / BYTES_PER_WAITING;
    pacer->paid_at = -BURST;
    bool is_open = true;
    for (int index = 0; index < PRIORITIES; index++)
        is_open &= lane_open(&pacer->lanes[index], pacer->bytes_left, pacer->datagrams_left);
    if (is_open) return pacer;
    pacer_close(pacer);
    return NULL;
}

void pacer_close(struct pacer *pacer) {
    for (int index = 0; index < PRIORITIES; index++) free(pacer->lanes[index].bytes);
    free(pacer);
}
