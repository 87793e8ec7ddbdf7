#include "timers.h"

#include <stdlib.h>
#include <sys/timerfd.h>
#include <unistd.h>

#include "deliver.h"

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

struct timers *timers_open_on(struct stage *stage) {
    struct timers *timers = calloc(1, sizeof *timers);
    if (!timers) return NULL;
    timers->timer = timerfd_create(CLOCK_BOOTTIME, TFD_CLOEXEC | TFD_NONBLOCK);
    if (timers->timer < 0) {
        free(timers);
        return NULL;
    }
    if (open_lock(&timers->lock)) {
        close(timers->timer);
        free(timers);
        return NULL;
    }
    timers->stage = stage;
    timers->timer_set_for = NEVER;
    timers->next_due = NEVER;
    return timers;
}

/* Send a command while the lock is held. */
static int send_locked(struct stage *stage, const struct target *target, const uint8_t *data, size_t size, int64_t expires) {
    int64_t now = stage->now(stage);
    return command_send_at(stage->timers, target->sender, data, size, expires, target->feeds, target->feed_count, now);
}

struct timers *timers_open(counter *counters, struct ring *events) {
    struct stage *stage = calloc(1, sizeof *stage);
    if (!stage) return NULL;
    struct timers *timers = stage_open(stage, counters, events, NULL) ? timers_open_on(stage) : NULL;
    if (!timers) {
        stage_close(stage);
        free(stage);
        return NULL;
    }
    stage->timers = timers;
    stage->send = send_locked;
    timers->has_own_stage = true;
    return timers;
}

void timers_close(struct timers *timers) {
    pthread_mutex_destroy(&timers->lock);
    close(timers->timer);
    if (timers->has_own_stage) {
        stage_close(timers->stage);
        free(timers->stage);
    }
    free(timers);
}

/* ---- with the lock held ---- */

/* Set the timerfd for `due`. If it has expired, it is no longer readable then. */
static void set_timer(struct timers *timers, int64_t due) {
    struct itimerspec at = {.it_value = {due / 1000000000, due % 1000000000}};
    if (due == NEVER) at.it_value = (struct timespec){0, 0}; /* stops it */
    else if (due <= 0) at.it_value = (struct timespec){0, 1};
    timerfd_settime(timers->timer, TFD_TIMER_ABSTIME, &at, NULL);
    timers->timer_set_for = due;
}

/* Find out when the next timer is due, and return that time. */
static int64_t find_due(struct timers *timers) {
    int64_t next = NEVER;
    for (const struct timer *each = timers->first; each; each = each->next)
        if (each->due < next) next = each->due;
    atomic_store_explicit(&timers->next_due, next, memory_order_relaxed);
    return next;
}

/* See to it that the timerfd expires by then. One that expires earlier is left alone, and set anew when it has expired:
 * commands put off a deadline a thousand times per second, and cost no system call. */
void timers_note_due(struct timers *timers) {
    int64_t next = find_due(timers);
    if (next < timers->timer_set_for) set_timer(timers, next);
}

void timers_await_next(struct timers *timers) {
    if (!timers->is_left) set_timer(timers, find_due(timers));
}

void timers_add(struct timers *timers, struct timer *timer) {
    if (timer->is_listed) return;
    timer->is_listed = true;
    timer->next = timers->first;
    timers->first = timer;
}

void timers_remove(struct timers *timers, struct timer *timer) {
    if (!timer->is_listed) return;
    timer->is_listed = false;
    struct timer **link = &timers->first;
    while (*link != timer) link = &(*link)->next;
    *link = timer->next;
}

/* End the timers that hold messages, the oldest first: a pacer before what passes on to it. */
static void end_holding(struct timers *timers, int64_t now) {
    for (struct timer *oldest = timers->first; oldest && !timers->is_left;) {
        oldest = NULL;
        for (struct timer *each = timers->first; each; each = each->next)
            if (each->kind->adopt) oldest = each;
        if (oldest) oldest->kind->end(timers, oldest, now); /* which leaves the list */
    }
}

static void end_deadmen(struct timers *timers, int64_t now) {
    for (struct timer *each = timers->first; each && !timers->is_left; each = each->next)
        if (!each->kind->adopt) each->kind->end(timers, each, now);
}

/* ---- public ---- */

void timers_serve(struct timers *timers, int64_t now) {
    pthread_mutex_lock(&timers->lock);
    for (struct timer *each = timers->first; each && !timers->is_left; each = each->next)
        if (each->due <= now) each->kind->serve(timers, each, now);
    timers_await_next(timers);
    pthread_mutex_unlock(&timers->lock);
}


void timers_change(struct timers *timers, const struct timer_change *change) {
    pthread_mutex_lock(&timers->lock);
    int64_t now = timers->stage->now(timers->stage);
    for (uint32_t index = 0; index < change->ended_count && !timers->is_left; index++) {
        struct timer *timer = change->ended[index];
        timer->kind->end(timers, timer, now);
    }
    for (uint32_t index = 0; index < change->adopted_count && !timers->is_left; index++) {
        const struct adoption *adoption = &change->adopted[index];
        adoption->timer->kind->adopt(timers, adoption->timer, adoption->to, adoption->target);
    }
    if (!timers->is_left) timers_note_due(timers);
    pthread_mutex_unlock(&timers->lock);
}

void timer_end(struct timers *timers, struct timer *timer) {
    pthread_mutex_lock(&timers->lock);
    timer->kind->end(timers, timer, timers->stage->now(timers->stage));
    timers_note_due(timers);
    pthread_mutex_unlock(&timers->lock);
}

void timers_end(struct timers *timers) {
    pthread_mutex_lock(&timers->lock);
    int64_t now = timers->stage->now(timers->stage);
    end_holding(timers, now);
    end_deadmen(timers, now);
    if (!timers->is_left) timers_note_due(timers);
    pthread_mutex_unlock(&timers->lock);
}
