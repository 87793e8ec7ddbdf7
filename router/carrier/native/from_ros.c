#include "from_ros.h"

#include <errno.h>
#include <pthread.h>
#include <stdlib.h>
#include <string.h>
#include <sys/epoll.h>
#include <sys/eventfd.h>
#include <unistd.h>

#include "carrier_internal.h"
#include "clock.h"
#include "evaluate.h"
#include "lists.h"

enum {
    TURN = 32, /* messages of one topic before others have their turn */
    TOPICS_PER_WAIT = 16,
    LOOK_MS = 250, /* the longest time between two looks at the clocks */
    MOST_PUBLISHERS = 64,
    MOST_ELEMENTS = 1 << 16, /* that `for_each` sends of one message: the lock is held meanwhile */
};

/* A publisher sends its messages in order. By the oldest readings of its last message's stamps: */
struct publisher {
    uint8_t gid[GID_SIZE];
    int64_t sent, stamped; /* INT64_MIN if it is not known */
};

struct from_ros {
    struct stage stage;
    pthread_t thread;
    pthread_mutex_t lock; /* held by the thread, unless it waits or is in the middleware */
    pthread_cond_t changed;
    /* Under the lock: */
    const struct ros_set *current, *offered;
    bool is_stopping, has_ended, is_left;
    /* Written by the thread: */
    edition edition; /* of the counters */
    _Atomic uint64_t failures;
    /* Of the thread: */
    take_function *take;
    reset_function *reset;
    struct freshness freshness;
    struct publisher publishers[MOST_PUBLISHERS];
    int epoll, wake;
    bool is_urgent;
    struct serialized_message message;
};

/* A message that is served. */
struct served {
    const uint8_t *data;
    size_t size;
    int64_t published_at, arrived_at; /* wall clock of the sender, and of this computer; 0 if it is not known */
    int64_t received_at;              /* wall clock */
    int64_t now;                      /* boot clock */
    struct publisher *publisher;
};

/* ---- the age of a message ---- */

static struct born earlier_of(struct born one, struct born other) {
    if (other.oldest < one.oldest) one.oldest = other.oldest;
    if (other.youngest < one.youngest) one.youngest = other.youngest;
    return one;
}

/* When a message was sent by the sender's clock, or arrived if that is earlier: then the sender's clock is ahead. Its
 * arrival is not known to be in order, so of that the youngest reading counts. */
static struct born sent(struct from_ros *thread, const struct served *served) {
    int64_t stamp = served->published_at ? served->published_at : served->arrived_at;
    if (!stamp) stamp = served->received_at;
    struct born sent = freshness_born(&thread->freshness, stamp, served->received_at, served->now, served->publisher->sent);
    served->publisher->sent = sent.oldest;
    if (!served->published_at || !served->arrived_at) return sent;
    int64_t arrived = freshness_born(&thread->freshness, served->arrived_at, served->received_at, served->now,
                                     INT64_MIN).youngest;
    return earlier_of(sent, (struct born){arrived, arrived});
}

/* When the message was born: when it was sent, or when it was stamped, if that is earlier. */
static struct born born(struct from_ros *thread, const struct ros_route *route, const struct served *served,
                        struct born sent) {
    if (route->seconds == NONE) return sent;
    const struct value *slots = thread->stage.machine.slots;
    int64_t stamp = slots[route->seconds].integer * 1000000000 + slots[route->nanoseconds].integer;
    if (!stamp) return sent;
    struct born stamped = freshness_born(&thread->freshness, stamp, served->received_at, served->now,
                                         served->publisher->stamped);
    served->publisher->stamped = stamped.oldest;
    return earlier_of(sent, stamped);
}

/* ---- messages ---- */

/* Take an element off a list, and deliver it. The cells that this takes are freed afterwards. */
static void serve_element(struct from_ros *thread, const struct ros_route *route, struct message message,
                          struct value *list, int64_t index) {
    struct machine *machine = &thread->stage.machine;
    const struct for_each *each = &route->for_each;
    uint32_t cell_count = machine->cell_count;
    struct value item = list_next(machine, list, each->stored);
    if (each->index != NONE) machine->slots[each->index].integer = index;
    if (each->node == NONE) machine->slots[each->item] = item;
    else if (!machine_enter(machine, each->node, &item)) message.outcome = LOSS_MAPPING_ERROR;
    deliver_to_all(&thread->stage, &route->targets, &message);
    machine->cell_count = cell_count;
}

