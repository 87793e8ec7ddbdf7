/* The carrier: receives datagrams, forwards them, and hands over to the publish thread what topics get.
 *
 * It executes a program: immutable arrays that router/carrier/program.py makes of a compiled table. All arrays belong to
 * the caller and must live until another program was adopted, the rings hold nothing that refers to them, and the receive
 * thread has made another turn since (`carrier_turns`): it may be dropping such a message. */
#ifndef CARRIER_H
#define CARRIER_H

#include <netinet/in.h>
#include <stdatomic.h>
#include <stdbool.h>
#include <stdint.h>

#include "counters.h"
#include "deadman.h"
#include "deliver.h"
#include "envelope.h"
#include "ring.h"

struct route {
    struct targets sends;     /* destinations, which the receive thread serves */
    struct targets publishes; /* topics, which the publish thread serves */
    uint32_t last_message, duration; /* counters; a histogram has HISTOGRAM_BOUNDS + 2 */
};

/* What a sender's messages of a payload case come to: the index of a route, or -1. */
struct choice {
    int32_t route;
    uint32_t received; /* counter */
};

/* A field of the envelope's oneof. */
struct payload_case {
    uint32_t number;
    int32_t row;        /* of the listener's choices; -1 for a case without a route */
    uint32_t is_ignored;
    uint32_t unhandled; /* counter */
};

/* An endpoint as a listener recognises it. */
struct peer {
    uint32_t address; /* host byte order */
    uint32_t port;    /* 0: any */
    uint32_t column;  /* of the listener's choices */
    uint32_t last_seen; /* counter */
    uint32_t id;        /* of the endpoint, in what is mirrored */
};

struct listener {
    int32_t fd;
    uint32_t id; /* in events, and in what is mirrored */
    uint32_t repairs;
    uint32_t keeps_input; /* what it holds at the stop is left for the next process */
    const struct peer *peers; /* by address; of one address, those with a port first */
    const struct choice *choices; /* `columns` for each row; the last one is for strangers */
    uint32_t peer_count, columns;
    uint32_t received, received_bytes, padded, rejected[REASONS]; /* counters */
    uint32_t reserved;
};

struct program {
    uint32_t generation;
    uint32_t listener_count, case_count;
    uint32_t unknown_case; /* counter */
    const struct wire_schema *schema;
    const struct listener *listeners;
    const struct payload_case *cases; /* by number */
    const struct route *routes;
};

/* What changes with a program, beside it: done between two datagrams. What ends sends what it holds, then. */
struct change {
    const struct program *program;
    struct deadman *const *replaced; /* pairs: the next deadman, the earlier one */
    struct timer_change timers;
    uint32_t replaced_count, reserved;
};

/* A message for topics, as it stands in the ring. The bytes of the envelope follow, as they are forwarded. */
struct message_record {
    uint32_t size, generation;
    const struct targets *to;
    int64_t received_at;  /* wall clock */
    int64_t now, oldest, youngest; /* boot clock: when it was received, and when it arrived, as in struct born */
    uint32_t column;      /* of the sender */
    uint32_t is_single;   /* the payload is the only field */
    uint32_t length;      /* of the datagram */
    uint32_t start, payload_length; /* of the payload, where it is the only field */
    uint32_t reserved;
};

/* A received datagram in the mirror, once it is decided what becomes of it. Up to MAX_DATAGRAM + 1 bytes follow, as they
 * were received. */
struct mirror_record {
    uint32_t size, listener;
    int64_t at; /* wall clock */
    uint32_t address, port; /* of the sender, host byte order */
    uint32_t length;
    int32_t reason;   /* enum reason, or ROUTED */
    int32_t endpoint; /* `id` of the sender, or STRANGER */
    uint32_t reserved;
};
enum { ROUTED = -1, STRANGER = -1 };

struct carrier;

/* Open a carrier that counts in `counters`, and writes losses and rejections to `events`: nobody else writes to either.
 * `published` gets the messages for topics. NULL for lack of memory. */
struct carrier *carrier_open(struct timers *timers, counter *counters, struct ring *events, struct ring *published);

/* Start the threads. Return 0, or an errno. */
int carrier_start(struct carrier *carrier, const struct change *first);

/* Feed the watchdog of a service manager every `interval` ns, by a socket that is connected to it. */
void carrier_watchdog(struct carrier *carrier, int notify, int64_t interval);

/* Adopt another program between two datagrams; return when that is done. Listeners that it does not have are emptied
 * before. To be called while the receive thread runs. */
void carrier_change(struct carrier *carrier, const struct change *change);

/* Show received datagrams in `mirror` from now on; NULL for none. `lost` is the counter of those that had no room. */
void carrier_mirror(struct carrier *carrier, struct ring *mirror, uint32_t lost);

/* Python is alive: to be called every few seconds, or the watchdog is not fed. */
void carrier_pulse(struct carrier *carrier);

/* A number that grows at least every 50 ms unless the receive thread is stuck. */
uint64_t carrier_turns(struct carrier *carrier);

/* Copy the first counters of the receive thread as in `counters_copy`. */
bool carrier_counters(struct carrier *carrier, int64_t *to, uint32_t count);

/* Handle what the kernel holds, and end the receive thread; then `carrier_close` ends the timer thread too. */
void carrier_stop_receiving(struct carrier *carrier);
void carrier_close(struct carrier *carrier);

#endif
