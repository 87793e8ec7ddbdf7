/* Threads that offer messages to deferrals and pacers, one that serves them, and programs that keep, change and drop them
 * meanwhile. Fails if a message is lost without being counted, or leaves twice; sanitizers see the rest. The argument is
 * how many messages each thread offers. */
#include <poll.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#include "check.h"
#include "clock.h"
#include "defer.h"

enum { OFFERING = 3, TARGETS = 4, COUNTERS = 2 + DROP_REASONS, LONGEST = 3000, BANDWIDTH = 2000000 };
enum { DELIVERED, BYTES, FIRST_DROP };

/* Targets of one program: of each, its deferral, which it may have in common with the program before. */
struct program {
    struct targets to;
    struct target targets[TARGETS];
    struct deferral *deferrals[TARGETS];
    struct program *earlier;
    uint32_t generation;
};

static struct thread_env sending;
static struct timers *timers;
static struct pacer *pacer;
static counter counters[COUNTERS];
static _Atomic(struct program *) current;
static _Atomic uint32_t seen[OFFERING];
static _Atomic bool is_done;
static _Atomic int64_t offered, refused;
static long messages;
static uint8_t *left; /* how often each message has left, by thread and number */

/* Under the lock of the timers. Some fail. */
static int note_sent(struct thread_env *env, const struct target *target, const uint8_t *data, size_t size, int64_t expires) {
    uint32_t number;
    (void)target;
    if (env->now(env) > expires) return COMMAND_STALE;
    check(size >= sizeof number, "a message is whole");
    memcpy(&number, data, sizeof number);
    check(!left[number]++, "no message leaves twice");
    if (number % 100) return 0;
    atomic_fetch_add(&refused, 1);
    return 5;
}

/* The next program: it keeps most deferrals, some with another rate, and opens the others. */
static struct program *open_program(struct program *earlier, unsigned *random) {
    struct program *made = calloc(1, sizeof *made);
    check(made, "memory");
    made->earlier = earlier;
    made->generation = earlier ? earlier->generation + 1 : 1;
    made->to = (struct targets){.targets = made->targets, .count = TARGETS};
    for (uint32_t index = 0; index < TARGETS; index++) {
        struct target *target = &made->targets[index];
        bool keeps = earlier && rand_r(random) % 4;
        *target = (struct target){.delivered = DELIVERED, .delivered_bytes = BYTES, .priority = index % PRIORITIES};
        target->period = index % 2 ? 1000 * (1 + rand_r(random) % 100) : 0;
        if (keeps && rand_r(random) % 2) target->period = earlier->targets[index].period;
        for (uint32_t reason = 0; reason < DROP_REASONS; reason++) target->dropped[reason] = FIRST_DROP + reason;
        made->deferrals[index] = keeps ? earlier->deferrals[index] : deferral_open(index == 3 ? NULL : pacer);
        check(made->deferrals[index], "memory");
    }
    return made;
}

static void adopt(struct program *next) {
    struct adoption adopted[TARGETS + 1] = {{(struct timer *)pacer, NULL, NULL}};
    struct timer *ended[TARGETS];
    struct timer_change change = {adopted, ended, TARGETS + 1, 0};
    for (uint32_t index = 0; index < TARGETS; index++) {
        adopted[1 + index] = (struct adoption){(struct timer *)next->deferrals[index], &next->to, &next->targets[index]};
        if (next->earlier && next->earlier->deferrals[index] != next->deferrals[index])
            ended[change.ended_count++] = (struct timer *)next->earlier->deferrals[index];
    }
    timers_change(timers, &change);
    atomic_store(&current, next);
}

/* Once no thread uses the earlier program: all but what the next one has of it. */
static void close_earlier(struct program *next) {
    struct program *earlier = next->earlier;
    for (int thread = 0; thread < OFFERING; thread++)
        while (atomic_load(&seen[thread]) < next->generation && !atomic_load(&is_done)) usleep(100);
    for (uint32_t index = 0; index < TARGETS; index++)
        if (earlier->deferrals[index] != next->deferrals[index])
            deferral_close(earlier->deferrals[index]);
    free(earlier);
    next->earlier = NULL;
}