/* Deliver each element of the list of `for_each`. Return how many there were. A list that is refused or too long counts as
 * one message. */
static int64_t serve_each(struct from_ros *thread, const struct ros_route *route, struct message *message) {
    struct machine *machine = &thread->stage.machine;
    struct value list;
    uint32_t at;
    message->place = PLACE_FOR_EACH;
    message->outcome = evaluate_list(machine, &route->for_each.list, &list, &at);
    if (message->outcome == EVALUATED && list.size > MOST_ELEMENTS) message->outcome = LOSS_MAPPING_ERROR;
    if (message->outcome != EVALUATED) {
        deliver_to_all(&thread->stage, &route->targets, message);
        return 1;
    }
    int64_t count = list.size;
    if (route->for_each.count != NONE) machine->slots[route->for_each.count].integer = count;
    for (int64_t index = 0; index < count; index++) serve_element(thread, route, *message, &list, index);
    return count;
}

static void serve_route(struct from_ros *thread, const struct ros_route *route, const struct served *served) {
    struct message message = {.now = served->now, .is_read = true, .outcome = EVALUATED};
    struct machine *machine = &thread->stage.machine;
    int64_t count = 1;
    if (route->targets.ttl) message.born = sent(thread, served);
    machine_begin(machine, route->targets.layout);
    machine->slots[SLOT_RECEIVED_AT].integer = served->received_at;
    if (!machine_read(machine, 0, served->data, served->size)) message.outcome = LOSS_MAPPING_ERROR;
    else if (route->targets.ttl) message.born = born(thread, route, served, message.born);
    if (route->for_each.list.count && message.outcome == EVALUATED) count = serve_each(thread, route, &message);
    else deliver_to_all(&thread->stage, &route->targets, &message);
    stage_count(&thread->stage, route->received, count);
}

/* Return what is known of a publisher. One with the same hash is forgotten. */
static struct publisher *find_publisher(struct from_ros *thread, const uint8_t *gid) {
    uint32_t hash = 2166136261; /* FNV-1a */
    for (int index = 0; index < GID_SIZE; index++) hash = (hash ^ gid[index]) * 16777619;
    struct publisher *found = &thread->publishers[hash % MOST_PUBLISHERS];
    if (memcmp(found->gid, gid, GID_SIZE)) {
        memcpy(found->gid, gid, GID_SIZE);
        found->sent = found->stamped = INT64_MIN;
    }
    return found;
}

static void serve_message(struct from_ros *thread, const struct ros_topic *topic, const struct message_info *info) {
    struct served served = {.data = thread->message.buffer, .size = thread->message.length};
    served.now = boottime_ns();
    served.received_at = wall_ns();
    served.published_at = info->source_timestamp;
    served.arrived_at = info->received_timestamp;
    served.publisher = find_publisher(thread, info->publisher);
    for (uint32_t index = 0; index < topic->route_count; index++) {
        const struct ros_route *route = &topic->routes[index];
        serve_route(thread, route, &served);
        counter_set(thread->stage.counters, route->last_message, served.received_at);
        count_duration(thread->stage.counters, route->duration, boottime_ns() - served.now);
    }
}

/* ---- the middleware ---- */

