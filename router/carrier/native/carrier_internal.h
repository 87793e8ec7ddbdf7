#ifndef CARRIER_INTERNAL_H
#define CARRIER_INTERNAL_H

#include <pthread.h>

#include "carrier.h"
#include "priority.h"
#include "route.h"

struct carrier {
    /* Of the receive thread alone: */
    struct share share;
    int epoll;
    /* Shared: */
    edition edition; /* of the counters */
    _Atomic(struct ring *) mirror;
    _Atomic uint32_t mirror_lost; /* counter */
    _Atomic(const struct change *) next, adopted;
    _Atomic bool is_stopping, is_closing;
    _Atomic uint64_t turns;
    _Atomic int64_t pulse; /* when Python was alive, monotonic */
    /* Of the timer thread: */
    _Atomic int notify; /* a socket, or -1 */
    _Atomic int64_t interval;
    int wake; /* eventfd */
    uint64_t turns_seen;
    pthread_t receiving, timing;
    bool has_started, has_stopped;
    struct routing routing; /* of the receive thread, too; last, as it is large */
};

void *receive_thread(void *carrier);
void *timer_thread(void *carrier);
void carrier_adopt_first(struct carrier *carrier, const struct change *first);

/* Start a thread that gets no signals: those are Python's. Return 0, or an errno. */
int start_thread(pthread_t *thread, const char *name, void *(*run)(void *), void *argument);

/* Open a condition that is waited for by the monotonic clock: until `patience`, the longest wait for a thread that may be
 * stuck in the middleware. */
void condition_open(pthread_cond_t *condition);
struct timespec patience(void);

/* Count a duration in ns in the histogram that begins at this counter. */
void count_duration(counter *counters, uint32_t histogram, int64_t elapsed);

#endif
