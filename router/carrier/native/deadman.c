#include "deadman.h"

#include <errno.h>
#include <stdlib.h>
#include <string.h>

#include "deliver.h"

enum { MOST_REACHED = 64 };

/* In ns: the delay before a failed datagram of the start is sent again; how long after the start a newly discovered
 * subscriber may be one that already existed, as discovery takes less; and the time in which it also discovers the
 * publisher. */
static const int64_t START_AGAIN = 1000000000, START = 10000000000, GREETING = 500000000;

struct deadman {
    struct timer timer;      /* not due while unarmed, unless it repeats the start, and never once replaced */
    struct deadman *acting;  /* the last deadman that has replaced it, or itself */
    struct deadman *fellow;  /* the next one with the same `acting`, in a circular list */
    int64_t timeout, repeat; /* ns */
    bool is_armed;           /* or tripped: sends when it ends */
    bool has_tripped;
    bool starts;             /* sends when the router starts */
    bool is_kept_back;       /* the last attempt to send a datagram failed */
    bool is_ending;          /* ends when it is served next */
    int64_t greets_until;    /* until then, and while unarmed, it greets new subscribers */
    int64_t greets_again;    /* the due time after the next one, while unarmed; or NEVER */
    uint32_t active, trips, id;
    uint32_t count;
    struct deadman_destination destinations[];
};

/* The functions up to the public ones are called with the lock held. */

/* Report an event without a limit: if there is no room, drop the oldest event. */
static void report_with(struct timers *timers, struct deadman_event event, const char *why) {
    struct deadman_event oldest;
    struct ring *events = timers->stage->reporter.events;
    if (!events) return;
    while (!put_event(events, &event, sizeof event, why)) ring_drop(events, &oldest, sizeof oldest);
}

static void report(struct timers *timers, enum event_kind kind, const struct deadman *deadman) {
    report_with(timers, (struct deadman_event){.kind = kind, .deadman = deadman->id}, "");
}

/* Report that a datagram failed: `error` is an errno, or 0 and `why` is the reason. */
static void report_error(struct timers *timers, const struct deadman *deadman, const struct deadman_destination *to,
                         int error, const char *why) {
    report_with(timers, (struct deadman_event){0, EVENT_DEADMAN_ERROR, deadman->id, to->id, error, to->send_errors}, why);
}

/* Send a datagram. Return whether it was sent; if not, `is_kept_back` says whether it is worth another attempt. A refused
 * one is not: a receiver that refuses it does not execute earlier commands either. */
static bool send_one(struct timers *timers, struct deadman *deadman, const struct deadman_destination *to,
                     const struct deadman_datagram *datagram) {
    int error = timers->stage->brake(timers->stage, to, datagram);
    if (error == BRAKE_LATER) return false;
    stage_count(timers->stage, error ? to->send_errors : to->sent, 1);
    deadman->is_kept_back |= error && error != ECONNREFUSED;
    if (error) report_error(timers, deadman, to, error, "");
    return !error;
}

/* Send the datagrams. Return a bit for each of the first 64 destinations that all of theirs have reached. */
static uint64_t send_all(struct timers *timers, struct deadman *deadman) {
    uint64_t reached = 0;
    deadman->is_kept_back = false;
    for (uint32_t index = 0; index < deadman->count; index++) {
        const struct deadman_destination *to = &deadman->destinations[index];
        bool is_reached = index < MOST_REACHED;
        for (uint32_t each = 0; each < to->count; each++)
            is_reached &= send_one(timers, deadman, to, &to->datagrams[each]);
        if (is_reached) reached |= (uint64_t)1 << index;
    }
    return reached;
}

static void release(struct timers *timers, struct deadman *deadman) {
    if (!deadman->has_tripped) return;
    deadman->has_tripped = false;
    counter_set(timers->stage->counters, deadman->active, 0);
    report(timers, EVENT_RELEASED, deadman);
}

static void feed_one(struct timers *timers, const struct feed *feed, int64_t now) {
    struct deadman *deadman = feed->deadman->acting;
    deadman->is_armed = !feed->disarms;
    timer_set_due(timers, &deadman->timer, feed->disarms ? NEVER : now + deadman->timeout);
    release(timers, deadman);
}

/* A command was sent, and an ICMP message says that the board refused an earlier one. The message may be forged, and whether
 * the board executes this command is unknown: so arm the deadman, but do not extend its deadline. */
static void arm_one(struct timers *timers, const struct feed *feed, int64_t now) {
    struct deadman *deadman = feed->deadman->acting;
    if (feed->disarms || deadman->is_armed) return;
    deadman->is_armed = true;
    timer_set_due(timers, &deadman->timer, now + deadman->timeout);
}

/* Send the datagrams of the start. If that fails, for example because the network is not up yet, repeat it. */
static uint64_t start(struct timers *timers, struct deadman *deadman, int64_t now) {
    uint64_t reached = send_all(timers, deadman);
    int64_t again = deadman->is_kept_back ? now + START_AGAIN : NEVER;
    timer_set_due(timers, &deadman->timer, again < deadman->greets_again ? again : deadman->greets_again);
    deadman->greets_again = NEVER;
    return reached;
}