/* Take a message, without the lock, and serve it. Return whether there was one. */
static bool serve_one(struct from_ros *thread, const struct ros_topic *topic) {
    struct message_info info = {0};
    const void *subscription = topic->subscription; /* the topic may be gone if we are left in the middleware */
    pthread_mutex_unlock(&thread->lock);
    int error = thread->take(subscription, &thread->message, &info, NULL);
    bool has_failed = error && error != TAKE_FAILED;
    if (has_failed) {
        thread->reset();
        atomic_fetch_add_explicit(&thread->failures, 1, memory_order_relaxed);
    }
    pthread_mutex_lock(&thread->lock);
    if (error || thread->is_left) return false;
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

/* Serve what has arrived on the subscriptions of `set` that `next` does not have; NULL for none. `next` may be taken back
 * meanwhile. */
static void serve_rest(struct from_ros *thread, const struct ros_set *set, const struct ros_set *next) {
    for (uint32_t index = 0; set && !thread->is_left && index < set->count; index++) {
        const struct ros_topic *topic = &set->topics[index];
        if (next && thread->offered != next) return;
        if (next && has_subscription(next, topic->subscription)) continue;
        for (uint32_t left = topic->capacity; left && serve_one(thread, topic); left--) {}
    }
}

/* Serve another set if there is one. Return whether there was. */
static bool adopt(struct from_ros *thread) {
    const struct ros_set *next = thread->offered;
    if (!next) return false;
    serve_rest(thread, thread->current, next);
    if (thread->offered != next) return true; /* nobody waits for it any more */
    thread->current = next;
    thread->offered = NULL;
    for (uint32_t index = 0; index < next->count; index++)
        eventfd_write(next->topics[index].eventfd, 1); /* for messages that have come before */
    pthread_cond_broadcast(&thread->changed);
    return true;
}

/* Whether the thread may go on with what it serves. */
static bool goes_on(struct from_ros *thread) {
    return !thread->is_left && !thread->is_stopping && !adopt(thread);
}

static const struct ros_topic *find_topic(const struct ros_set *set, int eventfd) {
    for (uint32_t index = 0; set && index < set->count; index++)
        if (set->topics[index].eventfd == eventfd) return &set->topics[index];
    return NULL;
}

/* Serve up to TURN messages. Return false if the set has changed, or the thread is to end. */
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
    freshness_look(&thread->freshness, wall_ns(), now);
    if (!goes_on(thread)) return;
    for (int index = 0; index < count; index++) {
        const struct ros_topic *topic = find_topic(thread->current, ready[index].data.fd);
        if (topic && !serve_turn(thread, topic)) return;
    }
}

static void *run(void *of) {
    struct from_ros *thread = of;
    if (thread->is_urgent) run_first();
    else run_in_turn(); /* Fast DDS wakes it with the lock of its reader in hand */
    pthread_mutex_lock(&thread->lock);
    while (!thread->is_stopping && !thread->is_left) serve_arrivals(thread);
    serve_rest(thread, thread->current, NULL);
    thread->has_ended = true;
    pthread_cond_broadcast(&thread->changed);
    pthread_mutex_unlock(&thread->lock);
    return NULL;
}

/* ---- for others ---- */

/* Free a thread that does not run. */
static void from_ros_close(struct from_ros *thread) {
    if (thread->epoll >= 0) close(thread->epoll);
    if (thread->wake >= 0) close(thread->wake);
    pthread_cond_destroy(&thread->changed);
    pthread_mutex_destroy(&thread->lock);
    stage_close(&thread->stage);
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
    bool is_open = stage_open(&thread->stage, counters, events, timers);
    if (!is_open || thread->epoll < 0 || thread->wake < 0 || from_ros_watch(thread, thread->wake) ||
        start_thread(&thread->thread, is_urgent ? "ros commands" : "ros messages", run, thread)) {
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

bool from_ros_stop(struct from_ros *thread) {
    struct timespec until = patience();
    pthread_mutex_lock(&thread->lock);
    thread->is_stopping = true;
    eventfd_write(thread->wake, 1);
    while (!thread->has_ended && !pthread_cond_timedwait(&thread->changed, &thread->lock, &until)) {}
    thread->is_left = !thread->has_ended;
    bool has_ended = thread->has_ended;
    pthread_mutex_unlock(&thread->lock);
    if (!has_ended) {
        pthread_detach(thread->thread);
        return false;
    }
    pthread_join(thread->thread, NULL);
    from_ros_close(thread);
    return true;
}

uint64_t from_ros_failures(struct from_ros *thread) {
    return atomic_load_explicit(&thread->failures, memory_order_relaxed);
}

bool from_ros_counters(struct from_ros *thread, int64_t *to, uint32_t count) {
    return counters_copy(&thread->edition, thread->stage.counters, to, count);
}
