/* Delivers messages to targets. All threads use it: the receive thread and the publish thread for datagrams, others for
 * messages from ROS. The steps, in this order:
 *
 *     wanted      a topic needs a subscriber                          else filtered
 *     condition   `when`                                              else filtered
 *     age         `ttl`                                               else stale
 *     rate        `max_rate`                                          else rate_limited
 *     message     the output of its routine, or the envelope as it was received
 *     board       what the firmware can decode                        else too_large, non_finite, missing_field
 *     defer       `on_limit: latest` and `bandwidth` (defer.h); when it leaves, the condition's states again
 *     send or publish, and feed deadmen
 *
 * Each target counts every message once. Losses are reported, except those by `max_rate`, which the table requests.
 *
 * A thread environment provides the clock, sockets and middleware as functions, so that tests can replace them. */
#ifndef DELIVER_H
#define DELIVER_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "beside.h"
#include "board.h"
#include "counters.h"
#include "deadman.h"
#include "freshness.h"
#include "limit.h"
#include "machine.h"
#include "report.h"
#include "sender.h"

/* ---- settings of the table ---- */

enum wanted {
    NOTHING,       /* no subscriber */
    EVERY_MESSAGE,
    NEWEST_MESSAGE, /* all subscribers are gateways of this router that look only now and then: the newest is published then */
    EVERY_REPLY     /* it is a service: each reply is handed to Python */
};

/* What the subscribers of a topic want. Belongs to the owner of its publisher. */
struct demand {
    uint8_t wanted;     /* enum wanted */
    uint8_t is_due;     /* with NEWEST_MESSAGE: set by a gateway that will look, and cleared once it may */
    uint64_t replaced;  /* messages that newer ones replaced before they were published */
    struct held *held;  /* the newest message; for the publish thread */
};

/* A topic that any number of routes publish on; or a service, which gets replies, and has no publisher. */
struct topic {
    const void *publisher; /* rcl_publisher_t */
    struct demand *demand;
};

static inline uint8_t wanted_of(const struct topic *topic) {
    return __atomic_load_n(&topic->demand->wanted, __ATOMIC_RELAXED);
}

struct target {
    struct routine condition; /* empty: the target gets every message */
    struct routine message;   /* empty: the target gets the envelope as it was received */
    /* By `source_of`, one for each source of the route, or NULL: the limits of `max_rate` with `on_limit: first`, and the
     * deferrals. */
    struct limit *const *limits;
    struct deferral *const *deferrals;
    int64_t period;            /* of `on_limit: latest`, ns; 0 without */
    const struct topic *topic; /* NULL for a destination, which has: */
    struct sender *sender;
    const struct board *board; /* NULL if it is not a board */
    const struct feed *feeds;  /* the deadmen that a command feeds or disarms */
    uint32_t feed_count;
    uint32_t is_ordered; /* 1: its messages are sent with the lock of the timers held, as they have feeds or `beside` */
    const struct beside *beside; /* what is filled when a message is sent; NULL without */
    uint32_t trims; /* whether it gets datagrams without their trailing zeros */
    uint32_t priority; /* of its messages under a bandwidth: enum priority in pace.h */
    uint32_t id;    /* in events */
    /* A topic gets each element of a list in place of the datagram (each.h); NULL without `for_each`. */
    const struct for_each *for_each;
    /* Counters. `waiting` is for a target whose messages pass a ring, `collected` for one that gets frames, `split` for one
     * with `for_each`, `delivered_bytes` for a destination. */
    uint32_t waiting, filtered, collected, split, delivered, delivered_bytes, dropped[DROP_REASONS];
    struct routine gate; /* the part of the condition that only reads states; empty if messages are never held */
};

/* The first slots of every layout of datagrams. */
enum { SLOT_RECEIVED_AT, SLOT_SOURCE };

struct collect;

/* The targets of a route that are served by one thread. */
struct targets {
    int64_t ttl;                 /* ns, 0 for none */
    const struct layout *layout; /* the fields that their routines read; NULL without routines */
    const struct value *sources; /* names of senders, by column; of datagrams */
    const struct collect *collect; /* they get frames (collect.h) instead of datagrams; NULL without `collect` */
    const struct target *targets;
    uint32_t count;
    /* For events: the route, the topic that the messages come from, or NO_NAME, and the generation of the program. */
    uint32_t route, topic, generation;
};

/* ---- messages ---- */

/* A datagram as it was received, with what envelope_read found. */
struct datagram {
    const uint8_t *data;
    uint32_t size;
    uint32_t start, length; /* of the payload, or of its pieces with everything between them, as in struct envelope */
    bool is_single;         /* it is in one piece */
    uint32_t column;        /* of the sender */
    int64_t received_at;    /* wall clock */
};

