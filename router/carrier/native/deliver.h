/* Delivers messages to targets. All threads use it: the receive thread and the publish thread for datagrams, others for
 * messages from ROS. The steps, in this order:
 *
 *     wanted      a topic needs a subscriber                          else filtered
 *     condition   `when`                                              else filtered
 *     age         `ttl`                                               else stale
 *     rate        `max_rate`                                          else rate_limited
 *     message     what its routine writes, or the envelope as it was received
 *     board       what the firmware can take                          else too_large or non_finite
 *     defer       `on_limit: latest` and `bandwidth` (defer.h)
 *     send or publish, and feed deadmen
 *
 * Each target counts every message once. Losses are reported, except those by `max_rate`, which the table asks for.
 *
 * A stage provides the clock, sockets and middleware as functions, so that tests can do without them. */
#ifndef DELIVER_H
#define DELIVER_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "board.h"
#include "counters.h"
#include "deadman.h"
#include "freshness.h"
#include "limit.h"
#include "machine.h"
#include "report.h"
#include "sender.h"

/* ---- what a table says ---- */

/* A topic that any number of routes publish on. */
struct topic {
    const void *publisher; /* rcl_publisher_t */
    const uint8_t *wanted; /* not 0 while somebody subscribes */
};

struct target {
    struct routine condition; /* empty: it gets every message */
    struct routine message;   /* empty: it gets the envelope as it was received */
    /* One for each source of the route, by `source_of`, or NULL: of `max_rate` with `on_limit: first`, and what may hold
     * messages back. */
    struct limit *const *limits;
    struct deferral *const *deferrals;
    int64_t period;            /* of `on_limit: latest`, ns; 0 without */
    const struct topic *topic; /* NULL for a destination, which has these: */
    struct sender *sender;
    const struct board *board; /* NULL if it is no board */
    const struct feed *feeds;  /* the deadmen that a command feeds or disarms */
    uint32_t feed_count;
    uint32_t trims; /* it gets datagrams without their trailing zeros */
    uint32_t priority; /* where its messages wait for a bandwidth, an enum priority in pace.h */
    uint32_t id;    /* in events */
    /* Counters. `waiting`: of a target whose messages come by a ring; `collected`: of one that gets frames;
     * `delivered_bytes`: of a destination. */
    uint32_t waiting, filtered, collected, delivered, delivered_bytes, dropped[LOSSES];
};

/* The first slots of every layout of datagrams. */
enum { SLOT_RECEIVED_AT, SLOT_SOURCE };

struct collect;

/* The targets of a route that one thread serves. */
struct targets {
    int64_t ttl;                 /* ns, 0 for none */
    const struct layout *layout; /* what their routines read; NULL if there are none */
    const struct value *sources; /* names of senders, by column; of datagrams */
    const struct collect *collect; /* they get frames (collect.h), not each datagram; NULL without `collect` */
    const struct target *targets;
    uint32_t count;
    /* In events: the route, the topic whose messages these are, or NO_NAME, and the generation of the program. */
    uint32_t route, topic, generation;
};

/* ---- what is delivered ---- */

/* A datagram as it was received, with what the carrier knows about it. */
struct datagram {
    const uint8_t *data;
    uint32_t size;
    uint32_t start, length; /* of the payload, or of its pieces with all that is between them, as in struct envelope */
    bool is_single;         /* it is in one piece */
    uint32_t column;        /* of the sender */
    int64_t received_at;    /* wall clock */
};

/* A message on its way to the targets of a route. Its fields are read when a routine first needs them. */
struct message {
    const struct datagram *datagram; /* NULL if it is from ROS: then it has been read */
    int64_t now;                     /* boot clock: when it was received */
    struct born born;
    enum refused since; /* what its age counts from */
    bool is_read;
    int outcome;    /* of reading: EVALUATED, or an enum loss */
    uint32_t place; /* that refused it, an enum place */
};

/* The source of a message in arrays of its route: the column of the sender, or 0 if it is from ROS. */
static inline uint32_t source_of(const struct message *message) { return message->datagram ? message->datagram->column : 0; }

/* ---- how it is delivered ---- */

enum publication { PUBLISHED, PUBLISH_FAILED, ABANDONED };
enum { BRAKE_LATER = -1 };

/* What a thread needs to deliver messages. */
struct stage {
    struct rehearsal *rehearsal; /* that the functions belong to; NULL in flight */
    counter *counters;
    struct reporter reporter;
    struct timers *timers; /* in which its commands feed deadmen */
    /* Called for each counter that a message or a deadman adds to; NULL in flight. */
    void (*counted)(struct stage *stage, uint32_t index, int64_t amount);
    /* The boot clock, ns. */
    int64_t (*now)(struct stage *stage);
    /* Send as `command_send` does. The caller has just checked the age. */
    int (*send)(struct stage *stage, const struct target *target, const uint8_t *data, size_t size, int64_t expires);
    /* Send the datagram of a deadman, with the lock held. Return 0, an errno, or BRAKE_LATER: see `deadman_settle`. */
    int (*brake)(struct stage *stage, const struct deadman_destination *to);
    /* Publish the machine's output. If that fails, `why` is set, and valid until the next call. ABANDONED: the thread was
     * stuck in the middleware and was abandoned, and must not use anything that belongs to others. */
    enum publication (*publish)(struct stage *stage, const struct target *target, const char **why);
    struct machine machine; /* last, as it is large */
};

/* Prepare a stage with the clock and sockets of this computer; the caller sets `publish`. Return false for lack of memory.
 * Close the stage in either case. */
bool stage_open(struct stage *stage, counter *counters, struct ring *events, struct timers *timers);
void stage_close(struct stage *stage);

/* Add to a counter of the stage. */
static inline void stage_count(struct stage *stage, uint32_t index, int64_t amount) {
    counter_add(stage->counters, index, amount);
    if (stage->counted) stage->counted(stage, index, amount);
}

/* Begin with a datagram: slots have their defaults, but those of its time and its sender. */
void begin_datagram(struct machine *machine, const struct targets *to, const struct datagram *from);

/* Begin with it, and read the fields that routines of the route use. Return false if it is malformed. */
bool read_datagram(struct machine *machine, const struct targets *to, const struct datagram *from);

/* Count and report that a target loses a message. `lost` has the reason, and details if there are any. */
void lose_message(struct stage *stage, const struct targets *to, const struct target *target, int64_t now,
                  struct lost_event lost, const char *text);

/* Likewise of what the machine has refused. */
void lose_refused(struct stage *stage, const struct targets *to, const struct target *target, int64_t now,
                  struct lost_event lost);

/* The message is older than `ttl`: it has expired. `since` says what its age counts from. */
void lose_stale(struct stage *stage, const struct targets *to, const struct target *target, int64_t now, int64_t expires,
                enum refused since);

/* Send these bytes, or publish the machine's output, and count that. Return false if the thread was abandoned. */
bool deliver_now(struct stage *stage, const struct targets *to, const struct target *target, const uint8_t *data,
                 size_t size, int64_t expires, int64_t now);

/* Deliver a message to one of the targets. Return false if the thread was abandoned. */
bool deliver(struct stage *stage, const struct targets *to, const struct target *target, struct message *message);

/* Deliver it to all of them, likewise. */
bool deliver_to_all(struct stage *stage, const struct targets *to, struct message *message);

#endif
