/* A thread that takes messages from ROS, most of them commands, and sends what routes make of them.
 *
 * It takes serialized messages, and delivers them (deliver.h) as the receive thread delivers datagrams. Neither the
 * interpreter nor a publisher can hold it up. It holds its lock while it serves a message, never while it is in the
 * middleware, so other threads wait for that lock for one message at most. */
#ifndef FROM_ROS_H
#define FROM_ROS_H

#include <stdbool.h>
#include <stdint.h>

#include "rcl_types.h"
#include "route_ros.h"

/* What the thread serves. Belongs to the caller, with all that it refers to. */
struct ros_set {
    const struct ros_topic *topics;
    uint32_t count, reserved;
};

struct from_ros;

/* Open a thread that serves nothing yet. It counts in `counters`, and losses go to `events`. Messages that are urgent have
 * a thread of their own, which runs first. NULL for lack of memory, descriptors or threads. */
struct from_ros *from_ros_open(struct timers *timers, counter *counters, struct ring *events, take_function *take,
                               reset_function *reset, bool is_urgent);

/* Have the thread wait for an eventfd as well, before it is in a set. Return 0, or an errno. */
int from_ros_watch(struct from_ros *thread, int eventfd);
void from_ros_unwatch(struct from_ros *thread, int eventfd);

/* Serve this set from the next message on, also what has arrived on its subscriptions, after what has arrived on those
 * that are left. Returns when the earlier set is not used any more. Returns false, with nothing changed, after 1 s: the
 * thread is stuck in the middleware. */
bool from_ros_serve(struct from_ros *thread, const struct ros_set *set);

/* Go on where another thread has left subscriptions: what it has served is not served again. */
void from_ros_follow(struct from_ros *thread, struct from_ros *other);

/* Serve what has arrived, and end the thread. Returns false after 1 s: the thread is stuck in the middleware, and
 * abandoned there with a subscription. If it returns, it ends, and uses nothing else of the caller's. */
bool from_ros_stop(struct from_ros *thread);

/* How often the middleware refused to hand out a message. */
uint64_t from_ros_failures(struct from_ros *thread);

/* Copy the first counters as in `counters_copy`. */
bool from_ros_counters(struct from_ros *thread, int64_t *to, uint32_t count);

#endif
