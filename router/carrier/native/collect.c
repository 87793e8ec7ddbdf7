#include "collect.h"

#include <inttypes.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "envelope.h"
#include "evaluate.h"
#include "events.h"
#include "lists.h"
#include "payload.h"
#include "timers.h"
#include "wire.h"

/* The name of a frame, unique for a sender: an integer or text. The hash distinguishes most names. */
struct name {
    uint64_t hash;
    uint32_t sender, size; /* `size` of the text, or IS_INTEGER */
    union {
        int64_t integer;
        uint8_t text[LONGEST_NAME];
    };
};
#define IS_INTEGER UINT32_MAX

/* A datagram of a frame. */
struct part {
    struct name name;
    uint64_t count; /* may exceed the limit of a frame */
    uint32_t index;
};

struct frame {
    struct name name;
    bool is_open;
    int64_t ends_at;
    uint32_t count, held; /* parts: of the frame, and present ones */
    uint32_t bytes;       /* of their payloads */
    uint32_t stored;      /* and of their records */
    uint32_t places[MOST_PARTS]; /* offset of each part's record in the store, plus 1; 0 if missing */
};

/* In the store, before a payload. */
struct record {
    uint32_t size;         /* of the payload */
    uint32_t frame, index; /* the owner: the record is kept while that place of the frame points to it */
};

enum {
    MOST_PADDING = sizeof(uint32_t) - 1,
    LONGEST_RECORD = sizeof(struct record) + MAX_DATAGRAM + MOST_PADDING,
    MOST_STORED = MOST_PART_BYTES + LONGEST_RECORD + (MOST_PARTS + 1) * (sizeof(struct record) + MOST_PADDING),
    SLACK = 1 << 16,
    STORE = 2 * MOST_STORED + SLACK
};

struct collector {
    struct timer timer; /* first */
    struct timers *timers;
    int64_t timeout;
    const struct targets *to;
    struct frame *order[MOST_FRAMES]; /* open frames, the oldest first, then the others */
    uint32_t open, parts, bytes;      /* frames, their parts, and the bytes of those */
    uint32_t first_closed, closed;    /* of a ring, the oldest first */
    uint64_t closed_hashes[MOST_CLOSED];
    int64_t closed_until[MOST_CLOSED];
    struct name closed_names[MOST_CLOSED];
    uint8_t *store;          /* consecutive records; those that are no longer kept are skipped */
    uint32_t used, stored;   /* bytes in use, and bytes of kept records */
    struct frame frames[MOST_FRAMES];
};

/* ---- counting ---- */

enum { LONGEST_DETAIL = 80 };

/* Report the loss of a datagram or a frame for all topics of the route. */
static void lose_for_all(struct thread_env *env, const struct targets *to, int64_t now, struct lost_event lost,
                         const char *detail) {
    for (uint32_t index = 0; index < to->count; index++)
        lose_message(env, to, &to->targets[index], now, lost, detail);
}

static void lose(const struct collector *collector, int64_t now, const char *detail) {
    lose_for_all(collector->timers->env, collector->to, now, (struct lost_event){.reason = DROP_INCOMPLETE}, detail);
}

static void lose_large(const struct collector *collector, uint64_t count, int64_t now) {
    char detail[LONGEST_DETAIL];
    snprintf(detail, sizeof detail, "a frame of %" PRIu64 " parts, more than %d", count, MOST_PARTS);
    lose(collector, now, detail);
}

/* Count a datagram that is kept in a frame or is a duplicate. */
static void count_all(const struct collector *collector, bool is_kept) {
    const struct targets *to = collector->to;
    for (uint32_t index = 0; index < to->count; index++) {
        const struct target *target = &to->targets[index];
        env_count(collector->timers->env, is_kept ? target->collected : target->filtered, 1);
    }
}

/* ---- names ---- */

static uint64_t hash_of(const struct name *name) {
    const uint8_t *bytes = name->size == IS_INTEGER ? (const uint8_t *)&name->integer : name->text;
    uint32_t size = name->size == IS_INTEGER ? sizeof name->integer : name->size;
    uint64_t hash = 14695981039346656037u + name->sender; /* FNV-1a */
    for (uint32_t index = 0; index < size; index++) hash = (hash ^ bytes[index]) * 1099511628211u;
    return hash;
}

