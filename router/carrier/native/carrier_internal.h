#ifndef CARRIER_INTERNAL_H
#define CARRIER_INTERNAL_H

#include <pthread.h>

#include "carrier.h"

struct carrier {
    /* Of the receive thread alone: */
    const struct program *program;
    counter *counters;
    struct ring *events;
    struct deadmen *deadmen;
    struct freshness freshness;
    int64_t window_began; /* of the events that may be reported */
    uint32_t events_left;
    uint32_t mirror_lost; /* counter */
    int epoll;
    /* Shared: */
    edition edition; /* of the counters */
    _Atomic(struct ring *) mirror;
    _Atomic(const struct change *) next, adopted;
    _Atomic bool is_held, is_stopping, is_closing;
    _Atomic uint64_t turns;
    _Atomic int64_t pulse; /* when Python was alive, monotonic */
    /* Of the timer thread: */
    _Atomic int notify; /* a socket, or -1 */
    _Atomic int64_t interval;
    int wake; /* eventfd */
    uint64_t turns_seen;
    pthread_t receiving, timing;
    bool has_started, has_stopped;
    /* A datagram, and the record that is made of it. Last, as they are large. */
    _Alignas(8) uint8_t datagram[MAX_DATAGRAM + 8];
    _Alignas(8) uint8_t record[MAX_DATAGRAM + 256];
};

void *receive_thread(void *carrier);
void *timer_thread(void *carrier);
void carrier_adopt_first(struct carrier *carrier, const struct change *first);

/* Count a duration in ns in the histogram that begins at this counter. */
void count_duration(counter *counters, uint32_t histogram, int64_t elapsed);

#endif
