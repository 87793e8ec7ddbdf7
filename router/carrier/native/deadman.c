#include "deadman.h"

#include <errno.h>
#include <stdlib.h>
#include <string.h>
#include <sys/timerfd.h>
#include <unistd.h>

#include "clock.h"

enum { MOST_REACHED = 64 };
static const int64_t START_AGAIN = 1000000000; /* ns */

struct deadman {
    struct deadman *next;    /* in the list of all */
    struct deadman *acting;  /* the deadman that has replaced it, with no other one between; or itself */
    int64_t timeout, repeat; /* ns */
    int64_t due;             /* NEVER while it is unarmed, and once it is replaced; of an unarmed one: to start again */
    bool is_armed;           /* or tripped: it sends when it ends */
    bool has_tripped;
    bool starts;             /* sends when the router starts */
    bool is_kept_back;       /* a datagram that was sent last has not left */
    uint32_t active, trips, id;
    uint32_t count;
    struct deadman_destination destinations[];
};

/* Whoever holds a lock with priority inheritance lends itself the priority of those who wait, and hands it to the first
 * of them when it is done: a thread that sends without a pause cannot keep brakes waiting by taking it again and again. It
 * costs nothing while nobody waits. Return 0 or an errno. */
static int open_lock(pthread_mutex_t *lock) {
    pthread_mutexattr_t attributes;
    int error = pthread_mutexattr_init(&attributes);
    if (error) return error;
    error = pthread_mutexattr_setprotocol(&attributes, PTHREAD_PRIO_INHERIT);
    if (!error) error = pthread_mutex_init(lock, &attributes);
    pthread_mutexattr_destroy(&attributes);
    return error;
}

struct deadmen *deadmen_open(counter *counters, struct ring *events) {
    struct deadmen *deadmen = calloc(1, sizeof *deadmen);
    if (!deadmen) return NULL;
    deadmen->timer = timerfd_create(CLOCK_BOOTTIME, TFD_CLOEXEC | TFD_NONBLOCK);
    if (deadmen->timer < 0) {
        free(deadmen);
        return NULL;
    }
    if (open_lock(&deadmen->lock)) {
        close(deadmen->timer);
        free(deadmen);
        return NULL;
    }
    deadmen->counters = counters;
    deadmen->events = events;
    deadmen->timer_set_for = NEVER;
    deadmen->next_due = NEVER;
    return deadmen;
}

void deadmen_close(struct deadmen *deadmen) {
    pthread_mutex_destroy(&deadmen->lock);
    close(deadmen->timer);
    free(deadmen);
}

/* What follows, up to the public functions, is called with the lock held. */

static void report(struct deadmen *deadmen, enum event_kind kind, const struct deadman *deadman,
                   const struct deadman_destination *to, int error) {
    struct deadman_event event = {sizeof event, kind, deadman->id, to ? to->id : 0, error, to ? to->send_errors : 0};
    struct deadman_event oldest;
    if (!deadmen->events) return;
    while (!ring_put(deadmen->events, &event, sizeof event)) ring_drop(deadmen->events, &oldest, sizeof oldest);
}

/* Set the timer for `due`. A timer that has ended is no longer readable then. */
static void set_timer(struct deadmen *deadmen, int64_t due) {
    struct itimerspec at = {.it_value = {due / 1000000000, due % 1000000000}};
    if (due == NEVER) at.it_value = (struct timespec){0, 0}; /* stops it */
    else if (due <= 0) at.it_value = (struct timespec){0, 1};
    timerfd_settime(deadmen->timer, TFD_TIMER_ABSTIME, &at, NULL);
    deadmen->timer_set_for = due;
}

/* Find out when the next deadman is due, and return that time. */
static int64_t find_due(struct deadmen *deadmen) {
    int64_t next = NEVER;
    for (const struct deadman *each = deadmen->first; each; each = each->next)
        if (each->due < next) next = each->due;
    atomic_store_explicit(&deadmen->next_due, next, memory_order_relaxed);
    return next;
}

/* As a deadline has changed, see to it that the timer ends by then. A timer that ends earlier is left alone, and set anew
 * when it has ended: commands put off a deadline a thousand times per second, and cost no system call. */
