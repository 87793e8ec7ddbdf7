/* A thread that publishes what topics get of datagrams: it takes messages from a ring, reads their fields (fields.h),
 * composes what is wanted (compose.h), and has rcl publish it.
 *
 * A publisher may block in the middleware: then all topics of the thread wait, and the ring drops its oldest messages.
 * Nothing else waits. The thread holds its lock while it serves a message, never while it publishes or waits. */
#ifndef PUBLISHING_H
#define PUBLISHING_H

#include <stdbool.h>
#include <stdint.h>

#include "carrier.h"
#include "compose.h"
#include "rcl_types.h"

/* A topic, however many routes publish on it. */
struct publish_topic {
    const void *publisher; /* rcl_publisher_t */
    const uint8_t *wanted; /* not 0 while somebody subscribes */
    uint32_t id;           /* in events, and of the topic that is stuck */
    uint32_t reserved;
};

struct publish_target {
    const struct publish_topic *topic;
    const struct operation *condition; /* NULL for none */
    const struct operation *operations;
    struct limit *limit; /* `max_rate`, or NULL */
    uint32_t condition_count, operation_count;
    /* Counters: */
    uint32_t published, waiting, filtered, stale, rate_limited, mapping_error, non_finite, publish_error;
};

/* The slots of every route begin with these: */
enum { SLOT_RECEIVED_AT, SLOT_SOURCE };
/* And its nodes: */
enum { NODE_PAYLOAD, NODE_ENVELOPE };

struct publish_route {
    int64_t ttl; /* ns, 0 for none */
    const struct node *nodes;
    const struct value *defaults; /* of the slots */
    const struct value *sources;  /* names of senders, by column */
    const uint8_t *literals;
    const struct publish_target *targets;
    uint32_t slot_count, target_count;
    uint32_t id, program; /* in events; `program`: its generation */
};

struct publishing;

/* Open a thread that serves what comes into `ring`, where each message's part has a route to publish. It counts in
 * `counters`, and losses go to `events`. NULL for lack of memory, descriptors or threads. */
struct publishing *publishing_open(struct ring *ring, counter *counters, struct ring *events, publish_function *publish,
                                   error_function *error, reset_function *reset);

/* Have the thread go on to a generation once all that is in the ring is served: nothing of an earlier one comes any more. */
void publishing_advance(struct publishing *publishing, uint32_t generation);

/* Whether the thread uses nothing of earlier generations any more. */
bool publishing_has_reached(struct publishing *publishing, uint32_t generation);

/* Have the thread serve nothing of that generation or a later one until it is called with 0: others serve first what
 * belongs in front. */
void publishing_hold(struct publishing *publishing, uint32_t generation);

/* The topic in whose publisher the thread is now, by its id, and since when (monotonic); 0 if in none. */
int64_t publishing_since(struct publishing *publishing, uint32_t *topic);

/* Serve what waits, and end the thread. Returns false after 1 s: it is stuck in the middleware, and left there with a
 * publisher. Should it return, it ends; it uses nothing else of the caller's. */
bool publishing_stop(struct publishing *publishing);

/* Copy the first counters as in `counters_copy`. */
bool publishing_counters(struct publishing *publishing, int64_t *to, uint32_t count);

#endif