/* A message for the targets of a route. Its fields are read when a routine first needs them. */
struct message {
    const struct datagram *datagram; /* NULL for a message from ROS, whose fields are already read */
    int64_t now;                     /* boot clock: when it was received */
    struct time_range times;         /* of the event `since` */
    enum refused since;              /* the event that its age counts from */
    bool is_read;
    int outcome;    /* result of reading: EVALUATED, or an enum drop_reason */
    uint32_t place; /* where it was refused: enum place */
};

/* The index of a message's source in arrays of its route: the column of the sender, or 0 for a message from ROS. */
static inline uint32_t source_of(const struct message *message) { return message->datagram ? message->datagram->column : 0; }

/* ---- delivery ---- */

enum publication { PUBLISHED, PUBLISH_FAILED, ABANDONED };
enum { BRAKE_LATER = -1 };

/* The environment in which a thread delivers messages. */
struct thread_env {
    struct simulation *simulation; /* the owner of the functions in a simulation; NULL in operation */
    counter *counters;
    struct reporter reporter;
    struct timers *timers; /* the group of the deadmen that its commands feed */
    /* Called for each increment by a message or a deadman; NULL in operation. */
    void (*counted)(struct thread_env *env, uint32_t index, int64_t amount);
    /* The boot clock and the wall clock, ns. */
    int64_t (*now)(struct thread_env *env);
    int64_t (*wall)(struct thread_env *env);
    /* Send as `command_send` does. The caller has just checked the age. */
    int (*send)(struct thread_env *env, const struct target *target, const uint8_t *data, size_t size, int64_t expires);
    /* Send a datagram of a deadman, with the lock held. Return 0, an errno, or BRAKE_LATER: see `deadman_settle`. */
    int (*brake)(struct thread_env *env, const struct deadman_destination *to, const struct deadman_datagram *datagram);
    /* Publish the machine's output. If that fails, `why` is set, and valid until the next call. ABANDONED: the thread was
     * stuck in the middleware and has been abandoned: it must not use anything that belongs to others. */
    enum publication (*publish)(struct thread_env *env, const struct targets *to, const struct target *target, const char **why);
    struct machine machine; /* last, as it is large */
};

/* Prepare an environment with the clock and sockets of this computer; the caller sets `publish`. Return false if memory runs out.
 * Close it in either case. */
bool env_open(struct thread_env *env, counter *counters, struct ring *events, struct timers *timers);
void env_close(struct thread_env *env);

/* Add to a counter of the environment. */
static inline void env_count(struct thread_env *env, uint32_t index, int64_t amount) {
    counter_add(env->counters, index, amount);
    if (env->counted) env->counted(env, index, amount);
}

/* Where to note actions of its thread; NULL while nobody observes. The environment must have a group of timers. */
static inline struct actions *env_actions(const struct thread_env *env) {
    return atomic_load_explicit(&env->timers->actions, memory_order_acquire);
}

/* Begin with a datagram: set the slots of its time and its sender, and the others to their defaults. `sources` are names of
 * senders, by column. */
void begin_datagram(struct machine *machine, const struct layout *layout, const struct value *sources,
                    const struct datagram *from);

/* Likewise, then read the fields of the layout. Return false if the datagram is malformed. */
bool read_datagram(struct machine *machine, const struct layout *layout, const struct value *sources,
                   const struct datagram *from);

/* Count and report the loss of a message for a target. `lost` has the reason, and details if there are any. */
void lose_message(struct thread_env *env, const struct targets *to, const struct target *target, int64_t now,
                  struct lost_event lost, const char *text);

/* Likewise for a message that the machine has refused. */
void lose_refused(struct thread_env *env, const struct targets *to, const struct target *target, int64_t now,
                  struct lost_event lost);

/* Likewise for an expired message, older than `ttl`. `since` is the event that its age counts from. */
void lose_stale(struct thread_env *env, const struct targets *to, const struct target *target, int64_t now, int64_t expires,
                enum refused since);

/* Whether states still let a message that was held leave, for a target with a gate; otherwise count it as filtered. */
bool passes_gate(struct thread_env *env, const struct targets *to, const struct target *target);

static inline bool may_leave(struct thread_env *env, const struct targets *to, const struct target *target) {
    return !target->gate.count || passes_gate(env, to, target);
}

/* Send these bytes, or publish the machine's output, and count that. Return false if the thread was abandoned. */
bool deliver_now(struct thread_env *env, const struct targets *to, const struct target *target, const uint8_t *data,
                 size_t size, int64_t expires, int64_t now);

/* The first steps for a message that is split for a target: whether it is wanted, readable and fresh. Otherwise it is counted. */
bool deliver_begin(struct thread_env *env, const struct targets *to, const struct target *target, struct message *message);

/* Deliver a message to one of the targets. Return false if the thread was abandoned. */
bool deliver(struct thread_env *env, const struct targets *to, const struct target *target, struct message *message);

/* Deliver a message to all targets. Return false if the thread was abandoned. */
bool deliver_to_all(struct thread_env *env, const struct targets *to, struct message *message);

#endif
