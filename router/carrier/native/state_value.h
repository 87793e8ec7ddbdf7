/* The object of a state and how any thread reads its value: inline, so that routines need nothing else of states. */
#ifndef STATE_VALUE_H
#define STATE_VALUE_H

#include <stdatomic.h>

#include "state.h"

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

static inline int64_t state_relaxed(const _Atomic int64_t *from) { return atomic_load_explicit(from, memory_order_relaxed); }

/* The number of messages that set the state, and the last one. */
static inline uint64_t state_last_set(const struct state *state, int64_t *value, int64_t *at) {
    for (;;) {
        uint64_t count = atomic_load_explicit(&state->count, memory_order_acquire);
        *value = state_relaxed(&state->set[count % 2].value);
        *at = state_relaxed(&state->set[count % 2].at);
        atomic_thread_fence(memory_order_acquire);
        if (atomic_load_explicit(&state->count, memory_order_relaxed) == count) return count;
    }
}

/* The last time at which a value that was set at `at` is valid. */
static inline int64_t state_valid_until(const struct state *state, int64_t at) {
    int64_t until;
    return __builtin_add_overflow(at, state_relaxed(&state->valid_for), &until) ? NEVER : until;
}

/* The value at `now` (boot clock): of the last message that set it, or the initial one without a valid message. */
static inline int64_t state_value(const struct state *state, int64_t now) {
    int64_t value, at;
    uint64_t count = state_last_set(state, &value, &at);
    return count && now <= state_valid_until(state, at) ? value : state_relaxed(&state->initial);
}

#endif
