#include "timers.h"

#include <stdlib.h>
#include <sys/timerfd.h>
#include <unistd.h>

#include "deliver.h"

/* The holder runs with the priority of the waiting threads, and unlocking passes the lock to the first of them, so a thread
 * that sends continuously cannot delay brakes by taking it again and again. It costs nothing if no thread waits. */
int lock_open(pthread_mutex_t *lock) {
    pthread_mutexattr_t attributes;
    int error = pthread_mutexattr_init(&attributes);
    if (error) return error;
    error = pthread_mutexattr_setprotocol(&attributes, PTHREAD_PRIO_INHERIT);
    if (!error) error = pthread_mutex_init(lock, &attributes);
    pthread_mutexattr_destroy(&attributes);
    return error;
}

struct timers *timers_open_on(struct thread_env *env, bool has_timer) {
    struct timers *timers = calloc(1, sizeof *timers);
    if (!timers) return NULL;
    timers->timer = has_timer ? timerfd_create(CLOCK_BOOTTIME, TFD_CLOEXEC | TFD_NONBLOCK) : -1;
    if ((has_timer && timers->timer < 0) || lock_open(&timers->lock)) {
        if (timers->timer >= 0) close(timers->timer);
        free(timers);
        return NULL;
    }
    timers->env = env;
    timers->wakes_at = timers->arrived = NEVER;
    return timers;
}

/* Send a command while the lock is held. */
static int send_locked(struct thread_env *env, const struct target *target, const uint8_t *data, size_t size, int64_t expires) {
    int64_t now = env->now(env);
    if (target->beside) beside_fill(target->beside, data, env->wall(env));
    return command_send_at(env->timers, target->sender, data, size, expires, target->feeds, target->feed_count, now);
}

struct timers *timers_open(counter *counters, struct ring *events) {
    struct thread_env *env = calloc(1, sizeof *env);
    if (!env) return NULL;
    struct timers *timers = env_open(env, counters, events, NULL) ? timers_open_on(env, true) : NULL;
    if (!timers) {
        env_close(env);
        free(env);
        return NULL;
    }
    env->timers = timers;
    env->send = send_locked;
    timers->has_own_env = true;
    return timers;
}

void timers_close(struct timers *timers) {
    pthread_mutex_destroy(&timers->lock);
    if (timers->timer >= 0) close(timers->timer);
    if (timers->has_own_env) {
        env_close(timers->env);
        free(timers->env);
    }
    free(timers);
}

void timers_observe(struct timers *timers, struct actions *actions) {
    atomic_store_explicit(&timers->actions, actions, memory_order_release);
}

/* ---- with the lock held ---- */

/* Wake the thread of the group at that time. An expired timerfd is no longer readable afterwards. */
static void wake_at(struct timers *timers, int64_t due) {
    atomic_store_explicit(&timers->wakes_at, due, memory_order_relaxed);
    if (timers->timer < 0) return;
    struct itimerspec at = {.it_value = {due / 1000000000, due % 1000000000}};
    if (due == NEVER) at.it_value = (struct timespec){0, 0}; /* stops it */
    else if (due <= 0) at.it_value = (struct timespec){0, 1};
    timerfd_settime(timers->timer, TFD_TIMER_ABSTIME, &at, NULL);
}

void timer_set_due(struct timers *timers, struct timer *timer, int64_t due) {
    timer->due = due;
    if (due < atomic_load_explicit(&timers->wakes_at, memory_order_relaxed)) wake_at(timers, due);
}

void timers_await_next(struct timers *timers) {
    int64_t next = NEVER;
    for (const struct timer *each = timers->first; each; each = each->next)
        if (each->due < next) next = each->due;
    wake_at(timers, next);
}

void timers_add(struct timers *timers, struct timer *timer) {
    if (timer->is_listed) return;
    timer->is_listed = true;
    timer->previous = NULL;
    timer->next = timers->first;
    *(timers->first ? &timers->first->previous : &timers->last) = timer;
    timers->first = timer;
}

void timers_remove(struct timers *timers, struct timer *timer) {
    if (!timer->is_listed) return;
    timer->is_listed = false;
    *(timer->previous ? &timer->previous->next : &timers->first) = timer->next;
    *(timer->next ? &timer->next->previous : &timers->last) = timer->previous;
}

/* End all deadmen, or all other timers, the oldest first: a pacer before the deferrals that pass messages to it. */
static void end_all(struct timers *timers, bool are_deadmen, int64_t now) {
    for (struct timer *each = timers->last, *next; each && !timers->is_abandoned; each = next) {
        next = each->previous; /* `end` may remove it from the list */
        if ((each->kind->adopt == NULL) == are_deadmen) each->kind->end(timers, each, now);
    }
}

/* ---- public ---- */

void timers_serve(struct timers *timers, int64_t now) {
    pthread_mutex_lock(&timers->lock);
    for (struct timer *each = timers->first; each; each = timers->is_abandoned ? NULL : each->next)
        if (each->due <= now) each->kind->serve(timers, each, now);
    if (!timers->is_abandoned) timers_await_next(timers);
    pthread_mutex_unlock(&timers->lock);
}

void timers_change(struct timers *timers, const struct timer_change *change) {
    pthread_mutex_lock(&timers->lock);
    int64_t now = timers->env->now(timers->env);
    for (uint32_t index = 0; index < change->ended_count && !timers->is_abandoned; index++) {
        struct timer *timer = change->ended[index];
        timer->kind->end(timers, timer, now);
    }
    for (uint32_t index = 0; index < change->adopted_count && !timers->is_abandoned; index++) {
        const struct adoption *adoption = &change->adopted[index];
        adoption->timer->kind->adopt(timers, adoption->timer, adoption->to, adoption->target);
    }
    pthread_mutex_unlock(&timers->lock);
}

void timer_end(struct timers *timers, struct timer *timer) {
    timers_change(timers, &(struct timer_change){.ended = &timer, .ended_count = 1});
}

void timers_end(struct timers *timers) {
    pthread_mutex_lock(&timers->lock);
    int64_t now = timers->env->now(timers->env);
    end_all(timers, false, now);
    end_all(timers, true, now);
    pthread_mutex_unlock(&timers->lock);
}
