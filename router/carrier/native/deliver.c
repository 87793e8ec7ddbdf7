#include "deliver.h"

#include <errno.h>
#include <string.h>

#include "clock.h"
#include "defer.h"
#include "envelope.h"
#include "evaluate.h"

/* One message on its way to one target. */
struct delivery {
    struct thread_env *env;
    const struct targets *to;
    const struct target *target;
    struct message *message;
    int64_t expires; /* boot clock, ns; NEVER without `ttl` */
    const uint8_t *data; /* the bytes to send */
    size_t size;
};

/* ---- losses ---- */

enum { LONGEST_REFUSED = 48 /* reported bytes of a text */ };

static void count(const struct delivery *of, uint32_t which) { env_count(of->env, which, 1); }

static void note_lost(struct actions *actions, const struct thread_env *env, const struct lost_event *lost, const char *text) {
    struct action_record action = {.action = ACTION_LOST, .route = lost->route, .target = lost->target, .topic = lost->topic,
                                   .reason = lost->reason, .error = lost->error, .refusal = lost->refusal};
    actions_note(actions, env->counters, action, text, strlen(text));
}

void lose_message(struct thread_env *env, const struct targets *to, const struct target *target, int64_t now,
                  struct lost_event lost, const char *text) {
    lost.route = to->route;
    lost.topic = to->topic;
    lost.target = target->id;
    lost.counter = target->dropped[lost.reason];
    env_count(env, lost.counter, 1);
    report_loss(&env->reporter, now, lost, text);
    struct actions *observed = target->topic ? NULL : env_actions(env);
    if (observed) note_lost(observed, env, &lost, text);
}

void lose_refused(struct thread_env *env, const struct targets *to, const struct target *target, int64_t now,
                  struct lost_event lost) {
    const struct value *refused = &env->machine.refused;
    char text[LONGEST_REFUSED + 1] = {0};
    size_t size = refused->size < LONGEST_REFUSED ? refused->size : LONGEST_REFUSED;
    if (size) memcpy(text, refused->bytes, size);
    lost.refusal = env->machine.refusal;
    lose_message(env, to, target, now, lost, text);
}

void lose_stale(struct thread_env *env, const struct targets *to, const struct target *target, int64_t now, int64_t expires,
                enum refused since) {
    struct refusal refusal = {.kind = since, .values = {now - expires + to->ttl, to->ttl}};
    lose_message(env, to, target, now, (struct lost_event){.reason = DROP_STALE, .refusal = refusal}, "");
}

/* Report a loss. Returns false. */
static bool lose(const struct delivery *of, struct lost_event lost, const char *text) {
    lose_message(of->env, of->to, of->target, of->message->now, lost, text);
    return false;
}

/* Report that a place in the table refuses the message. Returns false. */
static bool refuse(const struct delivery *of, int reason, uint32_t place) {
    struct lost_event lost = {.reason = (uint32_t)reason, .generation = of->to->generation, .place = place};
    lose_refused(of->env, of->to, of->target, of->message->now, lost);
    return false;
}

/* ---- fields ---- */

void begin_datagram(struct machine *machine, const struct layout *layout, const struct value *sources,
                    const struct datagram *from) {
    machine_begin(machine, layout);
    machine->slots[SLOT_RECEIVED_AT].integer = from->received_at;
    machine->slots[SLOT_SOURCE] = sources[from->column];
}

bool read_datagram(struct machine *machine, const struct layout *layout, const struct value *sources,
                   const struct datagram *from) {
    begin_datagram(machine, layout, sources, from);
    const uint8_t *payload = from->data + from->start;
    bool is_read = from->is_single ? machine_read(machine, payload, from->length)
                                   : machine_read_pieces(machine, payload, from->length);
    return is_read && machine_read_envelope(machine, from);
}

/* Read the message, unless it was already read for another target. */
static bool is_readable(const struct delivery *of) {
    struct message *message = of->message;
    if (!message->is_read) {
        bool is_well_formed = read_datagram(&of->env->machine, of->to->layout, of->to->sources, message->datagram);
        message->outcome = is_well_formed ? EVALUATED : DROP_MAPPING_ERROR;
        message->is_read = true;
    }
    return message->outcome == EVALUATED || refuse(of, message->outcome, message->place);
}

/* ---- the steps: each returns whether to continue; otherwise the message is counted ---- */

