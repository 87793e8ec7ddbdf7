#include "route.h"

#include <string.h>

#include "clock.h"
#include "collect.h"
#include "each.h"
#include "evaluate.h"
#include "events.h"
#include "hosts.h"
#include "learn.h"

/* ---- events ---- */

static void report(struct routing *routing, const struct received *received, struct datagram_event about) {
    if (!may_report(&routing->env.reporter, received->now)) return;
    struct datagram_event *event = (struct datagram_event *)routing->record;
    size_t kept = received->length < MAX_DATAGRAM ? received->length : MAX_DATAGRAM;
    *event = about;
    event->size = padded_to_word(sizeof *event + kept);
    event->listener = received->listener->id;
    event->address = received->address;
    event->port = received->port;
    event->length = (uint32_t)received->length;
    memcpy(event + 1, routing->datagram, kept);
    ring_put(routing->env.reporter.events, event, event->size);
}

static void reject(struct routing *routing, const struct received *received, enum reason reason) {
    const struct listener *listener = received->listener;
    struct datagram_event event = {.kind = EVENT_REJECTED, .reason = reason, .counter = listener->rejected[reason]};
    env_count(&routing->env, event.counter, 1);
    if (reason != IGNORED) report(routing, received, event);
}

static void report_superseded(struct routing *routing, const struct received *received) {
    struct datagram_event event = {.kind = EVENT_SUPERSEDED, .counter = received->listener->superseded};
    env_count(&routing->env, event.counter, received->envelope.others);
    report(routing, received, event);
}

/* ---- targets ---- */

static struct datagram datagram_of(const struct routing *routing, const struct received *received) {
    const struct envelope *envelope = &received->envelope;
    return (struct datagram){.data = routing->datagram, .size = envelope->size, .start = envelope->start,
                             .length = envelope->length, .is_single = envelope->is_single, .column = received->column,
                             .received_at = received->received_at};
}

static void send_to_all(struct routing *routing, const struct targets *to, const struct received *received) {
    struct datagram datagram = datagram_of(routing, received);
    struct message message = {.datagram = &datagram, .now = received->now, .times = received->times,
                              .since = REFUSED_ARRIVAL};
    deliver_to_all(&routing->env, to, &message);
}

/* What the subscribers of these topics want at most. Neither a `ttl` nor the parts of frames can wait until the newest
 * message is due. */
static enum wanted most_wanted(const struct targets *to) {
    if (to->collect) return EVERY_MESSAGE; /* frames are counted even without subscribers */
    enum wanted most = NOTHING;
    for (uint32_t index = 0; index < to->count; index++) {
        uint8_t wanted = wanted_of(to->targets[index].topic);
        if (wanted && (wanted != NEWEST_MESSAGE || to->ttl)) return EVERY_MESSAGE;
        if (wanted) most = NEWEST_MESSAGE;
    }
    return most;
}

static void drop_oldest(struct routing *routing, int64_t now) {
    struct message_record oldest;
    if (!ring_drop(routing->published, &oldest, sizeof oldest)) return;
    for (uint32_t index = 0; index < oldest.to->count; index++) {
        const struct target *target = &oldest.to->targets[index];
        env_count(&routing->env, target->waiting, -1);
        lose_message(&routing->env, oldest.to, target, now, (struct lost_event){.reason = DROP_QUEUE_FULL}, "");
    }
}

/* Have the publish thread deliver to topics, if one of them has subscribers. */
static void hand_over(struct routing *routing, const struct targets *to, const struct received *received) {
    enum wanted wanted = most_wanted(to);
    if (wanted == NOTHING) {
        for (uint32_t index = 0; index < to->count; index++)
            env_count(&routing->env, to->targets[index].filtered, 1);
        return;
    }
    struct message_record *record = (struct message_record *)routing->record;
    *record = (struct message_record){.size = padded_to_word(sizeof *record + received->envelope.size),
                                      .generation = routing->program->generation,
                                      .to = to,
                                      .received_at = received->received_at,
                                      .now = received->now,
                                      .oldest = received->times.oldest,
                                      .youngest = received->times.youngest,
                                      .column = received->column,
                                      .is_single = received->envelope.is_single,
                                      .length = received->envelope.size,
                                      .start = received->envelope.start,
                                      .payload_length = received->envelope.length};
    memcpy(record + 1, routing->datagram, received->envelope.size);
    for (uint32_t index = 0; index < to->count; index++)
        env_count(&routing->env, to->targets[index].waiting, 1);
    while (!(wanted == EVERY_MESSAGE ? ring_put : ring_put_quietly)(routing->published, record, record->size))
        drop_oldest(routing, received->now);
}

