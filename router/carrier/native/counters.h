/* Counters: 64-bit integers that one thread writes and any thread may read. */
#ifndef COUNTERS_H
#define COUNTERS_H

#include <stdatomic.h>
#include <stdbool.h>
#include <stdint.h>
#include <unistd.h>

typedef _Atomic int64_t counter;

/* Counters of each thread: a fixed number, because their addresses must not change. A table cannot have more. */
enum { MOST_COUNTERS = 1 << 19 };

/* Add to a counter. Each array of counters has one writing thread, or one lock that its writers hold. */
static inline void counter_add(counter *counters, uint32_t index, int64_t amount) {
    int64_t now = atomic_load_explicit(&counters[index], memory_order_relaxed);
    atomic_store_explicit(&counters[index], now + amount, memory_order_relaxed);
}

/* The bounds of histograms, in ns: LATENCY_BOUNDS_NS and STOPPING_BOUNDS_NS in compiler/metrics.py. A cell for longer
 * durations and one for the sum follow. */
enum { HISTOGRAM_BOUNDS = 12 };
static const int64_t LATENCY[HISTOGRAM_BOUNDS] = {10000,   20000,   50000,   100000,  200000,   500000,
                                                  1000000, 2000000, 5000000, 10000000, 20000000, 50000000};
static const int64_t STOPPING[HISTOGRAM_BOUNDS] = {20000000,   50000000,   100000000,  200000000,   500000000,   1000000000,
                                                   2000000000, 3000000000, 5000000000, 10000000000, 20000000000, 30000000000};

/* Count a duration in ns in the histogram that begins at this counter. */
static inline void count_duration(counter *counters, uint32_t histogram, const int64_t *bounds, int64_t elapsed) {
    uint32_t cell = 0;
    while (cell < HISTOGRAM_BOUNDS && elapsed > bounds[cell]) cell++;
    counter_add(counters, histogram + cell, 1);
    counter_add(counters, histogram + HISTOGRAM_BOUNDS + 1, elapsed);
}

static inline void counter_set(counter *counters, uint32_t index, int64_t value) {
    atomic_store_explicit(&counters[index], value, memory_order_relaxed);
}

/* The edition of a thread's counters: odd while the thread handles a message, whose counters must be read together. */
typedef _Atomic uint64_t edition;

static inline void edition_begin(edition *of) {
    atomic_fetch_add_explicit(of, 1, memory_order_relaxed);
    atomic_thread_fence(memory_order_release);
}

static inline void edition_end(edition *of) { atomic_fetch_add_explicit(of, 1, memory_order_release); }

/* Copy counters as they are between two messages, so that they balance. Return false if there was no such moment in
 * many tries: the copy then shows a message that is being handled. */
static inline bool counters_copy(edition *of, counter *counters, int64_t *to, uint32_t count) {
    for (int tries = 1000; tries; tries--) {
        uint64_t before = atomic_load_explicit(of, memory_order_acquire);
        for (uint32_t index = 0; index < count; index++)
            to[index] = atomic_load_explicit(&counters[index], memory_order_relaxed);
        atomic_thread_fence(memory_order_acquire);
        if (before % 2 == 0 && atomic_load_explicit(of, memory_order_relaxed) == before) return true;
        usleep(50); /* the thread may have been interrupted by others */
    }
    return false;
}

/* Join the counters of a thread with the `totals` of others: their sum, or the larger one where `latest` is 1. */
void counters_join(int64_t *totals, const int64_t *counters, const uint8_t *latest, uint32_t count);

#endif
