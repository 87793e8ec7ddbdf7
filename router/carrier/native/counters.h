/* Counters: 64-bit integers that one thread writes and any thread may read. */
#ifndef COUNTERS_H
#define COUNTERS_H

#include <stdatomic.h>
#include <stdint.h>

typedef _Atomic int64_t counter;

/* Add to a counter. Each array of counters has one writing thread, or one lock that its writers hold. */
static inline void counter_add(counter *counters, uint32_t index, int64_t amount) {
    int64_t now = atomic_load_explicit(&counters[index], memory_order_relaxed);
    atomic_store_explicit(&counters[index], now + amount, memory_order_relaxed);
}

static inline void counter_set(counter *counters, uint32_t index, int64_t value) {
    atomic_store_explicit(&counters[index], value, memory_order_relaxed);
}

#endif
