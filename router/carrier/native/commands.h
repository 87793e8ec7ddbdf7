/* A thread that takes messages from ROS, most of them commands, and sends them to boards and others.
 *
 * It takes serialized messages, makes datagrams of them (convert.h), and checks, feeds and sends as for commands from
 * UDP. Neither the interpreter nor a publisher can hold it up, and it holds its lock while it serves a message, never
 * while it is in the middleware: so whoever waits for that lock waits for one message at most. */
#ifndef COMMANDS_H
#define COMMANDS_H

#include <stdbool.h>
#include <stdint.h>

#include "carrier.h"
#include "convert.h"
#include "rcl_types.h"

struct command_target {
    struct destination destination;
    const struct write_op *writes;
    const uint8_t *literals;
    uint32_t write_count;
    uint32_t mapping_error; /* counter */
};

struct command_route {
    int64_t ttl; /* ns, 0 for none */
    const struct read_op *reads;
    const struct command_target *targets;
    uint32_t read_count, target_count;
    uint32_t id; /* in events */
    /* Slots of the message's stamp; NO_SLOT for none: */
    uint16_t seconds, nanoseconds;
    uint32_t received, last_message, duration; /* counters; the last one is a histogram */
    uint32_t reserved;
};

struct command_topic {
    const void *subscription; /* rcl_subscription_t */
    const struct command_route *routes;
    uint32_t route_count;
    uint32_t capacity; /* messages that the subscription holds */
    int32_t eventfd;   /* the middleware adds to it when messages come; nobody reads it */
    uint32_t reserved;
};

/* What the thread serves. Belongs to the caller, with all that it refers to. */
struct command_set {
    const struct command_topic *topics;
    uint32_t count, reserved;
};


struct commands;

/* Open a thread that serves nothing yet. It counts in `counters`, and losses go to `events`. Messages that are urgent have
 * a thread of their own, which runs first. NULL for lack of memory, descriptors or threads. */
struct commands *commands_open(struct deadmen *deadmen, counter *counters, struct ring *events, take_function *take,
                               reset_function *reset, bool is_urgent);

/* Have the thread wait for an eventfd as well, before it is in a set. Return 0, or an errno. */
int commands_watch(struct commands *commands, int eventfd);
void commands_unwatch(struct commands *commands, int eventfd);

/* Serve this set from the next message on, also what has arrived on its subscriptions, after what has arrived on those
 * that are left. Returns when the earlier set is not used any more. Returns false, with nothing changed, after 1 s: the
 * thread is stuck in the middleware. */
bool commands_serve(struct commands *commands, const struct command_set *set);

/* Serve what has arrived, and end the thread. Returns false after 1 s: the thread is stuck in the middleware, and left
 * there with a subscription. Should it return, it ends; it uses nothing else of the caller's. */
bool commands_stop(struct commands *commands);

/* How often the middleware refused to hand out a message. */
uint64_t commands_failures(struct commands *commands);

/* Copy the first counters as in `counters_copy`. */
bool commands_counters(struct commands *commands, int64_t *to, uint32_t count);

#endif
