/* Deadmen of gateway clients: they publish on topics, which may block, so they are a group of their own, with a thread.
 *
 * The thread decides about one deadman under the lock, and then publishes without it. Feeding a deadman, a reload and the
 * stop never wait for the middleware. A deadman that falls due while a publisher blocks is decided about afterwards. */
#ifndef CLIENT_DEADMEN_H
#define CLIENT_DEADMEN_H

#include <stdbool.h>
#include <stdint.h>

#include "counters.h"
#include "rcl_types.h"
#include "ring.h"
#include "timers.h"

struct client_deadmen;

/* Open the group, for as long as the process lives: a thread of a gateway that is stuck in the middleware may still feed a
 * deadman when the router has ended. It counts in `counters` and writes to `events`. NULL for lack of memory or descriptors.
 */
struct client_deadmen *client_deadmen_open(counter *counters, struct ring *events);

/* The group, of deadmen with a publisher each. They are served once the thread was started. */
struct timers *client_deadmen_group(struct client_deadmen *of);

/* Start the thread. Return 0, or an errno. */
int client_deadmen_start(struct client_deadmen *of, publish_function *publish, error_function *error,
                         reset_function *reset);

/* A reload has changed the deadmen and their publishers. Nothing of earlier generations is in use when this one is reached. */
void client_deadmen_advance(struct client_deadmen *of, uint32_t generation);
bool client_deadmen_have_reached(struct client_deadmen *of, uint32_t generation);

/* The topic in whose publisher the thread is now, by its id, and since when (monotonic); 0 if in none. */
int64_t client_deadmen_since(struct client_deadmen *of, uint32_t *topic);

/* Have armed deadmen publish a last time, and end the thread, if it was started. Returns false after 1 s: it is stuck in
 * the middleware, and abandoned there with a publisher. If it returns, it ends, and uses nothing else of the caller's. */
bool client_deadmen_stop(struct client_deadmen *of);

#endif
