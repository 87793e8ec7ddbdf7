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

void timers_await_next(struct timers *timers) { set_timer(timers, find_due(timers)); }

/* ---- public ---- */

void timers_serve(struct timers *timers, int64_t now) {
    pthread_mutex_lock(&timers->lock);
    for (struct timer *each = timers->first; each; each = each->next)
        if (each->due <= now) each->kind->serve(timers, each, now);
    timers_await_next(timers);
    pthread_mutex_unlock(&timers->lock);
}

void timers_add(struct timers *timers, struct timer *timer) {
    pthread_mutex_lock(&timers->lock);
    timer->next = timers->first;
    timers->first = timer;
    pthread_mutex_unlock(&timers->lock);
}

void timers_remove(struct timers *timers, struct timer *timer) {
    pthread_mutex_lock(&timers->lock);
    struct timer **link = &timers->first;
    while (*link != timer) link = &(*link)->next;
    *link = timer->next;
    pthread_mutex_unlock(&timers->lock);
}

void timer_adopt(struct timers *timers, struct timer *timer, const struct targets *to, const struct target *target) {
    pthread_mutex_lock(&timers->lock);
    timer->kind->adopt(timers, timer, to, target);
    timers_note_due(timers);
    pthread_mutex_unlock(&timers->lock);
}

void timer_end(struct timers *timers, struct timer *timer) {
    pthread_mutex_lock(&timers->lock);
    timer->kind->end(timers, timer, timers->stage->now(timers->stage));
    timers_note_due(timers);
    pthread_mutex_unlock(&timers->lock);
}
