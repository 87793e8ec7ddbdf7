/* Starts threads. Publishes from threads that may be stuck in the middleware, and ends such threads. */
#ifndef THREADS_H
#define THREADS_H

#include <pthread.h>
#include <stdatomic.h>
#include <stdbool.h>
#include <stdint.h>
#include <time.h>

#include "output.h"
#include "rcl_types.h"

/* Start a thread that receives no signals, which Python handles. Return 0, or an errno. */
int thread_start(pthread_t *thread, const char *name, void *(*run)(void *), void *argument);

/* Open a condition variable with the monotonic clock. `patience` is the end of the longest wait for a thread that may be
 * stuck in the middleware. */
void condition_open(pthread_cond_t *condition);
struct timespec patience(void);

/* Wait for a thread to end: with `lock` held, it sets `has_ended` and signals `changed`. If that takes more than a second,
 * the thread is stuck: `is_abandoned` is set, after which it uses nothing that belongs to others. Return whether it
 * has ended. */
bool thread_end(pthread_t thread, pthread_mutex_t *lock, pthread_cond_t *changed, const bool *has_ended, bool *is_abandoned);

/* The state of a thread that publishes: */
struct publishing {
    publish_function *publish;
    error_function *error;
    reset_function *reset;
    _Atomic int64_t since;  /* when it entered the middleware, monotonic; 0 while outside */
    _Atomic uint32_t topic; /* the topic then, as in events */
    struct error_text why;  /* the error of the last failed publication */
};

/* Publish a message, with `lock` released meanwhile. Return NULL, or the error, which is valid until the next call. */
const char *publish_unlocked(struct publishing *by, pthread_mutex_t *lock, const void *publisher, uint32_t topic,
                             const struct output *message);

/* The topic on which the thread is publishing now, and since when (monotonic); 0 if there is none. */
int64_t publishing_since(struct publishing *by, uint32_t *topic);

#endif
