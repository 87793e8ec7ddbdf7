#include "publish.h"

#include <pthread.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

#include "clock.h"
#include "priority.h"
#include "route.h"
#include "threads.h"

/* A message that waits until it is due. */
struct held {
    struct held *next;
    const struct targets *to;
    const struct target *target;
    struct output message;
};

struct publish_thread {
    struct thread_env env; /* first: its functions get a pointer to it */
    pthread_t thread;
    pthread_mutex_t lock; /* held by the thread, except while it waits or is in the middleware */
    pthread_cond_t changed;
    bool has_ended, is_abandoned; /* under the lock */
    struct publish_change *changes; /* likewise: those not reached yet, in order */
    _Atomic bool is_stopping;
    _Atomic uint32_t latest; /* generation */
    /* Written by the thread: */
    edition edition;             /* of the counters */
    _Atomic uint32_t generation; /* nothing of an earlier one is in use */
    struct publishing publishing;
    /* For the thread: */
    struct held *held, *spare;
    struct ring *ring;
    struct {
        struct reply_event event;
        uint8_t message[MAX_DATAGRAM + 8];
    } reply;
    _Alignas(8) uint8_t records[2 * sizeof(struct message_record) + MAX_DATAGRAM + 8];
};

/* ---- the middleware ---- */

static void exchange(struct output *one, struct output *other) {
    struct output kept = *one;
    *one = *other;
    *other = kept;
}

/* Hold a message until it is due, instead of an older one. Return false if memory runs out. */
static bool hold(struct publish_thread *thread, const struct targets *to, const struct target *target) {
    struct demand *demand = target->topic->demand;
    struct held *held = demand->held;
    if (held) {
        __atomic_add_fetch(&demand->replaced, 1, __ATOMIC_RELAXED);
    } else {
        held = thread->spare ? thread->spare : calloc(1, sizeof *held);
        if (!held) return false;
        if (held == thread->spare) thread->spare = held->next;
        held->next = thread->held;
        thread->held = demand->held = held;
    }
    held->to = to;
    held->target = target;
    exchange(&held->message, &thread->env.machine.output);
    return true;
}

/* Publish a held message, without the lock. */
static void release(struct publish_thread *thread, struct held *held) {
    struct thread_env *env = &thread->env;
    const struct target *target = held->target;
    const char *why = publish_unlocked(&thread->publishing, &thread->lock, target->topic->publisher, target->id, &held->message);
    if (thread->is_abandoned) return;
    if (why) { /* it was counted when it was held */
        edition_begin(&thread->edition);
        env_count(env, target->delivered, -1);
        lose_message(env, held->to, target, env->now(env), (struct lost_event){.reason = DROP_PUBLISH_ERROR}, why);
        edition_end(&thread->edition);
    }
    __atomic_store_n(&target->topic->demand->is_due, 0, __ATOMIC_RELEASE);
}

/* Publish the held messages that are due, or all. */
static void release_due(struct publish_thread *thread, bool all) {
    for (struct held **at = &thread->held; *at && !thread->is_abandoned;) {
        struct held *held = *at;
        struct demand *demand = held->target->topic->demand;
        if (all || __atomic_load_n(&demand->is_due, __ATOMIC_ACQUIRE)) {
            *at = held->next;
            demand->held = NULL;
            release(thread, held);
            held->next = thread->spare;
            thread->spare = held;
        } else {
            at = &held->next;
        }
    }
}

/* Forget what is held of a topic, because a newer message is published. */
static void supersede(struct publish_thread *thread, struct demand *demand) {
    struct held **at = &thread->held, *held = demand->held;
    while (*at != held) at = &(*at)->next;
    *at = held->next;
    held->next = thread->spare;
    thread->spare = held;
    demand->held = NULL;
    __atomic_add_fetch(&demand->replaced, 1, __ATOMIC_RELAXED);
}

