/* The stage for rehearsal: a program without threads, sockets, middleware and a clock of its own. Messages are handed in,
 * and the clock is told what time it is; what became of them is written down, in order. It runs the functions that the
 * threads of a router run, each of them at once.
 *
 * Every topic is wanted, and the network and the middleware take everything. */
#ifndef REHEARSAL_H
#define REHEARSAL_H

#include <stddef.h>
#include <stdint.h>

#include "program.h"
#include "route_ros.h"

/* What was written down: events (events.h), and records of these kinds. Each begins with `size` and `kind`. */
enum record_kind { RECORD_TIME = 32, RECORD_COUNTED, RECORD_SENT, RECORD_BRAKED, RECORD_PUBLISHED };

/* What follows was at this time; before the first one, at that of the opening. */
struct time_record {
    uint32_t size, kind;
    int64_t at; /* boot clock */
};

struct counted_record {
    uint32_t size, kind;
    int64_t amount;
    uint32_t counter, reserved;
};

/* What left, by a target or by a deadman; the bytes follow. It is counted afterwards. */
struct left_record {
    uint32_t size, kind;
    uint32_t target, length; /* `target`: as in events */
};

struct rehearsal;

/* Open a stage that counts in `counters`, at this time of the boot clock. NULL for lack of memory or descriptors. */
struct rehearsal *rehearsal_open(counter *counters, int64_t now);
void rehearsal_close(struct rehearsal *rehearsal); /* when it has no timer left */

/* The timers of destinations: deadmen of its programs are opened there. */
struct timers *rehearsal_timers(struct rehearsal *rehearsal);

/* Go on with another program, as at a reload, or with the first one. `published` is what changes for the timers of topics.
 * All belongs to the caller. */
void rehearsal_adopt(struct rehearsal *rehearsal, const struct change *change, const struct timer_change *published,
                     const struct ros_topic *topics);

/* Receive a datagram of a listener, or a message of a topic from ROS, by their indexes in the program. A datagram has
 * `arrived_at`, and a message `sent_at` by the wall clock. */
void rehearsal_datagram(struct rehearsal *rehearsal, uint32_t listener, uint32_t address, uint32_t port, const void *data,
                        size_t size, int64_t arrived_at);
void rehearsal_message(struct rehearsal *rehearsal, uint32_t topic, const void *data, size_t size, int64_t sent_at);

/* Let time pass, and serve what is due until then. It never goes back. */
void rehearsal_advance(struct rehearsal *rehearsal, int64_t to);

/* Set the wall clock, to so many ns ahead of the boot clock: 0 at first. */
void rehearsal_set_clock(struct rehearsal *rehearsal, int64_t ahead);

/* Stop as the router does: what is held leaves, and armed deadmen send last. */
void rehearsal_end(struct rehearsal *rehearsal);

/* Return the records since the last call, valid until the next call of any function, and their size in bytes; NULL for
 * lack of memory. */
const void *rehearsal_records(struct rehearsal *rehearsal, size_t *size);

/* Evaluate a condition on a payload, as `when` of a route is evaluated. `source` is the name of the sender. Return EVALUATED,
 * an enum loss if it has no value for this payload or the payload is malformed, or LOSSES for lack of memory. */
int condition_holds(const struct layout *layout, const struct routine *condition, const struct value *source,
                    int64_t received_at, const void *payload, size_t size, bool *holds);

#endif
