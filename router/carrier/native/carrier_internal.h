#ifndef CARRIER_INTERNAL_H
#define CARRIER_INTERNAL_H

#include <pthread.h>

#include "carrier.h"
#include "priority.h"

/* Where a thread reports events, and how many it may still write: a flood is counted only. */
struct reporter {
    struct ring *events;
    int64_t window_began;
    uint32_t left;
};

struct carrier {
    /* Of the receive thread alone: */
    const struct program *program;
    counter *counters;
    struct reporter reporter;
    struct deadmen *deadmen;
    struct freshness freshness;
    struct share share;
    int epoll;
    /* Shared: */
    edition edition; /* of the counters */
    _Atomic(struct ring *) mirror;
    _Atomic uint32_t mirror_lost; /* counter */
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

/* Start a thread that gets no signals: those are Python's. Return 0, or an errno. */
int start_thread(pthread_t *thread, const char *name, void *(*run)(void *), void *argument);

/* Open a condition that is waited for by the monotonic clock: until `patience`, the longest wait for a thread that may be
 * stuck in the middleware. */
void condition_open(pthread_cond_t *condition);
struct timespec patience(void);

/* Whether an event may be written, which is then done. */
bool may_report(struct reporter *reporter, int64_t now);

/* Report that a target did not get a message. `counted` is the counter of such losses. */
void report_loss(struct reporter *reporter, int64_t now, uint32_t route, uint32_t target, enum loss reason, int error,
                 uint32_t counted);

/* Report a loss, whose size and kind are filled in here, with a text that says more. */
void report_loss_because(struct reporter *reporter, int64_t now, const struct lost_event *lost, const char *text);

/* Report that `destination_send` has returned an errno. */
void report_send_error(struct reporter *reporter, int64_t now, uint32_t route, const struct destination *to, int error);

/* Count a duration in ns in the histogram that begins at this counter. */
void count_duration(counter *counters, uint32_t histogram, int64_t elapsed);

/* When a message expires for a destination; NEVER without `ttl`. Commands to boards are as old as they can be, anything
 * else is as young. */
static inline int64_t destination_expiry(const struct destination *to, struct born born, int64_t ttl) {
    return ttl ? (to->board ? born.oldest : born.youngest) + ttl : NEVER;
}

/* Check that a message that was received at `now` has not expired (NEVER: it does not), and that `max_rate` lets it
 * pass; else count it, and return false. */
bool destination_may_send(counter *counters, const struct destination *to, int64_t now, int64_t expires);

/* Check that the destination, if it is a board, can take an envelope; else count and report it, and return false. */
bool destination_takes(counter *counters, struct reporter *reporter, int64_t now, uint32_t route,
                       const struct destination *to, const uint8_t *data, size_t size);

/* Send and count a datagram. Return what `command_send` does. */
int destination_send(struct deadmen *deadmen, counter *counters, const struct destination *to, const uint8_t *data,
                     size_t size, int64_t expires);

#endif
