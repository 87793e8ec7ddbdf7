/* A program: immutable arrays that router/image/writer.py makes from a compiled table.
 *
 * All arrays belong to the caller and must live until another program is adopted, the ring holds no message that points to
 * them, and the receive thread has made another turn since (`carrier_turns`): it may be dropping such a message. */
#ifndef PROGRAM_H
#define PROGRAM_H

#include <stdbool.h>
#include <stdint.h>

#include "deadman.h"
#include "deliver.h"
#include "envelope.h"
#include "hosts.h"
#include "link.h"
#include "order.h"
#include "state.h"

/* A condition on the messages of a route from one sender. If it holds, the sender obeys the brake of this deadman. */
struct witness {
    struct deadman *deadman;
    struct routine condition;
    const struct layout *layout; /* the fields that it reads */
    const struct value *sources; /* names of senders, by column */
    uint32_t column;             /* of the sender */
    uint32_t deadman_id, endpoint_id; /* in events */
    uint32_t reserved;
};

/* What the router itself answers. */
struct replies {
    struct targets to;         /* one for each endpoint that gets a reply */
    const uint32_t *by_column; /* the target of each sender; `to.count` for one that gets no reply */
};

/* What else the receive thread does with each message of a route. */
struct effects {
    const struct setter *setters;
    const struct witness *witnesses;
    const struct replies *replies; /* NULL without `reply` */
    uint32_t setter_count, witness_count;
};

struct route {
    struct targets sends;     /* destinations, which the receive thread serves */
    struct targets publishes; /* topics, which the publish thread serves */
    const struct ordering *order; /* NULL without `order` */
    const struct effects *effects; /* NULL without any */
    uint32_t last_message, duration; /* counters: boot clock; a histogram has HISTOGRAM_BOUNDS + 2 */
    uint64_t reserved; /* 144 bytes in total make the choice cheaper */
};

/* The route for messages of one sender with one payload case. Of a route with `order`, the number is ORDERED minus its index,
 * so that other routes cost nothing more. */
enum { NO_ROUTE = -1, ORDERED = -2 };
struct choice {
    int32_t route;
    uint32_t received; /* counter */
};

/* A payload case of an envelope. */
struct payload_case {
    uint32_t number;
    int32_t row;        /* of the listener's choices; -1 for a case without a route */
    uint32_t is_ignored;
    uint32_t unhandled; /* counter */
};

/* An envelope: what the frames of a listener are. */
struct protocol {
    struct wire_schema schema;
    const struct payload_case *cases; /* by number */
    uint32_t case_count;
    uint32_t unknown_case; /* counter */
};

/* An endpoint, as a listener identifies it. */
struct peer {
    uint32_t address; /* hosts.h */
    uint32_t port;    /* 0: any */
    uint32_t column;  /* of the listener's choices */
    uint32_t last_seen, heard_since, silences, last_silence; /* counters, the first two of the boot clock */
    uint32_t id;      /* of the endpoint, in mirror records and events */
    uint32_t reserved;
    int64_t pause;    /* ns: a longer one is a silence */
};

struct network {
    uint8_t address[HOST_BYTES];
    uint32_t prefix; /* bits */
};

/* An endpoint whose address is learned (learn.h), as a listener identifies it. */
struct learned_peer {
    struct peer peer;        /* its address and port are not used */
    struct sender *sender;   /* NULL if nothing is sent to it */
    const struct network *networks;
    uint32_t network_count;  /* 0: its address may be any */
    uint32_t port;           /* that it sends from; 0: any */
    uint32_t origin;         /* counter: the learned address (times 65536) and port; 0 for none */
    uint32_t reserved;
    int64_t stale_after;     /* ns of silence after which another sender may take its place; NEVER */
};

struct listener {
    int32_t fd;  /* -1 for a link */
    uint32_t id; /* in events and mirror records */
    uint32_t repairs;
    uint32_t keeps_input; /* datagrams queued at the stop are left for the next process */
    const struct protocol *protocol;
    struct link *link; /* NULL for a socket */
    const struct peer *peers; /* by address; for one address, those with a port first */
    const struct learned_peer *learned;
    const struct choice *choices; /* `columns` for each row; the last one is for strangers */
    uint32_t peer_count, learned_count, columns, reserved;
    uint32_t received, received_bytes, padded, superseded, rejected[REASONS]; /* counters */
};

struct program {
    uint32_t generation;
    uint32_t listener_count, state_count;
    const struct state_settings *states;
    const struct listener *listeners;
    const struct route *routes;
};

/* The changes that come with a program, made between two datagrams. Ending timers send the messages that they hold. */
struct change {
    const struct program *program;
    struct deadman *const *replaced; /* pairs: the next deadman, the earlier one */
    struct timer_change timers;
    uint32_t replaced_count, reserved;
};

/* A message for topics in the ring. The bytes of the envelope follow, as they are forwarded. */
struct message_record {
    uint32_t size, generation;
    const struct targets *to;
    int64_t received_at;  /* wall clock */
    int64_t now, oldest, youngest; /* boot clock: when it was received, and when it arrived, as in struct time_range */
    uint32_t column;      /* of the sender */
    uint32_t is_single;   /* the payload is in one piece */
    uint32_t length;      /* of the datagram */
    uint32_t start, payload_length; /* of the payload, as in struct envelope */
    uint32_t reserved;
};

#endif
