#include "state.h"

#include <stdlib.h>

/* Messages are kept in turn in two places, so readers never wait for a writer, which may have a lower priority: the place of
 * message number `count` is not written before message `count + 1` is complete. */
struct state {
    struct timer timer; /* first */
    _Atomic int64_t initial, valid_for;
    _Atomic uint64_t count; /* of messages that set it */
    struct {
        _Atomic int64_t value, at;
    } set[2];
    /* For the holder of the lock: */
    struct state_settings settings;
    int64_t announced; /* the value that was reported last */
};

/* ---- reading ---- */

static int64_t relaxed(const _Atomic int64_t *from) { return atomic_load_explicit(from, memory_order_relaxed); }

/* The number of messages that set the state, and the last one. */
static uint64_t last_set(const struct state *state, int64_t *value, int64_t *at) {
    for (;;) {
        uint64_t count = atomic_load_explicit(&state->count, memory_order_acquire);
        *value = relaxed(&state->set[count % 2].value);
        *at = relaxed(&state->set[count % 2].at);
        atomic_thread_fence(memory_order_acquire);
        if (atomic_load_explicit(&state->count, memory_order_relaxed) == count) return count;
    }
}

/* The last time at which a value that was set at `at` is valid. */
static int64_t valid_until(const struct state *state, int64_t at) {
    int64_t until;
    return __builtin_add_overflow(at, relaxed(&state->valid_for), &until) ? NEVER : until;
}

int64_t state_value(const struct state *state, int64_t now) {
    int64_t value, at;
    uint64_t count = last_set(state, &value, &at);
    return count && now <= valid_until(state, at) ? value : relaxed(&state->initial);
}

/* ---- with the lock held ---- */

/* Report the value if it has changed. `source` has set it; NO_NAME if none has. */
static void announce(struct timers *timers, struct state *state, int64_t now, uint32_t source) {
    struct thread_env *env = timers->env;
    struct state_event event = {.kind = EVENT_STATE, .state = state->settings.id, .source = source,
                                .before = state->announced, .after = state_value(state, now)};
    counter_set(env->counters, state->settings.value, event.after);
    if (event.after == event.before) return;
    state->announced = event.after;
    env_count(env, state->settings.changes, 1);
    if (may_report(&env->reporter, now)) put_event(env->reporter.events, &event, sizeof event, "");
}

/* Determine when the value expires. */
static void await_expiry(struct timers *timers, struct state *state) {
    int64_t value, at, due = NEVER;
    if (last_set(state, &value, &at)) due = valid_until(state, at);
    timer_set_due(timers, &state->timer, due == NEVER ? NEVER : due + 1);
}

/* ---- the timer ---- */

static void serve(struct timers *timers, struct timer *timer, int64_t now) {
    timer_set_due(timers, timer, NEVER);
    announce(timers, (struct state *)timer, now, NO_NAME);
}

static void adopt(struct timers *timers, struct timer *timer, const struct targets *to, const struct target *target) {
    (void)to, (void)target; /* it holds no messages */
    timers_add(timers, timer);
}

static void end(struct timers *timers, struct timer *timer, int64_t now) {
    (void)now;
    timer_set_due(timers, timer, NEVER);
    timers_remove(timers, timer);
}

static const struct timer_kind STATE = {.serve = serve, .adopt = adopt, .end = end};

/* ---- public ---- */

static void adopt_settings(struct timers *timers, const struct state_settings *settings) {
    struct state *state = settings->state;
    bool is_first = !state->settings.state;
    state->settings = *settings;
    atomic_store_explicit(&state->initial, settings->initial, memory_order_relaxed);
    atomic_store_explicit(&state->valid_for, settings->valid_for, memory_order_relaxed);
    if (is_first) state->announced = settings->initial;
    announce(timers, state, timers->env->now(timers->env), NO_NAME);
    await_expiry(timers, state);
}

void states_adopt(struct timers *timers, const struct state_settings *settings, uint32_t count) {
    pthread_mutex_lock(&timers->lock);
    for (uint32_t index = 0; index < count; index++) adopt_settings(timers, &settings[index]);
    pthread_mutex_unlock(&timers->lock);
}

void state_set(struct timers *timers, const struct setter *setter, int64_t value, int64_t at) {
    struct state *state = setter->state;
    pthread_mutex_lock(&timers->lock);
    uint64_t count = atomic_load_explicit(&state->count, memory_order_relaxed) + 1;
    atomic_thread_fence(memory_order_release);
    atomic_store_explicit(&state->set[count % 2].value, value, memory_order_relaxed);
    atomic_store_explicit(&state->set[count % 2].at, at, memory_order_relaxed);
    atomic_store_explicit(&state->count, count, memory_order_release);
    counter_set(timers->env->counters, setter->age, at);
    announce(timers, state, timers->env->now(timers->env), setter->source);
    await_expiry(timers, state);
    pthread_mutex_unlock(&timers->lock);
}

struct state *state_open(void) {
    struct state *state = calloc(1, sizeof *state);
    if (state) state->timer = (struct timer){.kind = &STATE, .due = NEVER};
    return state;
}

void state_close(struct state *state) { free(state); }