/* Give a reply to Python. The message of a service is its response, after a number. */
static enum publication hand_over(struct publish_thread *thread, const struct target *target, const char **why) {
    const struct output *message = &thread->env.machine.output;
    struct reply_event *event = &thread->reply.event;
    if (message->size > MAX_DATAGRAM) {
        *why = "the response is too long";
        return PUBLISH_FAILED;
    }
    *event = (struct reply_event){.size = padded_to_word(sizeof *event + message->size), .kind = EVENT_REPLY,
                                  .target = target->id, .length = (uint32_t)message->size};
    memcpy(thread->reply.message, message->data, message->size);
    if (ring_put(thread->env.reporter.events, event, event->size)) return PUBLISHED;
    *why = "the router is too slow to answer the calls";
    return PUBLISH_FAILED;
}

/* Publish the written message, without the lock. The counters balance meanwhile, as the message counts as waiting. */
static enum publication publish_written(struct thread_env *env, const struct targets *to, const struct target *target,
                                        const char **why) {
    struct publish_thread *thread = (struct publish_thread *)env;
    struct demand *demand = target->topic->demand;
    uint8_t wanted = wanted_of(target->topic);
    if (wanted > EVERY_MESSAGE) {
        if (wanted == EVERY_REPLY) return hand_over(thread, target, why);
        if (hold(thread, to, target)) return PUBLISHED;
    }
    if (demand->held) supersede(thread, demand);
    edition_end(&thread->edition);
    *why = publish_unlocked(&thread->publishing, &thread->lock, target->topic->publisher, target->id, &env->machine.output);
    edition_begin(&thread->edition);
    return thread->is_abandoned ? ABANDONED : *why ? PUBLISH_FAILED : PUBLISHED;
}

/* ---- the thread ---- */

/* How long to wait for messages, in ns: until the next timer is due, or forever (-1). */
static int64_t patience_of(const struct publish_thread *thread) {
    int64_t due = atomic_load_explicit(&thread->env.timers->wakes_at, memory_order_relaxed);
    if (due == NEVER) return -1;
    int64_t wait = due - boottime_ns();
    return wait > 0 ? wait : 0;
}

/* Take messages, without the lock. Return their size in bytes. */
static size_t take(struct publish_thread *thread, bool waits) {
    int64_t timeout = waits ? patience_of(thread) : 0;
    pthread_mutex_unlock(&thread->lock);
    size_t size = ring_take(thread->ring, thread->records, sizeof thread->records, timeout);
    pthread_mutex_lock(&thread->lock);
    return size;
}

static void serve_timers(struct publish_thread *thread) {
    int64_t due = atomic_load_explicit(&thread->env.timers->wakes_at, memory_order_relaxed);
    if (due == NEVER) return;
    int64_t now = thread->env.now(&thread->env);
    if (now < due) return;
    edition_begin(&thread->edition);
    timers_serve(thread->env.timers, now);
    edition_end(&thread->edition);
}

/* Go on to a generation, unless it was reached. */
static void reach(struct publish_thread *thread, uint32_t generation) {
    if (generation <= atomic_load(&thread->generation)) return;
    release_due(thread, true); /* their targets belong to the generation */
    while (!thread->is_abandoned && thread->changes && thread->changes->generation <= generation) {
        const struct publish_change *change = thread->changes;
        thread->changes = change->next;
        edition_begin(&thread->edition);
        timers_change(thread->env.timers, &change->timers);
        edition_end(&thread->edition);
    }
    atomic_store(&thread->generation, generation);
}

/* Handle the taken messages. Return false if the thread was abandoned meanwhile. */
static bool serve_all(struct publish_thread *thread, size_t size) {
    for (size_t at = 0; at < size;) {
        const struct message_record *record = (const struct message_record *)(thread->records + at);
        reach(thread, record->generation);
        if (thread->is_abandoned) return false;
        edition_begin(&thread->edition);
        bool goes_on = route_to_topics(&thread->env, record);
        edition_end(&thread->edition);
        if (!goes_on) return false;
        serve_timers(thread);
        if (thread->is_abandoned) return false;
        at += record->size;
    }
    return true;
}

/* Settle the timers, and publish what they and others hold. */
static void end_timers(struct publish_thread *thread) {
    edition_begin(&thread->edition);
    timers_end(thread->env.timers);
    edition_end(&thread->edition);
    release_due(thread, true);
}

