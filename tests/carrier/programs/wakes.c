/* A reader that sleeps between any two records or requests, which come at all moments of its falling asleep. Fails if one
 * does not wake it. The arguments are how often each of the others wakes it, and which of them there are: 1 for the one
 * that writes, 2 for the one that wakes by request, 3 for both. Alone, each is on its own if the other's wake is lost. */
#include <pthread.h>
#include <stdio.h>
#include <stdlib.h>

#include "check.h"
#include "clock.h"
#include "ring.h"

static struct ring *ring;
static uint64_t count;
static _Atomic uint64_t asked, answered, has_taken;
static _Atomic bool has_ended;

static const int64_t PATIENCE_NS = 20000000000;

static void await(_Atomic uint64_t *reached, uint64_t value, const char *what) {
    int64_t until = monotonic_ns() + PATIENCE_NS;
    for (unsigned turn = 0; atomic_load_explicit(reached, memory_order_relaxed) < value; turn++)
        if (turn % 4096 == 4095) check(monotonic_ns() < until, what);
}

/* Spin for some time, about as long as the other side needs: both come to their critical moments in any order. */
static void wander(unsigned *random) {
    for (volatile int left = rand_r(random) % 500; left; left--) {}
}

static void *write_all(void *unused) {
    unsigned random = 1;
    for (uint64_t number = 1; number <= count; number++) {
        uint64_t record[2] = {sizeof record, number};
        wander(&random);
        check(ring_put(ring, record, sizeof record), "there is room");
        await(&has_taken, number, "a record wakes the reader");
    }
    return unused;
}

static void *request_all(void *unused) {
    unsigned random = 2;
    for (uint64_t number = 1; number <= count; number++) {
        wander(&random);
        atomic_store(&asked, number);
        ring_wake(ring);
        await(&answered, number, "a request wakes the reader");
    }
    return unused;
}

static void *read_all(void *unused) {
    uint64_t records[64];
    unsigned random = 3;
    while (!atomic_load(&has_ended)) {
        wander(&random);
        size_t size = ring_take(ring, records, sizeof records, -1);
        if (size) atomic_store(&has_taken, records[size / 8 - 1]);
        atomic_store(&answered, atomic_load(&asked));
    }
    return unused;
}

int main(int arguments, char **values) {
    check(arguments == 3, "two arguments");
    count = strtoull(values[1], NULL, 10);
    int which = atoi(values[2]);
    ring = ring_open(1 << 10);
    pthread_t reader, writer, waker;
    pthread_create(&reader, NULL, read_all, NULL);
    if (which & 1) pthread_create(&writer, NULL, write_all, NULL);
    if (which & 2) pthread_create(&waker, NULL, request_all, NULL);
    if (which & 1) pthread_join(writer, NULL);
    if (which & 2) pthread_join(waker, NULL);
    atomic_store(&has_ended, true);
    ring_wake(ring);
    pthread_join(reader, NULL);
    ring_close(ring);
    return 0;
}
