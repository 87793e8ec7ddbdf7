/* Deadmen: send a ready datagram in place of a route's commands when these stop coming.
 *
 * Commands and the datagrams of deadmen leave under one lock, so that no command leaves behind the brake that replaces
 * it. The lock is never held while waiting for anything: sockets do not block, and no thread that holds it needs the
 * interpreter. The state machine is described in engine/deadman.py; both have to give the same answers. */
#ifndef DEADMAN_H
#define DEADMAN_H

#include <pthread.h>
#include <stdatomic.h>
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "counters.h"
#include "events.h"
#include "ring.h"
#include "sender.h"

#define NEVER INT64_MAX

struct deadman_destination {
    struct sender *sender;
    const uint8_t *datagram; /* as are the lists of destinations: copied by `deadman_open` */
    uint32_t size;
    uint32_t sent, send_errors; /* counters */
    uint32_t id;                /* in events */
};

struct deadman;

/* All deadmen of the router, their lock, their counters, and the timer that the timer thread waits for. */
struct deadmen {
    pthread_mutex_t lock;
    counter *counters;
    struct ring *events;       /* of struct deadman_event, written under the lock; may be NULL */
    int timer;                 /* timerfd, readable when a deadman is due */
    int64_t timer_set_for;     /* boot clock, ns; NEVER while it is not set */
    _Atomic int64_t next_due;  /* NEVER if nothing is due; may be read without the lock */
    struct deadman *first;     /* a linked list */
};

/* What a command does to a deadman once it is sent. */
struct feed {
    struct deadman *deadman;
    uint32_t disarms; /* 1: the command is of a route that the deadman hands over to */
    uint32_t reserved;
};

/* Both are written under the lock, and by nobody else. Return NULL for lack of memory or descriptors. */
struct deadmen *deadmen_open(counter *counters, struct ring *events);
void deadmen_close(struct deadmen *deadmen); /* when no thread uses it and it has no deadman left */

/* Add a deadman, with its timeout and repetition in ns. Returns NULL for lack of memory. `starts`: it sends when the router
 * starts. `active` and `trips` are counters, `id` stands for it in events. It is unarmed, and served from now on. */
struct deadman *deadman_open(struct deadmen *deadmen, int64_t timeout, int64_t repeat, bool starts, uint32_t active,
                             uint32_t trips, uint32_t id, const struct deadman_destination *destinations, uint32_t count);

/* Remove a deadman that no program refers to, and nothing that may still feed it. */
void deadman_close(struct deadmen *deadmen, struct deadman *deadman);

/* Send the datagrams when the router starts, if it does so. Return a bit for each of the first 64 destinations reached.
 * While one of the datagrams does not leave, all are sent again each second, until a command feeds or disarms it. */
uint64_t deadman_start(struct deadmen *deadmen, struct deadman *deadman, int64_t now);

/* Have `next` take over deadline and state of `earlier`, the deadman of the same route in the previous program.
 * `earlier` keeps only the destinations (by sender) that `next` does not have, and sends to them when it ends. Feeds of
 * `earlier` act on `next` from now on. */
void deadman_replace(struct deadmen *deadmen, struct deadman *next, struct deadman *earlier);

/* Send a last time if armed or tripped; nothing is due any more. */
void deadman_end(struct deadmen *deadmen, struct deadman *deadman);

/* Serve the deadmen that are due, and set the timer for the next one. `now` is of the boot clock. */
void deadmen_serve(struct deadmen *deadmen, int64_t now);

enum { COMMAND_STALE = -1 };

/* Send a command: check that it has not expired (`expires`, boot clock, ns; NEVER: it does not), send it, and feed or
 * disarm the deadmen if that returned no error, all under the lock. Return 0, COMMAND_STALE, or an errno of
 * `sender_send`. If that is about an earlier command (ECONNREFUSED), this one arms its deadman where it is unarmed, but
 * puts off no deadline. Without feeds the lock is not taken. */
int command_send(struct deadmen *deadmen, struct sender *sender, const void *data, size_t size, int64_t expires,
                 const struct feed *feeds, uint32_t count);

/* As `command_send` at the time `now`, for callers that hold the lock if there are feeds. */
int command_send_at(struct deadmen *deadmen, struct sender *sender, const void *data, size_t size, int64_t expires,
                    const struct feed *feeds, uint32_t count, int64_t now);

#endif
