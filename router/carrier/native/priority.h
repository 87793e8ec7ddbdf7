/* Scheduling of threads. Most compute little, and should preempt a computing thread as soon as they wake up. */
#ifndef PRIORITY_H
#define PRIORITY_H

#include <stdbool.h>
#include <stdint.h>

/* A thread's use of the processor. Initially, both flags are the result of `run_first`, and the rest is 0. */
struct share {
    bool may_be_first, is_first;
    int64_t began, used; /* when its turn began, and its processor time until then, in ns */
};

/* Give the calling thread the lowest real-time priority, so that no other program delays it, and return true. Without the
 * permission, request the shortest slices, to reduce delays, which are some 0.5 ms while Python or another program computes. */
bool run_first(void);

/* Request only the shortest slices: for a thread that may block or compute, but should not wait long for others. */
void run_soon(void);

/* Set the default policy, even if the thread inherits another one from Python. For a thread whose lock is held by the thread
 * that wakes it: if it preempted that thread, it would wait for the lock, which costs two more switches per message. */
void run_in_turn(void);

/* After a turn of 100 ms of which the calling thread used three quarters, remove its priority for one turn: in a flood, it
 * would leave other threads almost nothing of its processor core. `now` is on the boot clock. */
void share_processor(struct share *share, int64_t now);

#endif
