#include "simulation.h"

#include <errno.h>
#include <stdlib.h>
#include <string.h>

#include "evaluate.h"
#include "route.h"

struct simulation {
    struct routing routing;
    struct ros_routing ros;
    struct thread_env publishing, timing; /* for messages to topics, and for timers */
    struct timers *timers, *holding; /* of destinations, and of topics */
    struct ring *events;
    const struct ros_topic *topics;
    int64_t now, ahead;   /* boot clock; the lead of the wall clock */
    int64_t noted_at;     /* the time that the records have reached */
    uint8_t *records;
    size_t size, capacity;
    bool is_incomplete;   /* memory for a record has run out */
    _Alignas(8) uint8_t taken[2 * sizeof(struct message_record) + MAX_DATAGRAM + 8];
};

/* ---- records ---- */

static void append_record(struct simulation *simulation, const void *record, size_t size) {
    if (!size) return;
    if (simulation->size + size > simulation->capacity) {
        size_t capacity = simulation->capacity * 2 + size;
        uint8_t *larger = realloc(simulation->records, capacity);
        if (!larger) {
            simulation->is_incomplete = true;
            return;
        }
        simulation->records = larger;
        simulation->capacity = capacity;
    }
    memcpy(simulation->records + simulation->size, record, size);
    simulation->size += size;
}

/* Append a record, after the events that were reported before it. These have the time of the preceding record, which says
 * what was counted. */
static void note(struct simulation *simulation, const void *record, size_t size) {
    for (size_t taken; (taken = ring_take(simulation->events, simulation->taken, sizeof simulation->taken, 0));)
        append_record(simulation, simulation->taken, taken);
    if (simulation->noted_at != simulation->now) {
        struct time_record time = {.size = sizeof time, .kind = RECORD_TIME, .at = simulation->now};
        simulation->noted_at = simulation->now;
        append_record(simulation, &time, sizeof time);
    }
    append_record(simulation, record, size);
}

static void note_output(struct thread_env *env, enum record_kind kind, uint32_t target, const void *data, size_t size) {
    static const uint8_t zeros[8];
    struct output_record record = {.size = padded_to_word(sizeof record + size), .kind = kind, .target = target,
                                   .length = (uint32_t)size};
    note(env->simulation, &record, sizeof record);
    append_record(env->simulation, data, size);
    append_record(env->simulation, zeros, record.size - sizeof record - size);
}

/* ---- the environment of its threads ---- */

static void counted(struct thread_env *env, uint32_t index, int64_t amount) {
    struct increment_record record = {.size = sizeof record, .kind = RECORD_INCREMENT, .amount = amount, .counter = index};
    note(env->simulation, &record, sizeof record);
}

static int64_t simulated_now(struct thread_env *env) { return env->simulation->now; }

static int64_t simulated_wall(struct thread_env *env) { return env->simulation->now + env->simulation->ahead; }

static int send_nowhere(struct thread_env *env, const struct target *target, const uint8_t *data, size_t size, int64_t expires) {
    int64_t now = env->simulation->now;
    if (now > expires) return COMMAND_STALE;
    if (!sender_has_address(target->sender)) return EDESTADDRREQ;
    if (target->beside) beside_fill(target->beside, data, env->wall(env));
    note_output(env, RECORD_SENT, target->id, data, size);
    if (target->feed_count) command_has_left(env->simulation->timers, target->feeds, target->feed_count, 0, now);
    return 0;
}

static int brake_nowhere(struct thread_env *env, const struct deadman_destination *to,
                         const struct deadman_datagram *datagram) {
    if (!sender_has_address(to->sender)) return EDESTADDRREQ;
    note_output(env, RECORD_BRAKED, to->id, datagram->data, datagram->size);
    return 0;
}

static enum publication publish_nowhere(struct thread_env *env, const struct targets *to, const struct target *target,
                                        const char **why) {
    (void)to;
    (void)why;
    note_output(env, RECORD_PUBLISHED, target->id, env->machine.output.data, env->machine.output.size);
    return PUBLISHED;
}

static bool open_env(struct simulation *simulation, struct thread_env *env, counter *counters) {
    bool is_open = env_open(env, counters, simulation->events, simulation->timers);
    env->simulation = simulation;
    env->counted = counted;
    env->now = simulated_now;
    env->wall = simulated_wall;
    env->send = send_nowhere;
    env->brake = brake_nowhere;
    env->publish = publish_nowhere;
    /* All losses are reported: the time window never ends. */
    env->reporter.window_began = INT64_MAX;
    env->reporter.left = UINT32_MAX;
    return is_open;
}

struct simulation *simulation_open(counter *counters, int64_t now) {
    struct simulation *simulation = calloc(1, sizeof *simulation);
    if (!simulation) return NULL;
    simulation->now = simulation->noted_at = now;
    simulation->events = ring_open(1 << 16);
    simulation->routing.published = ring_open(1 << 16); /* each message is taken at once */
    simulation->timers = timers_open_on(&simulation->timing, false);
    simulation->holding = timers_open_on(&simulation->publishing, false);
    struct thread_env *envs[] = {&simulation->routing.env, &simulation->ros.env, &simulation->timing, &simulation->publishing};
    bool is_open = simulation->events && simulation->routing.published && simulation->timers && simulation->holding;
    for (size_t index = 0; index < sizeof envs / sizeof *envs; index++)
        is_open &= open_env(simulation, envs[index], counters);
    simulation->publishing.timers = simulation->holding;
    if (is_open) return simulation;
    simulation_close(simulation);
    return NULL;
}

