/* The thread that publishes datagrams on topics: it takes messages from a ring, and delivers them (deliver.h).
 *
 * A publisher may block in the middleware: then all topics of the thread wait, and the ring drops its oldest messages.
 * Nothing else waits. The thread holds its lock while it serves a message, never while it publishes or waits. */
#ifndef PUBLISH_H
#define PUBLISH_H

#include <stdbool.h>
#include <stdint.h>

#include "program.h"
#include "rcl_types.h"

struct publish_thread;

struct publish_change;

/* Start a thread that serves what comes into `ring`, which are messages for topics. It counts in `counters`, and losses go
 * to `events`. `first` is a change of which messages wait in the ring already, or NULL. NULL for lack of memory,
 * descriptors or threads. */
struct publish_thread *publish_open(struct ring *ring, counter *counters, struct ring *events, publish_function *publish,
                                    error_function *error, reset_function *reset, struct publish_change *first);

/* What a generation changes in the timers of messages that the thread keeps. Belongs to the caller until it has reached it. */
struct publish_change {
    struct timer_change timers;
    struct publish_change *next; /* of those that the thread has not reached */
    uint32_t generation, reserved;
};

/* Have the thread make a change when it reaches that generation: to be called before a message of it comes. */
void publish_change(struct publish_thread *thread, struct publish_change *change);

/* Have the thread go on to a generation once all that is in the ring is served: nothing of an earlier one comes any more. */
void publish_advance(struct publish_thread *thread, uint32_t generation);

/* Whether the thread uses nothing of earlier generations any more. */
bool publish_has_reached(struct publish_thread *thread, uint32_t generation);

/* The topic in whose publisher the thread is now, by its id, and since when (monotonic); 0 if in none. */
int64_t publish_since(struct publish_thread *thread, uint32_t *topic);

/* Serve what waits, settle what is kept, and end the thread. Returns false after 1 s: it is stuck in the middleware, and
 * abandoned there with a publisher. If it returns, it ends, and uses nothing else of the caller's. */
bool publish_stop(struct publish_thread *thread);

/* Copy the first counters as in `counters_copy`. */
bool publish_counters(struct publish_thread *thread, int64_t *to, uint32_t count);

#endif
