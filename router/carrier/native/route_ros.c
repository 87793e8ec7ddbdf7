#include "route_ros.h"

#include <string.h>

#include "each.h"
#include "evaluate.h"

/* ---- the age of a message ---- */

static struct time_range earlier_of(struct time_range one, struct time_range other) {
    if (other.oldest < one.oldest) one.oldest = other.oldest;
    if (other.youngest < one.youngest) one.youngest = other.youngest;
    return one;
}

/* The time of sending on the sender's clock, or of arrival if that is earlier because the sender's clock is ahead. Messages
 * may arrive out of order, so no reading of the arrival is excluded and the youngest one counts. */
static struct time_range sent(struct ros_routing *routing, const struct taken *taken) {
    int64_t stamp = taken->published_at ? taken->published_at : taken->arrived_at;
    if (!stamp) stamp = taken->received_at;
    struct time_range sent = freshness_times(&routing->freshness, stamp, taken->received_at, taken->now,
                                             taken->publisher->sent);
    taken->publisher->sent = sent.oldest;
    if (!taken->published_at || !taken->arrived_at) return sent;
    int64_t arrived = freshness_times(&routing->freshness, taken->arrived_at, taken->received_at, taken->now,
                                      INT64_MIN).youngest;
    return earlier_of(sent, (struct time_range){arrived, arrived});
}

/* If the stamp of a message is before its sending, its age counts from the stamp. */
static void date_by_stamp(struct ros_routing *routing, const struct ros_route *route, const struct taken *taken,
                          struct message *message) {
    if (route->seconds == NONE) return;
    const struct value *slots = routing->env.machine.slots;
    int64_t stamp = slots[route->seconds].integer * 1000000000 + slots[route->nanoseconds].integer;
    if (!stamp) return;
    struct time_range stamped = freshness_times(&routing->freshness, stamp, taken->received_at, taken->now,
                                                taken->publisher->stamped);
    taken->publisher->stamped = stamped.oldest;
    if (stamped.oldest < message->times.oldest) message->since = REFUSED_STAMP;
    message->times = earlier_of(message->times, stamped);
}

/* ---- messages ---- */

/* Deliver each element of the list of `for_each`. Return their number. A list that is refused or too long counts as one
 * message. */
static int64_t serve_each(struct ros_routing *routing, const struct ros_route *route, struct message *message) {
    struct machine *machine = &routing->env.machine;
    struct value list;
    if (!each_begin(machine, &route->for_each, message, &list)) {
        deliver_to_all(&routing->env, &route->targets, message);
        return 1;
    }
    int64_t count = list.size;
    for (int64_t index = 0; index < count; index++) {
        uint32_t cell_count = machine->cell_count;
        struct message element = *message;
        each_next(machine, &route->for_each, &element, &list, index);
        deliver_to_all(&routing->env, &route->targets, &element);
        machine->cell_count = cell_count;
    }
    return count;
}

/* ---- public ---- */

struct ros_publisher *find_publisher(struct ros_routing *routing, const uint8_t *gid, uint32_t topic) {
    uint32_t hash = 2166136261 ^ topic; /* FNV-1a */
    for (int index = 0; index < GID_SIZE; index++) hash = (hash ^ gid[index]) * 16777619;
    struct ros_publisher *found = &routing->publishers[hash % MOST_PUBLISHERS];
    if (memcmp(found->gid, gid, GID_SIZE) || found->topic != topic) {
        memcpy(found->gid, gid, GID_SIZE);
        found->topic = topic;
        found->number = 0;
        found->sent = found->stamped = INT64_MIN;
    }
    return found;
}

bool is_new(struct ros_publisher *publisher, uint64_t number) {
    if (number == NO_NUMBER) return true;
    if (number && number <= publisher->number) return false;
    publisher->number = number;
    return true;
}

void follow_publisher(struct ros_routing *routing, const struct ros_publisher *known) {
    struct ros_publisher *publisher = find_publisher(routing, known->gid, known->topic);
    if (publisher->number < known->number) *publisher = *known;
}

void route_ros(struct ros_routing *routing, const struct ros_route *route, const struct taken *taken) {
    struct message message = {.now = taken->now, .is_read = true, .outcome = EVALUATED,
                              .since = taken->published_at ? REFUSED_SENDING : REFUSED_ARRIVAL};
    struct machine *machine = &routing->env.machine;
    int64_t count = 1;
    bool is_dated = route->targets.ttl || route->setter;
    if (is_dated) message.times = sent(routing, taken);
    machine_begin(machine, route->targets.layout);
    machine->slots[SLOT_RECEIVED_AT].integer = taken->received_at;
    if (!machine_read(machine, taken->data, taken->size)) message.outcome = DROP_MAPPING_ERROR;
    else if (is_dated) date_by_stamp(routing, route, taken, &message);
    if (route->setter)
        set_state(&routing->env, route->setter, message.outcome == EVALUATED, message.times.oldest, taken->now);
    else if (route->for_each.list.count && message.outcome == EVALUATED) count = serve_each(routing, route, &message);
    else deliver_to_all(&routing->env, &route->targets, &message);
    env_count(&routing->env, route->received, count);
}

void route_ros_message(struct ros_routing *routing, const struct ros_topic *topic, const struct taken *taken) {
    struct thread_env *env = &routing->env;
    for (uint32_t index = 0; index < topic->route_count; index++) {
        const struct ros_route *route = &topic->routes[index];
        route_ros(routing, route, taken);
        counter_set(env->counters, route->last_message, taken->now);
        count_duration(env->counters, route->duration, LATENCY, env->now(env) - taken->now);
    }
}