void simulation_close(struct simulation *simulation) {
    env_close(&simulation->routing.env);
    env_close(&simulation->ros.env);
    env_close(&simulation->timing);
    env_close(&simulation->publishing);
    if (simulation->timers) timers_close(simulation->timers);
    if (simulation->holding) timers_close(simulation->holding);
    if (simulation->events) ring_close(simulation->events);
    if (simulation->routing.published) ring_close(simulation->routing.published);
    free(simulation->records);
    free(simulation);
}

struct timers *simulation_timers(struct simulation *simulation) { return simulation->timers; }

/* ---- messages ---- */

/* The work of the publish thread. */
static void publish_waiting(struct simulation *simulation) {
    _Alignas(8) uint8_t records[2 * sizeof(struct message_record) + MAX_DATAGRAM + 8];
    for (size_t size; (size = ring_take(simulation->routing.published, records, sizeof records, 0));)
        for (size_t at = 0; at < size;) {
            const struct message_record *record = (const struct message_record *)(records + at);
            route_to_topics(&simulation->publishing, record);
            at += record->size;
        }
}

void simulation_adopt(struct simulation *simulation, const struct change *change, const struct timer_change *published,
                     const struct ros_topic *topics) {
    routing_adopt(&simulation->routing, change);
    timers_change(simulation->holding, published);
    simulation->topics = topics;
}

void simulation_datagram(struct simulation *simulation, uint32_t listener, uint32_t address, uint32_t port, const void *data,
                        size_t size, int64_t arrived_at) {
    struct routing *routing = &simulation->routing;
    struct received received = {.listener = &routing->program->listeners[listener], .length = size, .address = address,
                                .port = port, .arrived_at = arrived_at, .now = simulation->now,
                                .received_at = simulation->now + simulation->ahead};
    size_t kept = size < MAX_DATAGRAM + 1 ? size : MAX_DATAGRAM + 1;
    if (kept) memcpy(routing->datagram, data, kept);
    route_datagram(routing, &received);
    publish_waiting(simulation);
}

void simulation_message(struct simulation *simulation, uint32_t topic, const void *data, size_t size, int64_t sent_at) {
    static const uint8_t gid[GID_SIZE];
    struct taken taken = {.data = data, .size = size, .published_at = sent_at, .now = simulation->now,
                          .received_at = simulation->now + simulation->ahead,
                          .publisher = find_publisher(&simulation->ros, gid, NO_NAME)};
    taken.publisher->sent = taken.publisher->stamped = INT64_MIN; /* any publisher may have sent it */
    route_ros_message(&simulation->ros, &simulation->topics[topic], &taken);
}

void simulation_send_again(struct simulation *simulation, uint32_t topic, const void *data, size_t size) {
    const struct ros_route *route = &simulation->topics[topic].routes[0];
    struct target again = route->targets.targets[0];
    again.beside = NULL; /* it is filled already */
    env_count(&simulation->ros.env, route->received, 1);
    deliver_now(&simulation->ros.env, &route->targets, &again, data, size, NEVER, simulation->now);
}

/* ---- time ---- */

static int64_t next_due(struct simulation *simulation) {
    int64_t one = atomic_load(&simulation->timers->wakes_at), other = atomic_load(&simulation->holding->wakes_at);
    return one < other ? one : other;
}

void simulation_advance(struct simulation *simulation, int64_t to) {
    for (int64_t due; (due = next_due(simulation)) <= to;) {
        if (due > simulation->now) simulation->now = due;
        timers_serve(simulation->holding, simulation->now);
        timers_serve(simulation->timers, simulation->now);
    }
    if (to > simulation->now) simulation->now = to;
}

void simulation_set_clock(struct simulation *simulation, int64_t ahead) { simulation->ahead = ahead; }

void simulation_end(struct simulation *simulation) {
    timers_end(simulation->holding);
    timers_end(simulation->timers);
}

/* ---- results ---- */

const void *simulation_records(struct simulation *simulation, size_t *size) {
    note(simulation, NULL, 0);
    *size = simulation->size;
    simulation->size = 0;
    return simulation->is_incomplete ? NULL : simulation->records;
}

/* ---- stand-alone conditions ---- */

static int evaluate_on_payload(struct machine *machine, const struct layout *layout, const struct routine *condition,
                               int64_t received_at, const struct value *source, const struct value *payload,
                               const struct value *beside, bool *holds) {
    uint32_t at;
    if (!machine_open(machine)) return DROP_REASONS;
    machine_begin(machine, layout);
    machine->slots[SLOT_RECEIVED_AT].integer = received_at;
    machine->slots[SLOT_SOURCE] = *source;
    bool is_read = machine_read(machine, payload->bytes, payload->size);
    struct datagram envelope = {.data = beside->bytes, .size = beside->size};
    if (!is_read || !machine_read_envelope(machine, &envelope)) return DROP_MAPPING_ERROR;
    return evaluate_condition(machine, condition, holds, &at);
}

int condition_holds(const struct layout *layout, const struct routine *condition, int64_t received_at,
                    const struct value *source, const struct value *payload, const struct value *beside, bool *holds) {
    struct machine *machine = calloc(1, sizeof *machine);
    if (!machine) return DROP_REASONS;
    int outcome = evaluate_on_payload(machine, layout, condition, received_at, source, payload, beside, holds);
    machine_close(machine);
    free(machine);
    return outcome;
}