static void *reload(void *unused) {
    unsigned random = 7;
    while (!atomic_load(&is_done)) {
        struct program *next = open_program(atomic_load(&current), &random);
        adopt(next);
        close_earlier(next);
        usleep(500);
    }
    return unused;
}

static void *wait_for_timer(void *unused) {
    while (!atomic_load(&is_done)) {
        struct pollfd waiting = {timers->timer, POLLIN, 0};
        if (poll(&waiting, 1, 5) > 0) timers_serve(timers, boottime_ns());
    }
    return unused;
}

/* Datagrams, and messages that a machine has written. */
static void *offer(void *which) {
    uint32_t thread = (uint32_t)(uintptr_t)which;
    unsigned random = thread + 1;
    struct thread_env env;
    static counter unused[OFFERING];
    check(env_open(&env, unused, NULL, timers), "memory");
    env.timers = timers;
    for (uint32_t number = 0; number < messages; number++) {
        const struct program *program = atomic_load(&current);
        uint32_t id = thread * (uint32_t)messages + number, index = (uint32_t)rand_r(&random) % TARGETS;
        uint8_t datagram[LONGEST] = {0};
        size_t size = sizeof id + (size_t)rand_r(&random) % (LONGEST - sizeof id);
        int64_t now = boottime_ns(), expires = rand_r(&random) % 3 ? NEVER : now + rand_r(&random) % 3000000;
        memcpy(datagram, &id, sizeof id);
        const uint8_t *data = datagram;
        if (rand_r(&random) % 2) {
            env.machine.output.size = 0;
            check(append(&env.machine.output, datagram, size), "memory");
            data = env.machine.output.data;
        }
        check(defer(&env, program->deferrals[index], data, size, expires, now), "nobody is left");
        atomic_fetch_add(&offered, 1);
        atomic_store(&seen[thread], program->generation);
        if (number % 16 == 0) usleep(100);
    }
    atomic_store(&seen[thread], UINT32_MAX);
    env_close(&env);
    return NULL;
}

int main(int count, char **arguments) {
    check(count == 2, "one argument");
    messages = atol(arguments[1]);
    left = calloc(OFFERING * (size_t)messages, 1);
    struct ring *events = ring_open(1 << 12);
    check(env_open(&sending, counters, events, NULL), "memory");
    sending.send = note_sent;
    timers = timers_open_on(&sending, true);
    sending.timers = timers;
    pacer = pacer_open(BANDWIDTH);
    unsigned random = 1;
    adopt(open_program(NULL, &random));
    pthread_t others[2], threads[OFFERING];
    pthread_create(&others[0], NULL, wait_for_timer, NULL);
    pthread_create(&others[1], NULL, reload, NULL);
    for (uintptr_t thread = 0; thread < OFFERING; thread++) pthread_create(&threads[thread], NULL, offer, (void *)thread);
    for (int thread = 0; thread < OFFERING; thread++) pthread_join(threads[thread], NULL);
    atomic_store(&is_done, true);
    for (int index = 0; index < 2; index++) pthread_join(others[index], NULL);
    timers_end(timers);
    check(!timers->first, "nothing waits at the end");
    int64_t dropped = 0;
    for (int reason = 0; reason < DROP_REASONS; reason++) dropped += counters[FIRST_DROP + reason];
    check(counters[DELIVERED] + dropped == offered, "each message is counted once");
    check(counters[FIRST_DROP + DROP_SEND_ERROR] == refused, "what is refused is counted so");
    check(counters[FIRST_DROP + DROP_RATE_LIMITED] && counters[FIRST_DROP + DROP_STALE], "messages are held");
    printf("offered %lld, delivered %lld, %u programs\n", (long long)offered, (long long)counters[DELIVERED],
           atomic_load(&current)->generation);
    struct program *last = atomic_load(&current);
    for (uint32_t index = 0; index < TARGETS; index++) deferral_close(last->deferrals[index]);
    free(last);
    pacer_close(pacer);
    timers_close(timers);
    env_close(&sending);
    ring_close(events);
    free(left);
    return 0;
}
