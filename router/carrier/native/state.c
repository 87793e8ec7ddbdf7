#include "state.h"

#include <stdlib.h>
#include <string.h>

#include "evaluate.h"
#include "state_value.h"

/* ---- with the lock held ---- */

static bool is_same(const struct state_content *one, const struct state_content *other) {
    return one->number == other->number && !memcmp(one->text, other->text, sizeof one->text);
}

/* Report the value if it has changed. `source` has set it; NO_NAME if none has. */
static void announce(struct timers *timers, struct state *state, int64_t now, uint32_t source) {
    struct thread_env *env = timers->env;
    const struct state_settings *settings = &state->settings;
    struct state_event event = {.kind = EVENT_STATE, .state = settings->id, .source = source,
                                .is_text = settings->is_text, .before = state->announced};
    state_value(settings, now, &event.after);
    if (!settings->is_text) counter_set(env->counters, settings->value, event.after.number);
    if (is_same(&event.after, &event.before)) return;
    state->announced = event.after;
    env_count(env, settings->changes, 1);
    if (may_report(&env->reporter, now)) put_event(env->reporter.events, &event, sizeof event, "");
}

/* Determine when the value expires. */
static void await_expiry(struct timers *timers, struct state *state) {
    struct state_content value;
    int64_t at, due = NEVER;
    if (state_last_set(state, 0, &value, &at)) due = state_valid_until(&state->settings, at);
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
    if (is_first) state->announced = settings->initial;
    announce(timers, state, timers->env->now(timers->env), NO_NAME);
    await_expiry(timers, state);
}

void states_adopt(struct timers *timers, const struct state_settings *settings, uint32_t count) {
    pthread_mutex_lock(&timers->lock);
    for (uint32_t index = 0; index < count; index++) adopt_settings(timers, &settings[index]);
    pthread_mutex_unlock(&timers->lock);
}

void state_set(struct timers *timers, const struct setter *setter, const struct state_content *value, int64_t at) {
    struct state *state = setter->state;
    pthread_mutex_lock(&timers->lock);
    uint64_t count = atomic_load_explicit(&state->count, memory_order_relaxed) + 1;
    atomic_thread_fence(memory_order_release);
    atomic_store_explicit(&state->set[count % 2].number, value->number, memory_order_relaxed);
    atomic_store_explicit(&state->set[count % 2].at, at, memory_order_relaxed);
    for (uint32_t index = 0; index < STATE_WORDS; index++) {
        uint64_t word;
        memcpy(&word, value->text + index * sizeof word, sizeof word);
        atomic_store_explicit(&state->set[count % 2].text[index], word, memory_order_relaxed);
    }
    atomic_store_explicit(&state->count, count, memory_order_release);
    counter_set(timers->env->counters, setter->age, at);
    announce(timers, state, timers->env->now(timers->env), setter->source);
    await_expiry(timers, state);
    pthread_mutex_unlock(&timers->lock);
}

void set_state(struct thread_env *env, const struct setter *setter, bool is_read, int64_t at, int64_t now) {
    const struct target *target = setter->to.targets;
    struct lost_event lost = {.reason = DROP_MAPPING_ERROR, .generation = setter->to.generation, .place = PLACE_MESSAGE};
    if (is_read) {
        struct value value;
        uint32_t operation;
        int outcome = evaluate_value(&env->machine, &target->message, &value, &operation);
        if (outcome == EVALUATED) {
            struct state_content content = {.number = setter->is_text ? value.size : value.integer};
            if (setter->is_text && value.size) memcpy(content.text, value.bytes, value.size);
            state_set(env->timers, setter, &content, at);
            return;
        }
        lost.reason = (uint32_t)outcome;
        lost.place = PLACE_OPERATIONS + operation;
    }
    lose_refused(env, &setter->to, target, now, lost);
}

void state_read(const struct state_settings *settings, int64_t now, struct state_content *value) {
    state_value(settings, now, value);
}

struct state *state_open(void) {
    struct state *state = calloc(1, sizeof *state);
    if (state) state->timer = (struct timer){.kind = &STATE, .due = NEVER};
    return state;
}

void state_close(struct state *state) { free(state); }
