/* Threads: how they start, and how those publish and end that may be stuck in the middleware. */
#ifndef THREADS_H
#define THREADS_H

#include <pthread.h>
#include <stdatomic.h>
#include <stdbool.h>
#include <stdint.h>
#include <time.h>

#include "output.h"
#include "rcl_types.h"

/* Start a thread that gets no signals: those are Python's. Return 0, or an errno. */
int thread_start(pthread_t *thread, const char *name, void *(*run)(void *), void *argument);

/* Open a condition that is waited for by the monotonic clock: until `patience`, the longest wait for a thread that may be
 * stuck in the middleware. */
void condition_open(pthread_cond_t *condition);
struct timespec patience(void);

/* Wait for a thread that is to end: with `lock` held, it sets `has_ended` and signals `changed`. If that takes more than a
 * second, it is stuck, and abandoned: `is_abandoned` is set, and it uses nothing of others from then on. Return whether it has
 * ended. */
bool thread_end(pthread_t thread, pthread_mutex_t *lock, pthread_cond_t *changed, const bool *has_ended, bool *is_abandoned);

/* Of a thread that publishes: */
struct publishing {
    publish_function *publish;
    error_function *error;
    reset_function *reset;
    _Atomic int64_t since;  /* when it entered the middleware, monotonic; 0 while it is not there */
    _Atomic uint32_t topic; /* where it did, as in events */
    struct error_text why;  /* the last publication failed */
};

/* Publish a message, with `lock` released meanwhile. Return NULL, or why it failed, which is valid until the next call. */
const char *publish_unlocked(struct publishing *by, pthread_mutex_t *lock, const void *publisher, uint32_t topic,
                             const struct output *message);

/* The topic in whose publisher the thread is now, and since when (monotonic); 0 if in none. */
int64_t publishing_since(struct publishing *by, uint32_t *topic);

#endif