static void note_due(struct deadmen *deadmen) {
    int64_t next = find_due(deadmen);
    if (next < deadmen->timer_set_for) set_timer(deadmen, next);
}

/* Send the datagrams. Return a bit for each of the first 64 destinations reached. One that is refused has left: whoever
 * refuses it obeys no earlier command either. */
static uint64_t send_all(struct deadmen *deadmen, struct deadman *deadman) {
    uint64_t reached = 0;
    deadman->is_kept_back = false;
    for (uint32_t index = 0; index < deadman->count; index++) {
        const struct deadman_destination *to = &deadman->destinations[index];
        int error = sender_send_checked(to->sender, to->datagram, to->size);
        counter_add(deadmen->counters, error ? to->send_errors : to->sent, 1);
        deadman->is_kept_back |= error && error != ECONNREFUSED;
        if (error) report(deadmen, EVENT_DEADMAN_ERROR, deadman, to, error);
        else if (index < MOST_REACHED) reached |= (uint64_t)1 << index;
    }
    return reached;
}

static void release(struct deadmen *deadmen, struct deadman *deadman) {
    if (!deadman->has_tripped) return;
    deadman->has_tripped = false;
    counter_set(deadmen->counters, deadman->active, 0);
    report(deadmen, EVENT_RELEASED, deadman, NULL, 0);
}

static void feed_one(struct deadmen *deadmen, const struct feed *feed, int64_t now) {
    struct deadman *deadman = feed->deadman->acting;
    deadman->is_armed = !feed->disarms;
    deadman->due = feed->disarms ? NEVER : now + deadman->timeout;
    release(deadmen, deadman);
}

/* A command has left, and the board is said to have refused an earlier one. Nobody knows whether it obeys this one, and the
 * ICMP message may be forged: so the deadman is armed, and nothing is put off. */
static void arm_one(const struct feed *feed, int64_t now) {
    struct deadman *deadman = feed->deadman->acting;
    if (feed->disarms || deadman->is_armed) return;
    deadman->is_armed = true;
    deadman->due = now + deadman->timeout;
}

/* Send what is sent when the router starts. A network that is not there yet keeps it back: then do so again. */
static uint64_t start(struct deadmen *deadmen, struct deadman *deadman, int64_t now) {
    uint64_t reached = send_all(deadmen, deadman);
    deadman->due = deadman->is_kept_back ? now + START_AGAIN : NEVER;
    return reached;
}

static void serve_one(struct deadmen *deadmen, struct deadman *deadman, int64_t now) {
    if (!deadman->is_armed) {
        start(deadmen, deadman, now);
        return;
    }
    /* Repetitions that a stalled process has missed are left out. */
    deadman->due += deadman->repeat * ((now - deadman->due) / deadman->repeat + 1);
    if (deadman->has_tripped) {
        send_all(deadmen, deadman);
        return;
    }
    deadman->has_tripped = true;
    counter_set(deadmen->counters, deadman->active, 1);
    counter_add(deadmen->counters, deadman->trips, 1);
    send_all(deadmen, deadman);
    report(deadmen, EVENT_TRIPPED, deadman, NULL, 0);
}

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

/* Let `next` act for `earlier` and for all that this one has replaced. */
static void redirect(struct deadmen *deadmen, struct deadman *next, const struct deadman *earlier) {
    const struct deadman *acting = earlier->acting;
    for (struct deadman *each = deadmen->first; each; each = each->next)
        if (each->acting == acting) each->acting = next;
    next->acting = next;
}

/* Deadline and state pass to `next`, unless a later command has fed it already. */
static void take_over(struct deadmen *deadmen, struct deadman *next, struct deadman *earlier) {
    redirect(deadmen, next, earlier);
    keep_others_than(earlier, next);
    int64_t due = earlier->due;
    earlier->due = NEVER;
    if (due == NEVER) return;
    if (next->is_armed) {
        release(deadmen, earlier);
        return;
    }
    if (!earlier->is_armed) {
        if (next->starts) next->due = due;
        return;
    }
    next->is_armed = true;
    next->has_tripped = earlier->has_tripped;
    next->due = due + (next->has_tripped ? next->repeat - earlier->repeat : next->timeout - earlier->timeout);
}

