#include "commands.h"

#include <errno.h>
#include <pthread.h>
#include <stdlib.h>
#include <string.h>
#include <sys/epoll.h>
#include <sys/eventfd.h>
#include <unistd.h>

#include "carrier_internal.h"
#include "clock.h"

enum {
    TURN = 32, /* messages of one topic before others have their turn */
    TOPICS_PER_WAIT = 16,
    LOOK_MS = 250, /* the longest time between two looks at the clocks */
    MOST_PUBLISHERS = 64,
};

/* A publisher sends its messages in order. By the oldest readings of its last message's stamps: */
struct publisher {
    uint8_t gid[GID_SIZE];
    int64_t sent, stamped; /* INT64_MIN if it is not known */
};

struct commands {
    pthread_t thread;
    pthread_mutex_t lock; /* held by the thread, unless it waits or is in the middleware */
    pthread_cond_t changed;
    /* Under the lock: */
    const struct command_set *current, *offered;
    bool is_stopping, has_ended, is_left;
    /* Written by the thread: */
    edition edition; /* of the counters */
    _Atomic uint64_t failures;
    /* Of the thread: */
    struct deadmen *deadmen;
    counter *counters;
    struct reporter reporter;
    take_function *take;
    reset_function *reset;
    struct freshness freshness;
    struct publisher publishers[MOST_PUBLISHERS];
    int epoll, wake;
    bool is_urgent;
    struct serialized_message message;
    struct slot slots[MOST_SLOTS];
    uint8_t datagram[MOST_CONVERTED];
};

/* A message that is served. */
struct command {
    const uint8_t *data;
    size_t size;
    int64_t published_at, arrived_at; /* wall clock of the sender, and of this computer; 0 if it is not known */
    int64_t received_at;              /* wall clock */
    int64_t now;                      /* boot clock */
    struct publisher *publisher;
};

/* ---- messages ---- */

static void lose_invalid(struct commands *commands, const struct command_route *route,
                         const struct command_target *target, int64_t now) {
    counter_add(commands->counters, target->mapping_error, 1);
    report_loss(&commands->reporter, now, route->id, target->destination.id, LOSS_MAPPING_ERROR, 0, target->mapping_error);
}

static void serve_target(struct commands *commands, const struct command_route *route,
                         const struct command_target *target, const struct command *command, struct born born) {
    const struct destination *to = &target->destination;
    int64_t expires = destination_expiry(to, born, route->ttl);
    if (!destination_may_send(commands->counters, to, command->now, expires)) return;
    size_t size;
    if (!datagram_write(target->writes, target->write_count, target->literals, command->data, commands->slots,
                        commands->datagram, &size)) {
        lose_invalid(commands, route, target, command->now);
        return;
    }
    const uint8_t *datagram = commands->datagram + MOST_CONVERTED - size;
    if (!destination_takes(commands->counters, &commands->reporter, command->now, route->id, to, datagram, size)) return;
    int error = destination_send(commands->deadmen, commands->counters, to, datagram, size, expires);
    if (error && error != COMMAND_STALE) report_send_error(&commands->reporter, command->now, route->id, to, error);
}

static struct born earlier_of(struct born one, struct born other) {
    if (other.oldest < one.oldest) one.oldest = other.oldest;
    if (other.youngest < one.youngest) one.youngest = other.youngest;
    return one;
}

/* When a message was sent by the sender's clock, or arrived if that is earlier: then the sender's clock is ahead. Its
 * arrival is not known to be in order, so of that the youngest reading counts. */
static struct born sent(struct commands *commands, const struct command *command) {
    int64_t stamp = command->published_at ? command->published_at : command->arrived_at;
    if (!stamp) stamp = command->received_at;
    struct born sent = freshness_born(&commands->freshness, stamp, command->received_at, command->now,
                                      command->publisher->sent);
    command->publisher->sent = sent.oldest;
    if (!command->published_at || !command->arrived_at) return sent;
    int64_t arrived = freshness_born(&commands->freshness, command->arrived_at, command->received_at, command->now,
                                     INT64_MIN).youngest;
    return earlier_of(sent, (struct born){arrived, arrived});
}

/* When the message was born: when it was sent, or when it was stamped, if that is earlier. */
static struct born born(struct commands *commands, const struct command_route *route, const struct command *command,
                        struct born sent) {
    if (route->seconds == NO_SLOT) return sent;
    int64_t seconds = message_integer(command->data, &commands->slots[route->seconds], SCALAR_INT32);
    int64_t nanoseconds = message_integer(command->data, &commands->slots[route->nanoseconds], SCALAR_UINT32);
    int64_t stamp = seconds * 1000000000 + nanoseconds;
    if (!stamp) return sent;
    struct born stamped = freshness_born(&commands->freshness, stamp, command->received_at, command->now,
                                         command->publisher->stamped);
    command->publisher->stamped = stamped.oldest;
    return earlier_of(sent, stamped);
}

