/* Timers: what acts at a deadline, such as a deadman. Those that a thread serves form a group, which has one lock.
 *
 * Commands that feed deadmen and the datagrams of deadmen leave under the lock of their group, so that no command leaves
 * behind the brake that replaces it. The lock is never held while waiting for anything: sockets do not block, and no
 * thread that holds it needs the interpreter. */
#ifndef TIMERS_H
#define TIMERS_H

#include <pthread.h>
#include <stdatomic.h>
#include <stdbool.h>
#include <stdint.h>

#include "counters.h"
#include "ring.h"

#define NEVER INT64_MAX

struct stage;
struct target;
struct targets;
struct timer;
struct timers;

/* What a kind of timer does. All functions are called with the lock held. */
struct timer_kind {
    /* Act: it is due at `now` (boot clock, ns). */
    void (*serve)(struct timers *timers, struct timer *timer, int64_t now);
    /* After a reload: what it holds is delivered by this target of the next program; the same for the first program. It is
     * served from then on. NULL for a deadman. */
    void (*adopt)(struct timers *timers, struct timer *timer, const struct targets *to, const struct target *target);
    /* Settle what it holds, and be due never again. What is offered to it afterwards is not held. */
    void (*end)(struct timers *timers, struct timer *timer, int64_t now);
};

/* The first member of each kind of timer. */
struct timer {
    const struct timer_kind *kind;
    struct timer *next, *previous; /* in the list of its group */
    bool is_listed;
    int64_t due; /* boot clock, ns; NEVER if it is not. Changed by `timer_set_due` */
};

/* A group. Its stage says how what is due leaves, and where that is counted. */
struct timers {
    pthread_mutex_t lock;
    struct stage *stage;
    bool has_own_stage;
    bool is_abandoned; /* publishing returned ABANDONED: nothing of others may be used any more */
    int timer;    /* timerfd, readable from `wakes_at` on; -1 if the thread of the group waits for that without it */
    /* Nothing is due before (boot clock, ns); NEVER while nothing is due at all. May be read without the lock. It is put off
     * only when timers are served: a command that puts off a deadline costs the same however many timers there are. */
    _Atomic int64_t wakes_at;
    struct timer *first, *last; /* a list, the newest first: deferrals are served before the pacer that they pass messages to */
};

/* Open a group with a stage of its own, that of this computer: it counts in `counters`, and writes to `events`, which may
 * be NULL. Both are written under the lock, and by nobody else. */
struct timers *timers_open(counter *counters, struct ring *events);

/* Open a group that uses a stage of the caller under the lock, with a timerfd or without. Both return NULL for lack of memory
 * or descriptors. */
struct timers *timers_open_on(struct stage *stage, bool has_timer);
void timers_close(struct timers *timers); /* when no thread uses it and it has no timer left */

/* Serve the timers that are due, and find out when the next one is. `now` is of the boot clock. */
void timers_serve(struct timers *timers, int64_t now);

/* ---- with the lock held ---- */

/* Serve a timer from now on, or no longer. May be called again. */
void timers_add(struct timers *timers, struct timer *timer);
void timers_remove(struct timers *timers, struct timer *timer);

/* Have a timer be due then, or no more (NEVER). */
void timer_set_due(struct timers *timers, struct timer *timer, int64_t due);

/* Find out when the next timer is due, once those that are due were served. */
void timers_await_next(struct timers *timers);

/* ---- without it ---- */

/* What a reload changes in a group, between two messages: what the timers of the next program deliver to, and those that
 * only the earlier one has. Of the first program: what its timers deliver to. */
struct adoption {
    struct timer *timer;
    const struct targets *to;
    const struct target *target; /* NULL: all of them */
};
struct timer_change {
    const struct adoption *adopted;
    struct timer *const *ended;
    uint32_t adopted_count, ended_count;
};
void timers_change(struct timers *timers, const struct timer_change *change);

/* `end` of a timer; and of all, deadmen last, as what leaves then may feed them. */
void timer_end(struct timers *timers, struct timer *timer);
void timers_end(struct timers *timers);

#endif
