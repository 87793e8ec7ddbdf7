/* `state`: named values that messages set and conditions read. The object lasts across reloads, as long as name and type of
 * the state stay the same; its settings are those of the running program.
 *
 * Any thread reads a value without waiting. All changes are made under the lock of the group of timers: a state is one of
 * its timers, due when its value expires. The environment of the group counts and reports changes. */
#ifndef STATE_H
#define STATE_H

#include <stdint.h>

#include "deliver.h"
#include "timers.h"

struct state;

/* A state as a program declares it. */
struct state_settings {
    struct state *state;
    struct state_content initial;
    int64_t valid_for; /* ns, or NEVER if the value does not expire */
    uint32_t id;       /* in events */
    uint32_t is_text;
    uint32_t value, changes; /* counters; a text has no `value` */
};

/* The messages of a route from one sender, or of a topic, that set a state. */
struct setter {
    struct state *state;
    /* What reads the fields. Its only target stands for the state: `message` computes the value, and losses are counted there. */
    struct targets to;
    uint32_t column; /* of the sender; not for a topic */
    uint32_t source; /* the name of the sender or topic, in events */
    uint32_t age;    /* counter: boot clock */
    uint32_t is_text;
};

/* Open a state that was never set. Its first member is a struct timer. Returns NULL if memory runs out. */
struct state *state_open(void);
void state_close(struct state *state);

/* Adopt the settings of a program. Takes the lock. */
void states_adopt(struct timers *timers, const struct state_settings *settings, uint32_t count);

/* Set the state to a value, that of a message of `at` (boot clock). Takes the lock. */
void state_set(struct timers *timers, const struct setter *setter, const struct state_content *value, int64_t at);

/* Do so with the message that the environment's machine has read; `is_read`: without an error. If it has no value, count and
 * report that instead. */
void set_state(struct thread_env *env, const struct setter *setter, bool is_read, int64_t at, int64_t now);

/* Copy the value at `now` (boot clock). Any thread may call it while it has the program of these settings. */
void state_read(const struct state_settings *settings, int64_t now, struct state_content *value);

#endif