/* ---- public ---- */

struct deadman *deadman_open(struct deadmen *deadmen, int64_t timeout, int64_t repeat, bool starts, uint32_t active,
                             uint32_t trips, uint32_t id, const struct deadman_destination *destinations,
                             uint32_t count) {
    size_t datagrams = 0;
    for (uint32_t index = 0; index < count; index++) datagrams += destinations[index].size;
    struct deadman *deadman = calloc(1, sizeof *deadman + count * sizeof *destinations + datagrams);
    if (!deadman) return NULL;
    *deadman = (struct deadman){.timeout = timeout, .repeat = repeat, .due = NEVER, .starts = starts, .active = active,
                                .trips = trips, .id = id, .count = count};
    uint8_t *copy = (uint8_t *)&deadman->destinations[count];
    for (uint32_t index = 0; index < count; index++) {
        deadman->destinations[index] = destinations[index];
        deadman->destinations[index].datagram = memcpy(copy, destinations[index].datagram, destinations[index].size);
        copy += destinations[index].size;
    }
    pthread_mutex_lock(&deadmen->lock);
    deadman->acting = deadman;
    deadman->next = deadmen->first;
    deadmen->first = deadman;
    pthread_mutex_unlock(&deadmen->lock);
    return deadman;
}

void deadman_close(struct deadmen *deadmen, struct deadman *deadman) {
    pthread_mutex_lock(&deadmen->lock);
    struct deadman **link = &deadmen->first;
    while (*link != deadman) link = &(*link)->next;
    *link = deadman->next;
    pthread_mutex_unlock(&deadmen->lock);
    free(deadman);
}

uint64_t deadman_start(struct deadmen *deadmen, struct deadman *deadman, int64_t now) {
    if (!deadman->starts) return 0;
    pthread_mutex_lock(&deadmen->lock);
    uint64_t reached = start(deadmen, deadman, now);
    note_due(deadmen);
    pthread_mutex_unlock(&deadmen->lock);
    return reached;
}

void deadman_replace(struct deadmen *deadmen, struct deadman *next, struct deadman *earlier) {
    pthread_mutex_lock(&deadmen->lock);
    take_over(deadmen, next, earlier);
    note_due(deadmen);
    pthread_mutex_unlock(&deadmen->lock);
}

void deadman_end(struct deadmen *deadmen, struct deadman *deadman) {
    pthread_mutex_lock(&deadmen->lock);
    bool was_armed = deadman->is_armed;
    deadman->is_armed = false;
    deadman->due = NEVER;
    if (was_armed) send_all(deadmen, deadman);
    note_due(deadmen);
    pthread_mutex_unlock(&deadmen->lock);
}

void deadmen_serve(struct deadmen *deadmen, int64_t now) {
    pthread_mutex_lock(&deadmen->lock);
    for (struct deadman *each = deadmen->first; each; each = each->next)
        if (each->due <= now) serve_one(deadmen, each, now);
    set_timer(deadmen, find_due(deadmen));
    pthread_mutex_unlock(&deadmen->lock);
}

int command_send_at(struct deadmen *deadmen, struct sender *sender, const void *data, size_t size, int64_t expires,
                    const struct feed *feeds, uint32_t count, int64_t now) {
    if (now > expires) return COMMAND_STALE;
    int error = sender_send_only(sender, data, size);
    if (error) return error;
    int refused = sender_take_refused(sender);
    if (!count) return refused;
    for (uint32_t index = 0; index < count; index++) {
        if (refused) arm_one(&feeds[index], now);
        else feed_one(deadmen, &feeds[index], now);
    }
    note_due(deadmen);
    return refused;
}

int command_send(struct deadmen *deadmen, struct sender *sender, const void *data, size_t size, int64_t expires,
                 const struct feed *feeds, uint32_t count) {
    if (!count) {
        int64_t now = expires == NEVER ? 0 : boottime_ns();
        return command_send_at(deadmen, sender, data, size, expires, feeds, count, now);
    }
    pthread_mutex_lock(&deadmen->lock);
    int error = command_send_at(deadmen, sender, data, size, expires, feeds, count, boottime_ns());
    pthread_mutex_unlock(&deadmen->lock);
    return error;
}
