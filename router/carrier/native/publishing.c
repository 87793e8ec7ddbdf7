#include "publishing.h"

#include <pthread.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

#include "carrier_internal.h"
#include "clock.h"

struct publishing {
    pthread_t thread;
    pthread_mutex_t lock; /* held by the thread, unless it waits or is in the middleware */
    pthread_cond_t changed;
    bool has_ended, is_left; /* under the lock */
    uint32_t held;           /* likewise: a generation, or 0 */
    _Atomic bool is_stopping;
    _Atomic uint32_t latest; /* generation */
    /* Written by the thread: */
    edition edition;             /* of the counters */
    _Atomic uint32_t generation; /* nothing of an earlier one is in use */
    _Atomic int64_t since;       /* when it entered the middleware, or 0 */
    _Atomic uint32_t topic;      /* where it did */
    /* Of the thread: */
    struct ring *ring;
    counter *counters;
    struct reporter reporter;
    publish_function *publish;
    error_function *error;
    reset_function *reset;
    struct composer composer;
    _Alignas(8) uint8_t records[2 * sizeof(struct message_record) + MAX_DATAGRAM + 8];
};

/* A message that is served. */
struct served {
    const struct message_record *record;
    const struct publish_route *route;
    bool is_read, is_valid; /* whether its fields were, and could be read */
    int64_t expires;
};

/* ---- outcomes ---- */

static uint32_t counter_of(const struct publish_target *target, enum loss reason) {
    switch (reason) {
    case LOSS_NON_FINITE: return target->non_finite;
    case LOSS_STALE: return target->stale;
    case LOSS_PUBLISH_ERROR: return target->publish_error;
    default: return target->mapping_error;
    }
}

/* Count and report a loss, with the place that refused or a text that says more. */
static void lose(struct publishing *publishing, const struct served *served, const struct publish_target *target,
                 enum loss reason, uint32_t place, const char *text) {
    struct lost_event lost = {.route = served->route->id, .target = target->topic->id, .reason = reason,
                              .counter = counter_of(target, reason), .program = (uint16_t)served->route->program,
                              .place = (uint16_t)place};
    counter_add(publishing->counters, lost.counter, 1);
    report_loss_because(&publishing->reporter, served->record->now, &lost, text);
}

/* ---- the middleware ---- */

/* Publish what was composed, without the lock. The counters balance meanwhile: the message waits. Return false if the
 * thread was left. */
static bool publish_composed(struct publishing *publishing, const struct served *served, const struct publish_target *target) {
    struct composed *composed = &publishing->composer.message;
    struct serialized_message message = {composed->data, composed->size, composed->capacity, ALLOCATOR};
    const void *publisher = target->topic->publisher;
    atomic_store_explicit(&publishing->topic, target->topic->id, memory_order_relaxed);
    atomic_store_explicit(&publishing->since, monotonic_ns(), memory_order_release);
    edition_end(&publishing->edition);
    pthread_mutex_unlock(&publishing->lock);
    int error = publishing->publish(publisher, &message, NULL);
    struct error_text why = {""};
    if (error) {
        why = publishing->error();
        publishing->reset();
    }
    pthread_mutex_lock(&publishing->lock);
    edition_begin(&publishing->edition);
    atomic_store_explicit(&publishing->since, 0, memory_order_relaxed);
    if (publishing->is_left) return false;
    if (error) lose(publishing, served, target, LOSS_PUBLISH_ERROR, PLACE_UNKNOWN, why.text);
    else counter_add(publishing->counters, target->published, 1);
    return true;
}

/* ---- messages ---- */

static bool read_fields(struct fields *fields, const struct served *served) {
    const struct message_record *record = served->record;
    const struct publish_route *route = served->route;
    const uint8_t *datagram = (const uint8_t *)(record + 1);
    fields->nodes = route->nodes;
    fields->defaults = route->defaults;
    fields->cell_count = 0;
    memcpy(fields->slots, route->defaults, route->slot_count * sizeof *fields->slots);
    fields->slots[SLOT_RECEIVED_AT].integer = record->received_at;
    fields->slots[SLOT_SOURCE] = route->sources[record->column];
    if (!record->is_single) return fields_read(fields, NODE_ENVELOPE, datagram, record->length);
    return fields_read(fields, NODE_PAYLOAD, datagram + record->start, record->payload_length);
}

static bool is_valid(struct publishing *publishing, struct served *served) {
    if (!served->is_read) served->is_valid = read_fields(&publishing->composer.fields, served);
    served->is_read = true;
    return served->is_valid;
}

/* Compose the message for a target if it is to have it. Return whether there is one now; else it is counted. */
static bool is_composed(struct publishing *publishing, struct served *served, const struct publish_target *target) {
    struct composer *composer = &publishing->composer;
    counter *counters = publishing->counters;
    bool is_true = true;
    uint32_t at, place = PLACE_UNKNOWN;
    int outcome = is_valid(publishing, served) ? COMPOSED : LOSS_MAPPING_ERROR;
    composer->literals = served->route->literals;
    if (outcome == COMPOSED && target->condition) {
        outcome = compose_condition(composer, target->condition, target->condition_count, &is_true, &at);
        if (outcome != COMPOSED) place = PLACE_CONDITION;
    }
    if (outcome == COMPOSED && !is_true) {
        counter_add(counters, target->filtered, 1);
        return false;
    }
    if (outcome == COMPOSED && served->expires != NEVER && boottime_ns() > served->expires) outcome = LOSS_STALE;
    if (outcome == COMPOSED && target->limit && !limit_passes(target->limit, served->record->now)) {
        counter_add(counters, target->rate_limited, 1);
        return false;
    }
    if (outcome == COMPOSED) {
        outcome = compose(composer, target->operations, target->operation_count, &at);
        if (outcome == COMPOSED) return true;
        place = PLACE_OPERATIONS + at;
    }
    lose(publishing, served, target, (enum loss)outcome, place, "");
    return false;
}

