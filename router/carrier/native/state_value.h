/* The object of a state and how any thread reads its value: inline, so that routines need nothing else of states. */
#ifndef STATE_VALUE_H
#define STATE_VALUE_H

#include <stdatomic.h>
#include <string.h>

#include "state.h"

/* Messages are kept in turn in two places, so readers never wait for a writer, which may have a lower priority: the place of
 * message number `count` is not written before message `count + 1` is complete. A text is read like a number, word by word:
 * all its words are those of one message. */
struct state {
    struct timer timer; /* first */
    _Atomic uint64_t count; /* of messages that set it */
    struct {
        _Atomic int64_t number, at;
        _Atomic uint64_t text[STATE_WORDS];
    } set[2];
    /* For the holder of the lock: */
    struct state_settings settings;
    struct state_content announced; /* the value that was reported last */
};

/* The number of messages that set the state, and the value and time of the last one. `words`: how much of its text. */
static inline uint64_t state_last_set(const struct state *state, uint32_t words, struct state_content *value, int64_t *at) {
    for (;;) {
        uint64_t count = atomic_load_explicit(&state->count, memory_order_acquire);
        value->number = atomic_load_explicit(&state->set[count % 2].number, memory_order_relaxed);
        *at = atomic_load_explicit(&state->set[count % 2].at, memory_order_relaxed);
        for (uint32_t index = 0; index < words; index++) {
            uint64_t word = atomic_load_explicit(&state->set[count % 2].text[index], memory_order_relaxed);
            memcpy(value->text + index * sizeof word, &word, sizeof word);
        }
        atomic_thread_fence(memory_order_acquire);
        if (atomic_load_explicit(&state->count, memory_order_relaxed) == count) return count;
    }
}

/* The last time at which a value that was set at `at` is valid. */
static inline int64_t state_valid_until(const struct state_settings *settings, int64_t at) {
    int64_t until;
    return __builtin_add_overflow(at, settings->valid_for, &until) ? NEVER : until;
}

/* Whether the last message is valid at `now` (boot clock). If so, `value` is its value, with `words` of its text. */
static inline bool state_is_set(const struct state_settings *settings, int64_t now, uint32_t words, struct state_content *value) {
    int64_t at;
    uint64_t count = state_last_set(settings->state, words, value, &at);
    return count && now <= state_valid_until(settings, at);
}

/* The number at `now` (boot clock): of the last message that set it, or the initial one without a valid message. */
static inline int64_t state_number(const struct state_settings *settings, int64_t now) {
    struct state_content value;
    return state_is_set(settings, now, 0, &value) ? value.number : settings->initial.number;
}

/* The value likewise, of either kind. */
static inline void state_value(const struct state_settings *settings, int64_t now, struct state_content *value) {
    if (!state_is_set(settings, now, settings->is_text ? STATE_WORDS : 0, value)) *value = settings->initial;
    else if (!settings->is_text) memset(value->text, 0, sizeof value->text);
}

#endif
