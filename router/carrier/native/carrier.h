/* The threads `receive` and `timers`, which receive datagrams and serve timers. The receive thread routes and forwards
 * (route.h), and passes messages for topics to the publish thread. */
#ifndef CARRIER_H
#define CARRIER_H

#include <stdbool.h>
#include <stdint.h>

#include "counters.h"
#include "program.h"
#include "ring.h"

/* A received datagram in the mirror, with the routing decision. Up to MAX_DATAGRAM + 1 bytes follow, as they were
 * received. */
struct mirror_record {
    uint32_t size, listener;
    int64_t at; /* wall clock */
    uint32_t address, port; /* of the sender, host byte order */
    uint32_t length;
    int32_t reason;   /* enum reason, or ROUTED (route.h) */
    int32_t endpoint; /* `id` of the sender, or STRANGER */
    uint32_t reserved;
};
enum { STRANGER = -1 };

struct carrier;

/* Open a carrier that counts in `counters` and writes losses and rejections to `events`, as the only writer of both.
 * `published` gets the messages for topics. Returns NULL if memory runs out. */
struct carrier *carrier_open(struct timers *timers, counter *counters, struct ring *events, struct ring *published);

/* Start the threads. Return 0, or an errno. */
int carrier_start(struct carrier *carrier, const struct change *first);

/* Feed the watchdog of a service manager every `interval` ns through a socket that is connected to it. */
void carrier_watchdog(struct carrier *carrier, int notify, int64_t interval);

/* Adopt another program between two datagrams, and wait for that. Listeners that it does not have are drained first.
 * The receive thread must be running. */
void carrier_change(struct carrier *carrier, const struct change *change);

/* Copy received datagrams to `mirror` from now on; NULL stops that. `lost` counts those dropped because it is full. */
void carrier_mirror(struct carrier *carrier, struct ring *mirror, uint32_t lost);

/* Signal that Python is alive. Call it every few seconds, or the watchdog is not fed. */
void carrier_pulse(struct carrier *carrier);

/* A number that grows at least every 50 ms unless the receive thread is stuck. */
uint64_t carrier_turns(struct carrier *carrier);

/* Copy the first counters of the receive thread as in `counters_copy`. */
bool carrier_counters(struct carrier *carrier, int64_t *to, uint32_t count);

/* Handle the datagrams queued in the kernel, and end the receive thread; then `carrier_close` also ends the timer thread. */
void carrier_stop_receiving(struct carrier *carrier);
void carrier_close(struct carrier *carrier);

#endif
