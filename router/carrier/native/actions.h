/* The actions of the router, for observers: the commands that it sends, the datagrams of deadmen, messages lost on the way to
 * an endpoint, changes of deadmen, and the ends of silences. Received datagrams have a ring of their own (carrier.h), so a
 * flood of them displaces no action.
 *
 * While nobody observes, an action costs one load. Any thread may note one; the lock is held only to copy a record. */
#ifndef ACTIONS_H
#define ACTIONS_H

#include <pthread.h>
#include <stdatomic.h>
#include <stdint.h>

#include "counters.h"
#include "events.h"
#include "ring.h"

enum action {
    ACTION_SENT,    /* a command: a message from ROS, or a datagram that feeds or disarms a deadman */
    ACTION_BRAKED,  /* a datagram of a deadman; `error` is 0 if it was sent */
    ACTION_LOST,    /* a message for an endpoint, with `reason` and `refusal`; a text with details may follow */
    ACTION_TRIPPED, /* a deadman */
    ACTION_RELEASED,
    ACTION_FED,     /* a deadman, by a message of a gateway's client */
    ACTION_RETURNED /* an endpoint is heard again after a silence, whose ns (int64_t) follow */
};

/* Up to MAX_DATAGRAM bytes follow: the datagram that was sent, a text or a number. */
struct action_record {
    uint32_t size, action; /* enum action */
    int64_t at;            /* wall clock */
    uint32_t route, target; /* as in events; NO_NAME if an endpoint returns, or if a deadman is fed or changes */
    uint32_t topic;         /* that the message came from, or NO_NAME */
    uint32_t reason;        /* enum drop_reason */
    int32_t error;          /* errno, or 0 */
    uint32_t length;        /* of what follows */
    struct refusal refusal;
};

struct actions;

/* Open a recorder that writes to `ring`. Returns NULL if memory runs out. It is never closed: threads may use it until the
 * end. */
struct actions *actions_open(struct ring *ring);

/* The counter, in the counters of each thread, of the actions dropped because the ring is full. */
void actions_count_lost(struct actions *actions, uint32_t lost);

/* Note an action, which happens now: sets size, time and length. `counters` are those of the calling thread. */
void actions_note(struct actions *actions, counter *counters, struct action_record action, const void *data, size_t length);

#endif