/* Send a last time if the deadman is armed or tripped. */
static void end(struct timers *timers, struct timer *timer, int64_t now) {
    struct deadman *deadman = (struct deadman *)timer;
    (void)now;
    bool was_armed = deadman->is_armed;
    deadman->is_armed = false;
    timer_set_due(timers, timer, NEVER);
    deadman->greets_until = 0;
    if (was_armed) send_all(timers, deadman);
}

static void serve(struct timers *timers, struct timer *timer, int64_t now) {
    struct deadman *deadman = (struct deadman *)timer;
    if (deadman->is_ending) {
        end(timers, timer, now);
        return;
    }
    if (!deadman->is_armed) {
        start(timers, deadman, now);
        return;
    }
    /* Skip repetitions that a stalled process has missed. */
    timer_set_due(timers, timer, timer->due + deadman->repeat * ((now - timer->due) / deadman->repeat + 1));
    if (deadman->has_tripped) {
        send_all(timers, deadman);
        return;
    }
    deadman->has_tripped = true;
    counter_set(timers->stage->counters, deadman->active, 1);
    stage_count(timers->stage, deadman->trips, 1);
    send_all(timers, deadman);
    report(timers, EVENT_TRIPPED, deadman);
}

static const struct timer_kind DEADMAN = {.serve = serve, .end = end};

static bool sends_to(const struct deadman *deadman, const struct sender *sender) {
    for (uint32_t index = 0; index < deadman->count; index++)
        if (deadman->destinations[index].sender == sender) return true;
    return false;
}

static void keep_others_than(struct deadman *deadman, const struct deadman *next) {
    uint32_t kept = 0;
    for (uint32_t index = 0; index < deadman->count; index++) {
        struct deadman_destination *each = &deadman->destinations[index];
        if (!sends_to(next, each->sender)) deadman->destinations[kept++] = *each;
    }
    deadman->count = kept;
}

static void leave_fellows(struct deadman *deadman) {
    struct deadman *before = deadman;
    while (before->fellow != deadman) before = before->fellow;
    before->fellow = deadman->fellow;
    deadman->fellow = deadman;
}

/* Let `next` act for `earlier`, and for all deadmen that `earlier` acts for. */
static void redirect(struct deadman *next, struct deadman *earlier) {
    leave_fellows(next);
    next->fellow = earlier->fellow;
    earlier->fellow = next;
    next->acting = next;
    for (struct deadman *each = next->fellow; each != next; each = each->fellow) each->acting = next;
}

/* Pass deadline and state to `next`, unless a later command has already fed it. */
static void take_over(struct timers *timers, struct deadman *next, struct deadman *earlier) {
    redirect(next, earlier);
    keep_others_than(earlier, next);
    next->greets_until = next->starts ? earlier->greets_until : 0;
    int64_t due = earlier->timer.due;
    timer_set_due(timers, &earlier->timer, NEVER);
    if (due == NEVER) return;
    if (next->is_armed) {
        release(timers, earlier);
        return;
    }
    if (!earlier->is_armed) {
        if (!next->starts) return;
        timer_set_due(timers, &next->timer, due);
        next->greets_again = earlier->greets_again;
        return;
    }
    next->is_armed = true;
    next->has_tripped = earlier->has_tripped;
    due += next->has_tripped ? next->repeat - earlier->repeat : next->timeout - earlier->timeout;
    timer_set_due(timers, &next->timer, due);
}

/* ---- public ---- */

struct deadman *deadman_open(struct timers *timers, int64_t timeout, int64_t repeat, bool starts, uint32_t active,
                             uint32_t trips, uint32_t id, const struct deadman_destination *destinations,
                             uint32_t count) {
    size_t datagrams = 0, bytes = 0;
    for (uint32_t index = 0; index < count; index++)
        for (uint32_t each = 0; each < destinations[index].count; each++, datagrams++)
            bytes += destinations[index].datagrams[each].size;
    size_t own = sizeof(struct deadman) + count * sizeof *destinations;
    struct deadman *deadman = calloc(1, own + datagrams * sizeof(struct deadman_datagram) + bytes);
    if (!deadman) return NULL;
    *deadman = (struct deadman){.timer = {.kind = &DEADMAN, .due = NEVER}, .acting = deadman, .timeout = timeout,
                                .repeat = repeat, .starts = starts, .active = active, .trips = trips, .id = id,
                                .count = count, .greets_again = NEVER};
    deadman->fellow = deadman;
    struct deadman_datagram *copy = (struct deadman_datagram *)&deadman->destinations[count];
    uint8_t *data = (uint8_t *)(copy + datagrams);
    for (uint32_t index = 0; index < count; index++) {
        const struct deadman_destination *from = &destinations[index];
        deadman->destinations[index] = *from;
        deadman->destinations[index].datagrams = copy;
        for (uint32_t each = 0; each < from->count; each++, copy++) {
            *copy = (struct deadman_datagram){memcpy(data, from->datagrams[each].data, from->datagrams[each].size),
                                              from->datagrams[each].size};
            data += copy->size;
        }
    }
    pthread_mutex_lock(&timers->lock);
    timers_add(timers, &deadman->timer);
    pthread_mutex_unlock(&timers->lock);
    return deadman;
}

