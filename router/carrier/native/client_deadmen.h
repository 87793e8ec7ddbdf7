/* Deadmen of gateway clients. They have their own group and thread, because they publish on topics, which may block.
 *
 * The thread decides about one deadman under the lock, then publishes without the lock, so feeding a deadman, a reload and
 * the stop never wait for the middleware. A deadman that falls due while a publisher blocks is handled afterwards. */
#ifndef CLIENT_DEADMEN_H
#define CLIENT_DEADMEN_H

#include <stdbool.h>
#include <stdint.h>

#include "counters.h"
#include "rcl_types.h"
#include "ring.h"
#include "timers.h"

struct client_deadmen;

/* Open the group, which is never closed: a gateway thread that is stuck in the middleware may feed a deadman after the
 * router has ended. It counts in `counters` and writes to `events`. Returns NULL if memory or descriptors run out. */
struct client_deadmen *client_deadmen_open(counter *counters, struct ring *events);

/* The group, whose deadmen have a publisher each. They are served once the thread is started. */
struct timers *client_deadmen_group(struct client_deadmen *of);

/* Start the thread. Return 0, or an errno. */
int client_deadmen_start(struct client_deadmen *of, publish_function *publish, error_function *error,
                         reset_function *reset);

/* A reload has changed the deadmen and their publishers. Once the thread reaches this generation, it uses no earlier one. */
void client_deadmen_advance(struct client_deadmen *of, uint32_t generation);
bool client_deadmen_have_reached(struct client_deadmen *of, uint32_t generation);

/* The id of the topic on which the thread is publishing now, and since when (monotonic); 0 if there is none. */
int64_t client_deadmen_since(struct client_deadmen *of, uint32_t *topic);

/* Have armed deadmen publish a last time, and end the thread, if it was started. Returns false after 1 s if the thread is
 * stuck in the middleware. It then keeps using that publisher, but nothing else of the caller's, and ends later. */
bool client_deadmen_stop(struct client_deadmen *of);

#endif
