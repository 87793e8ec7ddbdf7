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

/* What a kind of timer does. All functions are called with the lock held, and may change `due`. */
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
    struct timer *next; /* in the list of its group */
    int64_t due;        /* boot clock, ns; NEVER if it is not */
    bool is_listed;     /* the group has it */
};

/* A group. Its stage says how what is due leaves, and where that is counted. */
struct timers {
    pthread_mutex_t lock;
    struct stage *stage;
    bool has_own_stage;
    bool is_left; /* publishing returned LEFT: nothing of others may be used any more */
    int timer;                /* timerfd, readable when a timer is due */
    int64_t timer_set_for;    /* boot clock, ns; NEVER while it is not set */
    _Atomic int64_t next_due; /* NEVER if nothing is due; may be read without the lock */
    struct timer *first;      /* a linked list */
};

/* Open a group with a stage of its own, that of this computer: it counts in `counters`, and writes to `events`, which may
 * be NULL. Both are written under the lock, and by nobody else. */
struct timers *timers_open(counter *counters, struct ring *events);

/* Open a group that uses a stage of the caller under the lock. Both return NULL for lack of memory or descriptors. */
struct timers *timers_open_on(struct stage *stage);
void timers_close(struct timers *timers); /* when no thread uses it and it has no timer left */

/* Serve the timers that are due, and set the timerfd for the next one. `now` is of the boot clock. */
void timers_serve(struct timers *timers, int64_t now);

/* Serve a timer from now on, or no longer. To be called with the lock held; may be called again. */
void timers_add(struct timers *timers, struct timer *timer);
void timers_remove(struct timers *timers, struct timer *timer);

/* Likewise, once `due` of a timer has changed. */
void timers_note_due(struct timers *timers);

/* Set the timerfd for the next timer, once those that are due were served. The lock is held. */
void timers_await_next(struct timers *timers);
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