static bool is_wanted(const struct delivery *of) {
    const struct topic *topic = of->target->topic;
    if (!topic || wanted_of(topic)) return true;
    count(of, of->target->filtered);
    return false;
}

static bool meets_condition(const struct delivery *of) {
    bool is_true;
    uint32_t at;
    int outcome = evaluate_condition(&of->env->machine, &of->target->condition, &is_true, &at);
    if (outcome != EVALUATED) return refuse(of, outcome, PLACE_CONDITION);
    if (!is_true) count(of, of->target->filtered);
    return is_true;
}

bool passes_gate(struct thread_env *env, const struct targets *to, const struct target *target) {
    bool is_true;
    uint32_t at;
    machine_begin(&env->machine, to->layout);
    if (evaluate_condition(&env->machine, &target->gate, &is_true, &at) == EVALUATED && is_true) return true;
    env_count(env, target->filtered, 1);
    return false;
}

/* The age of a message is uncertain: the oldest reading counts for a command to a board, the youngest for others. */
static int64_t expiry(const struct delivery *of) {
    struct time_range times = of->message->times;
    return of->to->ttl ? (of->target->board ? times.oldest : times.youngest) + of->to->ttl : NEVER;
}

static bool is_fresh(const struct delivery *of) {
    if (of->expires == NEVER) return true;
    int64_t now = of->env->now(of->env);
    if (now <= of->expires) return true;
    lose_stale(of->env, of->to, of->target, now, of->expires, of->message->since);
    return false;
}

static bool keeps_rate(const struct delivery *of) {
    struct limit *const *limits = of->target->limits;
    if (!limits || limit_passes(limits[source_of(of->message)], of->message->now)) return true;
    count(of, of->target->dropped[DROP_RATE_LIMITED]);
    return false;
}

static bool is_written(struct delivery *of) {
    uint32_t at;
    int outcome = evaluate_message(&of->env->machine, &of->target->message, &at);
    if (outcome != EVALUATED) return refuse(of, outcome, PLACE_OPERATIONS + at);
    of->data = of->env->machine.output.data;
    of->size = of->env->machine.output.size;
    return true;
}

static bool fits_board(const struct delivery *of) {
    struct board_refusal refusal;
    if (!of->target->board || board_takes(of->target->board, of->data, of->size, &refusal)) return true;
    return lose(of, (struct lost_event){.reason = refusal.reason}, refusal.text);
}

/* ---- the last step ---- */

/* The size of an envelope without its trailing zeros, if their number follows from the remaining bytes. */
static size_t trimmed_size(const uint8_t *data, size_t size) {
    size_t trimmed = size;
    while (trimmed && !data[trimmed - 1]) trimmed--;
    return envelope_restored_size(data, trimmed) == size ? trimmed : size;
}

static enum drop_reason drop_reason_of(int error) {
    bool is_full = error == EAGAIN || error == EWOULDBLOCK || error == ENOBUFS;
    return is_full ? DROP_SEND_BUFFER_FULL : DROP_SEND_ERROR;
}

static void lose_unsent(struct thread_env *env, const struct targets *to, const struct target *target, int64_t expires,
                        int64_t now, int error) {
    if (error == COMMAND_STALE) lose_stale(env, to, target, env->now(env), expires, REFUSED_WAITING);
    else lose_message(env, to, target, now, (struct lost_event){.reason = drop_reason_of(error), .error = error}, "");
}

static bool publish_it(struct thread_env *env, const struct targets *to, const struct target *target, int64_t now) {
    const char *why;
    switch (env->publish(env, to, target, &why)) {
    case PUBLISHED: env_count(env, target->delivered, 1); return true;
    case PUBLISH_FAILED:
        lose_message(env, to, target, now, (struct lost_event){.reason = DROP_PUBLISH_ERROR}, why);
        return true;
    default: return false;
    }
}

/* Note a command or a reply that was sent. A datagram that feeds no deadman is in the mirror as it was received. */
static void note_sent(struct actions *actions, const struct thread_env *env, const struct targets *to,
                      const struct target *target, const uint8_t *data, size_t size) {
    if (to->topic == NO_NAME && !target->feed_count && !target->message.count) return;
    struct action_record action = {.action = ACTION_SENT, .route = to->route, .target = target->id, .topic = to->topic};
    actions_note(actions, env->counters, action, data, size);
}

