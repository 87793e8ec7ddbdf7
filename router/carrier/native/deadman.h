/* Deadmen: timers that send prepared datagrams when the commands of a route stop.
 *
 * Unarmed: no command was sent yet, or another route has taken over; nothing is due.
 * Armed:   trips `timeout` after the last command was sent.
 * Tripped: has sent its datagram, and repeats it at fixed intervals, counted from when it was due to trip.
 *
 * A sent command arms the deadman in any state; a command of a route that it hands over to disarms it. A failed command
 * changes nothing: the deadman trips unless another one is sent. If the receiver refused an earlier command, a sent command
 * arms the deadman but does not extend its deadline. Datagrams sent at router start change no state. */
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

struct deadman_datagram {
    const uint8_t *data;
    uint32_t size;
};

struct deadman_destination {
    struct sender *sender;
    /* Sent in this order. `deadman_open` copies them, and the list of destinations. */
    const struct deadman_datagram *datagrams;
    uint32_t count;
    uint32_t sent, send_errors; /* counters */
    uint32_t id;                /* in events */
    const void *publisher;      /* rcl_publisher_t of the topic, for a gateway's deadman, which has no sender */
};

struct deadman;

/* The effect of a sent command on a deadman. */
struct feed {
    struct deadman *deadman;
    uint32_t disarms; /* 1: the command is from a route that the deadman hands over to */
    uint32_t reserved;
};

/* Add a deadman, with its timeout and repetition in ns. Returns NULL if memory runs out. `starts`: it sends at router start.
 * `active` and `trips` are counters, `id` identifies it in events. It is unarmed, and served from now on. When it ends, it
 * sends a last time if it is armed or tripped. Its first member is a struct timer. */
struct deadman *deadman_open(struct timers *timers, int64_t timeout, int64_t repeat, bool starts, uint32_t active,
                             uint32_t trips, uint32_t id, const struct deadman_destination *destinations, uint32_t count);

/* Remove a deadman that no program uses and nothing can feed. */
void deadman_close(struct timers *timers, struct deadman *deadman);

/* Send the datagrams at router start, if the deadman does so. Return a bit for each of the first 64 destinations reached.
 * While one of the datagrams fails, all are sent again each second, until a command feeds or disarms the deadman. */
uint64_t deadman_start(struct timers *timers, struct deadman *deadman, int64_t now);

/* Like `deadman_start`, for a deadman that publishes. It reaches no subscriber that is not discovered yet, so for some
 * time, and until a command is sent, it publishes to each new subscriber: at once, and again after half a second, because
 * subscriber and publisher do not discover each other at the same time and best effort loses messages in between.
 * `deadman_greet` returns whether it does so. */
void deadman_await_subscribers(struct timers *timers, struct deadman *deadman, int64_t now);
bool deadman_greet(struct timers *timers, struct deadman *deadman, int64_t now);

/* Pass deadline and state of `earlier`, the deadman of the same route in the previous program, to `next`. `earlier` keeps
 * only the destinations (by sender) that `next` does not have, and sends to them when it ends. From now on, feeding
 * `earlier` feeds `next`. */
void deadman_replace(struct timers *timers, struct deadman *next, struct deadman *earlier);

enum { COMMAND_STALE = -1 };

/* Send a command: check that it has not expired (`expires`, boot clock, ns; NEVER: it does not), send it, and feed or
 * disarm the deadmen if that returned no error, all under the lock. Return 0, COMMAND_STALE, or an errno of `sender_send`.
 * If that is about an earlier command (ECONNREFUSED), this one arms an unarmed deadman, but does not extend a deadline.
 * Without feeds, the lock is not taken. */
int command_send(struct timers *timers, struct sender *sender, const void *data, size_t size, int64_t expires,
                 const struct feed *feeds, uint32_t count);

/* Like `command_send` at the time `now`, for callers that hold the lock if there are feeds. */
int command_send_at(struct timers *timers, struct sender *sender, const void *data, size_t size, int64_t expires,
                    const struct feed *feeds, uint32_t count, int64_t now);

/* A command of the deadman's route was sent at `now`. Takes the lock. */
void deadman_feed(struct timers *timers, struct deadman *deadman, int64_t now);

/* Like `timer_end`, but done by the thread that serves the group: an armed or tripped deadman becomes due at once. */
void deadman_end_by_thread(struct timers *timers, struct deadman *deadman);
void deadman_schedule_end(struct timers *timers, struct timer *timer); /* with the lock held */

/* Settle a datagram that a stage's `brake` was to send later: `why` it failed, or NULL. The lock is held. The deadman may
 * be gone. */
void deadman_settle(struct timers *timers, struct timer *timer, const struct deadman_destination *to, const char *why,
                    int64_t now);

/* A command was sent at `now` and returned `refused`: 0, or an errno about an earlier one. The lock is held. */
void command_has_left(struct timers *timers, const struct feed *feeds, uint32_t count, int refused, int64_t now);

#endif
