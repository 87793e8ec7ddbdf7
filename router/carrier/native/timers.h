/* Timers act at a deadline: deadmen, for example. The timers that a thread serves form a group with one lock.
 *
 * Commands that feed deadmen and the datagrams of deadmen are sent under the lock of their group, so that no command is sent
 * after the brake that replaces it. The lock is never held while waiting for anything: sockets do not block, and no thread
 * that holds it needs the interpreter. */
#ifndef TIMERS_H
#define TIMERS_H

#include <pthread.h>
#include <stdatomic.h>
#include <stdbool.h>
#include <stdint.h>

#include "actions.h"
#include "counters.h"
#include "ring.h"

#define NEVER INT64_MAX

struct thread_env;
struct target;
struct targets;
struct timer;
struct timers;

/* The functions of a kind of timer. All are called with the lock held. */
struct timer_kind {
    /* Act: the timer is due at `now` (boot clock, ns). */
    void (*serve)(struct timers *timers, struct timer *timer, int64_t now);
    /* At the start and after a reload: deliver the held messages to this target of the program, and serve the timer from
     * then on. NULL for a deadman. */
    void (*adopt)(struct timers *timers, struct timer *timer, const struct targets *to, const struct target *target);
    /* Settle the messages that the timer holds; it is never due again, and holds no later messages. */
    void (*end)(struct timers *timers, struct timer *timer, int64_t now);
};

/* The first member of each kind of timer. */
struct timer {
    const struct timer_kind *kind;
    struct timer *next, *previous; /* in the list of its group */
    bool is_listed;
    int64_t due; /* boot clock, ns, or NEVER. Changed by `timer_set_due` */
};

/* A group. Its environment sends and counts the messages of the timers. */
struct timers {
    pthread_mutex_t lock;
    struct thread_env *env;
    bool has_own_env;
    int64_t arrived;   /* when the message that is being delivered arrived, if it was held or queued; otherwise NEVER */
    bool is_abandoned; /* publishing returned ABANDONED: use nothing that belongs to others */
    const counter *heard; /* of the thread that receives: when endpoints were heard; NULL if none does */
    int timer;    /* timerfd, readable from `wakes_at` on; -1 if the thread of the group waits without it */
    /* Nothing is due before this time (boot clock, ns); NEVER if nothing is due at all. May be read without the lock. It moves
     * back only when timers are served, so the cost of a command that extends a deadline is independent of other timers. */
    _Atomic int64_t wakes_at;
    _Atomic(struct actions *) actions; /* of all threads that use the group, while they are observed; else NULL */
    struct timer *first, *last; /* newest first: deferrals are served before the pacer that gets their messages */
};

/* Open a group with an environment of its own, for this computer. It counts in `counters` and writes to `events`, which may be
 * NULL, under the lock and as the only writer. */
struct timers *timers_open(counter *counters, struct ring *events);

/* Open a group that uses an environment of the caller under the lock, with a timerfd or without. Both return NULL if memory or
 * descriptors run out. */
struct timers *timers_open_on(struct thread_env *env, bool has_timer);
void timers_close(struct timers *timers); /* when no thread uses it and it has no timer left */

/* Note the actions of the threads that use the group from now on; NULL stops that. Takes no lock. */
void timers_observe(struct timers *timers, struct actions *actions);

/* Open a lock with priority inheritance. Return 0 or an errno. */
int lock_open(pthread_mutex_t *lock);

/* Serve the timers that are due, and determine when the next one is. `now` is on the boot clock. */
void timers_serve(struct timers *timers, int64_t now);

/* ---- with the lock held ---- */

/* Start and stop serving a timer. Both may be called repeatedly. */
void timers_add(struct timers *timers, struct timer *timer);
void timers_remove(struct timers *timers, struct timer *timer);

/* Set the time at which a timer is due; NEVER if it is not. */
void timer_set_due(struct timers *timers, struct timer *timer, int64_t due);

/* Determine when the next timer is due. Call it after serving the timers that are due. */
void timers_await_next(struct timers *timers);

/* ---- without it ---- */

/* The changes of a reload to a group, made between two messages: the targets of the next program's timers, and the timers
 * that only the earlier program has. For the first program: the targets of its timers. */
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

/* End a timer; end all, deadmen last, because messages sent at the end may feed them. */
void timer_end(struct timers *timers, struct timer *timer);
void timers_end(struct timers *timers);

#endif