/* Like `deliver_now`; part of `deliver`, where each instruction counts. */
static inline bool leave(struct thread_env *env, const struct targets *to, const struct target *target, const uint8_t *data,
                         size_t size, int64_t expires, int64_t now) {
    if (target->topic) return publish_it(env, to, target, now);
    int error = env->send(env, target, data, size, expires);
    if (error) {
        lose_unsent(env, to, target, expires, now, error);
    } else {
        env_count(env, target->delivered, 1);
        env_count(env, target->delivered_bytes, (int64_t)size);
        struct actions *observed = env_actions(env);
        if (observed) note_sent(observed, env, to, target, data, size);
    }
    return true;
}

bool deliver_now(struct thread_env *env, const struct targets *to, const struct target *target, const uint8_t *data,
                 size_t size, int64_t expires, int64_t now) {
    return leave(env, to, target, data, size, expires, now);
}

bool deliver_begin(struct thread_env *env, const struct targets *to, const struct target *target, struct message *message) {
    struct delivery of = {.env = env, .to = to, .target = target, .message = message};
    of.expires = expiry(&of);
    return is_wanted(&of) && is_readable(&of) && is_fresh(&of);
}

bool deliver(struct thread_env *env, const struct targets *to, const struct target *target, struct message *message) {
    struct delivery of = {.env = env, .to = to, .target = target, .message = message};
    bool is_forwarded = !target->message.count, has_condition = target->condition.count;
    of.expires = expiry(&of);
    if (!is_wanted(&of)) return true;
    if ((has_condition || !is_forwarded) && !is_readable(&of)) return true;
    if (has_condition && !meets_condition(&of)) return true;
    if (!is_fresh(&of) || !keeps_rate(&of)) return true;
    if (is_forwarded) {
        of.data = message->datagram->data;
        of.size = message->datagram->size;
    } else if (!is_written(&of)) {
        return true;
    }
    if (!fits_board(&of)) return true;
    if (target->trims) of.size = trimmed_size(of.data, of.size);
    if (target->deferrals)
        return defer(env, target->deferrals[source_of(message)], of.data, of.size, of.expires, message->now);
    return leave(env, to, target, of.data, of.size, of.expires, message->now);
}

bool deliver_to_all(struct thread_env *env, const struct targets *to, struct message *message) {
    for (uint32_t index = 0; index < to->count; index++)
        if (!deliver(env, to, &to->targets[index], message)) return false;
    return true;
}

/* ---- the environment of this computer ---- */

static int64_t clock_now(struct thread_env *env) {
    (void)env;
    return boottime_ns();
}

static int64_t clock_wall(struct thread_env *env) {
    (void)env;
    return wall_ns();
}

/* The environment of the group fills the message and sends it. */
static int send_filled(struct timers *timers, const struct target *target, const uint8_t *data, size_t size, int64_t expires) {
    pthread_mutex_lock(&timers->lock);
    int error = timers->env->send(timers->env, target, data, size, expires);
    pthread_mutex_unlock(&timers->lock);
    return error;
}

/* `deliver` has checked the age; it is checked again only after waiting for the lock of deadmen. */
static int send_by_socket(struct thread_env *env, const struct target *target, const uint8_t *data, size_t size,
                          int64_t expires) {
    if (!target->is_ordered) return sender_send(target->sender, data, size);
    if (target->beside) return send_filled(env->timers, target, data, size, expires);
    return command_send(env->timers, target->sender, data, size, expires, target->feeds, target->feed_count);
}

static int brake_by_socket(struct thread_env *env, const struct deadman_destination *to,
                           const struct deadman_datagram *datagram) {
    (void)env;
    return sender_send_checked(to->sender, datagram->data, datagram->size);
}

bool env_open(struct thread_env *env, counter *counters, struct ring *events, struct timers *timers) {
    memset(env, 0, sizeof *env);
    env->counters = counters;
    env->reporter.events = events;
    env->timers = timers;
    env->now = clock_now;
    env->wall = clock_wall;
    env->send = send_by_socket;
    env->brake = brake_by_socket;
    if (!machine_open(&env->machine)) return false;
    env->machine.env = env;
    return true;
}

void env_close(struct thread_env *env) { machine_close(&env->machine); }
