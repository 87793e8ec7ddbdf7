/* Sends the requests of services, for one Python thread at a time.
 *
 * A request is a message from ROS that is delivered (deliver.h) to the one target of its route. The caller learns at once
 * whether it left, and gets the bytes as they were sent, with what was filled in them: a request is never held back. */
#ifndef REQUESTS_H
#define REQUESTS_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "route_ros.h"

struct requests;

/* A request that has left, valid until the next call. */
struct sent_request {
    const uint8_t *data;
    size_t size;
};

enum { REQUEST_SENT = -1 };

/* Open an environment that counts in `counters` and writes losses to `events`. Returns NULL if memory runs out. */
struct requests *requests_open(struct timers *timers, counter *counters, struct ring *events);
void requests_close(struct requests *requests);

/* Deliver a request, a message from ROS that was sent at `called_at` (wall clock, ns). Return REQUEST_SENT, or an enum
 * drop_reason. */
int requests_send(struct requests *requests, const struct ros_route *route, const void *data, size_t size,
                  int64_t called_at, struct sent_request *sent);

/* Send a datagram that was sent before, unchanged. Return as above. */
int requests_send_again(struct requests *requests, const struct ros_route *route, const void *data, size_t size);

/* Compare the clocks, see freshness_look. */
void requests_look(struct requests *requests);

/* Copy the first counters as in `counters_copy`. */
bool requests_counters(struct requests *requests, int64_t *to, uint32_t count);

#endif
