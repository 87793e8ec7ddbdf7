/* A thread that takes messages from ROS, most of them commands, and executes their routes.
 *
 * It takes serialized messages, and delivers them (deliver.h) as the receive thread delivers datagrams. Neither the
 * interpreter nor a publisher can block it. It holds its lock while it handles a message, never while it is in the
 * middleware, so other threads wait for that lock for one message at most. */
#ifndef FROM_ROS_H
#define FROM_ROS_H

#include <stdbool.h>
#include <stdint.h>

#include "rcl_types.h"
#include "route_ros.h"

/* The topics that the thread serves. Belongs to the caller, with everything that it points to. */
struct ros_set {
    const struct ros_topic *topics;
    uint32_t count, reserved;
};

struct from_ros;

/* Open a thread that serves nothing yet. It counts in `counters` and writes losses to `events`. Urgent messages have their
 * own thread, with priority. Returns NULL if memory, descriptors or threads run out. */
struct from_ros *from_ros_open(struct timers *timers, counter *counters, struct ring *events, take_function *take,
                               reset_function *reset, bool is_urgent);

/* Add an eventfd to the thread's wait, before it is in a set. Return 0, or an errno. */
int from_ros_watch(struct from_ros *thread, int eventfd);
void from_ros_unwatch(struct from_ros *thread, int eventfd);

/* Serve this set from the next message on, including messages that have already arrived. Messages on subscriptions that only
 * the earlier set has are handled first. Returns when the earlier set is no longer used. Returns false
 * with nothing changed after 1 s: the thread is stuck in the middleware. */
bool from_ros_serve(struct from_ros *thread, const struct ros_set *set);

/* Copy the positions of another thread in its subscriptions, so that no message is handled twice. */
void from_ros_follow(struct from_ros *thread, struct from_ros *other);

/* Handle what has arrived, and end the thread. Returns false after 1 s if the thread is stuck in the middleware. It then
 * keeps using that subscription, but nothing else of the caller's, and ends later. */
bool from_ros_stop(struct from_ros *thread);

/* How often the middleware failed to deliver a message. */
uint64_t from_ros_failures(struct from_ros *thread);

/* Copy the first counters as in `counters_copy`. */
bool from_ros_counters(struct from_ros *thread, int64_t *to, uint32_t count);

#endif