/* ---- witnesses ---- */

static bool meets_condition(struct machine *machine, const struct witness *witness, const struct datagram *datagram) {
    bool is_true = false;
    uint32_t at;
    return read_datagram(machine, witness->layout, witness->sources, datagram)
           && evaluate_condition(machine, &witness->condition, &is_true, &at) == EVALUATED && is_true;
}

/* Report what the sender of the datagram sends instead of obeying. */
static void report_evidence(struct routing *routing, const struct witness *witness, const struct datagram *datagram) {
    struct answer_event *event = (struct answer_event *)routing->record;
    *event = (struct answer_event){.size = padded_to_word(sizeof *event + datagram->size), .kind = EVENT_EVIDENCE,
                                   .deadman = witness->deadman_id, .destination = witness->endpoint_id,
                                   .after = datagram->size};
    memcpy(event + 1, datagram->data, datagram->size);
    ring_put(routing->env.reporter.events, event, event->size);
}

/* Show the datagram to deadmen that send to its sender. A condition without a result is not met. */
static void show_to_deadmen(struct routing *routing, const struct effects *effects, const struct received *received,
                            const struct datagram *datagram) {
    for (uint32_t index = 0; index < effects->witness_count; index++) {
        const struct witness *witness = &effects->witnesses[index];
        if (witness->column != received->column || !deadman_is_tripped(witness->deadman)) continue;
        bool obeys = meets_condition(&routing->env.machine, witness, datagram);
        if (deadman_is_shown(routing->env.timers, witness->deadman, witness->endpoint_id, obeys, received->times.oldest))
            report_evidence(routing, witness, datagram);
    }
}

/* Return the target that replies to a sender, or NULL. */
static const struct target *reply_to(const struct replies *replies, uint32_t column) {
    uint32_t index = replies->by_column[column];
    return index < replies->to.count ? &replies->to.targets[index] : NULL;
}

/* Reply to where the datagram came from, through the socket or the link that received it. */
static void reply(struct routing *routing, const struct replies *replies, const struct received *received,
                  const struct datagram *datagram) {
    const struct target *target = reply_to(replies, received->column);
    if (!target) return;
    struct message message = {.datagram = datagram, .now = received->now, .times = received->times,
                              .since = REFUSED_ARRIVAL};
    if (!received->listener->link) {
        sender_aim(target->sender, received->address, (uint16_t)received->port);
        sender_move(target->sender, received->listener->fd, received->listener->fd);
    }
    deliver(&routing->env, &replies->to, target, &message);
}

/* Set the states that the datagram sets, show it to deadmen, and reply. */
static void take_effect(struct routing *routing, const struct effects *effects, const struct received *received) {
    struct datagram datagram = datagram_of(routing, received);
    for (uint32_t index = 0; index < effects->setter_count; index++) {
        const struct setter *setter = &effects->setters[index];
        if (setter->column != received->column) continue;
        bool is_read = read_datagram(&routing->env.machine, setter->to.layout, setter->to.sources, &datagram);
        set_state(&routing->env, setter, is_read, received->times.oldest, received->now);
    }
    show_to_deadmen(routing, effects, received, &datagram);
    if (effects->replies) reply(routing, effects->replies, received, &datagram);
}

/* ---- order ---- */

/* A datagram is out of order, as `numbers` say; or if they are NULL, `order` has no value for this reason. */
static void lose_one(struct routing *routing, const struct targets *to, const struct target *target, int64_t now, int reason,
                     const struct refusal *numbers) {
    struct lost_event lost = {.reason = (uint32_t)reason};
    if (numbers) {
        lost.refusal = *numbers;
        lose_message(&routing->env, to, target, now, lost, "");
    } else {
        lost.generation = to->generation;
        lost.place = PLACE_ORDER;
        lose_refused(&routing->env, to, target, now, lost);
    }
}

static void lose_of(struct routing *routing, const struct targets *to, int64_t now, int reason, const struct refusal *numbers) {
    for (uint32_t index = 0; index < to->count; index++)
        lose_one(routing, to, &to->targets[index], now, reason, numbers);
}

