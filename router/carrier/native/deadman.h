/* Deadmen: timers that send prepared datagrams when the commands of a route stop.
 *
 * Unarmed: no command was sent yet, or another route has taken over; nothing is due.
 * Armed:   trips `timeout` after the last command was sent.
 * Tripped: has sent its datagrams, and repeats them at fixed intervals, counted from when it was due to trip.
 *
 * Each destination is armed or not, and gets datagrams only while it is; the deadman is armed while one of them is, and has
 * one deadline. A sent command arms the destination that it went to, in any state; a command of a route that the deadman
 * hands over to disarms it. Destinations that the route itself never commands follow: they are armed by each command, and
 * disarmed when no commanded one is armed any more.
 *
 * What the deadman's route still holds for a destination when it is disarmed is dropped: it would leave after the newer
 * command.
 *
 * A failed command changes nothing: the deadman trips unless another one is sent. If the receiver refused an earlier
 * command, a sent command arms the destination but does not extend the deadline. Datagrams sent at router start change no
 * state.
 *
 * While a deadman is tripped, messages of its destinations may show whether they obey (`deadman_is_shown`). A destination
 * disobeys if for `within` no message has shown that it does: since the deadman tripped, or since the first message that
 * showed the contrary after one that showed it. Only messages that arrived after the deadman tripped count. */
#ifndef DEADMAN_H
#define DEADMAN_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "beside.h"
#include "counters.h"
#include "events.h"
#include "ring.h"
#include "sender.h"
#include "timers.h"

struct deadman_datagram {
    const uint8_t *data;
    uint32_t size;
};

enum { MOST_DESTINATIONS = 64 }; /* of a deadman */

struct deadman_destination {
    struct sender *sender;
    /* Sent in this order. `deadman_open` copies them, what is filled when they are sent, and the list of destinations. */
    const struct deadman_datagram *datagrams;
    struct beside beside;
    uint32_t count;
    uint32_t sent, send_errors; /* counters */
    uint32_t id;                /* of its name: in events, and the same in the next program */
    uint32_t follows;           /* 1: the route never commands it */
    uint32_t is_heard, last_seen; /* 1: it may send, and this counter of `heard` in struct timers says when it last did */
    const void *publisher;      /* rcl_publisher_t of the topic, for a gateway's deadman, which has no sender */
    int64_t within;             /* ns in which it obeys a brake; 0 if no message shows that (program.h: struct witness) */
    uint32_t disobeyed;         /* counter: 1 while it does not obey */
    uint32_t stopping;          /* histogram: time from the brake until it obeyed */
};

struct deadman;
struct deferral;

/* The effect of a sent command on a deadman. */
struct feed {
    struct deadman *deadman;
    uint64_t to; /* a bit for each destination that the command arms or disarms, without those that follow */
    struct deferral *const *superseded; /* what holds commands that the command replaces (deferral_supersede) */
    uint32_t superseded_count;
    uint32_t disarms; /* 1: the command is from a route that the deadman hands over to */
};

/* Add a deadman, with its timeout and repetition in ns. Returns NULL if memory runs out. `starts`: it sends at router start.
 * `active` and `trips` are counters, `id` identifies it in events. It is unarmed, and served from now on. When it ends, it
 * sends a last time to the destinations that are armed. Its first member is a struct timer. */
struct deadman *deadman_open(struct timers *timers, int64_t timeout, int64_t repeat, bool starts, uint32_t active,
                             uint32_t trips, uint32_t id, const struct deadman_destination *destinations, uint32_t count);

/* Remove a deadman that no program uses and nothing can feed. */
void deadman_close(struct timers *timers, struct deadman *deadman);

/* Send the datagrams at router start, if the deadman does so. Return a bit for each destination that all of its datagrams
 * have reached. A destination gets them again each second until a command to it arms or disarms it, or until they were sent
 * once more after it was heard: what the kernel accepts may be lost while the destination cannot be reached. One that is
 * never heard gets them until there is a command. */
uint64_t deadman_start(struct timers *timers, struct deadman *deadman, int64_t now);

/* Send, with the lock held, before anything else is sent through a link that has just opened: all deadmen that are armed for its
 * other end, and all that send at router start. */
void deadmen_send_first(struct timers *timers, const struct sender *sender);

/* Like `deadman_start`, for a deadman that publishes. It reaches no subscriber that is not discovered yet, so for some
 * time, and until a command is sent, it publishes to each new subscriber: at once, and again after half a second, because
 * subscriber and publisher do not discover each other at the same time and best effort loses messages in between.
 * `deadman_greet` returns whether it does so. */
void deadman_await_subscribers(struct timers *timers, struct deadman *deadman, int64_t now);
bool deadman_greet(struct timers *timers, struct deadman *deadman, int64_t now);

/* Pass deadline and state of `earlier`, the deadman of the same commands in the previous program, to `next`: what was armed
 * stays armed, by `id`. `earlier` keeps only the destinations (by sender) that `next` does not have, and sends to them when
 * it ends. From now on, feeding `earlier` feeds `next`. Several deadmen may be replaced by one: it trips when the last of
 * their deadlines has passed. */
void deadman_replace(struct timers *timers, struct deadman *next, struct deadman *earlier);

enum { COMMAND_STALE = -1 };

/* Send a command: check that it has not expired (`expires`, boot clock, ns; NEVER: it does not), send it, and feed or
 * disarm the deadmen if that returned no error, all under the lock. Return 0, COMMAND_STALE, or an errno of `sender_send`.
 * If that is about an earlier command (ECONNREFUSED), this one arms what is unarmed, but does not extend a deadline.
 * Without feeds, the lock is not taken. */
int command_send(struct timers *timers, struct sender *sender, const void *data, size_t size, int64_t expires,
                 const struct feed *feeds, uint32_t count);

/* Like `command_send` at the time `now`, for callers that hold the lock if there are feeds. */
int command_send_at(struct timers *timers, struct sender *sender, const void *data, size_t size, int64_t expires,
                    const struct feed *feeds, uint32_t count, int64_t now);

/* Whether the deadman is tripped. May be called without the lock. */
bool deadman_is_tripped(const struct deadman *deadman);

/* A message of the destination `id`, which arrived at `arrived`, shows whether it obeys the deadman. Return whether to
 * report the message as evidence that it does not: at most once a second. Takes the lock. */
bool deadman_is_shown(struct timers *timers, struct deadman *deadman, uint32_t id, bool obeys, int64_t arrived);

/* A message was published at `now` on the only topic of a deadman that publishes. Takes the lock. */
void deadman_feed(struct timers *timers, struct deadman *deadman, int64_t now);

/* Like `timer_end`, but done by the thread that serves the group: an armed or tripped deadman becomes due at once. */
void deadman_end_by_thread(struct timers *timers, struct deadman *deadman);
void deadman_schedule_end(struct timers *timers, struct timer *timer); /* with the lock held */

/* Settle a datagram that an environment's `brake` was to send later: `why` it failed, or NULL. The lock is held. The deadman may
 * be gone. */
void deadman_settle(struct timers *timers, struct timer *timer, const struct deadman_destination *to, const char *why,
                    int64_t now);

/* A command was sent at `now` and returned `refused`: 0, or an errno about an earlier one. The lock is held. */
void command_has_left(struct timers *timers, const struct feed *feeds, uint32_t count, int refused, int64_t now);

#endif
