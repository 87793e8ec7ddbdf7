/* What a message from ROS comes to: the routes of its topic deliver it, or each element of one of its lists.
 *
 * Threads, middleware and clocks are the caller's: from_ros.c, and rehearsal.c, which has none. */
#ifndef ROUTE_ROS_H
#define ROUTE_ROS_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "deliver.h"
#include "freshness.h"
#include "rcl_types.h"

/* ---- what a table says ---- */

/* `for_each`: each element of a list is served as a message. */
struct for_each {
    struct routine list;   /* leaves the list on the stack; empty without `for_each` */
    uint16_t stored;    /* how, an enum scalar */
    uint16_t section;      /* into which an element is read that is a message, or NONE */
    uint16_t item;      /* slot of any other element */
    uint16_t index, count; /* slots, NONE if nothing uses them */
    uint16_t reserved[3];
};

/* A route, as one of its topics feeds it. */
struct ros_route {
    struct targets targets;
    struct for_each for_each;
    uint16_t seconds, nanoseconds; /* slots of the message's stamp, or NONE */
    uint32_t received, last_message, duration; /* counters; the last one is a histogram */
};

struct ros_topic {
    const void *subscription; /* rcl_subscription_t */
    const struct ros_route *routes;
    uint32_t route_count;
    uint32_t capacity; /* messages that the subscription holds */
    int32_t eventfd;   /* the middleware adds to it when messages come; nobody reads it */
    uint32_t reserved;
};

/* ---- what is served ---- */

enum { MOST_PUBLISHERS = 64 };

/* A publisher numbers its messages, and sends them in order. Of its last one: the number, and the oldest readings of its
 * stamps. */
struct ros_publisher {
    uint8_t gid[GID_SIZE];
    uint32_t topic;        /* as in events: a table may call a topic by two names, and has a subscription for each */
    uint64_t number;       /* 0 if it is not known, */
    int64_t sent, stamped; /* INT64_MIN if these are not */
};

/* What a thread needs that routes messages from ROS. */
struct ros_routing {
    struct stage stage; /* first: what it calls is given this */
    struct freshness freshness;
    struct ros_publisher publishers[MOST_PUBLISHERS];
};

/* A message that was taken. */
struct taken {
    const uint8_t *data;
    size_t size;
    int64_t published_at, arrived_at; /* wall clock of the sender, and of this computer; 0 if it is not known */
    int64_t received_at;              /* wall clock */
    int64_t now;                      /* boot clock */
    struct ros_publisher *publisher;
};

/* Return what is known of a publisher on a topic. One with the same hash is forgotten. */
struct ros_publisher *find_publisher(struct ros_routing *routing, const uint8_t *gid, uint32_t topic);

/* Whether a message comes after the publisher's last one, as far as the middleware numbers them. Where one subscription
 * takes over from another, both receive what comes meanwhile. */
bool is_new(struct ros_publisher *publisher, uint64_t number);

/* Go on from what is known of a publisher elsewhere. */
void follow_publisher(struct ros_routing *routing, const struct ros_publisher *known);

/* Deliver a message of a topic. */
void route_ros_message(struct ros_routing *routing, const struct ros_topic *topic, const struct taken *taken);

/* Deliver it to the targets of one route. */
void route_ros(struct ros_routing *routing, const struct ros_route *route, const struct taken *taken);

#endif
