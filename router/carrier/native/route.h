/* Routes a received datagram, sends it to the destinations of its route, and passes it to the thread that serves the route's
 * topics, through a ring.
 *
 * The callers provide sockets, threads and clocks: carrier.c, publish.c, and simulation.c, which simulates them. */
#ifndef ROUTE_H
#define ROUTE_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "program.h"
#include "deliver.h"
#include "envelope.h"
#include "freshness.h"

/* The environment of a thread that routes datagrams. */
struct routing {
    struct thread_env env; /* first: its functions get a pointer to it */
    const struct program *program;
    struct freshness freshness;
    struct ring *published; /* messages for topics */
    /* A datagram, and its record for the ring. Last, as they are large. */
    _Alignas(8) uint8_t datagram[MAX_DATAGRAM + 8];
    _Alignas(8) uint8_t record[MAX_DATAGRAM + 256];
    uint8_t frame[MAX_DATAGRAM]; /* the datagram, while its messages are routed one by one */
};

/* A received datagram. */
struct received {
    /* Set by the caller: */
    const struct listener *listener;
    size_t length;          /* of the datagram, which is cut to MAX_DATAGRAM + 1 bytes */
    uint32_t address, port; /* of the sender. The port of a link is 0, and the address of a serial line */
    int64_t arrived_at;     /* wall clock, arrival in the kernel; 0 if unknown. Of a frame: when its first byte was read */
    int64_t received_at;    /* wall clock */
    int64_t now;            /* boot clock */
    /* Set by `route_datagram`: */
    const struct peer *peer; /* NULL for a stranger */
    uint32_t column;
    const struct route *route; /* NULL if no route matches */
    struct time_range times;
    struct envelope envelope;
};

enum { ROUTED = -1 };

/* Route and deliver the datagram in `routing->datagram`. Return ROUTED, or the reason for rejecting it. */
int route_datagram(struct routing *routing, struct received *received);

/* Count and report a frame of a link that has no payload: `reason` is BAD_FRAME or BAD_CHECKSUM. */
void route_bad_frame(struct routing *routing, struct received *received, enum reason reason);

/* Adopt another program between two datagrams: deadmen of the earlier one are passed on, or end. */
void routing_adopt(struct routing *routing, const struct change *change);

/* Deliver a message that `route_datagram` has put into the ring. Return false if the thread has been abandoned. */
bool route_to_topics(struct thread_env *env, const struct message_record *record);

#endif