static void serve_targets(struct commands *commands, const struct command_route *route, const struct command *command) {
    struct born when = {0, 0};
    if (route->ttl) when = sent(commands, command);
    counter_add(commands->counters, route->received, 1);
    bool is_valid = message_read(route->reads, route->read_count, command->data, command->size, commands->slots);
    if (is_valid && route->ttl) when = born(commands, route, command, when);
    for (uint32_t index = 0; index < route->target_count; index++) {
        if (is_valid) serve_target(commands, route, &route->targets[index], command, when);
        else lose_invalid(commands, route, &route->targets[index], command->now);
    }
}

/* Return what is known of a publisher. One with the same hash is forgotten. */
static struct publisher *find_publisher(struct commands *commands, const uint8_t *gid) {
    uint32_t hash = 2166136261; /* FNV-1a */
    for (int index = 0; index < GID_SIZE; index++) hash = (hash ^ gid[index]) * 16777619;
    struct publisher *found = &commands->publishers[hash % MOST_PUBLISHERS];
    if (memcmp(found->gid, gid, GID_SIZE)) {
        memcpy(found->gid, gid, GID_SIZE);
        found->sent = found->stamped = INT64_MIN;
    }
    return found;
}

static void serve_message(struct commands *commands, const struct command_topic *topic, const struct message_info *info) {
    struct command command = {.data = commands->message.buffer, .size = commands->message.length};
    command.now = boottime_ns();
    command.received_at = wall_ns();
    command.published_at = info->source_timestamp;
    command.arrived_at = info->received_timestamp;
    command.publisher = find_publisher(commands, info->publisher);
    for (uint32_t index = 0; index < topic->route_count; index++) {
        const struct command_route *route = &topic->routes[index];
        serve_targets(commands, route, &command);
        counter_set(commands->counters, route->last_message, command.received_at);
        count_duration(commands->counters, route->duration, boottime_ns() - command.now);
    }
}

/* ---- the middleware ---- */

/* Take a message, without the lock, and serve it. Return whether there was one. */
static bool serve_one(struct commands *commands, const struct command_topic *topic) {
    struct message_info info = {0};
    const void *subscription = topic->subscription; /* the topic may be gone if we are left in the middleware */
    pthread_mutex_unlock(&commands->lock);
    int error = commands->take(subscription, &commands->message, &info, NULL);
    bool has_failed = error && error != TAKE_FAILED;
    if (has_failed) {
        commands->reset();
        atomic_fetch_add_explicit(&commands->failures, 1, memory_order_relaxed);
    }
    pthread_mutex_lock(&commands->lock);
    if (error || commands->is_left) return false;
    edition_begin(&commands->edition);
    serve_message(commands, topic, &info);
    edition_end(&commands->edition);
    return true;
}

/* ---- the thread ---- */

static bool has_subscription(const struct command_set *set, const void *subscription) {
    for (uint32_t index = 0; index < set->count; index++)
        if (set->topics[index].subscription == subscription) return true;
    return false;
}

/* Serve what has arrived on the subscriptions of `set` that `next` does not have; NULL for none. */
static void serve_rest(struct commands *commands, const struct command_set *set, const struct command_set *next) {
    for (uint32_t index = 0; set && !commands->is_left && index < set->count; index++) {
        const struct command_topic *topic = &set->topics[index];
        if (next && has_subscription(next, topic->subscription)) continue;
        for (uint32_t left = topic->capacity; left && serve_one(commands, topic); left--) {}
    }
}

/* Serve another set if there is one. Return whether there was. */
static bool adopt(struct commands *commands) {
    const struct command_set *next = commands->offered;
    if (!next) return false;
    serve_rest(commands, commands->current, next);
    if (commands->offered != next) return true; /* nobody waits for it any more */
    commands->current = next;
    commands->offered = NULL;
    for (uint32_t index = 0; index < next->count; index++)
        eventfd_write(next->topics[index].eventfd, 1); /* for messages that have come before */
    pthread_cond_broadcast(&commands->changed);
    return true;
}

/* Whether the thread may go on with what it serves. */
static bool goes_on(struct commands *commands) {
    return !commands->is_left && !commands->is_stopping && !adopt(commands);
}

static const struct command_topic *find_topic(const struct command_set *set, int eventfd) {
    for (uint32_t index = 0; set && index < set->count; index++)
        if (set->topics[index].eventfd == eventfd) return &set->topics[index];
    return NULL;
}

