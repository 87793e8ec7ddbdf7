/* A simulation executes a program without threads, sockets or middleware, on a simulated clock. The caller passes
 * messages and sets the clock; the outcome is recorded, in order. It runs the functions of a router's threads
 * synchronously.
 *
 * Every topic has subscribers, and the network and the middleware accept everything. */
#ifndef SIMULATION_H
#define SIMULATION_H

#include <stddef.h>
#include <stdint.h>

#include "program.h"
#include "route_ros.h"

/* Records besides events (events.h). Each begins with `size` and `kind`. */
enum record_kind { RECORD_TIME = 32, RECORD_INCREMENT, RECORD_SENT, RECORD_BRAKED, RECORD_PUBLISHED };

/* The time of the following records; before the first one, they are of the time of opening. */
struct time_record {
    uint32_t size, kind;
    int64_t at; /* boot clock */
};

struct increment_record {
    uint32_t size, kind;
    int64_t amount;
    uint32_t counter, reserved;
};

/* A message sent by a target or a deadman; the bytes follow. Its counter follows. */
struct output_record {
    uint32_t size, kind;
    uint32_t target, length; /* `target`: as in events */
};

struct simulation;

/* Open a simulation that counts in `counters`, at this boot-clock time. Returns NULL if memory or descriptors run out. */
struct simulation *simulation_open(counter *counters, int64_t now);
void simulation_close(struct simulation *simulation); /* when it has no timer left */

/* The timers of destinations: deadmen of its programs are opened there. */
struct timers *simulation_timers(struct simulation *simulation);

/* Switch to another program, as at a reload, or to the first one. `published` are the changes to the timers of topics.
 * Everything belongs to the caller. */
void simulation_adopt(struct simulation *simulation, const struct change *change, const struct timer_change *published,
                     const struct ros_topic *topics);

/* Receive a datagram on a listener, or a message from ROS on a topic, by index in the program. `arrived_at` and `sent_at`
 * are wall-clock times. */
void simulation_datagram(struct simulation *simulation, uint32_t listener, uint32_t address, uint32_t port, const void *data,
                        size_t size, int64_t arrived_at);
void simulation_message(struct simulation *simulation, uint32_t topic, const void *data, size_t size, int64_t sent_at);

/* Send the datagram of a request again, as `requests_send_again` does. */
void simulation_send_again(struct simulation *simulation, uint32_t topic, const void *data, size_t size);

/* Advance the clock to that time, and serve timers that become due. Never goes back. */
void simulation_advance(struct simulation *simulation, int64_t to);

/* Set the wall clock to `ahead` ns ahead of the boot clock; 0 at first. */
void simulation_set_clock(struct simulation *simulation, int64_t ahead);

/* Stop as the router does: send what is held back, then have armed deadmen send. */
void simulation_end(struct simulation *simulation);

/* Return the records since the last call, valid until the next call of any function, and their size in bytes; NULL if
 * memory runs out. */
const void *simulation_records(struct simulation *simulation, size_t *size);

/* Evaluate a condition on a payload, like `when` of a route. `source` is the name of the sender, `beside` the envelope, which
 * may lack the payload. Return EVALUATED, an enum drop_reason if it has no value for this payload or the payload is
 * malformed, or DROP_REASONS if memory runs out. */
int condition_holds(const struct layout *layout, const struct routine *condition, int64_t received_at,
                    const struct value *source, const struct value *payload, const struct value *beside, bool *holds);

#endif