/* Serve a message. Return false if the thread was left meanwhile. */
static bool serve(struct publishing *publishing, const struct message_record *record) {
    const struct publish_route *route = record->part->publishes;
    struct served served = {.record = record, .route = route};
    served.expires = route->ttl ? record->youngest + route->ttl : NEVER;
    for (uint32_t index = 0; index < route->target_count; index++) {
        const struct publish_target *target = &route->targets[index];
        if (!__atomic_load_n(target->topic->wanted, __ATOMIC_RELAXED))
            counter_add(publishing->counters, target->filtered, 1);
        else if (is_composed(publishing, &served, target) && !publish_composed(publishing, &served, target))
            return false;
        counter_add(publishing->counters, target->waiting, -1);
    }
    return true;
}

/* ---- the thread ---- */

/* Take messages, without the lock. Return how many bytes they have. */
static size_t take(struct publishing *publishing, bool waits) {
    pthread_mutex_unlock(&publishing->lock);
    size_t size = ring_take(publishing->ring, publishing->records, sizeof publishing->records, waits ? -1 : 0);
    pthread_mutex_lock(&publishing->lock);
    return size;
}

/* Go on to a generation, unless it was reached, and wait there while it is held. */
static void reach(struct publishing *publishing, uint32_t generation) {
    if (generation <= atomic_load(&publishing->generation)) return;
    atomic_store(&publishing->generation, generation);
    while (publishing->held && publishing->held <= generation && !atomic_load(&publishing->is_stopping))
        pthread_cond_wait(&publishing->changed, &publishing->lock);
}

/* Serve what was taken. Return false if the thread was left meanwhile. */
static bool serve_all(struct publishing *publishing, size_t size) {
    for (size_t at = 0; at < size;) {
        const struct message_record *record = (const struct message_record *)(publishing->records + at);
        reach(publishing, record->generation);
        edition_begin(&publishing->edition);
        bool goes_on = serve(publishing, record);
        edition_end(&publishing->edition);
        if (!goes_on) return false;
        at += record->size;
    }
    return true;
}

static void *publishing_thread(void *of) {
    struct publishing *publishing = of;
    run_soon();
    pthread_mutex_lock(&publishing->lock);
    for (;;) {
        /* Read before the ring: what is there by now is served, and what comes later is of this generation at least. */
        uint32_t latest = atomic_load(&publishing->latest);
        bool is_stopping = atomic_load(&publishing->is_stopping);
        size_t size = take(publishing, !is_stopping && latest <= atomic_load(&publishing->generation));
        if (publishing->is_left || !serve_all(publishing, size) || (is_stopping && !size)) break;
        if (!size) reach(publishing, latest);
    }
    publishing->has_ended = true;
    pthread_cond_broadcast(&publishing->changed);
    pthread_mutex_unlock(&publishing->lock);
    return NULL;
}

/* ---- for others ---- */

static void publishing_close(struct publishing *publishing) {
    pthread_cond_destroy(&publishing->changed);
    pthread_mutex_destroy(&publishing->lock);
    composer_close(&publishing->composer);
    free(publishing);
}

struct publishing *publishing_open(struct ring *ring, counter *counters, struct ring *events, publish_function *publish,
                                   error_function *error, reset_function *reset) {
    struct publishing *publishing = calloc(1, sizeof *publishing);
    if (!publishing) return NULL;
    publishing->ring = ring;
    publishing->counters = counters;
    publishing->reporter.events = events;
    publishing->publish = publish;
    publishing->error = error;
    publishing->reset = reset;
    pthread_mutex_init(&publishing->lock, NULL);
    condition_open(&publishing->changed);
    if (!composer_open(&publishing->composer) ||
        start_thread(&publishing->thread, "publish", publishing_thread, publishing)) {
        publishing_close(publishing);
        return NULL;
    }
    return publishing;
}

void publishing_advance(struct publishing *publishing, uint32_t generation) {
    atomic_store(&publishing->latest, generation);
    ring_wake(publishing->ring);
}

bool publishing_has_reached(struct publishing *publishing, uint32_t generation) {
    return atomic_load(&publishing->generation) >= generation;
}

void publishing_hold(struct publishing *publishing, uint32_t generation) {
    pthread_mutex_lock(&publishing->lock);
    publishing->held = generation;
    pthread_cond_broadcast(&publishing->changed);
    pthread_mutex_unlock(&publishing->lock);
}

int64_t publishing_since(struct publishing *publishing, uint32_t *topic) {
    int64_t since = atomic_load_explicit(&publishing->since, memory_order_acquire);
    *topic = atomic_load_explicit(&publishing->topic, memory_order_relaxed);
    return since;
}

bool publishing_stop(struct publishing *publishing) {
    struct timespec until = patience();
    atomic_store(&publishing->is_stopping, true);
    ring_wake(publishing->ring);
    pthread_mutex_lock(&publishing->lock);
    pthread_cond_broadcast(&publishing->changed); /* if it is held */
    while (!publishing->has_ended && !pthread_cond_timedwait(&publishing->changed, &publishing->lock, &until)) {}
    bool has_ended = publishing->has_ended;
    publishing->is_left = !has_ended;
    pthread_mutex_unlock(&publishing->lock);
    if (!has_ended) {
        pthread_detach(publishing->thread);
        return false;
    }
    pthread_join(publishing->thread, NULL);
    publishing_close(publishing);
    return true;
}

bool publishing_counters(struct publishing *publishing, int64_t *to, uint32_t count) {
    return counters_copy(&publishing->edition, publishing->counters, to, count);
}