void deadman_close(struct timers *timers, struct deadman *deadman) {
    pthread_mutex_lock(&timers->lock);
    timers_remove(timers, &deadman->timer);
    leave_fellows(deadman);
    pthread_mutex_unlock(&timers->lock);
    free(deadman);
}

uint64_t deadman_start(struct timers *timers, struct deadman *deadman, int64_t now) {
    if (!deadman->starts) return 0;
    pthread_mutex_lock(&timers->lock);
    uint64_t reached = start(timers, deadman, now);
    pthread_mutex_unlock(&timers->lock);
    return reached;
}

void deadman_await_subscribers(struct timers *timers, struct deadman *deadman, int64_t now) {
    pthread_mutex_lock(&timers->lock);
    deadman->greets_until = deadman->starts ? now + START : 0;
    pthread_mutex_unlock(&timers->lock);
}

bool deadman_greet(struct timers *timers, struct deadman *deadman, int64_t now) {
    pthread_mutex_lock(&timers->lock);
    bool greets = now < deadman->greets_until && !deadman->is_armed;
    if (greets) {
        timer_set_due(timers, &deadman->timer, now);
        deadman->greets_again = now + GREETING;
    }
    pthread_mutex_unlock(&timers->lock);
    return greets;
}

void deadman_replace(struct timers *timers, struct deadman *next, struct deadman *earlier) {
    pthread_mutex_lock(&timers->lock);
    take_over(timers, next, earlier);
    pthread_mutex_unlock(&timers->lock);
}

void command_has_left(struct timers *timers, const struct feed *feeds, uint32_t count, int refused, int64_t now) {
    for (uint32_t index = 0; index < count; index++) {
        if (refused) arm_one(timers, &feeds[index], now);
        else feed_one(timers, &feeds[index], now);
    }
}

void deadman_feed(struct timers *timers, struct deadman *deadman, int64_t now) {
    struct feed feed = {.deadman = deadman};
    pthread_mutex_lock(&timers->lock);
    command_has_left(timers, &feed, 1, 0, now);
    pthread_mutex_unlock(&timers->lock);
}

void deadman_schedule_end(struct timers *timers, struct timer *timer) {
    struct deadman *deadman = (struct deadman *)timer;
    deadman->is_ending = deadman->is_armed;
    timer_set_due(timers, timer, deadman->is_armed ? 0 : NEVER);
    deadman->greets_until = 0;
}

void deadman_end_by_thread(struct timers *timers, struct deadman *deadman) {
    pthread_mutex_lock(&timers->lock);
    deadman_schedule_end(timers, &deadman->timer);
    pthread_mutex_unlock(&timers->lock);
}

static bool is_served(const struct timers *timers, const struct timer *timer) {
    for (const struct timer *each = timers->first; each; each = each->next)
        if (each == timer) return true;
    return false;
}

void deadman_settle(struct timers *timers, struct timer *timer, const struct deadman_destination *to, const char *why,
                    int64_t now) {
    stage_count(timers->stage, why ? to->send_errors : to->sent, 1);
    if (!why || !is_served(timers, timer)) return;
    struct deadman *deadman = (struct deadman *)timer;
    report_error(timers, deadman, to, 0, why);
    deadman = deadman->acting;
    if (deadman->is_armed || now >= deadman->greets_until || deadman->timer.due <= now + START_AGAIN) return;
    timer_set_due(timers, &deadman->timer, now + START_AGAIN);
}

int command_send_at(struct timers *timers, struct sender *sender, const void *data, size_t size, int64_t expires,
                    const struct feed *feeds, uint32_t count, int64_t now) {
    if (now > expires) return COMMAND_STALE;
    int error = sender_send_only(sender, data, size);
    if (error) return error;
    int refused = sender_take_refused(sender);
    if (!count) return refused;
    command_has_left(timers, feeds, count, refused, now);
    return refused;
}

int command_send(struct timers *timers, struct sender *sender, const void *data, size_t size, int64_t expires,
                 const struct feed *feeds, uint32_t count) {
    if (!count) {
        int64_t now = expires == NEVER ? 0 : timers->stage->now(timers->stage);
        return command_send_at(timers, sender, data, size, expires, feeds, count, now);
    }
    pthread_mutex_lock(&timers->lock);
    int error = command_send_at(timers, sender, data, size, expires, feeds, count,
                                timers->stage->now(timers->stage));
    pthread_mutex_unlock(&timers->lock);
    return error;
}
