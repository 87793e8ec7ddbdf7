#include "from_ros.h"

#include <errno.h>
#include <pthread.h>
#include <stdlib.h>
#include <string.h>
#include <sys/epoll.h>
#include <sys/eventfd.h>
#include <unistd.h>

#include "clock.h"
#include "priority.h"
#include "threads.h"

enum {
    TURN = 32, /* messages of one topic before other topics are served */
    TOPICS_PER_WAIT = 16,
    LOOK_MS = 250, /* the longest time between two comparisons of the clocks */
};

struct from_ros {
    pthread_t thread;
    pthread_mutex_t lock; /* held by the thread, except while it waits or is in the middleware */
    pthread_cond_t changed;
    /* Under the lock: */
    const struct ros_set *current, *offered;
    bool is_stopping, has_ended, is_abandoned;
    /* Written by the thread: */
    edition edition; /* of the counters */
    _Atomic uint64_t failures;
    /* For the thread: */
    take_function *take;
    reset_function *reset;
    int epoll, wake;
    bool is_urgent;
    struct serialized_message message;
    struct ros_routing routing; /* last, as it is large */
};

/* ---- messages ---- */

static void serve_message(struct from_ros *thread, const struct ros_topic *topic, const struct message_info *info) {
    struct taken taken = {.data = thread->message.buffer, .size = thread->message.length};
    taken.now = boottime_ns();
    taken.received_at = wall_ns();
    taken.published_at = info->source_timestamp;
    taken.arrived_at = info->received_timestamp;
    taken.publisher = find_publisher(&thread->routing, info->publisher, topic->routes[0].targets.topic);
    if (is_new(taken.publisher, info->publication_sequence_number)) route_ros_message(&thread->routing, topic, &taken);
}

/* ---- the middleware ---- */

/* Take a message, without the lock, and handle it. Return whether there was one. */
static bool serve_one(struct from_ros *thread, const struct ros_topic *topic) {
    struct message_info info = {0};
    const void *subscription = topic->subscription; /* the topic may be freed when an abandoned thread returns */
    pthread_mutex_unlock(&thread->lock);
    int error = thread->take(subscription, &thread->message, &info, NULL);
    bool has_failed = error && error != TAKE_FAILED;
    if (has_failed) {
        thread->reset();
        atomic_fetch_add_explicit(&thread->failures, 1, memory_order_relaxed);
    }
    pthread_mutex_lock(&thread->lock);
    if (error || thread->is_abandoned) return false;
    edition_begin(&thread->edition);
    serve_message(thread, topic, &info);
    edition_end(&thread->edition);
    return true;
}

/* ---- the thread ---- */

static bool has_subscription(const struct ros_set *set, const void *subscription) {
    for (uint32_t index = 0; index < set->count; index++)
        if (set->topics[index].subscription == subscription) return true;
    return false;
}

/* Handle the messages that have arrived on the subscriptions of `set` which `next` does not have; `next` is NULL for none,
 * and may be withdrawn meanwhile. */
static void serve_rest(struct from_ros *thread, const struct ros_set *set, const struct ros_set *next) {
    for (uint32_t index = 0; set && !thread->is_abandoned && index < set->count; index++) {
        const struct ros_topic *topic = &set->topics[index];
        if (next && thread->offered != next) return;
        if (next && has_subscription(next, topic->subscription)) continue;
        for (uint32_t left = topic->capacity; left && serve_one(thread, topic); left--) {}
    }
}

/* Switch to another set if there is one. Return whether there was. */
static bool adopt(struct from_ros *thread) {
    const struct ros_set *next = thread->offered;
    if (!next) return false;
    serve_rest(thread, thread->current, next);
    if (thread->offered != next) return true; /* it was withdrawn */
    thread->current = next;
    thread->offered = NULL;
    for (uint32_t index = 0; index < next->count; index++)
        eventfd_write(next->topics[index].eventfd, 1); /* for messages that arrived earlier */
    pthread_cond_broadcast(&thread->changed);
    return true;
}

/* Whether the thread may go on with its set. */
static bool goes_on(struct from_ros *thread) {
    return !thread->is_abandoned && !thread->is_stopping && !adopt(thread);
}

static const struct ros_topic *find_topic(const struct ros_set *set, int eventfd) {
    for (uint32_t index = 0; set && index < set->count; index++)
        if (set->topics[index].eventfd == eventfd) return &set->topics[index];
    return NULL;
}

/* Handle up to TURN messages. Return false if the set has changed or the thread is to end. */
static bool serve_turn(struct from_ros *thread, const struct ros_topic *topic) {
    for (int left = TURN; left; left--) {
        bool was_one = serve_one(thread, topic);
        if (!goes_on(thread)) return false;
        if (!was_one) return true;
    }
    eventfd_write(topic->eventfd, 1); /* the next wait returns it again */
    return true;
}

