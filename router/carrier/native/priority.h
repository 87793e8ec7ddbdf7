/* Scheduling of threads that wake up. Most are to run at once, in place of a thread that computes: they compute little. */
#ifndef PRIORITY_H
#define PRIORITY_H

#include <stdbool.h>
#include <stdint.h>

/* How much of the processor a thread uses. At first, both flags are what `run_first` returned, and the rest is 0. */
struct share {
    bool may_be_first, is_first;
    int64_t began, used; /* when its turn began, and its time on the processor until then; ns */
};

/* Give the calling thread the least real-time priority, so that no other program delays it, and return true. Where it may
 * not have it, ask for the shortest slices: it waits less then, which is some 0.5 ms while Python or a neighbour computes. */
bool run_first(void);

/* Ask for the shortest slices only: for a thread that may block or compute, but should not wait for others for long. */
void run_soon(void);

/* Have the usual policy, also where Python has passed on another one: for a thread that is woken by one that holds a lock
 * which it needs. In front of that thread it would wait for the lock: two switches more for each message. */
void run_in_turn(void);

/* Take the priority from the calling thread for a turn of 100 ms after one of which it used three quarters: a flood would
 * leave others next to nothing of its processor core. `now` is of the boot clock. */
void share_processor(struct share *share, int64_t now);

#endif
