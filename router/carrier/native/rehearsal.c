#include "rehearsal.h"

#include <stdlib.h>
#include <string.h>

#include "evaluate.h"
#include "route.h"

struct rehearsal {
    struct routing routing;
    struct ros_routing ros;
    struct stage publishing, timing; /* for messages to topics, and for timers */
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

static void append_record(struct rehearsal *rehearsal, const void *record, size_t size) {
    if (!size) return;
    if (rehearsal->size + size > rehearsal->capacity) {
        size_t capacity = rehearsal->capacity * 2 + size;
        uint8_t *larger = realloc(rehearsal->records, capacity);
        if (!larger) {
            rehearsal->is_incomplete = true;
            return;
        }
        rehearsal->records = larger;
        rehearsal->capacity = capacity;
    }
    memcpy(rehearsal->records + rehearsal->size, record, size);
    rehearsal->size += size;
}

/* Append a record, after the events that were reported before it. These have the time of the preceding record, which says
 * what was counted. */
static void note(struct rehearsal *rehearsal, const void *record, size_t size) {
    for (size_t taken; (taken = ring_take(rehearsal->events, rehearsal->taken, sizeof rehearsal->taken, 0));)
        append_record(rehearsal, rehearsal->taken, taken);
    if (rehearsal->noted_at != rehearsal->now) {
        struct time_record time = {.size = sizeof time, .kind = RECORD_TIME, .at = rehearsal->now};
        rehearsal->noted_at = rehearsal->now;
        append_record(rehearsal, &time, sizeof time);
    }
    append_record(rehearsal, record, size);
}

static void note_output(struct stage *stage, enum record_kind kind, uint32_t target, const void *data, size_t size) {
    static const uint8_t zeros[8];
    struct output_record record = {.size = padded_to_word(sizeof record + size), .kind = kind, .target = target,
                                   .length = (uint32_t)size};
    note(stage->rehearsal, &record, sizeof record);
    append_record(stage->rehearsal, data, size);
    append_record(stage->rehearsal, zeros, record.size - sizeof record - size);
}

/* ---- the stage ---- */

static void counted(struct stage *stage, uint32_t index, int64_t amount) {
    struct increment_record record = {.size = sizeof record, .kind = RECORD_INCREMENT, .amount = amount, .counter = index};
    note(stage->rehearsal, &record, sizeof record);
}

static int64_t simulated_now(struct stage *stage) { return stage->rehearsal->now; }

static int send_nowhere(struct stage *stage, const struct target *target, const uint8_t *data, size_t size, int64_t expires) {
    int64_t now = stage->rehearsal->now;
    if (now > expires) return COMMAND_STALE;
    note_output(stage, RECORD_SENT, target->id, data, size);
    if (target->feed_count) command_has_left(stage->rehearsal->timers, target->feeds, target->feed_count, 0, now);
    return 0;
}

static int brake_nowhere(struct stage *stage, const struct deadman_destination *to,
                         const struct deadman_datagram *datagram) {
    note_output(stage, RECORD_BRAKED, to->id, datagram->data, datagram->size);
    return 0;
}

static enum publication publish_nowhere(struct stage *stage, const struct target *target, const char **why) {
    (void)why;
    note_output(stage, RECORD_PUBLISHED, target->id, stage->machine.output.data, stage->machine.output.size);
    return PUBLISHED;
}

static bool open_stage(struct rehearsal *rehearsal, struct stage *stage, counter *counters) {
    bool is_open = stage_open(stage, counters, rehearsal->events, rehearsal->timers);
    stage->rehearsal = rehearsal;
    stage->counted = counted;
    stage->now = simulated_now;
    stage->send = send_nowhere;
    stage->brake = brake_nowhere;
    stage->publish = publish_nowhere;
    /* All losses are reported: the time window never ends. */
    stage->reporter.window_began = INT64_MAX;
    stage->reporter.left = UINT32_MAX;
    return is_open;
}

struct rehearsal *rehearsal_open(counter *counters, int64_t now) {
    struct rehearsal *rehearsal = calloc(1, sizeof *rehearsal);
    if (!rehearsal) return NULL;
    rehearsal->now = rehearsal->noted_at = now;
    rehearsal->events = ring_open(1 << 16);
    rehearsal->routing.published = ring_open(1 << 16); /* each message is taken at once */
    rehearsal->timers = timers_open_on(&rehearsal->timing, false);
    rehearsal->holding = timers_open_on(&rehearsal->publishing, false);
    struct stage *stages[] = {&rehearsal->routing.stage, &rehearsal->ros.stage, &rehearsal->timing, &rehearsal->publishing};
    bool is_open = rehearsal->events && rehearsal->routing.published && rehearsal->timers && rehearsal->holding;
    for (size_t index = 0; index < sizeof stages / sizeof *stages; index++)
        is_open &= open_stage(rehearsal, stages[index], counters);
    rehearsal->publishing.timers = rehearsal->holding;
    if (is_open) return rehearsal;
    rehearsal_close(rehearsal);
    return NULL;
}

void rehearsal_close(struct rehearsal *rehearsal) {
    stage_close(&rehearsal->routing.stage);
    stage_close(&rehearsal->ros.stage);
    stage_close(&rehearsal->timing);
    stage_close(&rehearsal->publishing);
    if (rehearsal->timers) timers_close(rehearsal->timers);
    if (rehearsal->holding) timers_close(rehearsal->holding);
    if (rehearsal->events) ring_close(rehearsal->events);
    if (rehearsal->routing.published) ring_close(rehearsal->routing.published);
    free(rehearsal->records);
    free(rehearsal);
}

struct timers *rehearsal_timers(struct rehearsal *rehearsal) { return rehearsal->timers; }

/* ---- messages ---- */

/* The work of the publish thread. */
static void publish_waiting(struct rehearsal *rehearsal) {
    _Alignas(8) uint8_t records[2 * sizeof(struct message_record) + MAX_DATAGRAM + 8];
    for (size_t size; (size = ring_take(rehearsal->routing.published, records, sizeof records, 0));)
        for (size_t at = 0; at < size;) {
            const struct message_record *record = (const struct message_record *)(records + at);
            route_to_topics(&rehearsal->publishing, record);
            at += record->size;
        }
}

void rehearsal_adopt(struct rehearsal *rehearsal, const struct change *change, const struct timer_change *published,
                     const struct ros_topic *topics) {
    routing_adopt(&rehearsal->routing, change);
    timers_change(rehearsal->holding, published);
    rehearsal->topics = topics;
}

void rehearsal_datagram(struct rehearsal *rehearsal, uint32_t listener, uint32_t address, uint32_t port, const void *data,
                        size_t size, int64_t arrived_at) {
    struct routing *routing = &rehearsal->routing;
    struct received received = {.listener = &routing->program->listeners[listener], .length = size, .address = address,
                                .port = port, .arrived_at = arrived_at, .now = rehearsal->now,
                                .received_at = rehearsal->now + rehearsal->ahead};
    size_t kept = size < MAX_DATAGRAM + 1 ? size : MAX_DATAGRAM + 1;
    if (kept) memcpy(routing->datagram, data, kept);
    route_datagram(routing, &received);
    publish_waiting(rehearsal);
}

void rehearsal_message(struct rehearsal *rehearsal, uint32_t topic, const void *data, size_t size, int64_t sent_at) {
    static const uint8_t gid[GID_SIZE];
    struct taken taken = {.data = data, .size = size, .published_at = sent_at, .now = rehearsal->now,
                          .received_at = rehearsal->now + rehearsal->ahead,
                          .publisher = find_publisher(&rehearsal->ros, gid, NO_NAME)};
    taken.publisher->sent = taken.publisher->stamped = INT64_MIN; /* any publisher may have sent it */
    route_ros_message(&rehearsal->ros, &rehearsal->topics[topic], &taken);
}

/* ---- time ---- */

static int64_t next_due(struct rehearsal *rehearsal) {
    int64_t one = atomic_load(&rehearsal->timers->wakes_at), other = atomic_load(&rehearsal->holding->wakes_at);
    return one < other ? one : other;
}

void rehearsal_advance(struct rehearsal *rehearsal, int64_t to) {
    for (int64_t due; (due = next_due(rehearsal)) <= to;) {
        if (due > rehearsal->now) rehearsal->now = due;
        timers_serve(rehearsal->holding, rehearsal->now);
        timers_serve(rehearsal->timers, rehearsal->now);
    }
    if (to > rehearsal->now) rehearsal->now = to;
}

void rehearsal_set_clock(struct rehearsal *rehearsal, int64_t ahead) { rehearsal->ahead = ahead; }

void rehearsal_end(struct rehearsal *rehearsal) {
    timers_end(rehearsal->holding);
    timers_end(rehearsal->timers);
}

/* ---- results ---- */

const void *rehearsal_records(struct rehearsal *rehearsal, size_t *size) {
    note(rehearsal, NULL, 0);
    *size = rehearsal->size;
    rehearsal->size = 0;
    return rehearsal->is_incomplete ? NULL : rehearsal->records;
}

/* ---- stand-alone conditions ---- */

static int evaluate_on_payload(struct machine *machine, const struct layout *layout, const struct routine *condition,
                               const struct value *source, int64_t received_at, const void *payload, size_t size,
                               bool *holds) {
    uint32_t at;
    if (!machine_open(machine)) return DROP_REASONS;
    machine_begin(machine, layout);
    machine->slots[SLOT_RECEIVED_AT].integer = received_at;
    machine->slots[SLOT_SOURCE] = *source;
    if (!machine_read(machine, payload, size)) return DROP_MAPPING_ERROR;
    return evaluate_condition(machine, condition, holds, &at);
}

int condition_holds(const struct layout *layout, const struct routine *condition, const struct value *source,
                    int64_t received_at, const void *payload, size_t size, bool *holds) {
    struct machine *machine = calloc(1, sizeof *machine);
    if (!machine) return DROP_REASONS;
    int outcome = evaluate_on_payload(machine, layout, condition, source, received_at, payload, size, holds);
    machine_close(machine);
    free(machine);
    return outcome;
}