static bool is_same(const struct name *one, const struct name *other) {
    if (one->hash != other->hash || one->sender != other->sender || one->size != other->size) return false;
    if (one->size == IS_INTEGER) return one->integer == other->integer;
    return !memcmp(one->text, other->text, one->size);
}

static struct frame *find_frame(const struct collector *collector, const struct name *name) {
    for (uint32_t index = 0; index < collector->open; index++)
        if (is_same(&collector->order[index]->name, name)) return collector->order[index];
    return NULL;
}

static bool is_closed(const struct collector *collector, const struct name *name) {
    for (uint32_t left = collector->closed, at = collector->first_closed; left; left--, at = (at + 1) % MOST_CLOSED)
        if (collector->closed_hashes[at] == name->hash && is_same(&collector->closed_names[at], name)) return true;
    return false;
}

static void forget_first_closed(struct collector *collector) {
    collector->first_closed = (collector->first_closed + 1) % MOST_CLOSED;
    collector->closed--;
}

/* Remember a frame that has ended. */
static void note_closed(struct collector *collector, const struct name *name, int64_t now) {
    if (collector->closed == MOST_CLOSED) forget_first_closed(collector);
    uint32_t at = (collector->first_closed + collector->closed++) % MOST_CLOSED;
    collector->closed_names[at] = *name;
    collector->closed_hashes[at] = name->hash;
    collector->closed_until[at] = now + collector->timeout;
}

/* ---- the store ---- */

/* The length of the record of a payload, a multiple of the alignment of records. */
static uint32_t length_of(uint32_t size) {
    return ((uint32_t)sizeof(struct record) + size + MOST_PADDING) & ~(uint32_t)MOST_PADDING;
}

static struct record *record_at(const struct collector *collector, uint32_t at) {
    return (struct record *)(collector->store + at);
}

static struct value payload_of(const struct collector *collector, const struct frame *frame, uint32_t index) {
    const struct record *record = record_at(collector, frame->places[index] - 1);
    return (struct value){.bytes = (const uint8_t *)(record + 1), .size = record->size};
}

/* Move kept records to the beginning. */
static void compact(struct collector *collector) {
    uint32_t kept = 0;
    for (uint32_t at = 0, length; at < collector->used; at += length) {
        struct record record = *record_at(collector, at);
        struct frame *frame = &collector->frames[record.frame];
        length = length_of(record.size);
        if (!frame->is_open || frame->places[record.index] != at + 1) continue;
        memmove(collector->store + kept, collector->store + at, length);
        frame->places[record.index] = kept + 1;
        kept += length;
    }
    collector->used = kept;
}

/* Keep the payload of a datagram. There is room: kept records never take more than half of the store. */
static void keep(struct collector *collector, struct frame *frame, uint32_t index, const struct datagram *from) {
    uint32_t longest = length_of(from->size);
    if (collector->used + longest > 2 * (collector->stored + longest) + SLACK) compact(collector);
    struct record *record = record_at(collector, collector->used);
    uint32_t size = write_payload(from, (uint8_t *)(record + 1)), length = length_of(size);
    *record = (struct record){size, (uint32_t)(frame - collector->frames), index};
    frame->places[index] = collector->used + 1;
    frame->held++;
    frame->bytes += size;
    frame->stored += length;
    collector->used += length;
    collector->parts++;
    collector->bytes += size;
    collector->stored += length;
}

/* ---- frames ---- */

static struct frame *open_frame(struct collector *collector, const struct part *part, int64_t now) {
    struct frame *frame = collector->order[collector->open++];
    frame->name = part->name;
    frame->is_open = true;
    frame->ends_at = now + collector->timeout;
    frame->count = (uint32_t)part->count;
    frame->held = frame->bytes = frame->stored = 0;
    memset(frame->places, 0, part->count * sizeof *frame->places);
    return frame;
}

/* Its contents can be read until another part is kept. */
static void remove_frame(struct collector *collector, struct frame *frame) {
    uint32_t at = 0;
    while (collector->order[at] != frame) at++;
    memmove(&collector->order[at], &collector->order[at + 1], (--collector->open - at) * sizeof *collector->order);
    collector->order[collector->open] = frame;
    frame->is_open = false;
    collector->parts -= frame->held;
    collector->bytes -= frame->bytes;
    collector->stored -= frame->stored;
}