static void *run(void *of) {
    struct publish_thread *thread = of;
    run_soon();
    pthread_mutex_lock(&thread->lock);
    for (;;) {
        /* Read this before the ring: present messages are handled, and later ones have at least this generation. */
        uint32_t latest = atomic_load(&thread->latest);
        bool is_stopping = atomic_load(&thread->is_stopping);
        size_t size = take(thread, !is_stopping && latest <= atomic_load(&thread->generation));
        if (thread->is_abandoned || !serve_all(thread, size) || (is_stopping && !size)) break;
        if (!size) reach(thread, latest);
        if (!thread->is_abandoned) serve_timers(thread);
        if (ring_is_empty(thread->ring)) release_due(thread, false);
        if (thread->is_abandoned) break;
    }
    if (!thread->is_abandoned) end_timers(thread);
    thread->has_ended = true;
    pthread_cond_broadcast(&thread->changed);
    pthread_mutex_unlock(&thread->lock);
    return NULL;
}

/* ---- public ---- */

/* Free a thread that is not running. */
static void publish_close(struct publish_thread *thread) {
    pthread_cond_destroy(&thread->changed);
    pthread_mutex_destroy(&thread->lock);
    if (thread->env.timers) timers_close(thread->env.timers);
    for (struct held *held; (held = thread->spare);) {
        thread->spare = held->next;
        free(held->message.data);
        free(held);
    }
    env_close(&thread->env);
    free(thread);
}

/* Prepare everything but the thread itself. Returns NULL if memory runs out. */
static struct publish_thread *publish_prepare(struct ring *ring, counter *counters, struct ring *events,
                                              publish_function *publish, error_function *error, reset_function *reset,
                                              struct publish_change *first) {
    struct publish_thread *thread = calloc(1, sizeof *thread);
    if (!thread) return NULL;
    thread->ring = ring;
    thread->changes = first;
    thread->publishing.publish = publish;
    thread->publishing.error = error;
    thread->publishing.reset = reset;
    pthread_mutex_init(&thread->lock, NULL);
    condition_open(&thread->changed);
    bool is_open = env_open(&thread->env, counters, events, NULL);
    thread->env.publish = publish_written;
    thread->env.timers = timers_open_on(&thread->env, false);
    if (is_open && thread->env.timers) return thread;
    publish_close(thread);
    return NULL;
}

struct publish_thread *publish_open(struct ring *ring, counter *counters, struct ring *events, publish_function *publish,
                                    error_function *error, reset_function *reset, struct publish_change *first) {
    struct publish_thread *thread = publish_prepare(ring, counters, events, publish, error, reset, first);
    if (!thread || !thread_start(&thread->thread, "publish", run, thread)) return thread;
    publish_close(thread);
    return NULL;
}

void publish_change(struct publish_thread *thread, struct publish_change *change) {
    change->next = NULL;
    pthread_mutex_lock(&thread->lock);
    struct publish_change **last = &thread->changes;
    while (*last) last = &(*last)->next;
    *last = change;
    pthread_mutex_unlock(&thread->lock);
}

void publish_advance(struct publish_thread *thread, uint32_t generation) {
    atomic_store(&thread->latest, generation);
    ring_wake(thread->ring);
}

bool publish_has_reached(struct publish_thread *thread, uint32_t generation) {
    return atomic_load(&thread->generation) >= generation;
}

int64_t publish_since(struct publish_thread *thread, uint32_t *topic) {
    return publishing_since(&thread->publishing, topic);
}

bool publish_stop(struct publish_thread *thread) {
    atomic_store(&thread->is_stopping, true);
    ring_wake(thread->ring);
    if (!thread_end(thread->thread, &thread->lock, &thread->changed, &thread->has_ended, &thread->is_abandoned)) return false;
    publish_close(thread);
    return true;
}

bool publish_counters(struct publish_thread *thread, int64_t *to, uint32_t count) {
    return counters_copy(&thread->edition, thread->env.counters, to, count);
}
