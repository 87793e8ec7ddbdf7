/* Deadmen: timers that send a ready datagram in place of a route's commands when these stop coming.
 *
 * Unarmed: no command was sent yet, or another route has taken over; nothing is due.
 * Armed:   trips `timeout` after the last command was sent.
 * Tripped: has sent when it tripped, and repeats that on the grid of the time at which that was due.
 *
 * A command that was sent arms the deadman in any state; one of a route that it hands over to disarms it. A command that
 * failed changes nothing: the deadman trips when no other one leaves. One that was sent though an earlier one was refused
 * arms the deadman and puts off nothing. What is sent when the router starts changes no state. */
#ifndef DEADMAN_H
#define DEADMAN_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "counters.h"
#include "events.h"
#include "ring.h"
#include "sender.h"
#include "timers.h"

struct deadman_destination {
    struct sender *sender;
    const uint8_t *datagram; /* as are the lists of destinations: copied by `deadman_open` */
    uint32_t size;
    uint32_t sent, send_errors; /* counters */
    uint32_t id;                /* in events */
    const void *publisher;      /* rcl_publisher_t, where there is no sender: the one topic of a gateway's deadman */
};

struct deadman;

/* What a command does to a deadman once it is sent. */
struct feed {
    struct deadman *deadman;
    uint32_t disarms; /* 1: the command is of a route that the deadman hands over to */
    uint32_t reserved;
};

/* Add a deadman, with its timeout and repetition in ns. Returns NULL for lack of memory. `starts`: it sends when the router
 * starts. `active` and `trips` are counters, `id` stands for it in events. It is unarmed, and served from now on. When it
 * ends, it sends a last time if it is armed or has tripped. Its first member is a struct timer. */
struct deadman *deadman_open(struct timers *timers, int64_t timeout, int64_t repeat, bool starts, uint32_t active,
                             uint32_t trips, uint32_t id, const struct deadman_destination *destinations, uint32_t count);

/* Remove a deadman that no program refers to, and nothing that may still feed it. */
void deadman_close(struct timers *timers, struct deadman *deadman);

/* Send the datagrams when the router starts, if it does so. Return a bit for each of the first 64 destinations reached.
 * While one of the datagrams does not leave, all are sent again each second, until a command feeds or disarms it. */
uint64_t deadman_start(struct timers *timers, struct deadman *deadman, int64_t now);

/* `deadman_start` where it publishes: nobody can be reached before subscribers are discovered. So it greets each new
 * subscriber for some time: it is due at once, while no command was sent, and again after half a second, as subscriber and
 * publisher do not discover each other at the same time and best effort loses what is sent in between. `deadman_greet`
 * returns whether it does so. */
void deadman_await_subscribers(struct timers *timers, struct deadman *deadman, int64_t now);
bool deadman_greet(struct timers *timers, struct deadman *deadman, int64_t now);

/* Have `next` take over deadline and state of `earlier`, the deadman of the same route in the previous program.
 * `earlier` keeps only the destinations (by sender) that `next` does not have, and sends to them when it ends. Feeds of
 * `earlier` act on `next` from now on. */
void deadman_replace(struct timers *timers, struct deadman *next, struct deadman *earlier);

enum { COMMAND_STALE = -1 };

/* Send a command: check that it has not expired (`expires`, boot clock, ns; NEVER: it does not), send it, and feed or
 * disarm the deadmen if that returned no error, all under the lock. Return 0, COMMAND_STALE, or an errno of
 * `sender_send`. If that is about an earlier command (ECONNREFUSED), this one arms its deadman where it is unarmed, but
 * puts off no deadline. Without feeds the lock is not taken. */
int command_send(struct timers *timers, struct sender *sender, const void *data, size_t size, int64_t expires,
                 const struct feed *feeds, uint32_t count);

/* As `command_send` at the time `now`, for callers that hold the lock if there are feeds. */
int command_send_at(struct timers *timers, struct sender *sender, const void *data, size_t size, int64_t expires,
                    const struct feed *feeds, uint32_t count, int64_t now);

/* A command of the deadman's route has left at `now`; takes the lock. */
void deadman_feed(struct timers *timers, struct deadman *deadman, int64_t now);

/* As `timer_end`, by the thread that serves the group: it is due at once for that if it is armed or has tripped. */
void deadman_end_by_thread(struct timers *timers, struct deadman *deadman);
void deadman_schedule_end(struct timers *timers, struct timer *timer); /* with the lock held */

/* What a stage's `brake` was to send later has left, or has not: `why`, else NULL. The lock is held. The deadman may be
 * gone. */
void deadman_settle(struct timers *timers, struct timer *timer, const struct deadman_destination *to, const char *why,
                    int64_t now);

/* A command has left at `now`, and returned `refused`: 0, or an errno about an earlier one. The lock is held. */
void command_has_left(struct timers *timers, const struct feed *feeds, uint32_t count, int refused, int64_t now);

#endif
