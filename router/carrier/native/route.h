/* What a received datagram comes to: it is routed, sent to the destinations of its route, and handed over to the thread
 * that serves the route's topics; there it comes out of a ring again.
 *
 * Sockets, threads and clocks are the caller's: carrier.c, publish.c, and rehearsal.c, which has none. */
#ifndef ROUTE_H
#define ROUTE_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "program.h"
#include "deliver.h"
#include "envelope.h"
#include "freshness.h"

/* What a thread needs that routes datagrams. */
struct routing {
    struct stage stage; /* first: what it calls is given this */
    const struct program *program;
    struct freshness freshness;
    struct ring *published; /* gets messages for topics */
    /* A datagram, and the record that is made of it. Last, as they are large. */
    _Alignas(8) uint8_t datagram[MAX_DATAGRAM + 8];
    _Alignas(8) uint8_t record[MAX_DATAGRAM + 256];
};

/* A datagram that was received. */
struct received {
    /* By the caller: */
    const struct listener *listener;
    size_t length;          /* of the datagram; what is longer than MAX_DATAGRAM + 1 bytes was cut */
    uint32_t address, port; /* of the sender */
    int64_t arrived_at;     /* wall clock, when the kernel got it; 0 if that is not known */
    int64_t received_at;    /* wall clock */
    int64_t now;            /* boot clock */
    /* By `route_datagram`: */
    const struct peer *peer; /* NULL for a stranger */
    uint32_t column;
    const struct route *route; /* NULL if none takes it */
    struct born born;
    struct envelope envelope;
};

enum { ROUTED = -1 };

/* Route and deliver the datagram in `routing->datagram`. Return ROUTED, or the reason why no route takes it. */
int route_datagram(struct routing *routing, struct received *received);

/* Adopt another program between two datagrams: deadmen pass from the earlier one to it, or end. */
void routing_adopt(struct routing *routing, const struct change *change);

/* Deliver a message that `route_datagram` has put into the ring. Return false if the thread was abandoned. */
bool route_to_topics(struct stage *stage, const struct message_record *record);

#endif
