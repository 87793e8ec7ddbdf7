#include "threads.h"

#include <signal.h>

#include "clock.h"

int thread_start(pthread_t *thread, const char *name, void *(*run)(void *), void *argument) {
    sigset_t all, usual;
    sigfillset(&all);
    pthread_sigmask(SIG_SETMASK, &all, &usual);
    int error = pthread_create(thread, NULL, run, argument);
    pthread_sigmask(SIG_SETMASK, &usual, NULL);
    if (!error) pthread_setname_np(*thread, name);
    return error;
}

static const int64_t PATIENCE = 1000000000;

struct timespec patience(void) {
    int64_t until = monotonic_ns() + PATIENCE;
    return (struct timespec){until / 1000000000, until % 1000000000};
}

void condition_open(pthread_cond_t *condition) {
    pthread_condattr_t attributes;
    pthread_condattr_init(&attributes);
    pthread_condattr_setclock(&attributes, CLOCK_MONOTONIC);
    pthread_cond_init(condition, &attributes);
    pthread_condattr_destroy(&attributes);
}

bool thread_end(pthread_t thread, pthread_mutex_t *lock, pthread_cond_t *changed, const bool *has_ended, bool *is_abandoned) {
    struct timespec until = patience();
    pthread_mutex_lock(lock);
    while (!*has_ended && !pthread_cond_timedwait(changed, lock, &until)) {}
    bool ended = *has_ended;
    *is_abandoned = !ended;
    pthread_mutex_unlock(lock);
    if (ended) pthread_join(thread, NULL);
    else pthread_detach(thread);
    return ended;
}

const char *publish_unlocked(struct publishing *by, pthread_mutex_t *lock, const void *publisher, uint32_t topic,
                             const struct output *message) {
    struct serialized_message serialized = {message->data, message->size, message->capacity, ALLOCATOR};
    atomic_store_explicit(&by->topic, topic, memory_order_relaxed);
    atomic_store_explicit(&by->since, monotonic_ns(), memory_order_release);
    pthread_mutex_unlock(lock);
    int error = by->publish(publisher, &serialized, NULL);
    if (error) {
        by->why = by->error();
        by->reset();
    }
    pthread_mutex_lock(lock);
    atomic_store_explicit(&by->since, 0, memory_order_relaxed);
    return error ? by->why.text : NULL;
}

int64_t publishing_since(struct publishing *by, uint32_t *topic) {
    int64_t since = atomic_load_explicit(&by->since, memory_order_acquire);
    *topic = atomic_load_explicit(&by->topic, memory_order_relaxed);
    return since;
}
