/* The thread that publishes datagrams on topics: it takes messages from a ring, and delivers them (deliver.h).
 *
 * A publisher may block in the middleware: then all topics of the thread wait, and the ring drops its oldest messages.
 * Nothing else waits. The thread holds its lock while it handles a message, never while it publishes or waits. */
#ifndef PUBLISH_H
#define PUBLISH_H

#include <stdbool.h>
#include <stdint.h>

#include "program.h"
#include "rcl_types.h"

struct publish_thread;

struct publish_change;

/* Start a thread that delivers the messages for topics in `ring`. It counts in `counters` and writes losses to `events`.
 * `first` is a change whose messages already wait in the ring, or NULL. Returns NULL if memory, descriptors or threads run
 * out. */
struct publish_thread *publish_open(struct ring *ring, counter *counters, struct ring *events, publish_function *publish,
                                    error_function *error, reset_function *reset, struct publish_change *first);

/* A generation's changes to the timers of the thread. Belongs to the caller until the thread has reached the generation. */
struct publish_change {
    struct timer_change timers;
    struct publish_change *next; /* in the list of changes that the thread has not reached */
    uint32_t generation, reserved;
};

/* Make a change when the thread reaches the generation. Call it before the first message of that generation. */
void publish_change(struct publish_thread *thread, struct publish_change *change);

/* Go on to a generation once all messages in the ring are handled. Add no more messages of earlier generations. */
void publish_advance(struct publish_thread *thread, uint32_t generation);

/* Whether the thread no longer uses anything of earlier generations. */
bool publish_has_reached(struct publish_thread *thread, uint32_t generation);

/* The id of the topic on which the thread is publishing now, and since when (monotonic); 0 if there is none. */
int64_t publish_since(struct publish_thread *thread, uint32_t *topic);

/* Handle waiting messages, settle the timers, and end the thread. Returns false after 1 s if it is stuck in the middleware.
 * It then keeps using that publisher, but nothing else of the caller's, and ends later. */
bool publish_stop(struct publish_thread *thread);

/* Copy the first counters as in `counters_copy`. */
bool publish_counters(struct publish_thread *thread, int64_t *to, uint32_t count);

#endif