static void give_up(struct collector *collector, struct frame *frame, int64_t now) {
    char detail[LONGEST_DETAIL];
    snprintf(detail, sizeof detail, "%" PRIu32 " of %" PRIu32 " parts", frame->held, frame->count);
    remove_frame(collector, frame);
    lose(collector, now, detail);
}

static void close_oldest(struct collector *collector, int64_t now) {
    struct frame *frame = collector->order[0];
    give_up(collector, frame, now);
    note_closed(collector, &frame->name, now);
}

static void set_due(struct collector *collector) {
    int64_t due = collector->open ? collector->order[0]->ends_at : NEVER;
    timer_set_due(collector->timers, &collector->timer, due);
}

static void end_what_is_due(struct collector *collector, int64_t now) {
    while (collector->open && collector->order[0]->ends_at <= now) close_oldest(collector, now);
    while (collector->closed && collector->closed_until[collector->first_closed] <= now) forget_first_closed(collector);
}

/* Return the frame that this part completes, which is then removed, or NULL. */
static struct frame *offer(struct collector *collector, const struct part *part, const struct datagram *from, int64_t now) {
    struct frame *frame = find_frame(collector, &part->name);
    if (frame && frame->count != part->count) {
        give_up(collector, frame, now);
        frame = NULL;
    }
    if (is_closed(collector, &part->name) || (frame && frame->places[part->index])) {
        count_all(collector, false);
        return NULL;
    }
    if (frame) {
        count_all(collector, true);
    } else {
        if (collector->open == MOST_FRAMES) close_oldest(collector, now);
        frame = open_frame(collector, part, now);
    }
    keep(collector, frame, part->index, from);
    if (frame->held == frame->count) {
        remove_frame(collector, frame);
        note_closed(collector, &frame->name, now);
        return frame;
    }
    while (collector->parts > MOST_PARTS || collector->bytes > MOST_PART_BYTES) close_oldest(collector, now);
    return NULL;
}

/* ---- the timer ---- */

static void serve(struct timers *timers, struct timer *timer, int64_t now) {
    struct collector *collector = (struct collector *)timer;
    (void)timers;
    end_what_is_due(collector, now);
    set_due(collector);
}

static void adopt(struct timers *timers, struct timer *timer, const struct targets *to, const struct target *target) {
    struct collector *collector = (struct collector *)timer;
    (void)target;
    collector->timers = timers;
    collector->to = to;
    timers_add(timers, timer);
}

static void end(struct timers *timers, struct timer *timer, int64_t now) {
    struct collector *collector = (struct collector *)timer;
    while (collector->open) close_oldest(collector, now);
    set_due(collector);
    timers_remove(timers, timer);
}

static const struct timer_kind COLLECTOR = {serve, adopt, end};

struct collector *collector_open(int64_t timeout) {
    struct collector *collector = calloc(1, sizeof *collector);
    if (!collector) return NULL;
    collector->timer = (struct timer){.kind = &COLLECTOR, .due = NEVER};
    collector->timeout = timeout;
    for (uint32_t index = 0; index < MOST_FRAMES; index++) collector->order[index] = &collector->frames[index];
    collector->store = malloc(STORE);
    if (!collector->store) {
        free(collector);
        return NULL;
    }
    return collector;
}

void collector_close(struct collector *collector) {
    free(collector->store);
    free(collector);
}

/* ---- datagrams ---- */

/* Report that `collect` refuses a datagram. Returns false. */
static bool refuse(struct thread_env *env, const struct targets *to, const struct message *message, int reason,
                   const char *detail) {
    struct lost_event lost = {.reason = (uint32_t)reason, .generation = to->generation, .place = PLACE_COLLECT};
    lose_for_all(env, to, message->now, lost, detail);
    return false;
}

/* Report that the machine refuses it. Returns false. */
static bool refuse_value(struct thread_env *env, const struct targets *to, const struct message *message, int reason) {
    struct lost_event lost = {.reason = (uint32_t)reason, .generation = to->generation, .place = PLACE_COLLECT};
    for (uint32_t index = 0; index < to->count; index++)
        lose_refused(env, to, &to->targets[index], message->now, lost);
    return false;
}

/* Print an integer. */
static const char *printed(char *text, size_t size, int64_t number, uint32_t is_unsigned) {
    if (is_unsigned) snprintf(text, size, "%" PRIu64, (uint64_t)number);
    else snprintf(text, size, "%" PRId64, number);
    return text;
}