/* Serve up to TURN messages. Return false if the set has changed, or the thread is to end. */
static bool serve_turn(struct commands *commands, const struct command_topic *topic) {
    for (int left = TURN; left; left--) {
        bool was_one = serve_one(commands, topic);
        if (!goes_on(commands)) return false;
        if (!was_one) return true;
    }
    eventfd_write(topic->eventfd, 1); /* the next wait returns it again */
    return true;
}

static void serve_arrivals(struct commands *commands) {
    struct epoll_event ready[TOPICS_PER_WAIT];
    pthread_mutex_unlock(&commands->lock);
    int count = epoll_wait(commands->epoll, ready, TOPICS_PER_WAIT, LOOK_MS);
    pthread_mutex_lock(&commands->lock);
    int64_t now = boottime_ns();
    freshness_look(&commands->freshness, wall_ns(), now);
    if (!goes_on(commands)) return;
    for (int index = 0; index < count; index++) {
        const struct command_topic *topic = find_topic(commands->current, ready[index].data.fd);
        if (topic && !serve_turn(commands, topic)) return;
    }
}

static void *commands_thread(void *of) {
    struct commands *commands = of;
    if (commands->is_urgent) run_first();
    else run_in_turn(); /* Fast DDS wakes it with the lock of its reader in hand */
    pthread_mutex_lock(&commands->lock);
    while (!commands->is_stopping && !commands->is_left) serve_arrivals(commands);
    serve_rest(commands, commands->current, NULL);
    commands->has_ended = true;
    pthread_cond_broadcast(&commands->changed);
    pthread_mutex_unlock(&commands->lock);
    return NULL;
}

/* ---- for others ---- */

static void commands_close(struct commands *commands) {
    if (commands->epoll >= 0) close(commands->epoll);
    if (commands->wake >= 0) close(commands->wake);
    pthread_cond_destroy(&commands->changed);
    pthread_mutex_destroy(&commands->lock);
    free(commands->message.buffer);
    free(commands);
}

struct commands *commands_open(struct deadmen *deadmen, counter *counters, struct ring *events, take_function *take,
                               reset_function *reset, bool is_urgent) {
    struct commands *commands = calloc(1, sizeof *commands);
    if (!commands) return NULL;
    commands->deadmen = deadmen;
    commands->counters = counters;
    commands->reporter.events = events;
    commands->take = take;
    commands->reset = reset;
    commands->is_urgent = is_urgent;
    commands->message.allocator = ALLOCATOR;
    pthread_mutex_init(&commands->lock, NULL);
    condition_open(&commands->changed);
    commands->epoll = epoll_create1(EPOLL_CLOEXEC);
    commands->wake = eventfd(0, EFD_CLOEXEC);
    if (commands->epoll < 0 || commands->wake < 0 || commands_watch(commands, commands->wake) ||
        start_thread(&commands->thread, is_urgent ? "ros commands" : "ros messages", commands_thread, commands)) {
        commands_close(commands);
        return NULL;
    }
    return commands;
}

int commands_watch(struct commands *commands, int eventfd) {
    struct epoll_event interest = {.events = EPOLLIN | EPOLLET, .data.fd = eventfd};
    return epoll_ctl(commands->epoll, EPOLL_CTL_ADD, eventfd, &interest) ? errno : 0;
}

void commands_unwatch(struct commands *commands, int eventfd) { epoll_ctl(commands->epoll, EPOLL_CTL_DEL, eventfd, NULL); }

bool commands_serve(struct commands *commands, const struct command_set *set) {
    struct timespec until = patience();
    pthread_mutex_lock(&commands->lock);
    commands->offered = set;
    eventfd_write(commands->wake, 1);
    while (commands->offered && !pthread_cond_timedwait(&commands->changed, &commands->lock, &until)) {}
    bool is_adopted = !commands->offered;
    commands->offered = NULL;
    pthread_mutex_unlock(&commands->lock);
    return is_adopted;
}

bool commands_stop(struct commands *commands) {
    struct timespec until = patience();
    pthread_mutex_lock(&commands->lock);
    commands->is_stopping = true;
    eventfd_write(commands->wake, 1);
    while (!commands->has_ended && !pthread_cond_timedwait(&commands->changed, &commands->lock, &until)) {}
    commands->is_left = !commands->has_ended;
    bool has_ended = commands->has_ended;
    pthread_mutex_unlock(&commands->lock);
    if (!has_ended) {
        pthread_detach(commands->thread);
        return false;
    }
    pthread_join(commands->thread, NULL);
    commands_close(commands);
    return true;
}

uint64_t commands_failures(struct commands *commands) {
    return atomic_load_explicit(&commands->failures, memory_order_relaxed);
}

bool commands_counters(struct commands *commands, int64_t *to, uint32_t count) {
    return counters_copy(&commands->edition, commands->counters, to, count);
}