static void lose_effects(struct routing *routing, const struct effects *effects, const struct received *received, int reason,
                         const struct refusal *numbers) {
    for (uint32_t index = 0; index < effects->setter_count; index++)
        if (effects->setters[index].column == received->column)
            lose_of(routing, &effects->setters[index].to, received->now, reason, numbers);
    const struct target *replying = effects->replies ? reply_to(effects->replies, received->column) : NULL;
    if (replying) lose_one(routing, &effects->replies->to, replying, received->now, reason, numbers);
}

/* Lose it for all targets, for the states that it would set, and for its reply. Returns false. */
static bool lose_for_all(struct routing *routing, const struct route *route, const struct received *received, int reason,
                         const struct refusal *numbers) {
    lose_of(routing, &route->sends, received->now, reason, numbers);
    lose_of(routing, &route->publishes, received->now, reason, numbers);
    if (route->effects) lose_effects(routing, route->effects, received, reason, numbers);
    return false;
}

static int number_of(struct routing *routing, const struct ordering *order, const struct received *received,
                     struct value *number) {
    struct datagram datagram = datagram_of(routing, received);
    struct machine *machine = &routing->env.machine;
    uint32_t at;
    if (!read_datagram(machine, order->layout, order->sources, &datagram)) return DROP_MAPPING_ERROR;
    return evaluate_value(machine, &order->number, number, &at);
}

/* Whether the datagram is newer than those of its sender that have passed. If it is not, or if its number does not exist, it is
 * lost. */
static bool is_in_order(struct routing *routing, const struct route *route, const struct received *received) {
    const struct ordering *order = route->order;
    struct value number;
    uint64_t last;
    int outcome = number_of(routing, order, received, &number);
    if (outcome != EVALUATED) return lose_for_all(routing, route, received, outcome, NULL);
    if (order_passes(order->state, received->address, received->port, number.bits, order->bits,
                     order->patience[received->column], received->now, &last))
        return true;
    struct refusal numbers = {.kind = REFUSED_ORDER, .flags = order->is_unsigned ? FIRST_UNSIGNED | SECOND_UNSIGNED : 0,
                              .values = {number.integer, (int64_t)last}};
    return lose_for_all(routing, route, received, DROP_OUT_OF_ORDER, &numbers);
}

/* ---- senders and payload cases ---- */

/* Return the sending endpoint, or NULL for a stranger. An endpoint with a port has priority over one without. It is inlined, as
 * each datagram needs it. */
static inline __attribute__((always_inline)) const struct peer *find_peer(const struct listener *listener, uint32_t address,
                                                                          uint32_t port) {
    uint32_t low = 0, high = listener->peer_count;
    while (low < high) {
        uint32_t middle = (low + high) / 2;
        if (listener->peers[middle].address < address) low = middle + 1;
        else high = middle;
    }
    for (; low < listener->peer_count && listener->peers[low].address == address; low++)
        if (!listener->peers[low].port || listener->peers[low].port == port) return &listener->peers[low];
    return NULL;
}

static const struct payload_case *find_case(const struct protocol *protocol, uint32_t number) {
    /* Most envelopes number their cases from 1 without gaps. */
    if (number - 1 < protocol->case_count && protocol->cases[number - 1].number == number) return &protocol->cases[number - 1];
    uint32_t low = 0, high = protocol->case_count;
    while (low < high) {
        uint32_t middle = (low + high) / 2;
        if (protocol->cases[middle].number < number) low = middle + 1;
        else high = middle;
    }
    return &protocol->cases[low]; /* envelope_read returns no other number */
}

/* ---- learned endpoints ---- */

static bool names_sender(const struct listener *listener, uint32_t number, uint32_t column) {
    const struct payload_case *found = find_case(listener->protocol, number);
    if (found->row < 0) return false;
    const struct choice *choices = &listener->choices[(uint32_t)found->row * listener->columns];
    return choices[column].route != choices[listener->columns - 1].route; /* the last one is for strangers */
}

/* Whether the datagram has a message for a route that names the endpoint in this column. */
static bool is_for_route_of(struct routing *routing, const struct received *received, uint32_t column) {
    const struct listener *listener = received->listener;
    const struct wire_schema *schema = &listener->protocol->schema;
    struct envelope envelope;
    if (envelope_read(schema, routing->datagram, received->length, listener->repairs, &envelope) != ROUTED) return false;
    if (!envelope.others || schema->case_by != BY_CASES) return names_sender(listener, envelope.case_number, column);
    struct bytes frame = {routing->datagram, routing->datagram + envelope.size};
    for (uint32_t number = 0; envelope_part(schema, frame, number, routing->frame, &envelope); number = envelope.case_number)
        if (names_sender(listener, envelope.case_number, column)) return true;
    return false;
}

