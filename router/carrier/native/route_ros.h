/* Routes a message from ROS: each route of its topic delivers it, or each element of one of its lists.
 *
 * The callers provide threads, middleware and clocks: from_ros.c, and simulation.c, which simulates them. */
#ifndef ROUTE_ROS_H
#define ROUTE_ROS_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "each.h"
#include "freshness.h"
#include "rcl_types.h"
#include "state.h"

/* ---- settings of the table ---- */

/* A route, for messages from one of its topics; or a state that they set, which has no targets. */
struct ros_route {
    struct targets targets;
    struct for_each for_each;
    const struct setter *setter; /* NULL for a route */
    uint16_t seconds, nanoseconds; /* slots of the message's stamp, or NONE */
    uint32_t received, last_message, duration; /* counters; the second one has the boot clock, the last one is a histogram */
};

struct ros_topic {
    const void *subscription; /* rcl_subscription_t */
    const struct ros_route *routes;
    uint32_t route_count;
    uint32_t capacity; /* messages that the subscription holds */
    int32_t eventfd;   /* the middleware adds to it when messages arrive; it is never read */
    uint32_t reserved;
};

/* ---- messages ---- */

enum { MOST_PUBLISHERS = 64 };

/* A publisher, which numbers its messages and sends them in order. `number` is that of the last message, `sent` and
 * `stamped` are the oldest readings of its stamps. */
struct ros_publisher {
    uint8_t gid[GID_SIZE];
    uint32_t topic;        /* as in events: a table may use two names for a topic, with a subscription each */
    uint64_t number;       /* 0 if unknown */
    int64_t sent, stamped; /* INT64_MIN if unknown */
};

/* The environment of a thread that routes messages from ROS. */
struct ros_routing {
    struct thread_env env; /* first: its functions get a pointer to it */
    struct freshness freshness;
    struct ros_publisher publishers[MOST_PUBLISHERS];
};

/* A taken message. */
struct taken {
    const uint8_t *data;
    size_t size;
    int64_t published_at, arrived_at; /* wall clock of the sender, and of this computer; 0 if unknown */
    int64_t received_at;              /* wall clock */
    int64_t now;                      /* boot clock */
    struct ros_publisher *publisher;
};

/* Return the state of a publisher on a topic. It replaces another publisher with the same hash. */
struct ros_publisher *find_publisher(struct ros_routing *routing, const uint8_t *gid, uint32_t topic);

/* Whether a message is newer than the publisher's last one, if the middleware numbers messages. When one subscription
 * replaces another, both receive the messages in between. */
bool is_new(struct ros_publisher *publisher, uint64_t number);

/* Copy the state of a publisher from another thread. */
void follow_publisher(struct ros_routing *routing, const struct ros_publisher *known);

/* Deliver a message of a topic. */
void route_ros_message(struct ros_routing *routing, const struct ros_topic *topic, const struct taken *taken);

/* Deliver it to the targets of one route. */
void route_ros(struct ros_routing *routing, const struct ros_route *route, const struct taken *taken);

#endif