static void serve_arrivals(struct from_ros *thread) {
    struct epoll_event ready[TOPICS_PER_WAIT];
    pthread_mutex_unlock(&thread->lock);
    int count = epoll_wait(thread->epoll, ready, TOPICS_PER_WAIT, LOOK_MS);
    pthread_mutex_lock(&thread->lock);
    int64_t now = boottime_ns();
    freshness_look(&thread->routing.freshness, wall_ns(), now);
    if (!goes_on(thread)) return;
    for (int index = 0; index < count; index++) {
        const struct ros_topic *topic = find_topic(thread->current, ready[index].data.fd);
        if (topic && !serve_turn(thread, topic)) return;
    }
}

static void *run(void *of) {
    struct from_ros *thread = of;
    if (thread->is_urgent) run_first();
    else run_in_turn(); /* Fast DDS wakes it while it holds the lock of its reader */
    pthread_mutex_lock(&thread->lock);
    while (!thread->is_stopping && !thread->is_abandoned) serve_arrivals(thread);
    serve_rest(thread, thread->current, NULL);
    thread->has_ended = true;
    pthread_cond_broadcast(&thread->changed);
    pthread_mutex_unlock(&thread->lock);
    return NULL;
}

/* ---- public ---- */

/* Free a thread that is not running. */
static void from_ros_close(struct from_ros *thread) {
    if (thread->epoll >= 0) close(thread->epoll);
    if (thread->wake >= 0) close(thread->wake);
    pthread_cond_destroy(&thread->changed);
    pthread_mutex_destroy(&thread->lock);
    env_close(&thread->routing.env);
    free(thread->message.buffer);
    free(thread);
}

struct from_ros *from_ros_open(struct timers *timers, counter *counters, struct ring *events, take_function *take,
                               reset_function *reset, bool is_urgent) {
    struct from_ros *thread = calloc(1, sizeof *thread);
    if (!thread) return NULL;
    thread->take = take;
    thread->reset = reset;
    thread->is_urgent = is_urgent;
    thread->message.allocator = ALLOCATOR;
    pthread_mutex_init(&thread->lock, NULL);
    condition_open(&thread->changed);
    thread->epoll = epoll_create1(EPOLL_CLOEXEC);
    thread->wake = eventfd(0, EFD_CLOEXEC);
    bool is_open = env_open(&thread->routing.env, counters, events, timers);
    if (!is_open || thread->epoll < 0 || thread->wake < 0 || from_ros_watch(thread, thread->wake) ||
        thread_start(&thread->thread, is_urgent ? "ros urgent" : "ros messages", run, thread)) {
        from_ros_close(thread);
        return NULL;
    }
    return thread;
}

int from_ros_watch(struct from_ros *thread, int eventfd) {
    struct epoll_event interest = {.events = EPOLLIN | EPOLLET, .data.fd = eventfd};
    return epoll_ctl(thread->epoll, EPOLL_CTL_ADD, eventfd, &interest) ? errno : 0;
}

void from_ros_unwatch(struct from_ros *thread, int eventfd) { epoll_ctl(thread->epoll, EPOLL_CTL_DEL, eventfd, NULL); }

bool from_ros_serve(struct from_ros *thread, const struct ros_set *set) {
    struct timespec until = patience();
    pthread_mutex_lock(&thread->lock);
    thread->offered = set;
    eventfd_write(thread->wake, 1);
    while (thread->offered && !pthread_cond_timedwait(&thread->changed, &thread->lock, &until)) {}
    bool is_adopted = !thread->offered;
    thread->offered = NULL;
    pthread_mutex_unlock(&thread->lock);
    return is_adopted;
}

void from_ros_follow(struct from_ros *thread, struct from_ros *other) {
    struct ros_publisher known[MOST_PUBLISHERS];
    pthread_mutex_lock(&other->lock);
    memcpy(known, other->routing.publishers, sizeof known);
    pthread_mutex_unlock(&other->lock);
    pthread_mutex_lock(&thread->lock);
    for (int index = 0; index < MOST_PUBLISHERS; index++)
        if (known[index].number) follow_publisher(&thread->routing, &known[index]);
    pthread_mutex_unlock(&thread->lock);
}

bool from_ros_stop(struct from_ros *thread) {
    pthread_mutex_lock(&thread->lock);
    thread->is_stopping = true;
    pthread_mutex_unlock(&thread->lock);
    eventfd_write(thread->wake, 1);
    if (!thread_end(thread->thread, &thread->lock, &thread->changed, &thread->has_ended, &thread->is_abandoned)) return false;
    from_ros_close(thread);
    return true;
}

uint64_t from_ros_failures(struct from_ros *thread) {
    return atomic_load_explicit(&thread->failures, memory_order_relaxed);
}

bool from_ros_counters(struct from_ros *thread, int64_t *to, uint32_t count) {
    return counters_copy(&thread->edition, thread->routing.env.counters, to, count);
}