/* Return the learned endpoint that the datagram is from, which may be learned from it; NULL for a stranger. */
static __attribute__((noinline)) const struct peer *find_learned(struct routing *routing, const struct received *received) {
    const struct listener *listener = received->listener;
    struct origin origin = {received->address, received->port};
    const struct peer *known = learned_at(&routing->env, listener, origin);
    for (uint32_t index = 0; !known && index < listener->learned_count; index++) {
        const struct learned_peer *learned = &listener->learned[index];
        if (!may_learn(&routing->env, learned, origin, received->now)) continue;
        if (!is_for_route_of(routing, received, learned->peer.column) || !host_keep(origin.address)) continue;
        learn(&routing->env, learned, origin);
        known = &learned->peer;
    }
    return known;
}

static void adopt_learned(struct thread_env *env, const struct listener *listener) {
    for (uint32_t index = 0; index < listener->learned_count; index++) {
        struct origin origin = learned_origin(env, &listener->learned[index]);
        learned_adopt(env, &listener->learned[index], find_peer(listener, origin.address, origin.port) != NULL);
    }
}

/* ---- routes ---- */

/* Return the index of the route with `order` that the datagram passes; NO_ROUTE, or ORDERED if it is lost. It is not inlined, as
 * other routes do not pay for it. */
static __attribute__((noinline)) int32_t route_in_order(struct routing *routing, const struct choice *choice,
                                                        struct received *received) {
    if (choice->route == NO_ROUTE) return NO_ROUTE;
    const struct route *chosen = &routing->program->routes[ORDERED - choice->route];
    if (is_in_order(routing, chosen, received)) return ORDERED - choice->route;
    received->route = chosen;
    env_count(&routing->env, choice->received, 1);
    return ORDERED;
}

/* Route a datagram. Return ROUTED, or the reason for rejecting it. */
static int route(struct routing *routing, const struct payload_case *found, struct received *received) {
    const struct program *program = routing->program;
    const struct listener *listener = received->listener;
    if (found->row < 0) {
        if (found->is_ignored) return IGNORED;
        env_count(&routing->env, found->unhandled, 1);
        return UNHANDLED;
    }
    const struct choice *choice = &listener->choices[(uint32_t)found->row * listener->columns + received->column];
    int32_t number = choice->route;
    if (number < 0 && (number = route_in_order(routing, choice, received)) < 0)
        return number == NO_ROUTE ? SOURCE_MISMATCH : ROUTED;
    const struct route *chosen = &program->routes[number];
    received->route = chosen;
    env_count(&routing->env, choice->received, 1);
    if (chosen->sends.count) send_to_all(routing, &chosen->sends, received);
    if (chosen->publishes.count) hand_over(routing, &chosen->publishes, received);
    if (__builtin_expect(chosen->effects != NULL, 0)) /* the order of the code favours routes without any */
        take_effect(routing, chosen->effects, received);
    counter_set(routing->env.counters, chosen->last_message, received->now);
    return ROUTED;
}

/* Route each message of a datagram that holds several, as a datagram of its own. Return ROUTED if one of them has a route, or the
 * reason for rejecting the last one. */
static __attribute__((noinline)) int route_each(struct routing *routing, struct received *received) {
    const struct protocol *protocol = received->listener->protocol;
    const struct envelope whole = received->envelope;
    size_t length = received->length;
    int outcome = UNHANDLED;
    memcpy(routing->frame, routing->datagram, whole.size);
    struct bytes frame = {routing->frame, routing->frame + whole.size};
    for (uint32_t number = 0; envelope_part(&protocol->schema, frame, number, routing->datagram, &received->envelope);) {
        number = received->envelope.case_number;
        received->length = received->envelope.size;
        int reason = route(routing, find_case(protocol, number), received);
        if (reason != ROUTED) reject(routing, received, (enum reason)reason);
        if (outcome != ROUTED) outcome = reason;
    }
    memcpy(routing->datagram, routing->frame, whole.size);
    received->envelope = whole;
    received->length = length;
    return outcome;
}

/* ---- silences ---- */

/* An endpoint is heard again, last time at `before` (0: never). If it had been heard for less time than it was silent, that
 * is its rhythm, not a silence. */
