/* A thread that sets a state while others read it. Messages with even values arrived too long ago to count. Fails if a reader
 * gets the value of one message with the time of another one, or a part of its text; sanitizers see the rest. The argument is
 * how often it is set. */
#include <pthread.h>
#include <stdlib.h>

#include "check.h"
#include "state_value.h"

enum { VALUE, CHANGES, AGE, COUNTERS, INITIAL = -1, NOW = 1000, READERS = 2 };

static counter counters[COUNTERS];
static struct state_settings settings = {.initial = {.number = INITIAL}, .valid_for = 100, .value = VALUE, .changes = CHANGES};
static _Atomic bool is_done;
static _Atomic int64_t valid, initial;

/* A text that shows of which message each of its parts is. */
static struct state_content content_of(int64_t value) {
    struct state_content content = {.number = value};
    for (uint32_t at = 0; at < MOST_STATE_TEXT; at += sizeof value) memcpy(content.text + at, &value, sizeof value);
    return content;
}

static void *read_on(void *unused) {
    (void)unused;
    while (!is_done) {
        struct state_content read;
        state_value(&settings, NOW, &read);
        bool is_initial = read.number == INITIAL;
        check(is_initial || read.number % 2 == 1, "a value with the time of another message");
        struct state_content whole = is_initial ? settings.initial : content_of(read.number);
        check(!memcmp(read.text, whole.text, settings.is_text ? MOST_STATE_TEXT : 0), "a text with parts of other messages");
        atomic_fetch_add(is_initial ? &initial : &valid, 1);
    }
    return NULL;
}

static void run(struct timers *timers, long times) {
    struct setter setter = {.state = settings.state = state_open(), .age = AGE, .is_text = settings.is_text};
    check(settings.state, "open");
    states_adopt(timers, &settings, 1);
    is_done = false, valid = initial = 0;
    pthread_t readers[READERS];
    for (int index = 0; index < READERS; index++) check(!pthread_create(&readers[index], NULL, read_on, NULL), "thread");
    for (long number = 1; number <= times || !valid || !initial; number++) {
        struct state_content value = content_of(number);
        state_set(timers, &setter, &value, number % 2 ? NOW : 0);
    }
    is_done = true;
    for (int index = 0; index < READERS; index++) pthread_join(readers[index], NULL);
    state_close(settings.state);
}

int main(int count, char **arguments) {
    long times = count > 1 ? atol(arguments[1]) : 1000;
    struct ring *events = ring_open(1 << 16);
    struct timers *timers = timers_open(counters, events);
    check(events && timers, "open");
    run(timers, times);
    settings.is_text = true;
    run(timers, times);
    timers_close(timers);
    ring_close(events);
    return 0;
}
