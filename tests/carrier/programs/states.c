/* A thread that sets a state while others read it. Messages with even values arrived too long ago to count. Fails if a reader
 * gets the value of one message with the time of another one; sanitizers see the rest. The argument is how often it is set. */
#include <pthread.h>
#include <stdlib.h>

#include "check.h"
#include "state_value.h"

enum { VALUE, CHANGES, AGE, COUNTERS, INITIAL = -1, NOW = 1000, READERS = 2 };

static counter counters[COUNTERS];
static struct state *state;
static _Atomic bool is_done;
static _Atomic int64_t valid, initial;

static void *read_on(void *unused) {
    (void)unused;
    while (!is_done) {
        int64_t value = state_value(state, NOW);
        check(value == INITIAL || value % 2 == 1, "a value with the time of another message");
        atomic_fetch_add(value == INITIAL ? &initial : &valid, 1);
    }
    return NULL;
}

int main(int count, char **arguments) {
    long times = count > 1 ? atol(arguments[1]) : 1000;
    struct ring *events = ring_open(1 << 16);
    struct timers *timers = timers_open(counters, events);
    state = state_open();
    check(events && timers && state, "open");
    struct state_settings settings = {.state = state, .initial = INITIAL, .valid_for = 100, .value = VALUE, .changes = CHANGES};
    struct setter setter = {.state = state, .age = AGE};
    states_adopt(timers, &settings, 1);
    pthread_t readers[READERS];
    for (int index = 0; index < READERS; index++) check(!pthread_create(&readers[index], NULL, read_on, NULL), "thread");
    for (long value = 1; value <= times || !valid || !initial; value++) state_set(timers, &setter, value, value % 2 ? NOW : 0);
    is_done = true;
    for (int index = 0; index < READERS; index++) pthread_join(readers[index], NULL);
    state_close(state);
    timers_close(timers);
    ring_close(events);
    return 0;
}