static void end_silence(struct routing *routing, const struct received *received, int64_t before) {
    const struct peer *peer = received->peer;
    counter *counters = routing->env.counters;
    int64_t heard_since = atomic_load_explicit(&counters[peer->heard_since], memory_order_relaxed);
    int64_t silence = received->now - before;
    counter_set(counters, peer->heard_since, received->now);
    if (!before || before - heard_since < silence) return;
    env_count(&routing->env, peer->silences, 1);
    counter_set(counters, peer->last_silence, silence);
    struct actions *observed = env_actions(&routing->env);
    struct action_record action = {.action = ACTION_RETURNED, .route = NO_NAME, .target = peer->id, .topic = NO_NAME};
    if (observed) actions_note(observed, counters, action, &silence, sizeof silence);
    struct returned_event event = {.kind = EVENT_RETURNED, .endpoint = peer->id, .silence = silence};
    if (may_report(&routing->env.reporter, received->now))
        put_event(routing->env.reporter.events, &event, sizeof event, "");
}

static void hear(struct routing *routing, const struct received *received) {
    const struct peer *peer = received->peer;
    counter *last_seen = &routing->env.counters[peer->last_seen];
    int64_t before = atomic_load_explicit(last_seen, memory_order_relaxed);
    atomic_store_explicit(last_seen, received->now, memory_order_relaxed);
    if (!before || received->now - before > peer->pause) end_silence(routing, received, before);
}

/* ---- public ---- */

int route_datagram(struct routing *routing, struct received *received) {
    const struct listener *listener = received->listener;
    int64_t arrived_at = received->arrived_at ? received->arrived_at : received->received_at;
    received->times = freshness_times(&routing->freshness, arrived_at, received->received_at, received->now, INT64_MIN);
    env_count(&routing->env, listener->received, 1);
    env_count(&routing->env, listener->received_bytes, (int64_t)received->length);
    const struct peer *peer = find_peer(listener, received->address, received->port);
    if (!peer && listener->learned_count) peer = find_learned(routing, received);
    received->peer = peer;
    received->column = peer ? peer->column : listener->columns - 1;
    received->route = NULL;
    if (peer) hear(routing, received);
    const struct protocol *protocol = listener->protocol;
    int reason = envelope_read(&protocol->schema, routing->datagram, received->length, listener->repairs,
                               &received->envelope);
    if (received->envelope.is_repaired) env_count(&routing->env, listener->padded, 1);
    if (received->envelope.others) {
        if (protocol->schema.case_by == BY_CASES) return route_each(routing, received);
        report_superseded(routing, received);
    }
    if (reason == UNKNOWN_CASE) env_count(&routing->env, protocol->unknown_case, 1);
    if (reason == ROUTED) reason = route(routing, find_case(protocol, received->envelope.case_number), received);
    if (reason != ROUTED) reject(routing, received, (enum reason)reason);
    return reason;
}

void route_bad_frame(struct routing *routing, struct received *received, enum reason reason) {
    received->length = 0; /* there is nothing to show */
    received->now = boottime_ns();
    reject(routing, received, reason);
}

void routing_adopt(struct routing *routing, const struct change *change) {
    for (uint32_t index = 0; index < change->replaced_count; index++)
        deadman_replace(routing->env.timers, change->replaced[2 * index], change->replaced[2 * index + 1]);
    timers_change(routing->env.timers, &change->timers);
    states_adopt(routing->env.timers, change->program->states, change->program->state_count);
    for (uint32_t index = 0; index < change->program->listener_count; index++)
        adopt_learned(&routing->env, &change->program->listeners[index]);
    routing->program = change->program;
}

bool route_to_topics(struct thread_env *env, const struct message_record *record) {
    const struct targets *to = record->to;
    struct datagram datagram = {.data = (const uint8_t *)(record + 1), .size = record->length, .start = record->start,
                                .length = record->payload_length, .is_single = record->is_single,
                                .column = record->column, .received_at = record->received_at};
    struct message message = {.datagram = &datagram, .now = record->now, .times = {record->oldest, record->youngest},
                              .since = REFUSED_ARRIVAL};
    bool is_delivered = !to->collect || collect(env, to, &message);
    for (uint32_t index = 0; index < to->count; index++) {
        const struct target *target = &to->targets[index];
        bool goes_on = !is_delivered || (target->for_each ? deliver_each(env, to, target, &message)
                                                          : deliver(env, to, target, &message));
        if (!goes_on) return false;
        env_count(env, target->waiting, -1);
    }
    return true;
}
