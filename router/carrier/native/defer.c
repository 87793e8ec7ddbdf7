#include "defer.h"

#include <stdlib.h>
#include <string.h>

#include "envelope.h"
#include "limit.h"

struct deferral {
    struct timer timer; /* due when a held message may pass */
    struct route_target of;
    struct pacer *pacer;  /* NULL without a bandwidth */
    struct limit limit;   /* for `on_limit: latest`; otherwise its period is 0 */
    struct output held;
    int64_t expires, arrived; /* of the held message */
    bool is_held;
    bool has_ended; /* no longer holds messages */
};

/* All functions but the public ones are called with the lock held. */

static void pass_on(struct timers *timers, struct deferral *deferral, const uint8_t *data, size_t size, int64_t expires,
                    int64_t now) {
    struct route_target *of = &deferral->of;
    bool can_leave = size <= LONGEST_SENT; /* otherwise sending fails, which is counted */
    if (deferral->pacer && !deferral->has_ended && can_leave)
        pacer_queue(timers, deferral->pacer, of, data, size, expires, now);
    else if (!deliver_now(timers->env, of->to, of->target, data, size, expires, now))
        timers->is_abandoned = true;
}

static void exchange(struct output *one, struct output *other) {
    struct output kept = *one;
    *one = *other;
    *other = kept;
}

static void forget(struct timers *timers, struct deferral *deferral) {
    deferral->is_held = false;
    timer_set_due(timers, &deferral->timer, NEVER);
}

/* Keep a message until it may pass. The machine's output is not copied. */
static void hold(struct thread_env *env, struct deferral *deferral, const uint8_t *data, size_t size, int64_t expires,
                 int64_t now) {
    struct output *written = &env->machine.output;
    deferral->held.size = 0;
    if (data == written->data) {
        exchange(&deferral->held, written);
        deferral->held.size = size;
    } else {
        append(&deferral->held, data, size); /* has room: deferral_open */
    }
    deferral->is_held = true;
    deferral->expires = expires;
    deferral->arrived = now;
    timer_set_due(env->timers, &deferral->timer, deferral->limit.next_pass);
}

/* Deliver the held message, unless it has expired or a state no longer lets it pass. */
static void release(struct timers *timers, struct deferral *deferral, int64_t now) {
    if (!deferral->is_held) return;
    forget(timers, deferral);
    if (now > deferral->expires) {
        lose_stale(timers->env, deferral->of.to, deferral->of.target, now, deferral->expires, REFUSED_WAITING);
        return;
    }
    if (!may_leave(timers->env, deferral->of.to, deferral->of.target)) return;
    struct output *held = &deferral->held;
    if (deferral->of.target->topic) { /* which gets the machine's output */
        exchange(held, &timers->env->machine.output);
        held = &timers->env->machine.output;
    }
    timers->arrived = deferral->arrived;
    pass_on(timers, deferral, held->data, held->size, deferral->expires, now);
    timers->arrived = NEVER;
}

static void offer(struct thread_env *env, struct deferral *deferral, const uint8_t *data, size_t size, int64_t expires,
                  int64_t now) {
    if (deferral->is_held) env_count(env->timers->env, deferral->of.target->dropped[DROP_RATE_LIMITED], 1);
    if (limit_passes(&deferral->limit, now)) {
        forget(env->timers, deferral);
        pass_on(env->timers, deferral, data, size, expires, now);
    } else {
        hold(env, deferral, data, size, expires, now);
    }
}

/* ---- the timer ---- */

static void serve(struct timers *timers, struct timer *timer, int64_t now) {
    struct deferral *deferral = (struct deferral *)timer;
    if (now > deferral->expires || limit_passes(&deferral->limit, now)) release(timers, deferral, now);
}

/* If the rate has changed, send the held message now, and restart the limit. */
static void adopt(struct timers *timers, struct timer *timer, const struct targets *to, const struct target *target) {
    struct deferral *deferral = (struct deferral *)timer;
    int64_t period = target->period;
    if (period != deferral->limit.period) {
        release(timers, deferral, timers->env->now(timers->env));
        if (timers->is_abandoned) return;
        deferral->limit = (struct limit){period, period - period / 2, -period};
    }
    deferral->of.to = to;
    deferral->of.target = target;
    timers_add(timers, timer);
}

static void end(struct timers *timers, struct timer *timer, int64_t now) {
    struct deferral *deferral = (struct deferral *)timer;
    release(timers, deferral, now);
    if (timers->is_abandoned) return;
    deferral->has_ended = true;
    if (deferral->pacer) pacer_release(timers, deferral->pacer, &deferral->of, now);
    timers_remove(timers, timer);
}

static const struct timer_kind DEFERRAL = {.serve = serve, .adopt = adopt, .end = end};

/* ---- public ---- */

bool defer(struct thread_env *env, struct deferral *deferral, const uint8_t *data, size_t size, int64_t expires, int64_t now) {
    struct timers *timers = env->timers;
    pthread_mutex_lock(&timers->lock);
    if (deferral->limit.period && !deferral->has_ended) offer(env, deferral, data, size, expires, now);
    else pass_on(timers, deferral, data, size, expires, now);
    bool goes_on = !timers->is_abandoned;
    pthread_mutex_unlock(&timers->lock);
    return goes_on;
}

void deferral_supersede(struct timers *timers, struct deferral *deferral, int64_t now) {
    if (deferral->is_held && deferral->arrived <= timers->arrived) {
        forget(timers, deferral);
        lose_superseded(timers->env, &deferral->of, now);
    }
    if (deferral->of.queued) pacer_supersede(timers, deferral->pacer, &deferral->of, now);
}

struct deferral *deferral_open(struct pacer *pacer) {
    struct deferral *deferral = calloc(1, sizeof *deferral);
    if (!deferral) return NULL;
    deferral->timer = (struct timer){.kind = &DEFERRAL, .due = NEVER};
    deferral->pacer = pacer;
    deferral->held = (struct output){malloc(MAX_DATAGRAM), 0, MAX_DATAGRAM};
    if (deferral->held.data) return deferral;
    free(deferral);
    return NULL;
}

void deferral_close(struct deferral *deferral) {
    free(deferral->held.data);
    free(deferral);
}