/* Whether a frame of `count` has the place `order`. */
static bool has_place(const struct collect *of, int64_t count, int64_t order) {
    bool is_count = count >= 0 || (of->signs & FIRST_UNSIGNED), is_place = order >= 0 || (of->signs & SECOND_UNSIGNED);
    return is_count && is_place && (uint64_t)order < (uint64_t)count;
}

static bool set_name(struct name *name, const struct collect *of, const struct value *by) {
    name->size = of->is_text ? by->size : IS_INTEGER;
    if (!of->is_text) name->integer = by->integer;
    else if (by->size > LONGEST_NAME) return false;
    else if (by->size) memcpy(name->text, by->bytes, by->size);
    name->hash = hash_of(name);
    return true;
}

/* Determine the frame and the part of a datagram. Return false, with all losses counted, if there is none. */
static bool identify(struct thread_env *env, const struct targets *to, const struct message *message, struct part *part) {
    const struct collect *of = to->collect;
    struct machine *machine = &env->machine;
    struct value by, count, order;
    char detail[LONGEST_DETAIL], numbers[2][24];
    uint32_t at;
    if (!read_datagram(machine, to->layout, to->sources, message->datagram)) return refuse_value(env, to, message, DROP_MAPPING_ERROR);
    part->name.sender = of->senders[message->datagram->column];
    int outcome = evaluate_value(machine, &of->by, &by, &at);
    if (outcome == EVALUATED && !set_name(&part->name, of, &by)) {
        snprintf(detail, sizeof detail, "'by' of %" PRIu32 " bytes, more than %d", by.size, LONGEST_NAME);
        return refuse(env, to, message, DROP_MAPPING_ERROR, detail);
    }
    if (outcome == EVALUATED) outcome = evaluate_value(machine, &of->count, &count, &at);
    if (outcome == EVALUATED) outcome = evaluate_value(machine, &of->order, &order, &at);
    if (outcome != EVALUATED) return refuse_value(env, to, message, outcome);
    if (!has_place(of, count.integer, order.integer)) {
        printed(numbers[0], sizeof numbers[0], count.integer, of->signs & FIRST_UNSIGNED);
        printed(numbers[1], sizeof numbers[1], order.integer, of->signs & SECOND_UNSIGNED);
        snprintf(detail, sizeof detail, "a frame of %s has no part %s", numbers[0], numbers[1]);
        return refuse(env, to, message, DROP_MAPPING_ERROR, detail);
    }
    part->count = count.bits;
    part->index = (uint32_t)order.bits; /* has no meaning for a frame that is too large */
    return true;
}

/* Keep a part. Return its frame if that is now complete, else NULL. */
static struct frame *take(struct timers *timers, struct collector *collector, const struct part *part,
                          const struct message *message) {
    struct frame *complete = NULL;
    pthread_mutex_lock(&timers->lock);
    end_what_is_due(collector, message->now);
    if (part->count > MOST_PARTS) lose_large(collector, part->count, message->now);
    else complete = offer(collector, part, message->datagram, message->now);
    set_due(collector);
    pthread_mutex_unlock(&timers->lock);
    return complete;
}

/* Read the first payload of a frame and the last envelope, and store the list of all payloads in the slot for `items`. */
static bool read_frame(struct machine *machine, const struct targets *to, const struct frame *frame,
                       const struct datagram *last) {
    const struct collect *of = to->collect;
    struct value first = payload_of(of->collector, frame, 0), items = {.size = 0};
    begin_datagram(machine, to->layout, to->sources, last);
    if (!machine_read(machine, first.bytes, first.size) || !machine_read_envelope(machine, last))
        return false;
    for (uint32_t index = 0; of->items != NONE && index < frame->count; index++)
        if (!list_add(machine, &items, payload_of(of->collector, frame, index)))
            return machine_refuse(machine, (struct refusal){.kind = REFUSED_ROOM});
    if (of->items != NONE) machine->slots[of->items] = items;
    if (of->counted != NONE) machine->slots[of->counted].integer = frame->count;
    return true;
}

bool collect(struct thread_env *env, const struct targets *to, struct message *message) {
    struct part part;
    if (!identify(env, to, message, &part)) return false;
    const struct frame *frame = take(env->timers, to->collect->collector, &part, message);
    if (!frame) return false;
    message->is_read = true;
    message->outcome = read_frame(&env->machine, to, frame, message->datagram) ? EVALUATED : DROP_MAPPING_ERROR;
    return true;
}
